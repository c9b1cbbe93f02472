"""Rays against nothing but planes that never move, in closed form: flat ground costs no query."""

from __future__ import annotations

import mujoco
import numpy as np

from mjlab.sim.native.ray_casting import Hits
from mjlab.sim.native.ray_tiles import is_static

Array = np.ndarray

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
# MuJoCo's mjMINVAL: rays that come down on a plane more slowly than that miss it.
_MIN_SLOPE = 1e-15


class StaticPlanes:
    """Planes that never move. Distances are those of `mj_ray`, in the same double precision."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, ids: Array) -> None:
        """Take the planes `ids` at the poses of `data`."""
        self._pos = data.geom_xpos[ids].copy()
        self._axes = data.geom_xmat[ids].reshape(-1, 3, 3).transpose(0, 2, 1).copy()
        # A plane of size 0 has no end.
        self._extent = np.where(model.geom_size[ids, :2] > 0.0, model.geom_size[ids, :2], np.inf)
        # What a ray reports of the plane that it meets. The last row is for none.
        self._ids = np.append(ids, -1).astype(np.int32)
        self._normals = np.vstack((self._axes[:, 2], np.zeros(3))).astype(np.float32)

    @classmethod
    def alone(
        cls, model: mujoco.MjModel, data: mujoco.MjData, visible: Array, excluded: Array | None
    ) -> StaticPlanes | None:
        """Return the planes, if all geoms `visible` (ngeom,) bool are such; else None.

        `excluded` are bodies that some of the rays do not see.
        """
        ids = np.flatnonzero(visible)
        others = (model.geom_type[ids] != _PLANE) | ~is_static(model)[ids]
        if excluded is not None:
            others |= np.isin(model.geom_bodyid[ids], excluded)
        return None if others.any() or not len(ids) else cls(model, data, ids)

    def cast(self, origins: Array, directions: Array, hits: Hits) -> None:
        """Cast the rays (n, R, 3) of all environments into `hits`."""
        nearest = np.full(origins.shape[:2], np.inf)
        which = np.full(origins.shape[:2], -1)
        for i in range(len(self._pos)):
            distance = self._distance(i, origins, directions)
            nearer = distance < nearest
            nearest = np.where(nearer, distance, nearest)
            which[nearer] = i
        hits.distances[:] = np.where(which < 0, -1.0, nearest)
        # Of all modes this one does not copy twice; -1 is the last row in it too.
        np.take(self._normals, which, axis=0, out=hits.normals, mode="wrap")
        np.take(self._ids, which, out=hits.geoms, mode="wrap")

    def _distance(self, i: int, origins: Array, directions: Array) -> Array:
        """Return how far rays go to plane `i`, (n, R); infinite for a miss."""
        x, y, z = self._axes[i]
        slope = _along(z, directions)
        # Those that do not come down divide by something harmless. NaN is no hit.
        comes_down = slope <= -_MIN_SLOPE
        height = _along(z, origins, self._pos[i])
        distance = height / np.where(comes_down, -slope, 1.0)
        is_hit = comes_down & (distance >= 0.0)
        for axis, extent in zip((x, y), self._extent[i], strict=True):
            if np.isfinite(extent):
                start = _along(axis, origins, self._pos[i])
                is_hit &= np.abs(start + distance * _along(axis, directions)) <= extent
        return np.where(is_hit, distance, np.inf)


def _along(axis: Array, vectors: Array, origin: Array | None = None) -> Array:
    """Return coordinates along `axis` (3,) of vectors (n, R, 3), from `origin` if there is one."""
    total = np.zeros(vectors.shape[:2])
    for k in range(3):
        part = vectors[..., k].astype(np.float64)
        if origin is not None:
            part -= origin[k]
        total += axis[k] * part
    return total
