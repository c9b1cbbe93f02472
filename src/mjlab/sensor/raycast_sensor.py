"""Ray-cast sensors: distance to surrounding geometry along a pattern of rays.

Data has N environments, F frames and n rays per frame; ray `f n + r` is ray r of frame f.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import numpy as np
import torch

from mjlab.compat import older_names
from mjlab.sensor.builtin_sensor import ObjRef, check_entity, find_in_scene
from mjlab.sensor.ray_patterns import (
    GridPatternCfg,
    PatternCfg,
    PinholeCameraPatternCfg,
    RingPatternCfg,
)
from mjlab.sensor.sensor import Sensor, SensorCfg
from mjlab.sim.engine import NUM_GEOM_GROUPS
from mjlab.utils.errors import check_one_of
from mjlab.utils.lab_api.math import quat_from_matrix
from mjlab.utils.memory import check_memory

if TYPE_CHECKING:
    from mjlab.entity import Entity
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

RayAlignment = Literal["base", "yaw", "world"]
"""Rotation of rays with their frame: full, about the vertical only, or none."""

Color = tuple[float, float, float, float]
_RAY_WIDTH = 0.1

# Frame types: fields of MjData with position and orientation.
_FRAMES = {
    "body": ("xpos", "xmat"),
    "site": ("site_xpos", "site_xmat"),
    "geom": ("geom_xpos", "geom_xmat"),
}

# Horizontal length of the frame's x axis below which the y axis defines the heading.
_STEEP = 0.1
_TINY = 1e-12


@dataclass
class VizCfg:
    """Colors (RGBA) and sizes of drawn rays. Lengths are multiples of the model's mean size."""

    hit_color: Color = (0.0, 1.0, 0.0, 0.8)
    """Color of rays that hit a geom."""
    miss_color: Color = (1.0, 0.0, 0.0, 0.4)
    """Color of rays that miss."""
    hit_sphere_color: Color = (0.0, 1.0, 1.0, 1.0)
    """Color of the spheres at hit points."""
    hit_sphere_radius: float = 0.5
    """Radius of the spheres at hit points."""
    show_rays: bool = False
    """Draw the rays as arrows."""
    show_normals: bool = False
    """Draw surface normals at hit points."""
    normal_color: Color = (1.0, 1.0, 0.0, 1.0)
    """Color of surface normals."""
    normal_length: float = 5.0
    """Length of surface normals."""


@dataclass
class RayCastSensorCfg(SensorCfg):
    """Ray-cast sensor configuration."""

    VizCfg = VizCfg

    frame: ObjRef | tuple[ObjRef, ...]
    """Body, site or geom the rays start from; or several, possibly of different entities."""
    pattern: PatternCfg = field(default_factory=GridPatternCfg)
    """Ray pattern of each frame."""
    ray_alignment: RayAlignment = "base"
    """Pattern rotation with its frame: `base` full, `yaw` about the vertical only, `world` none."""
    max_distance: float = 10.0
    """Range of the rays (m). Geometry beyond it is a miss."""
    exclude_parent_body: bool = True
    """Exclude the geoms of the frame's body (not those of its descendants)."""
    include_geom_groups: tuple[int, ...] | None = (0, 1, 2)
    """Visible geom groups, of 0 to 5. None: all. Empty: every ray misses."""
    debug_vis: bool = False
    """Draw the rays in viewers."""
    viz: VizCfg = field(default_factory=VizCfg)
    """Colors and sizes of drawn rays."""

    def build(self) -> RayCastSensor:
        """Build the sensor."""
        return RayCastSensor(self)


@dataclass
class RayCastData:
    """Data of a ray-cast sensor with F frames of n rays; ray `f n + r` is ray r of frame f."""

    distances: torch.Tensor
    """Distance (m), (N, F n). Miss: -1."""
    normals_w: torch.Tensor
    """Unit surface normal, world frame, (N, F n, 3). Miss: 0."""
    hit_pos_w: torch.Tensor
    """Hit point (m), world frame, (N, F n, 3). Miss: the ray's origin."""
    pos_w: torch.Tensor
    """Position of the first frame (m), world frame, (N, 3)."""
    quat_w: torch.Tensor
    """Orientation of the first frame, without alignment, (N, 4)."""
    frame_pos_w: torch.Tensor
    """Positions of the frames (m), world frame, (N, F, 3)."""
    frame_quat_w: torch.Tensor
    """Orientations of the frames, without alignment, (N, F, 4)."""


