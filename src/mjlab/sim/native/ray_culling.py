"""Surfaces that rays pass through, though MuJoCo's C code reports them (MuJoCo Warp does not).

Meshes and height fields are seen from outside only, and a height field is its top alone: its sides
and its base are not there.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

Array = np.ndarray

_MESH, _HFIELD = int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD)
# A hit so close (metres) to the bottom of a height field's elevations may be on its base.
_BASE_TOLERANCE = 1e-5
# A surface so far (metres) above a hit on the base shows that the ray began below it.
_SURFACE_TOLERANCE = 1e-4
# The cosine below which a face of a height field is one of its sides or its base.
_SIDE = 1e-9


class CullingRule:
    """Says which hits on the geoms of a model do not count."""

    def __init__(self, model: mujoco.MjModel, pos: Array, mat: Array) -> None:
        """Take the poses of geoms that do not move, (ngeom, 3) and (ngeom, 9).

        They count for height fields, which move only where a mocap body carries them.
        """
        self._model = model
        roots = model.body_rootid[model.geom_bodyid[model.geom_type == _HFIELD]]
        self.fields_are_carried = bool((model.body_mocapid[roots] >= 0).any())
        """Whether each environment places a height field for itself."""
        # One entry more, so that the geom -1 of a miss finds an entry of its own.
        self._is_field = np.append(model.geom_type == _HFIELD, False)
        self._is_one_sided = self._is_field | np.append(model.geom_type == _MESH, False)
        self._pos = np.append(pos, np.zeros((1, 3)), axis=0)
        self._mat = np.append(mat.reshape(-1, 3, 3), np.zeros((1, 3, 3)), axis=0)
        self._is_upright = bool((self._mat[self._is_field, 2, 2] > 1.0 - 1e-12).all())
        elevation = np.zeros(model.ngeom + 1)
        elevation[self._is_field] = model.hfield_size[model.geom_dataid[self._is_field[:-1]], 2]
        self._elevation = elevation
        self._base = np.where(self._is_field, self._pos[:, 2], np.nan)

    def concerns(self, geoms: Array) -> bool:
        """Return whether one of the geoms `geoms` (ngeom,) bool is not seen from everywhere."""
        return bool((self._is_one_sided[:-1] & geoms).any())

    def passed(
        self,
        origins: Array,
        directions: Array,
        distances: Array,
        normals: Array,
        geoms: Array,
        poses: tuple[Any, Any] | None = None,
    ) -> Array:
        """Return which hits (n, R) do not count; vectors are (n, R, 3), geoms -1 for a miss.

        `poses` are the positions (n, ngeom, 3) and orientations (n, ngeom, 3, 3) of the geoms,
        where height fields are carried.
        """
        facing = np.einsum("...k,...k", normals, directions)
        passed = self._is_one_sided[geoms] & (facing >= 0.0)
        is_field = self._is_field[geoms]
        if not is_field.any():
            return passed
        if self._is_upright and poses is None:
            up = normals[..., 2]
            height = origins[..., 2] + directions[..., 2] * distances - self._base[geoms]
        else:
            pos, mat = self._poses_of(geoms, poses)
            axis = mat[..., :, 2]
            up = np.einsum("...k,...k", normals, axis)
            hit = origins + directions * distances[..., None] - pos
            height = np.where(is_field, np.einsum("...k,...k", hit, axis), np.nan)
        passed |= is_field & (up <= _SIDE)
        # Rays from below the surface end on the base, which looks like flat ground.
        index = np.nonzero((np.abs(height) < _BASE_TOLERANCE) & ~passed)
        if len(index[0]):
            if poses is not None:
                poses = (poses[0][index[0]], poses[1][index[0]])
            at = (array[index] for array in (origins, directions, distances, geoms))
            passed[index] = self._begins_below(*at, poses)
        return passed

    def _poses_of(self, geoms: Array, poses: tuple[Any, Any] | None) -> tuple[Array, Array]:
        """Return positions (..., 3) and orientations (..., 3, 3) of geoms (...,)."""
        if poses is None:
            return self._pos[geoms], self._mat[geoms]
        rows = np.arange(len(geoms)).reshape(-1, *[1] * (geoms.ndim - 1))
        return poses[0][rows, geoms], poses[1][rows, geoms]

    def _begins_below(
        self,
        origins: Array,
        directions: Array,
        distances: Array,
        geoms: Array,
        poses: tuple[Any, Any] | None,
    ) -> Array:
        """Return for hits (M,) at the height of the base whether the surface is above them."""
        pos, mat = self._poses_of(geoms, poses)
        climb = -np.einsum("mk,mk->m", directions, mat[:, :, 2]) * distances
        below = climb < self._elevation[geoms]
        if below.any():
            hits = origins[below] + directions[below] * distances[below, None]
            local = np.einsum("mkj,mk->mj", mat[below], hits - pos[below])
            below[below] = self._surface(local, geoms[below]) > _SURFACE_TOLERANCE
        return below

    def _surface(self, local: Array, geoms: Array) -> Array:
        """Return the height of height fields (M,) at local positions (M, 3), above their base.

        Each cell is two triangles, cut from its first to its last corner.
        """
        m = self._model
        fields = m.geom_dataid[geoms]
        cells = np.stack((m.hfield_ncol[fields] - 1, m.hfield_nrow[fields] - 1), axis=-1)
        scaled = (local[:, :2] / m.hfield_size[fields, :2] + 1.0) / 2.0 * cells
        scaled = np.clip(scaled, 0.0, cells)
        corner = np.minimum(scaled.astype(int), cells - 1)
        x, y = (scaled - corner).T
        columns = m.hfield_ncol[fields]
        first = m.hfield_adr[fields] + corner[:, 1] * columns + corner[:, 0]
        h00, h01 = m.hfield_data[first], m.hfield_data[first + 1]
        h10, h11 = m.hfield_data[first + columns], m.hfield_data[first + columns + 1]
        lower = h00 + x * (h01 - h00) + y * (h11 - h01)
        upper = h00 + y * (h10 - h00) + x * (h11 - h10)
        return m.hfield_size[fields, 2] * np.where(x >= y, lower, upper)
