"""Casting rays on the native engine: what `Engine.raycast` promises, at a speed of its own.

`mj_ray` tries every geom of the model for every ray, and on generated terrain these are hundreds.
So rays are cast against the geoms that never move in further batches, whose simulations hold only
the few geoms that are near (`ray_nearby`). Their numbers are the same, hence the results.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sim.native.ray_casting import Hits, cast_through
from mjlab.sim.native.ray_culling import CullingRule
from mjlab.sim.native.ray_nearby import NearbyRays, cluster_rays
from mjlab.sim.native.ray_planes import StaticPlanes
from mjlab.sim.native.ray_sharing import SharedGeoms
from mjlab.sim.native.ray_tiles import (
    StaticGeoms,
    in_groups,
    is_static,
    is_welded,
    movable_kind,
    static_geoms,
    visible_geoms,
)

logger = logging.getLogger(__name__)

Array = np.ndarray
MakeBatch = Callable[[mujoco.MjModel, int], Any]
Poses = Callable[[], tuple[Array, Array]]

# Fewer static geoms than this are tried faster than they are looked up.
_MIN_GEOMS = 12
# A first query of fewer trials (rays times geoms) is not worth a plan: it may be the only one.
_MIN_TRIALS = 5_000_000
# Windows that reach farther (metres) hold most of the geoms anyway. So many calls later, the rays
# may be closer together.
_MAX_MARGIN = 4.0
_PAUSE = 100
# If more of the environments than this have rays that left their window, windows are made larger.
_MAX_STRAYS = 0.02

# Where one of these differs between environments, geoms may become visible.
_LOOKS = frozenset({"geom_rgba", "geom_matid", "mat_rgba"})


class NativeRays:
    """Casts the rays of a native engine."""

    def __init__(
        self, model: mujoco.MjModel, batch: Any, make_batch: MakeBatch, poses: Poses
    ) -> None:
        """Cast in `batch`.

        `make_batch(model, count)` makes further batches, and `poses()` returns the current
        positions (N, ngeom, 3) and orientations (N, ngeom, 3, 3) of the geoms.
        """
        self._poses = poses
        self._model, self._batch, self._make_batch = model, batch, make_batch
        self._host = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._host)
        self._rule = CullingRule(model, self._host.geom_xpos, self._host.geom_xmat)
        self._plans: dict[Any, _Plan] = {}
        self._has_warned = False

    def cast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None,
        exclude_body_ids: torch.Tensor | None,
        max_distances: torch.Tensor | None,
        fields: Mapping[str, torch.Tensor],
    ) -> Hits:
        """Cast rays (N, R); see `Engine.raycast`.

        `fields` are the model fields that environments have for themselves, (N, ...).
        """
        excluded = None
        if exclude_body_ids is not None:
            excluded = np.ascontiguousarray(exclude_body_ids.numpy().astype(np.int32))
        rays = origins.shape[1]
        looks_vary = not _LOOKS.isdisjoint(fields)
        key = (geom_groups, rays, None if excluded is None else excluded.tobytes(), looks_vary)
        if key not in self._plans:
            self._plans[key] = self._plan(geom_groups, excluded, looks_vary)
        plan = self._plans[key]
        hits = Hits.empty(len(origins), rays)
        trials = origins.shape[0] * rays * self._model.ngeom
        is_first, plan.is_new = plan.is_new and trials < _MIN_TRIALS, False
        is_shared = self._is_shared(plan, fields)
        if plan.planes is not None and is_shared:
            plan.planes.cast(origins.numpy(), directions.numpy(), hits)
        elif is_first or plan.nearby is None or not is_shared:
            self._cast_all(plan, origins, directions, hits)
        else:
            self._cast_nearby(plan, origins, directions, max_distances, hits)
        if max_distances is not None:
            too_far = hits.distances > max_distances.numpy()
            if too_far.any():
                hits.forget(too_far)
        return hits

    @cached_property
    def _movable(self) -> Array:
        return movable_kind(self._model)

    def _is_shared(self, plan: _Plan, fields: Mapping[str, torch.Tensor]) -> bool:
        """Return whether the geoms that are not looked for in the model are as compiled."""
        if plan.shared is None:
            return True
        field = plan.shared.differing_field(fields)
        if field is not None and not self._has_warned:
            self._has_warned = True
            logger.warning(
                "Rays try every geom of the model from now on, which is much slower: the field %r "
                "of geoms that never move, such as the ground, differs between environments or "
                "from the compiled model. Randomize it for things that move only (asset_cfg).",
                field,
            )
        return field is None

    def _plan(
        self, groups: tuple[int, ...] | None, excluded: Array | None, looks_vary: bool
    ) -> _Plan:
        """Find out which geoms the rays can meet, and which of these are looked up by place."""
        model = self._model
        visible = visible_geoms(model, groups)
        if looks_vary:
            # What moves may have been compiled transparent, and be seen in some environment.
            visible |= in_groups(model, groups) & ~is_static(model)
        plan = _Plan(groups, excluded, is_one_sided=self._rule.concerns(visible))
        plan.planes = StaticPlanes.alone(model, self._host, visible, excluded)
        if plan.planes is not None:
            plan.shared = SharedGeoms(model, np.flatnonzero(visible))
        near = visible & is_static(model)
        if near.sum() < _MIN_GEOMS:
            return plan
        near &= self._movable
        others = visible & ~near
        plan.has_moving = bool(others.any())
        # The others are cast without what MuJoCo counts as static, and no body is left out.
        complete = not (others & is_welded(model)).any()
        kept = excluded is None or not np.isin(model.geom_bodyid[near], excluded).any()
        if complete and kept and near.sum() >= _MIN_GEOMS:
            plan.nearby = static_geoms(model, self._host, near)
            plan.shared = SharedGeoms(model, np.flatnonzero(near))
        return plan

    def _cast_all(
        self,
        plan: _Plan,
        origins: torch.Tensor,
        directions: torch.Tensor,
        hits: Hits,
        envs: Array | None = None,
        static: bool = True,
    ) -> None:
        """Cast against the geoms of the model itself, in the environments `envs` (None: all)."""

        poses = self._poses() if self._rule.fields_are_carried and plan.is_one_sided else None

        def passed(rows: Any, origins: Array, directions: Array, hits: Hits) -> Array:
            return self._rule.passed(
                origins,
                directions,
                hits.distances,
                hits.normals,
                hits.geoms,
                None if poses is None else (poses[0][rows], poses[1][rows]),
            )

        cast_through(
            self._batch,
            np.ascontiguousarray(origins.numpy()),
            np.ascontiguousarray(directions.numpy()),
            hits,
            passed if plan.is_one_sided else None,
            envs,
            geomgroup=plan.mask,
            bodyexclude=-1 if plan.excluded is None else plan.excluded,
            flg_static=static,
        )

    def _cast_nearby(
        self,
        plan: _Plan,
        origins: torch.Tensor,
        directions: torch.Tensor,
        reach: torch.Tensor | None,
        hits: Hits,
    ) -> None:
        """Cast against the static geoms that are near, and then against those that move."""
        if not plan.parts and plan.pause == 0:
            self._build(plan, origins, directions, reach)
        if not plan.parts:
            plan.pause -= 1
            self._cast_all(plan, origins, directions, hits)
            return
        strayed = np.zeros(len(origins), dtype=bool)
        for part in plan.parts:
            strayed |= part.cast(origins, directions, reach, hits)
        if plan.has_moving:
            moving = Hits.empty(*hits.distances.shape)
            self._cast_all(plan, origins, directions, moving, static=False)
            hits.take_nearer(moving)
        if strayed.any():
            self._cast_all(plan, origins, directions, hits, np.flatnonzero(strayed))
            if strayed.mean() > _MAX_STRAYS:
                plan.parts.clear()

    def _build(
        self,
        plan: _Plan,
        origins: torch.Tensor,
        directions: torch.Tensor,
        reach: torch.Tensor | None,
    ) -> None:
        """Sort the rays into clusters, with windows that fit where they are now and some more."""
        limit = np.full(origins.shape[1], np.inf) if reach is None else reach.numpy()
        excluded = np.full(len(limit), -1) if plan.excluded is None else plan.excluded
        _, sources = np.unique(np.stack((limit, excluded)), axis=1, return_inverse=True)
        ends = (origins + (directions * torch.from_numpy(limit)[:, None]).nan_to_num()).numpy()
        # An environment that has diverged says nothing about the others.
        starts, ends = np.nan_to_num(origins.numpy()), np.nan_to_num(ends)
        classes = cluster_rays(starts[0], sources.reshape(-1))
        margins = [_margin(clusters, starts, ends) for clusters in classes]
        if len(margins) == len(plan.margins):
            margins = [max(pair) for pair in zip(margins, plan.margins, strict=True)]
        if not max(margins) < _MAX_MARGIN:
            plan.pause = _PAUSE
            return
        assert plan.nearby is not None
        rule = self._rule if plan.is_one_sided else None
        plan.margins = margins
        plan.parts = [
            NearbyRays(
                clusters, len(starts), plan.nearby, margin, self._make_batch, self._model, rule
            )
            for clusters, margin in zip(classes, margins, strict=True)
        ]


def _margin(clusters: list[Array], starts: Array, ends: Array) -> float:
    """Return how far windows have to reach around clusters, for nearly all environments."""
    extents = []
    for rays in clusters:
        points = np.concatenate((starts[:, rays, :2], ends[:, rays, :2]), axis=1)
        # Half the diagonal, which turning does not change.
        extents.append(np.linalg.norm(np.ptp(points, axis=1) / 2, axis=-1))
    return 1.2 * float(np.quantile(np.max(extents, axis=0), 0.99)) + 0.02


class _Plan:
    """How to cast rays against the geoms of some groups, as far as it is the same in every call."""

    def __init__(
        self, groups: tuple[int, ...] | None, excluded: Array | None, *, is_one_sided: bool
    ) -> None:
        self.mask = None
        if groups is not None:
            self.mask = np.zeros(6, dtype=np.uint8)
            self.mask[list(groups)] = 1
        self.excluded = excluded
        self.is_one_sided = is_one_sided
        self.is_new = True
        self.planes: StaticPlanes | None = None
        self.nearby: StaticGeoms | None = None
        self.shared: SharedGeoms | None = None
        self.has_moving = False
        self.pause = 0
        self.parts: list[NearbyRays] = []
        self.margins: list[float] = []
