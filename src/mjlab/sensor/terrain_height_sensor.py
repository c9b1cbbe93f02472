"""Terrain height sensors: height of frames above the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sensor.raycast_sensor import RayCastData, RayCastSensor, RayCastSensorCfg
from mjlab.utils.errors import check_one_of

# Reductions of heights (N, F, n) over the rays of each frame.
_REDUCE: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "min": lambda rays: rays.amin(dim=-1),
    "max": lambda rays: rays.amax(dim=-1),
    "mean": lambda rays: rays.mean(dim=-1),
    "none": lambda rays: rays,
}

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_HFIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)


@dataclass
class TerrainHeightSensorCfg(RayCastSensorCfg):
    """Terrain height sensor configuration."""

    reduction: str = "min"
    """Reduction over the rays of a frame: `min`, `max`, `mean`, or `none` (keep all rays)."""

    def build(self) -> TerrainHeightSensor:
        """Build the sensor."""
        return TerrainHeightSensor(self)


@dataclass
class TerrainHeightData(RayCastData):
    """Data of a terrain height sensor with F frames of n rays."""

    heights: torch.Tensor
    """Height above the ground (m), (N, F); (N, F, n) without reduction."""


class TerrainHeightSensor(RayCastSensor):
    """Ray-cast sensor that reports heights above the ground.

    The height of a ray is the frame's z minus the z of the hit point. The height is 0 if the ray
    starts inside a solid (hits a downward face), or below a plane or height field (invisible to
    rays from below), and `max_distance` for a miss.
    """

    cfg: TerrainHeightSensorCfg
    _transient = {"_ground"}

    def __init__(self, cfg: TerrainHeightSensorCfg) -> None:
        """Check the config.

        Raises:
            ValueError: unknown reduction, or any error of `RayCastSensor`.
        """
        super().__init__(cfg)
        check_one_of(f"Ray sensor {cfg.name!r} reduction", cfg.reduction, _REDUCE)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Generate the rays, and look up frames and ground in the compiled model."""
        super().initialize(mj_model, model, data, device)
        self._ground = OneSidedGround(mj_model, data, self.include_geom_groups, device)

    @property
    def scans_terrain(self) -> bool:
        """True: heights are those of the ground."""
        return True

    @property
    def data(self) -> TerrainHeightData:
        """Current sensor data."""
        data = super().data
        assert isinstance(data, TerrainHeightData)
        return data

    def _compute_data(self) -> TerrainHeightData:
        measured = self._measured()
        of_frame = self.num_frames, self.num_rays_per_frame
        hit_z = measured["hit_pos_w"][..., 2].unflatten(1, of_frame)
        heights = (self._frame_pos[..., 2:] - hit_z).flatten(1)
        heights = torch.where(self._normals[..., 2] < 0.0, 0.0, heights)
        missed = self._distances < 0.0
        heights = torch.where(missed, self.cfg.max_distance, heights)
        if len(self._ground):
            heights = self._zero_below_ground(heights, missed)
        heights = _REDUCE[self.cfg.reduction](heights.unflatten(1, of_frame))
        return TerrainHeightData(**measured, heights=heights)

    def _zero_below_ground(self, heights: torch.Tensor, missed: torch.Tensor) -> torch.Tensor:
        """Return heights with 0 for rays that missed because they start below the ground."""
        rows, columns = missed.nonzero(as_tuple=True)
        if len(rows):
            below = self._ground.is_above(self._origins[rows, columns], rows)
            heights[rows[below], columns[below]] = 0.0
        return heights


