"""Which hits of camera and shadow rays do not count: the culling of Warp's renderer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sim.native.camera_geoms import HFIELD, MESH, GeomTable, PosedGeoms
from mjlab.sim.native.camera_pixels import Lens
from mjlab.sim.native.camera_slots import SlotBatch
from mjlab.sim.native.rays import CullingRule, Hits, Passed

Array = np.ndarray


class SurfaceCulling:
    """Which hits do not count: on the backs of surfaces.

    A pinhole camera sees the back of a convex geom only from inside of it, and such geoms are
    left out before rays are cast. It is looked at one by one for meshes, height fields and
    parallel rays.
    """

    def __init__(self, model: mujoco.MjModel, table: GeomTable, lens: Lens) -> None:
        self._table, self._ngeom = table, model.ngeom
        self._rule = CullingRule(model, np.zeros((model.ngeom, 3)), np.zeros((model.ngeom, 9)))
        self._is_one_sided = not {MESH, HFIELD}.isdisjoint(table.present)
        self._is_needed = self._is_one_sided or lens.is_orthographic
        self._is_field = np.append(model.geom_type == HFIELD, False)

    def rule_for(self, geoms: PosedGeoms, slots: SlotBatch, rows_per_env: int) -> Passed | None:
        """Return which hits of camera rays on `geoms` do not count; None if all do."""
        if not self._is_needed:
            return None
        one_sided = self._one_sided_rule(geoms, slots, rows_per_env)

        def passed(rows: Any, origins: Array, directions: Array, hits: Hits) -> Array:
            backs = np.einsum("...k,...k", hits.normals, directions) > 0.0
            if self._is_one_sided:
                backs |= one_sided(rows, origins, directions, hits)[0]
            return backs

        return passed

    def shadow_rule_for(self, geoms: PosedGeoms, slots: SlotBatch) -> Passed | None:
        """Return the same for shadow rays, of which only the top of height fields is in the way."""
        if HFIELD not in self._table.present:
            return None
        one_sided = self._one_sided_rule(geoms, slots, 1)

        def passed(rows: Any, origins: Array, directions: Array, hits: Hits) -> Array:
            backs, met = one_sided(rows, origins, directions, hits)
            return backs & self._is_field[met]

        return passed

    def _one_sided_rule(
        self, geoms: PosedGeoms, slots: SlotBatch, rows_per_env: int
    ) -> Callable[..., tuple[Array, Array]]:
        """Return what finds hits on the backs of meshes and height fields, and the geoms met."""
        # By ids of the model, as the rule wants them.
        ids = self._table.ids[:-1].long()
        pos = torch.zeros(len(geoms.pos), self._ngeom, 3)
        mat = torch.zeros(len(geoms.pos), self._ngeom, 3, 3)
        pos[:, ids], mat[:, ids] = geoms.pos, geoms.mat

        def one_sided(
            rows: Any, origins: Array, directions: Array, hits: Hits
        ) -> tuple[Array, Array]:
            if isinstance(rows, slice):
                rows = np.arange(len(origins))
            met = self._table.ids.numpy()[slots.columns_of(rows, hits.geoms)]
            envs = rows // rows_per_env
            poses = _OfRows(pos.numpy(), envs), _OfRows(mat.numpy(), envs)
            backs = self._rule.passed(origins, directions, hits.distances, hits.normals, met, poses)
            return backs, met

        return one_sided


class _OfRows:
    """Values of environments, read as if each row had its own."""

    def __init__(self, values: Array, envs: Array) -> None:
        self._values, self._envs = values, envs

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, tuple):
            return self._values[self._envs[key[0]], key[1]]
        return _OfRows(self._values, self._envs[key])
