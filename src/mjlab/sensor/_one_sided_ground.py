"""Ground that rays do not see from below: planes and height fields."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_HFIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)


class OneSidedGround:
    """Planes and height fields of some geom groups; tells whether a point lies below one.

    Rays that start below such a surface do not meet it, so their misses do not mean that there is
    no ground.
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
        # MuJoCo takes planes and height fields on static bodies only; but a static body may be
        # carried by a mocap body, which every environment places for itself.
        carried = m.body_mocapid[m.body_rootid[m.geom_bodyid[geoms]]] >= 0
        self._is_placed_by_env = bool(carried.any())
        host = mujoco.MjData(m)
        mujoco.mj_kinematics(m, host)
        self._pos = _tensor(host.geom_xpos[geoms], device)
        self._mat = _tensor(host.geom_xmat[geoms].reshape(-1, 3, 3), device)
        self._is_turned = bool((np.abs(host.geom_xmat[geoms] - np.eye(3).ravel()) > 1e-12).any())
        fields = m.geom_dataid[geoms]
        is_field = m.geom_type[geoms] == _HFIELD
        size = np.zeros((len(geoms), 3))
        size[~is_field] = m.geom_size[geoms[~is_field]]
        size[is_field] = m.hfield_size[fields[is_field]][:, :3]
        # A plane of size 0 has no end.
        extent = np.where(size[:, :2] > 0.0, size[:, :2], np.inf)
        self._extent = _tensor(extent, device)
        self._elevation = _tensor(np.where(is_field, size[:, 2], 0.0), device)
        shape = np.ones((len(geoms), 2), dtype=np.int64) * 2
        start = np.zeros(len(geoms), dtype=np.int64)
        shape[is_field] = np.stack((m.hfield_nrow, m.hfield_ncol), -1)[fields[is_field]]
        start[is_field] = m.hfield_adr[fields[is_field]]
        self._shape = torch.from_numpy(shape).to(device)
        self._start = torch.from_numpy(start).to(device)
        # Planes among height fields read elevations too, which then count for nothing.
        self._has_fields = bool(is_field.any())
        self._heights = _tensor(m.hfield_data, device)

    def __len__(self) -> int:
        return len(self._geoms)

    def is_above(self, points: torch.Tensor, envs: torch.Tensor | None = None) -> torch.Tensor:
        """Return whether each of the world points (M, 3) has such ground above it, (M,) bool.

        `envs` (M,) says which environment each point is in.
        """
        pos, mat = self._pos, self._mat
        if self._is_placed_by_env:
            rows = slice(None) if envs is None else envs
            pos = self._data.geom_xpos[:, self._geoms][rows]
            mat = self._data.geom_xmat[:, self._geoms][rows]
        # (M, G, 3): the points in the frames of the geoms.
        local = points[:, None] - pos
        if self._is_placed_by_env or self._is_turned:
            local = (mat * local[..., :, None]).sum(dim=-2)
        inside = (local[..., :2].abs() <= self._extent).all(dim=-1)
        if points.device.type == "cpu":
            # Few of the geoms are around each point. On a GPU, finding which would wait.
            rows, geoms = inside.nonzero(as_tuple=True)
            near = local[rows, geoms]
            below = near[:, 2] < self._surface(near, geoms)
            return torch.zeros(len(points), dtype=torch.bool).index_put_(
                (rows[below],), torch.tensor(True)
            )
        geoms = torch.arange(len(self), device=points.device).expand(inside.shape)
        return (inside & (local[..., 2] < self._surface(local, geoms))).any(dim=-1)

    def _surface(self, local: torch.Tensor, geoms: torch.Tensor) -> torch.Tensor:
        """Return the height of surfaces `geoms` (...,) at local positions (..., 3), in their frames.

        A height field is made of triangles: each cell is cut from its first to its last corner.
        """
        if not self._has_fields:
            return torch.zeros_like(local[..., 2])
        cells = self._shape[geoms].flip(-1) - 1
        scaled = (local[..., :2] / self._extent[geoms] + 1.0) * 0.5 * cells
        # Positions beyond the edge count for nothing, but have to read something.
        scaled = torch.minimum(scaled.nan_to_num().clamp(min=0.0), cells.to(scaled.dtype))
        corner = torch.minimum(scaled.long(), cells - 1)
        x, y = (scaled - corner).unbind(-1)
        columns = self._shape[geoms, 1]
        first = self._start[geoms] + corner[..., 1] * columns + corner[..., 0]
        h00, h01 = self._heights[first], self._heights[first + 1]
        h10, h11 = self._heights[first + columns], self._heights[first + columns + 1]
        lower = h00 + x * (h01 - h00) + y * (h11 - h01)
        upper = h00 + y * (h10 - h00) + x * (h11 - h10)
        return self._elevation[geoms] * torch.where(x >= y, lower, upper)


def _tensor(array: Any, device: str) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to(device, torch.float32)
