"""Ray sensors: distances from frames to surrounding geometry, along a pattern of rays.

Data has N environments, F frames and n rays per frame; ray `f n + r` is ray r of frame f.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

import mujoco
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

# Frame types: fields of MjData with position and orientation, and MuJoCo's object type.
_FRAMES = {
    "body": ("xpos", "xmat", mujoco.mjtObj.mjOBJ_BODY),
    "site": ("site_xpos", "site_xmat", mujoco.mjtObj.mjOBJ_SITE),
    "geom": ("geom_xpos", "geom_xmat", mujoco.mjtObj.mjOBJ_GEOM),
}

# Below this horizontal length of the frame's x axis, its y axis says where the frame points.
_STEEP = 0.1
_TINY = 1e-12


@dataclass
class VizCfg:
    """How rays are drawn. Lengths are multiples of the model's mean size, colours RGBA."""

    hit_color: Color = (0.0, 1.0, 0.0, 0.8)
    """Colour of rays that hit something."""
    miss_color: Color = (1.0, 0.0, 0.0, 0.4)
    """Colour of rays that hit nothing."""
    hit_sphere_color: Color = (0.0, 1.0, 1.0, 1.0)
    """Colour of the spheres at the points that are hit."""
    hit_sphere_radius: float = 0.5
    """Radius of these spheres."""
    show_rays: bool = False
    """Whether to draw the rays as arrows."""
    show_normals: bool = False
    """Whether to draw surface normals at the points that are hit."""
    normal_color: Color = (1.0, 1.0, 0.0, 1.0)
    """Colour of the normals."""
    normal_length: float = 5.0
    """Length of the normals."""


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


