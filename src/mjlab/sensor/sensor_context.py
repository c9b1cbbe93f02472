"""What evaluates camera and ray sensors, with as few queries of the engine as possible."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.utils.errors import UnknownAttributeError
from mjlab.utils.state import capture_state, restore_state

if TYPE_CHECKING:
    from mjlab.sensor.camera_sensor import CameraSensor
    from mjlab.sensor.raycast_sensor import RayCastSensor
    from mjlab.sim.engine import CameraView, Images

RayCast = Callable[..., tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
"""`Simulation.raycast`: origins, directions, geom groups, excluded bodies, reach of each ray."""

Render = Callable[[tuple["CameraView", ...]], list["Images"]]
"""`Simulation.render`: views to images."""


class SensorContext:
    """Evaluates the camera and ray sensors of a scene, when `Simulation.sense` calls `sense`.

    Ray sensors that see the same geom groups share one buffer and one query, whatever their
    patterns, reaches and excluded bodies. All cameras are one query, and each keeps geom groups,
    textures and shadows for itself.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        model: Any,
        data: Any,
        camera_sensors: list[CameraSensor],
        raycast_sensors: Sequence[RayCastSensor],
        device: str,
    ) -> None:
        """Give the initialized sensors their parts of the buffers.

        Args:
            mj_model: The compiled model.
            model: The simulation's model fields.
            data: The simulation's data fields.
            camera_sensors: Camera sensors.
            raycast_sensors: Ray sensors.
            device: Torch device of all tensors.

        Raises:
            ValueError: two sensors want one camera to have two projections.
        """
        _check_shared_cameras(camera_sensors)
        self._model, self._data, self._device = model, data, device
        self._camera_sensors = list(camera_sensors)
        self._find_render_context: Callable[..., Any] | None = None
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
        for camera in self._camera_sensors:
            camera.set_context(self)
        self._views = tuple(camera.view for camera in self._camera_sensors)

    @property
    def has_cameras(self) -> bool:
        """Whether there are camera sensors."""
        return bool(self._camera_sensors)

    @property
    def has_raycasts(self) -> bool:
        """Whether there are ray sensors."""
        return bool(self._raycast_sensors)

    @property
    def render_context(self) -> Any:
        """MuJoCo Warp's render context of the first camera sensor.

        Raises:
            AttributeError: there is no camera, or the engine is another.
            RuntimeError: nothing has been rendered yet.
        """
        if not self._views or self._find_render_context is None:
            raise UnknownAttributeError(
                "There is no render context, because the scene has no camera."
            )
        return self._find_render_context(self._views, self._views[0])

    def set_render_context_source(self, find: Callable[..., Any]) -> None:
        """Set what returns the render context of a view: `Simulation.render_context`."""
        self._find_render_context = find

    def sense(self, raycast: RayCast, render: Render) -> None:
        """Evaluate all sensors at the current poses, by the engine's queries."""
        self.prepare()
        for query in self._queries:
            query.cast(raycast)
        if self._views:
            for camera, images in zip(self._camera_sensors, render(self._views), strict=True):
                camera.set_images(images)
        self.finalize()

    @contextlib.contextmanager
    def results_kept(self) -> Generator[None]:
        """Put the results of all sensors back after the block, in which `sense` may be called."""
        sensors = (*self._camera_sensors, *self._raycast_sensors)
        before = [capture_state(sensor) for sensor in sensors]
        try:
            yield
        finally:
            for sensor, state in zip(sensors, before, strict=True):
                restore_state(sensor, state)
                sensor.invalidate_cache()

    def prepare(self) -> None:
        """Compute all rays in the world frame."""
        for sensor in self._raycast_sensors:
            sensor.prepare_rays()

    def finalize(self) -> None:
        """Tell the ray sensors that they have new results; cameras take theirs from `sense`."""
        for sensor in self._raycast_sensors:
            sensor.postprocess_rays()

    # Images.

    def unpack_rgb(self) -> None:
        """Do nothing: colours are unpacked as soon as they are rendered."""

    def get_rgb(self, cam_idx: int) -> torch.Tensor:
        """Return the latest colours (N, height, width, 3) uint8 of a camera of the model.

        Where several sensors look through it, they are those of the first that asks for colours.

        Raises:
            ValueError: no camera sensor measures this; the message lists those that do.
        """
        return self._image_of(cam_idx, "rgb")

    def get_depth(self, cam_idx: int) -> torch.Tensor:
        """Return the latest depths (N, height, width, 1) in metres; likewise."""
        return self._image_of(cam_idx, "depth")

    def get_segmentation(self, cam_idx: int) -> torch.Tensor:
        """Return the latest ids and types of objects (N, height, width, 2) int32; likewise."""
        return self._image_of(cam_idx, "segmentation")

    def _image_of(self, cam_idx: int, data_type: str) -> torch.Tensor:
        offering = [s for s in self._camera_sensors if data_type in s.view.data_types]
        for sensor in offering:
            if sensor.camera_idx == cam_idx:
                return getattr(sensor.data, data_type)
        known = ", ".join(f"{s.camera_idx} ({s.cfg.name})" for s in offering) or "none"
        raise ValueError(
            f"No camera sensor measures {data_type!r} through the camera {cam_idx} of the model. "
            f"Those that do: {known}. Add it to data_types of the sensor's config."
        )


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
        self._origins = torch.zeros(num_envs, ends[-1], 3, dtype=torch.float32, device=device)
        self._directions = torch.zeros(num_envs, ends[-1], 3, dtype=torch.float32, device=device)
        for sensor, part in zip(sensors, self._parts, strict=True):
            sensor.set_buffers(self._origins[:, part], self._directions[:, part])
        excluded = [body for sensor in sensors for body in sensor.excluded_bodies]
        self._excluded = torch.tensor(excluded, dtype=torch.int32, device=device)
        reach = [sensor.cfg.max_distance for sensor in sensors for _ in range(sensor.num_rays)]
        self._reach = torch.tensor(reach, dtype=torch.float32, device=device)

    def cast(self, raycast: RayCast) -> None:
        distances, normals, _ = raycast(
            self._origins, self._directions, self._groups, self._excluded, self._reach
        )
        for sensor, part in zip(self._sensors, self._parts, strict=True):
            sensor.set_results(distances[:, part], normals[:, part])


def _check_shared_cameras(sensors: Sequence[CameraSensor]) -> None:
    """Raise `ValueError` if two sensors want one camera to have different projections."""
    first: dict[str, CameraSensor] = {}
    for sensor in sensors:
        other = first.setdefault(sensor.camera_name, sensor)
        for field in ("fovy", "orthographic"):
            values = getattr(other.cfg, field), getattr(sensor.cfg, field)
            if values[0] != values[1]:
                raise ValueError(
                    f"Camera sensors {other.cfg.name!r} and {sensor.cfg.name!r} look through the "
                    f"camera {sensor.camera_name!r}, but {field} is {values[0]!r} for the one and "
                    f"{values[1]!r} for the other. Give both the same, or one a camera of its own "
                    "(camera_name=None, with parent_body, pos and quat)."
                )