class OneSidedGround:
    """Point-below-surface test for the planes and height fields of some geom groups.

    Rays that start below such a surface do not hit it, so a miss does not imply missing ground.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        data: Any,
        groups: tuple[int, ...] | None,
        device: str,
    ) -> None:
        m = mj_model
        visible = np.isin(m.geom_type, (_PLANE, _HFIELD))
        if groups is not None:
            visible &= np.isin(m.geom_group.clip(0, 5), groups)
        geoms = np.flatnonzero(visible)
        self._data = data
        self._geoms = torch.from_numpy(geoms).to(device)
        # MuJoCo allows planes and height fields on static bodies only, but a static body may be
        # a child of a mocap body, whose pose differs between environments.
        carried = m.body_mocapid[m.body_rootid[m.geom_bodyid[geoms]]] >= 0
        self._is_placed_by_env = bool(carried.any())
        host = mujoco.MjData(m)
        mujoco.mj_kinematics(m, host)
        self._pos = _tensor(host.geom_xpos[geoms], device)
        self._mat = _tensor(host.geom_xmat[geoms].reshape(-1, 3, 3), device)
        self._is_rotated = bool((np.abs(host.geom_xmat[geoms] - np.eye(3).ravel()) > 1e-12).any())
        fields = m.geom_dataid[geoms]
        is_field = m.geom_type[geoms] == _HFIELD
        size = np.zeros((len(geoms), 3))
        size[~is_field] = m.geom_size[geoms[~is_field]]
        size[is_field] = m.hfield_size[fields[is_field]][:, :3]
        # A plane of size 0 is infinite.
        extent = np.where(size[:, :2] > 0.0, size[:, :2], np.inf)
        self._extent = _tensor(extent, device)
        self._elevation = _tensor(np.where(is_field, size[:, 2], 0.0), device)
        shape = np.ones((len(geoms), 2), dtype=np.int64) * 2
        start = np.zeros(len(geoms), dtype=np.int64)
        shape[is_field] = np.stack((m.hfield_nrow, m.hfield_ncol), -1)[fields[is_field]]
        start[is_field] = m.hfield_adr[fields[is_field]]
        self._shape = torch.from_numpy(shape).to(device)
        self._start = torch.from_numpy(start).to(device)
        # Planes among height fields read elevations too; their factor `_elevation` is 0.
        self._has_fields = bool(is_field.any())
        self._heights = _tensor(m.hfield_data, device)

    def __len__(self) -> int:
        return len(self._geoms)

    def is_above(self, points: torch.Tensor, envs: torch.Tensor) -> torch.Tensor:
        """Return world points (M, 3) that are below a surface, (M,) bool.

        `envs`: environment of each point, (M,).
        """
        pos, mat = self._pos, self._mat
        if self._is_placed_by_env:
            pos, mat = (
                field[envs][:, self._geoms]
                for field in (self._data.geom_xpos, self._data.geom_xmat)
            )
        # (M, G, 3): the points in the frames of the geoms.
        local = points[:, None] - pos
        if self._is_placed_by_env or self._is_rotated:
            local = (mat * local[..., :, None]).sum(dim=-2)
        inside = (local[..., :2].abs() <= self._extent).all(dim=-1)
        return (inside & (local[..., 2] < self._surface(local))).any(dim=-1)

    def _surface(self, local: torch.Tensor) -> torch.Tensor:
        """Return heights of all surfaces at positions (M, G, 3) in their frames, (M, G).

        Each height field cell consists of two triangles, split from its first to its last corner.
        """
        if not self._has_fields:
            return torch.zeros_like(local[..., 2])
        cells = self._shape.flip(-1) - 1
        scaled = (local[..., :2] / self._extent + 1.0) * 0.5 * cells
        # Positions beyond the edge are discarded later, but must index valid elevations.
        scaled = torch.minimum(scaled.nan_to_num().clamp(min=0.0), cells.to(scaled.dtype))
        corner = torch.minimum(scaled.long(), cells - 1)
        x, y = (scaled - corner).unbind(-1)
        columns = self._shape[:, 1]
        first = self._start + corner[..., 1] * columns + corner[..., 0]
        h00, h01 = self._heights[first], self._heights[first + 1]
        h10, h11 = self._heights[first + columns], self._heights[first + columns + 1]
        lower = h00 + x * (h01 - h00) + y * (h11 - h01)
        upper = h00 + y * (h10 - h00) + x * (h11 - h10)
        return self._elevation * torch.where(x >= y, lower, upper)


def _tensor(array: Any, device: str) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to(device, torch.float32)
