"""Evaluation of camera and ray sensors with batched engine queries."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.utils.errors import UnknownAttributeError
from mjlab.utils.state import changes_undone

if TYPE_CHECKING:
    from mjlab.sensor.camera_sensor import CameraSensor
    from mjlab.sensor.raycast_sensor import RayCastSensor
    from mjlab.sim.engine import CameraView, Images

RayCast = Callable[..., tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
"""`Simulation.raycast`: origins, directions, geom groups, excluded bodies, range of each ray."""

Render = Callable[[tuple["CameraView", ...]], list["Images"]]
"""`Simulation.render`: images of views."""


class SensorContext:
    """Evaluates the camera and ray sensors of a scene. `Simulation.sense` calls `sense`.

    Ray sensors with the same geom groups share one buffer and one query; patterns, ranges and
    excluded bodies may differ. All cameras share one query; geom groups, textures and shadows may
    differ.
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
        """Allocate buffers and assign slices to the initialized sensors.

        Args:
            mj_model: The compiled model.
            model: The simulation's model fields.
            data: The simulation's data fields.
            camera_sensors: Camera sensors.
            raycast_sensors: Ray sensors.
            device: Torch device of all tensors.

        Raises:
            ValueError: conflicting projections of a shared camera.
        """
        first: dict[str, CameraSensor] = {}
        for sensor in camera_sensors:
            other = first.setdefault(sensor.camera_name, sensor)
            for field in ("fovy", "orthographic"):
                values = getattr(other.cfg, field), getattr(sensor.cfg, field)
                if values[0] != values[1]:
                    raise ValueError(
                        f"Camera sensors {other.cfg.name!r} and {sensor.cfg.name!r} share camera "
                        f"{sensor.camera_name!r}: expected equal {field}, got {values[0]!r} and "
                        f"{values[1]!r}; use the same value, or a separate camera for one sensor "
                        "(camera_name=None, with parent_body, pos and quat)."
                    )
        self._model, self._data, self._device = model, data, device
        self._camera_sensors = list(camera_sensors)
        self._find_render_context: Callable[..., Any] | None = None
        self._raycast_sensors = list(raycast_sensors)
        self.recreate(mj_model)

    def recreate(self, mj_model: mujoco.MjModel, expanded_fields: set[str] | None = None) -> None:
        """Rebuild the buffers after a model change."""
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
        # Images of 0 pixels are not rendered.
        self._rendered = [s for s in self._camera_sensors if s.view.width * s.view.height > 0]
        self._views = tuple(camera.view for camera in self._rendered)

    @property
    def has_cameras(self) -> bool:
        """True if the scene has camera sensors."""
        return bool(self._camera_sensors)

    @property
    def has_raycasts(self) -> bool:
        """True if the scene has ray sensors."""
        return bool(self._raycast_sensors)

    @property
    def render_context(self) -> Any:
        """MuJoCo Warp's render context of the first camera sensor.

        Raises:
            AttributeError: scene without cameras, or engine without render contexts.
            RuntimeError: called before the first rendering.
        """
        if not self._views or self._find_render_context is None:
            raise UnknownAttributeError(
                "SensorContext.render_context requires a camera sensor; the scene has none."
            )
        return self._find_render_context(self._views, self._views[0])

    def set_render_context_source(self, find: Callable[..., Any]) -> None:
        """Set the function that returns a view's render context: `Simulation.render_context`."""
        self._find_render_context = find

    def sense(self, raycast: RayCast, render: Render) -> None:
        """Evaluate all sensors at the current poses with the engine's queries."""
        self.prepare()
        for query in self._queries:
            query.cast(raycast)
        if self._views:
            for camera, images in zip(self._rendered, render(self._views), strict=True):
                camera.set_images(images)
        self.finalize()

    @contextlib.contextmanager
    def results_kept(self) -> Generator[None]:
        """Restore the results of all sensors after the block. The block may call `sense`."""
        sensors = (*self._camera_sensors, *self._raycast_sensors)
        with changes_undone(sensors):
            yield
        for sensor in sensors:
            sensor.invalidate_cache()

    def prepare(self) -> None:
        """Compute all rays in the world frame."""
        for sensor in self._raycast_sensors:
            sensor.prepare_rays()

    def finalize(self) -> None:
        """Invalidate the caches of ray sensors. `sense` passes images to cameras directly."""
        for sensor in self._raycast_sensors:
            sensor.postprocess_rays()

    # Images.

    def unpack_rgb(self) -> None:
        """Do nothing: rendered colors are already unpacked."""

    def get_rgb(self, cam_idx: int) -> torch.Tensor:
        """Return the latest RGB image of a model camera, (N, height, width, 3) uint8.

        If several sensors share the camera, the first with `rgb` in its `data_types` applies.

        Raises:
            ValueError: no camera sensor renders this image type (with the cameras that do).
        """
        return self._image_of(cam_idx, "rgb")

    def get_depth(self, cam_idx: int) -> torch.Tensor:
        """Return the latest depth image (m), (N, height, width, 1) float32. See `get_rgb`."""
        return self._image_of(cam_idx, "depth")

    def get_segmentation(self, cam_idx: int) -> torch.Tensor:
        """Return the latest object ids and types, (N, height, width, 2) int32. See `get_rgb`."""
        return self._image_of(cam_idx, "segmentation")

    def _image_of(self, cam_idx: int, data_type: str) -> torch.Tensor:
        offering = [s for s in self._camera_sensors if data_type in s.view.data_types]
        for sensor in offering:
            if sensor.camera_idx == cam_idx:
                return getattr(sensor.data, data_type)
        known = ", ".join(f"{s.camera_idx} ({s.cfg.name})" for s in offering) or "none"
        raise ValueError(
            f"Camera {cam_idx}: no camera sensor renders {data_type!r}; add {data_type!r} to "
            f"CameraSensorCfg.data_types. Cameras with {data_type!r}: {known}."
        )


class _RayQuery:
    """Concatenated rays of all sensors with the same geom groups."""

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