@dataclass
class RayCastData:
    """What a ray sensor with F frames of n rays has measured; ray `f n + r` is ray r of frame f."""

    distances: torch.Tensor
    """(N, F n) metres; -1 for a miss."""
    normals_w: torch.Tensor
    """(N, F n, 3) unit surface normals in the world frame; 0 for a miss."""
    hit_pos_w: torch.Tensor
    """(N, F n, 3) world positions of what is hit; for a miss, where the ray starts."""
    pos_w: torch.Tensor
    """(N, 3) world position of the first frame."""
    quat_w: torch.Tensor
    """(N, 4) orientation of the first frame, not aligned."""
    frame_pos_w: torch.Tensor
    """(N, F, 3) world positions of the frames."""
    frame_quat_w: torch.Tensor
    """(N, F, 4) orientations of the frames, not aligned."""

    @classmethod
    def with_frames(cls, frame_mat: torch.Tensor, **fields: torch.Tensor) -> Self:
        """Return data whose quaternions are computed from `frame_mat` (N, F, 3, 3) when read.

        Few terms read them, and computing them takes longer than all the other fields together.
        """
        data = cls.__new__(cls)
        data.__dict__.update(fields, _frame_mat=frame_mat)
        return data

    def __getattr__(self, name: str) -> Any:
        # Only asked for what is not there yet.
        if name not in ("quat_w", "frame_quat_w") or "_frame_mat" not in self.__dict__:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        self.frame_quat_w = quat_from_matrix(self.__dict__["_frame_mat"])
        self.quat_w = self.frame_quat_w[:, 0]
        return self.__dict__[name]


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
        owner = f"Ray sensor {cfg.name!r}"
        check_one_of(f"{owner} ray_alignment", cfg.ray_alignment, get_args(RayAlignment))
        if not 0.0 < cfg.max_distance < math.inf:
            raise ValueError(
                f"{owner} max_distance: expected a finite length > 0 (m), got {cfg.max_distance}."
            )
        for group in cfg.include_geom_groups or ():
            check_one_of(f"{owner} include_geom_groups", group, range(NUM_GEOM_GROUPS))
        if cfg.include_geom_groups is not None and not cfg.include_geom_groups:
            raise ValueError(
                f"{owner} include_geom_groups is empty, so that no ray could hit anything; None "
                "includes all groups."
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
        if not self._frame_refs:
            raise self._error("frame is empty; give one ObjRef or several.")
        for frame in self._frame_refs:
            owner = f"Ray sensor {self.cfg.name!r} frame {frame.name!r}"
            check_one_of(f"{owner} type", frame.type, _FRAMES)
            check_entity(owner, frame, entities)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Generate the rays and find the frames in the compiled model.

        Raises:
            ValueError: the pattern has no rays or makes no sense, or a frame does not exist (with
                close names).
        """
        try:
            offsets, directions = self.cfg.pattern.generate_rays(mj_model, device)
            self._frames = _Frames(self._frame_refs, mj_model, data, device)
        except ValueError as error:
            raise self._error(str(error)) from error
        if len(offsets) == 0:
            raise self._error("its pattern has no rays.")
        self._offsets, self._local_directions = offsets, directions
        self._num_rays_per_frame = len(offsets)
        # Vertical rays keep their directions under a rotation about the vertical.
        alignment, is_vertical = self.cfg.ray_alignment, bool((directions[:, :2] == 0.0).all())
        self._moving_directions = alignment == "base" or (alignment == "yaw" and not is_vertical)
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

    def set_context(self, ctx: object) -> None:
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
        _rotate_into(self._origins.unflatten(1, shape), self._offsets, mat, alignment, pos)
        if self._moving_directions:
            rays = self._directions.unflatten(1, shape)
            _rotate_into(rays, self._local_directions, mat, alignment)

    def raycast_kernel(self, rc: Callable[..., tuple[torch.Tensor, ...]]) -> None:
        """Cast the prepared rays of this sensor alone, by `rc`: `Simulation.raycast`."""
        device, reach = self._origins.device, [self.cfg.max_distance] * self.num_rays
        reach = torch.tensor(reach, dtype=torch.float32, device=device)
        excluded = torch.tensor(self.excluded_bodies, dtype=torch.int32, device=device)
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
        """Draw the points that are hit, and rays and normals if the config says so.

        A ray that misses is drawn `min(0.5, 0.05 max_distance)` long, in metres.
        """
        if not self.cfg.debug_vis:
            return
        viz, name, size = self.cfg.viz, self.cfg.name, visualizer.meansize
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
    """Poses of several frames, in the order in which they were given."""

    def __init__(
        self, frames: tuple[ObjRef, ...], mj_model: mujoco.MjModel, data: Any, device: str
    ) -> None:
        """Find the frames; ValueError with close names for one that does not exist."""
        self._data = data
        self._parts: list[tuple[str, str, torch.Tensor, torch.Tensor]] = []
        self.body_ids: list[int] = []
        """The body that carries each frame."""
        ids = []
        owners = {"site": mj_model.site_bodyid, "geom": mj_model.geom_bodyid}
        for frame in frames:
            count = getattr(mj_model, f"n{frame.type}")
            kind = _FRAMES[frame.type][2]
            names = [mujoco.mj_id2name(mj_model, kind, i) or "" for i in range(count)]
            index = names.index(find_in_scene("frame", frame, names))
            ids.append(index)
            self.body_ids.append(index if frame.type == "body" else int(owners[frame.type][index]))
        for kind in dict.fromkeys(frame.type for frame in frames):
            places = [i for i, frame in enumerate(frames) if frame.type == kind]
            self._parts.append(
                (
                    *_FRAMES[kind][:2],
                    torch.tensor(places, device=device),
                    torch.tensor([ids[i] for i in places], device=device),
                )
            )

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

    Column by column, because every column is one operation over all environments and rays, and
    without a matrix product, which a GPU may round to TF32: centimetres, far from the origin.

    Args:
        out: (N, F, n, 3).
        vectors: (n, 3) in the aligned frame.
        mat: (N, F, 3, 3) orientations of the frames.
        alignment: Which part of the orientation counts.
        start: (N, F, 3) world positions; None for none.
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
        # The start comes last: far from the origin, sums with it are rounded most.
        torch.add(part, 0.0 if start is None else start[..., axis, None], out=column)


def _heading(mat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return cosine and sine of the yaw (...,) of rotation matrices (..., 3, 3).

    The direction is that of the horizontal projection of the frame's x axis. Where the x axis is
    nearly vertical (projection shorter than 0.1), it is the projection (a, b) of the y axis turned
    back by a quarter: (b, -a).
    """
    # By components: an operation over a last dimension of two takes a CPU ten times as long.
    x, y = mat[..., 0, 0], mat[..., 1, 0]
    is_steep = x * x + y * y < _STEEP**2
    x = torch.where(is_steep, mat[..., 1, 1], x)
    y = torch.where(is_steep, -mat[..., 0, 1], y)
    length = (x * x + y * y).sqrt_().clamp_(min=_TINY)
    return x / length, y / length


__getattr__ = older_names(__name__)
