"""What evaluates ray sensors together: one query of the engine for all that see the same geoms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import torch

if TYPE_CHECKING:
    from mjlab.sensor.raycast_sensor import RayCastSensor

RayCast = Callable[..., tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
"""`Simulation.raycast`: origins, directions, geom groups, excluded bodies, reach of each ray."""


class SensorContext:
    """Evaluates the ray sensors of a scene, when `Simulation.sense` calls `sense`.

    Sensors that see the same geom groups share one buffer and one query, whatever their patterns,
    reaches and excluded bodies.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        model: Any,
        data: Any,
        camera_sensors: list[Any],
        raycast_sensors: Sequence[RayCastSensor],
        device: str,
    ) -> None:
        """Give the initialized sensors their parts of the buffers.

        Args:
            mj_model: The compiled model.
            model: The simulation's model fields.
            data: The simulation's data fields.
            camera_sensors: Camera sensors; there are none yet.
            raycast_sensors: Ray sensors.
            device: Torch device of all tensors.
        """
        self._model, self._data, self._device = model, data, device
        self._camera_sensors = camera_sensors
        self._raycast_sensors = list(raycast_sensors)
        self.recreate(mj_model)

    def recreate(self, mj_model: mujoco.MjModel, expanded_fields: set[str] | None = None) -> None:
        """Build the buffers anew, for a model that has changed."""
        by_groups: dict[Any, list[RayCastSensor]] = {}
        for sensor in self._raycast_sensors:
            groups = sensor.include_geom_groups
            key = None if groups is None else tuple(sorted(set(groups)))
            by_groups.setdefault(key, []).append(sensor)
            sensor.set_context(self)
        num_envs = self._data.qpos.shape[0] if by_groups else 0
        self._queries = [
            _RayQuery(groups, sensors, num_envs, self._device)
            for groups, sensors in by_groups.items()
        ]

    @property
    def has_cameras(self) -> bool:
        """Whether there are camera sensors."""
        return bool(self._camera_sensors)

    @property
    def has_raycasts(self) -> bool:
        """Whether there are ray sensors."""
        return bool(self._raycast_sensors)

    def sense(self, raycast: RayCast) -> None:
        """Evaluate all sensors at the current poses; `raycast` is the engine's query."""
        self.prepare()
        for query in self._queries:
            query.cast(raycast)
        self.finalize()

    def prepare(self) -> None:
        """Compute all rays in the world frame."""
        for sensor in self._raycast_sensors:
            sensor.prepare_rays()

    def finalize(self) -> None:
        """Tell the sensors that they have new results."""
        for sensor in self._raycast_sensors:
            sensor.postprocess_rays()


class _RayQuery:
    """The rays of all sensors that see the same geom groups, one after the other."""

    def __init__(
        self,
        groups: tuple[int, ...] | None,
        sensors: list[RayCastSensor],
        num_envs: int,
        device: str,
    ) -> None:
        self._groups = groups
        self._sensors = sensors
        ends = torch.tensor([sensor.num_rays for sensor in sensors]).cumsum(0).tolist()
        self._parts = [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]
        self._origins = torch.zeros(num_envs, ends[-1], 3, device=device)
        self._directions = torch.zeros(num_envs, ends[-1], 3, device=device)
        for sensor, part in zip(sensors, self._parts, strict=True):
            sensor.set_buffers(self._origins[:, part], self._directions[:, part])
        excluded = [body for sensor in sensors for body in sensor.excluded_bodies]
        self._excluded = torch.tensor(excluded, dtype=torch.int32, device=device)
        reach = [sensor.cfg.max_distance for sensor in sensors for _ in range(sensor.num_rays)]
        self._reach = torch.tensor(reach, device=device)

    def cast(self, raycast: RayCast) -> None:
        distances, normals, _ = raycast(
            self._origins, self._directions, self._groups, self._excluded, self._reach
        )
        for sensor, part in zip(self._sensors, self._parts, strict=True):
            sensor.set_results(distances[:, part], normals[:, part])
