"""Ray sensors: distances to what surrounds a frame, along a pattern of rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, get_args

import mujoco
import torch

from mjlab.compat import older_names
from mjlab.sensor._frames import Frames, check_frames
from mjlab.sensor._ray_alignment import RayAlignment, is_constant, rotate_into
from mjlab.sensor._ray_data import RayCastData
from mjlab.sensor._ray_debug import VizCfg, draw_rays
from mjlab.sensor._ray_patterns import (
    GridPatternCfg,
    PatternCfg,
    PinholeCameraPatternCfg,
    RingPatternCfg,
)
from mjlab.sensor.builtin_sensor import ObjRef
from mjlab.sensor.sensor import Sensor, SensorCfg

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.sensor.sensor_context import SensorContext
    from mjlab.viewer.debug_visualizer import DebugVisualizer

__all__ = [
    "GridPatternCfg",
    "PatternCfg",
    "PinholeCameraPatternCfg",
    "RayAlignment",
    "RayCastData",
    "RayCastSensor",
    "RayCastSensorCfg",
    "RingPatternCfg",
]

NUM_GEOM_GROUPS = 6


@dataclass
class RayCastSensorCfg(SensorCfg):
    """Describes a ray sensor."""

    VizCfg = VizCfg

    frame: ObjRef | tuple[ObjRef, ...]
    """Body, site or geom from which the pattern is cast; or several, also of several entities."""
    pattern: PatternCfg = field(default_factory=GridPatternCfg)
    """The rays of each frame."""
    ray_alignment: RayAlignment = "base"
    """How the pattern turns with its frame: `base` fully, `yaw` about the vertical, `world` not."""
    max_distance: float = 10.0
    """Reach of the rays, in metres. What lies beyond is a miss."""
    exclude_parent_body: bool = True
    """Whether the geoms of the body that carries the frame (of that body alone) are invisible."""
    include_geom_groups: tuple[int, ...] | None = (0, 1, 2)
    """Geom groups, 0 to 5, that are visible; None for all."""
    debug_vis: bool = False
    """Whether viewers draw the rays."""
    viz: VizCfg = field(default_factory=VizCfg)
    """How they draw them."""

    def build(self) -> RayCastSensor:
        """Build the sensor."""
        return RayCastSensor(self)


class RayCastSensor(Sensor[RayCastData]):
    """Casts a pattern of rays from one or several frames.

    Rays are cast by `sim.sense()`: once per environment step, after resets and commands. So
    observations see the current scene, rewards and terminations that of the previous step, and all
    is zero before the first time. The rays meet the nearest surface of a geom of the included
    groups: planes from above, meshes and height fields from outside, and other geoms from either
    side. A geom that is fully transparent is not there.
    """

    _transient = {"_frames", "_offsets", "_local_directions", "_moving_directions"}

    def __init__(self, cfg: RayCastSensorCfg) -> None:
        """Check the config.

        Raises:
            ValueError: an unknown alignment, a geom group outside 0..5, a reach that is not
                positive.
        """
        super().__init__()
        self.cfg = cfg
        if cfg.ray_alignment not in get_args(RayAlignment):
            raise self._error(
                f"ray_alignment={cfg.ray_alignment!r} is unknown. Choose from: "
                f"{', '.join(get_args(RayAlignment))}."
            )
        if not (cfg.max_distance > 0.0 and math.isfinite(cfg.max_distance)):
            raise self._error(
                f"max_distance is {cfg.max_distance}; it has to be positive and finite (metres)."
            )
        wrong = [g for g in cfg.include_geom_groups or () if g not in range(NUM_GEOM_GROUPS)]
        if wrong:
            raise self._error(
                f"include_geom_groups has {wrong}; geom groups are 0 to {NUM_GEOM_GROUPS - 1}, and "
                "None includes all."
            )
        if cfg.include_geom_groups is not None and not cfg.include_geom_groups:
            raise self._error(
                "include_geom_groups is empty, so that no ray could hit anything; None includes "
                "all groups."
            )
        frame = cfg.frame
        self._frame_refs = (frame,) if isinstance(frame, ObjRef) else tuple(frame)
        self._num_rays_per_frame = 0

    def _error(self, message: str) -> ValueError:
        return ValueError(f"Ray sensor {self.cfg.name!r}: {message}")

    # Construction.

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Check what the frames refer to; the spec stays as it is.

        Raises:
            ValueError: no frame, one that is no body, site or geom, or one of an entity that does
                not exist.
        """
        try:
            check_frames(self._frame_refs, entities)
        except ValueError as error:
            raise self._error(str(error)) from error

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Generate the rays and find the frames in the compiled model.

        Raises:
            ValueError: the pattern has no rays or makes no sense, or a frame does not exist (with
                close names).
        """
        try:
            offsets, directions = self.cfg.pattern.generate_rays(mj_model, device)
            self._frames = Frames(self._frame_refs, mj_model, data, device)
        except ValueError as error:
            raise self._error(str(error)) from error
        if len(offsets) == 0:
            raise self._error("its pattern has no rays.")
        self._offsets, self._local_directions = offsets, directions
        self._num_rays_per_frame = len(offsets)
        self._moving_directions = not is_constant(directions, self.cfg.ray_alignment)
        shape = (data.qpos.shape[0], self.num_frames)
        self._frame_pos = torch.zeros(*shape, 3, dtype=torch.float32, device=device)
        self._frame_mat = torch.eye(3, dtype=torch.float32, device=device).repeat(*shape, 1, 1)
        self.set_buffers(
            torch.zeros(shape[0], self.num_rays, 3, dtype=torch.float32, device=device),
            torch.zeros(shape[0], self.num_rays, 3, dtype=torch.float32, device=device),
        )
        self.set_results(
            torch.zeros(shape[0], self.num_rays, dtype=torch.float32, device=device),
            torch.zeros(shape[0], self.num_rays, 3, dtype=torch.float32, device=device),
        )

    def set_buffers(self, origins: torch.Tensor, directions: torch.Tensor) -> None:
        """Use these tensors, (N, F n, 3) each, for the rays in the world frame.

        The sensor context hands out parts of one buffer, so that one query casts them all.
        """
        self._origins, self._directions = origins, directions
        if not self._moving_directions:
            directions.copy_(self._local_directions.repeat(self.num_frames, 1))

    def set_context(self, ctx: SensorContext) -> None:
        """Take note of what will evaluate the sensor; the sensor needs nothing of it."""

    # What there is.

    @property
    def num_frames(self) -> int:
        """Number of frames F."""
        return len(self._frame_refs)

    @property
    def num_rays_per_frame(self) -> int:
        """Number of rays n of each frame."""
        return self._num_rays_per_frame

    @property
    def num_rays(self) -> int:
        """Number of rays F n."""
        return self.num_frames * self._num_rays_per_frame

    @property
    def include_geom_groups(self) -> tuple[int, ...] | None:
        """Visible geom groups; None for all."""
        return self.cfg.include_geom_groups

    @property
    def excluded_bodies(self) -> list[int]:
        """For each ray, the body whose geoms it does not see; -1 for none."""
        bodies = self._frames.body_ids if self.cfg.exclude_parent_body else [-1] * self.num_frames
        return [body for body in bodies for _ in range(self.num_rays_per_frame)]

    # Sensing.

    def update(self, dt: float) -> None:
        """Do nothing: what was measured stays until rays are cast again."""

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Do nothing, likewise."""

    @property
    def needs_substep(self) -> bool:
        """Whether a subclass does something in `update` after all."""
        return type(self).update is not RayCastSensor.update

    def prepare_rays(self) -> None:
        """Compute the rays in the world frame from the current poses of the frames."""
        alignment = self.cfg.ray_alignment
        pos, mat = self._frame_pos, self._frame_mat
        self._frames.read(pos, mat)
        shape = (self.num_frames, self.num_rays_per_frame)
        rotate_into(self._origins.unflatten(1, shape), self._offsets, mat, alignment, pos)
        if self._moving_directions:
            rays = self._directions.unflatten(1, shape)
            rotate_into(rays, self._local_directions, mat, alignment)

    def raycast_kernel(self, rc: Callable[..., tuple[torch.Tensor, ...]]) -> None:
        """Cast the prepared rays of this sensor alone, by `rc`: `Simulation.raycast`."""
        reach = torch.full(
            (self.num_rays,),
            self.cfg.max_distance,
            dtype=torch.float32,
            device=self._origins.device,
        )
        excluded = torch.tensor(
            self.excluded_bodies, dtype=torch.int32, device=self._origins.device
        )
        distances, normals, _ = rc(
            self._origins, self._directions, self.include_geom_groups, excluded, reach
        )
        self.set_results(distances, normals)

    def set_results(self, distances: torch.Tensor, normals: torch.Tensor) -> None:
        """Take what the rays met: distances (N, F n) and normals (N, F n, 3)."""
        self._distances, self._normals = distances, normals

    def postprocess_rays(self) -> None:
        """Have `data` computed anew from the latest results."""
        self.invalidate_cache()

    def _compute_data(self) -> RayCastData:
        return RayCastData.with_frames(self._frame_mat.clone(), **self._measured())

    def _measured(self) -> dict[str, torch.Tensor]:
        """Return the fields of the data, but for the orientations of the frames."""
        reach = self._distances.clamp(min=0.0).unsqueeze(-1)
        return {
            "distances": self._distances,
            "normals_w": self._normals,
            "hit_pos_w": torch.addcmul(self._origins, self._directions, reach),
            "pos_w": self._frame_pos[:, 0],
            "frame_pos_w": self._frame_pos,
        }

    # Looking at it.

    @property
    def draws(self) -> bool:
        """Whether viewers draw the rays, as the config says."""
        return self.cfg.debug_vis

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw the points that are hit, and rays and normals if the config says so."""
        if not self.cfg.debug_vis:
            return
        data = self.data
        rays = {
            "origins": self._origins,
            "directions": self._directions,
            "hits": data.hit_pos_w,
            "normals": data.normals_w,
            "distances": data.distances,
        }
        draw_rays(visualizer, self.cfg.name, self.cfg.viz, self.cfg.max_distance, rays)


__getattr__ = older_names(__name__)