class RayCastSensor(Sensor[RayCastData]):
    """Ray-cast sensor: casts a pattern of rays from one or several frames.

    `sim.sense()` casts the rays once per environment step, after resets and commands. So
    observations read the current scene, rewards and terminations that of the previous step. Data is
    zero before the first `sim.sense()`. Rays hit the nearest surface of a geom of the included
    groups: planes from above, meshes and height fields from outside, and other geoms from either
    side. Rays ignore fully transparent geoms.
    """

    _transient = {
        "_frames", "_offsets", "_local_directions", "_moving_directions", "is_checked_scan",
    }  # fmt: skip

    def __init__(self, cfg: RayCastSensorCfg) -> None:
        """Check the config.

        Raises:
            ValueError: unknown alignment, or a geom group that MuJoCo lacks.
        """
        super().__init__()
        self.cfg = cfg
        owner = f"Ray sensor {cfg.name!r}"
        check_one_of(f"{owner} ray_alignment", cfg.ray_alignment, get_args(RayAlignment))
        for group in cfg.include_geom_groups or ():
            check_one_of(f"{owner} include_geom_groups", group, range(NUM_GEOM_GROUPS))
        frame = cfg.frame
        self._frame_refs = (frame,) if isinstance(frame, ObjRef) else tuple(frame)
        self._num_rays_per_frame = 0
        self.is_checked_scan = False
        """True after `check_terrain_scan`."""

    # Construction.

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Check the frames. The spec is unchanged.

        Raises:
            ValueError: `frame` is empty, is not a body, site or geom, or has an unknown entity.
        """
        # As in a template that is not filled in.
        if not self._frame_refs:
            raise ValueError(
                f"Ray sensor {self.cfg.name!r} frame: expected at least one ObjRef, got ()."
            )
        for frame in self._frame_refs:
            owner = f"Ray sensor {self.cfg.name!r} frame {frame.name!r}"
            check_one_of(f"{owner} type", frame.type, _FRAMES)
            check_entity(owner, frame, entities)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Generate the rays and look up the frames in the compiled model.

        Raises:
            ValueError: invalid pattern, or unknown frame (with close names).
        """
        try:
            offsets, directions = self.cfg.pattern.generate_rays(mj_model, device)
            self._frames = _Frames(self._frame_refs, mj_model, data, device)
        except ValueError as error:
            raise ValueError(f"Ray sensor {self.cfg.name!r}: {error}") from error
        self._offsets, self._local_directions = offsets, directions
        self._num_rays_per_frame = len(offsets)
        # Vertical rays keep their directions under a rotation about the vertical.
        alignment, is_vertical = self.cfg.ray_alignment, bool((directions[:, :2] == 0.0).all())
        self._moving_directions = alignment == "base" or (alignment == "yaw" and not is_vertical)
        shape = (data.qpos.shape[0], self.num_frames)
        # Origin, direction, distance, normal and hit point.
        check_memory(
            f"Ray sensor {self.cfg.name!r} rays of {shape[0]} environments", shape[0] * self.num_rays,
            52, device, "fewer rays, or fewer environments",
        )  # fmt: skip
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
        """Set the tensors for ray origins and directions in the world frame, (N, F n, 3) each.

        The sensor context assigns slices of one buffer, so that one query casts all rays.
        """
        self._origins, self._directions = origins, directions
        if not self._moving_directions:
            directions.copy_(self._local_directions.repeat(self.num_frames, 1))

    def set_context(self, ctx: object) -> None:
        """Do nothing: the sensor does not use its context."""

    # Properties.

    @property
    def num_frames(self) -> int:
        """Number of frames F."""
        return len(self._frame_refs)

    @property
    def num_rays_per_frame(self) -> int:
        """Number of rays per frame n."""
        return self._num_rays_per_frame

    @property
    def num_rays(self) -> int:
        """Number of rays F n."""
        return self.num_frames * self._num_rays_per_frame

    @property
    def include_geom_groups(self) -> tuple[int, ...] | None:
        """Visible geom groups. None: all."""
        return self.cfg.include_geom_groups

    @property
    def excluded_bodies(self) -> list[int]:
        """Id of the excluded body of each ray. -1: none."""
        bodies = self._frames.body_ids if self.cfg.exclude_parent_body else [-1] * self.num_frames
        return [body for body in bodies for _ in range(self.num_rays_per_frame)]

    @property
    def frame_bodies(self) -> list[int]:
        """Id of the body of each frame."""
        return self._frames.body_ids

    @property
    def scans_terrain(self) -> bool:
        """True if all rays point straight down, however the frame tilts."""
        down = torch.tensor([0.0, 0.0, -1.0], device=self._local_directions.device)
        return self.cfg.ray_alignment != "base" and bool((self._local_directions == down).all())

    # Sensing.

    def update(self, dt: float) -> None:
        """Do nothing: data stays valid until the next ray cast."""

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Do nothing: data stays valid until the next ray cast."""

    @property
    def needs_substep(self) -> bool:
        """True if a subclass overrides `update`."""
        return type(self).update is not RayCastSensor.update

    def prepare_rays(self) -> None:
        """Compute the rays in the world frame from the current poses of the frames."""
        alignment = self.cfg.ray_alignment
        pos, mat = self._frame_pos, self._frame_mat
        self._frames.read(pos, mat)
        shape = (self.num_frames, self.num_rays_per_frame)
        _rotate_into(self._origins.unflatten(1, shape), self._offsets, mat, alignment, pos)
        if self._moving_directions:
            rays = self._directions.unflatten(1, shape)
            _rotate_into(rays, self._local_directions, mat, alignment)

    def rays_in_pose(self, host: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return origins and unit directions of the rays, (F, n, 3) each, in the pose of `host`."""
        device, alignment = self._offsets.device, self.cfg.ray_alignment
        fields = {
            name: np.array(getattr(host, name), dtype=np.float32).reshape(1, -1, *shape)
            for names in _FRAMES.values()
            for name, shape in zip(names, ((3,), (3, 3)), strict=True)
        }
        frames = copy.copy(self._frames)
        frames.bind(
            SimpleNamespace(**{name: torch.tensor(v, device=device) for name, v in fields.items()})
        )
        pos, mat = self._frame_pos[:1].clone(), self._frame_mat[:1].clone()
        frames.read(pos, mat)
        shape = (1, self.num_frames, self.num_rays_per_frame, 3)
        origins, directions = (torch.zeros(shape, device=device) for _ in range(2))
        _rotate_into(origins, self._offsets, mat, alignment, pos)
        _rotate_into(directions, self._local_directions, mat, alignment)
        return origins[0].cpu().double().numpy(), directions[0].cpu().double().numpy()

    def raycast_kernel(self, rc: Callable[..., tuple[torch.Tensor, ...]]) -> None:
        """Cast only the prepared rays of this sensor, with `rc`: `Simulation.raycast`."""
        device, reach = self._origins.device, [self.cfg.max_distance] * self.num_rays
        reach = torch.tensor(reach, dtype=torch.float32, device=device)
        excluded = torch.tensor(self.excluded_bodies, dtype=torch.int32, device=device)
        distances, normals, _ = rc(
            self._origins, self._directions, self.include_geom_groups, excluded, reach
        )
        self.set_results(distances, normals)

    def set_results(self, distances: torch.Tensor, normals: torch.Tensor) -> None:
        """Store ray results: distances (N, F n) and normals (N, F n, 3)."""
        self._distances, self._normals = distances, normals

    def postprocess_rays(self) -> None:
        """Recompute `data` from the latest results on next access."""
        self.invalidate_cache()

    def _compute_data(self) -> RayCastData:
        return RayCastData(**self._measured())

    def _measured(self) -> dict[str, torch.Tensor]:
        """Return the fields of the data."""
        quats = quat_from_matrix(self._frame_mat)
        reach = self._distances.clamp(min=0.0).unsqueeze(-1)
        return {
            "distances": self._distances,
            "normals_w": self._normals,
            "hit_pos_w": torch.addcmul(self._origins, self._directions, reach),
            "pos_w": self._frame_pos[:, 0],
            "quat_w": quats[:, 0],
            "frame_pos_w": self._frame_pos,
            "frame_quat_w": quats,
        }

    # Drawing.

    @property
    def draws(self) -> bool:
        """True if `cfg.debug_vis` is set."""
        return self.cfg.debug_vis

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw hit points, and rays and normals as configured by `cfg.viz`.

        Rays that miss are drawn with a length of `min(0.5, 0.05 max_distance)` (m).
        """
        if not self.cfg.debug_vis:
            return
        viz, name, size = self.cfg.viz, self.cfg.name, visualizer.meansize
        visualizer.add_legend(viz.hit_sphere_color, f"hit points of {name}")
        if viz.show_rays:
            visualizer.add_legend(viz.hit_color, f"rays of {name} that hit")
            visualizer.add_legend(viz.miss_color, f"rays of {name} that miss")
        if viz.show_normals:
            visualizer.add_legend(viz.normal_color, f"normals of {name}")
        miss_length = min(0.5, 0.05 * self.cfg.max_distance)
        data = self.data
        rays = (self._origins, self._directions, data.hit_pos_w, data.normals_w, data.distances)
        for env in visualizer.get_env_indices(data.distances.shape[0]):
            of_env = (values[env].detach().cpu().double().numpy() for values in rays)
            for i, (origin, direction, hit_pos, normal, distance) in enumerate(
                zip(*of_env, strict=True)
            ):
                hit = distance >= 0.0
                end = hit_pos if hit else origin + miss_length * direction
                if viz.show_rays:
                    color = viz.hit_color if hit else viz.miss_color
                    visualizer.add_arrow(
                        origin, end, color, width=_RAY_WIDTH * size, label=f"{name}_ray_{i}"
                    )
                if not hit:
                    continue
                visualizer.add_sphere(
                    end, viz.hit_sphere_radius * size, viz.hit_sphere_color, label=f"{name}_hit_{i}"
                )
                if viz.show_normals:
                    tip = end + viz.normal_length * size * normal
                    visualizer.add_arrow(
                        end, tip, viz.normal_color, _RAY_WIDTH * size, label=f"{name}_normal_{i}"
                    )


class _Frames:
    """Poses of the sensor's frames, in config order."""

    def __init__(
        self, frames: tuple[ObjRef, ...], mj_model: mujoco.MjModel, data: Any, device: str
    ) -> None:
        """Look up the frames. Raises `ValueError` with close names for unknown frames."""
        self._data = data
        self._parts: list[tuple[str, str, torch.Tensor, torch.Tensor]] = []
        self.body_ids: list[int] = []
        """Id of the body of each frame."""
        ids = []
        owners = {"site": mj_model.site_bodyid, "geom": mj_model.geom_bodyid}
        for frame in frames:
            count, element = (getattr(mj_model, name) for name in (f"n{frame.type}", frame.type))
            names = [element(i).name for i in range(count)]
            index = names.index(find_in_scene("frame", frame, names))
            ids.append(index)
            self.body_ids.append(index if frame.type == "body" else int(owners[frame.type][index]))
        for kind in dict.fromkeys(frame.type for frame in frames):
            places = [i for i, frame in enumerate(frames) if frame.type == kind]
            self._parts.append(
                (
                    *_FRAMES[kind],
                    torch.tensor(places, device=device),
                    torch.tensor([ids[i] for i in places], device=device),
                )
            )

    def bind(self, data: Any) -> None:
        """Read poses from other data fields."""
        self._data = data

    def read(self, pos: torch.Tensor, mat: torch.Tensor) -> None:
        """Copy current positions into `pos` (N, F, 3) and orientations into `mat` (N, F, 3, 3)."""
        for pos_field, mat_field, places, ids in self._parts:
            for out, source in ((pos, pos_field), (mat, mat_field)):
                values = getattr(self._data, source).index_select(1, ids)
                if len(self._parts) == 1:
                    out.copy_(values)
                else:
                    out.index_copy_(1, places, values)


def _rotate_into(
    out: torch.Tensor,
    vectors: torch.Tensor,
    mat: torch.Tensor,
    alignment: RayAlignment,
    start: torch.Tensor | None = None,
) -> None:
    """Write `start + A vectors` into `out`, with A the aligned orientation of each frame.

    Column by column, because every column is one operation over all environments and rays. No
    matrix product: GPUs may compute it in TF32, with errors of centimeters far from the origin.

    Args:
        out: (N, F, n, 3).
        vectors: (n, 3) in the aligned frame.
        mat: (N, F, 3, 3) orientations of the frames.
        alignment: Part of the orientation to apply.
        start: (N, F, 3) world positions. None: zero.
    """
    x, y, z = vectors.unbind(-1)
    if alignment == "yaw":
        cosine, sine = (part[..., None] for part in _heading(mat))
        turn = (cosine, -sine), (sine, cosine)
    else:
        turn = ()
    for axis, column in enumerate(out.unbind(-1)):
        if alignment == "base":
            first, second, third = mat[..., axis, :, None].unbind(-2)
            part = (first * x).addcmul_(second, y).addcmul_(third, z)
        elif alignment == "world" or axis == 2:
            part = vectors[:, axis].expand_as(column)
        else:
            first, second = turn[axis]
            part = (first * x).addcmul_(second, y)
        # `start` is added last: far from the origin, sums with it have the largest rounding errors.
        torch.add(part, 0.0 if start is None else start[..., axis, None], out=column)


def _heading(mat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return cosine and sine of the yaw (...,) of rotation matrices (..., 3, 3).

    The heading is the horizontal projection of the frame's x axis. If the x axis is nearly vertical
    (projection shorter than 0.1), the heading is the projection (a, b) of the y axis rotated by
    -90 deg: (b, -a).
    """
    # By components: operations over a last dimension of size 2 take ten times as long on a CPU.
    x, y = mat[..., 0, 0], mat[..., 1, 0]
    is_steep = x * x + y * y < _STEEP**2
    x = torch.where(is_steep, mat[..., 1, 1], x)
    y = torch.where(is_steep, -mat[..., 0, 1], y)
    length = (x * x + y * y).sqrt_().clamp_(min=_TINY)
    return x / length, y / length


__getattr__ = older_names(__name__)
