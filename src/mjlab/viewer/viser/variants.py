"""Shapes that differ between environments, drawn as each environment has them."""

from __future__ import annotations

import copy
import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import viser
import viser.transforms as vtf
from mjviser.conversions import group_geoms_by_visual_compat, merge_geoms

from mjlab.viewer.model_sync import sync_model_fields, to_numpy

if TYPE_CHECKING:
    from mjviser import ViserMujocoScene

log = logging.getLogger(__name__)

_SHAPE_FIELDS = frozenset(
    {"geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_matid", "geom_dataid", "mat_rgba"}
)
_MAX_SHAPES = 256
_CHECK_PERIOD_S = 1.0


@dataclass
class _Shape:
    """One look, and the environments and bodies that have it."""

    handle: viser.BatchedGlbHandle
    group: int
    envs: list[int] = field(default_factory=list)
    bodies: list[int] = field(default_factory=list)


class GeomVariants:
    """Replaces mjviser's one shape for all environments where randomisation made them differ.

    Environments and bodies that look alike share a batch. Shapes are sent again when the fields
    have changed, at most once a second: randomisation at resets changes them often.
    """

    def __init__(self, scene: ViserMujocoScene, sim_model: Any, expanded_fields: set[str]):
        """Prepare to draw the per-environment `expanded_fields` of `sim_model`."""
        self._scene = scene
        self._sim_model = sim_model
        self._fields = _SHAPE_FIELDS & expanded_fields
        # What mjviser drew. The scene's own model is overwritten with the selected environment's.
        self._base = copy.copy(scene.mj_model)
        self._shapes: dict[Any, _Shape] = {}
        self._taken_over: set[tuple[int, int]] = set()
        self._seen: dict[str, np.ndarray] = {}
        self._next_check = 0.0

    def update(
        self, body_xpos: np.ndarray, body_xmat: np.ndarray, env_idx: int, offset: np.ndarray
    ) -> None:
        """Move the shapes to (num_envs, nbody, ...) poses; make them again if they changed."""
        now = time.perf_counter()
        if now >= self._next_check:
            self._next_check = now + _CHECK_PERIOD_S
            self._rebuild_if_changed()
        if not self._shapes:
            return
        quats = vtf.SO3.from_matrix(body_xmat).wxyz
        for shape in self._shapes.values():
            envs, bodies = np.array(shape.envs), np.array(shape.bodies)
            chosen = envs < len(body_xpos)
            if self._scene.show_only_selected:
                chosen = envs == env_idx
            envs, bodies = envs[chosen], bodies[chosen]
            shape.handle.visible = self._scene.geom_groups_visible[shape.group] and len(envs) > 0
            if shape.handle.visible:
                shape.handle.batched_positions = body_xpos[envs, bodies] + offset
                shape.handle.batched_wxyzs = quats[envs, bodies]

    def _rebuild_if_changed(self) -> None:
        values = {name: to_numpy(getattr(self._sim_model, name)) for name in sorted(self._fields)}
        if values.keys() == self._seen.keys() and all(
            np.array_equal(value, self._seen[name]) for name, value in values.items()
        ):
            return
        self._seen = {name: value.copy() for name, value in values.items()}
        for shape in self._shapes.values():
            shape.handle.remove()
        self._shapes = {}
        self._take_over(_varying_geoms(self._base, values))
        if self._taken_over:
            self._build()

    def _take_over(self, varying: np.ndarray) -> None:
        """Remove mjviser's batches of bodies with a varying geom; they are drawn here from now."""
        model = self._base
        for batch in list(self._scene._mesh_groups):
            geoms = np.isin(model.geom_bodyid, batch.body_ids)
            if (varying & geoms & (model.geom_group == batch.group_id)).any():
                batch.handle.remove()
                # Batches hold arrays, so that they cannot be compared as `remove` would do.
                groups = self._scene._mesh_groups
                groups[:] = [other for other in groups if other is not batch]
                self._taken_over |= {(int(body), batch.group_id) for body in batch.body_ids}

    def _build(self) -> None:
        model = copy.copy(self._base)
        borrowed = False
        for env_idx in range(self._scene.num_envs):
            sync_model_fields(model, self._sim_model, self._fields, env_idx)
            for body, group in sorted(self._taken_over):
                for part, geom_ids in enumerate(_drawn_geoms(model, body, group)):
                    look = self._scene._geom_subgroup_fingerprint(model, geom_ids, False)
                    key: Any = (look, group)
                    if key not in self._shapes and len(self._shapes) >= _MAX_SHAPES:
                        # Past the limit, a body keeps the look that the model file gives it.
                        borrowed, key = True, (body, group, part)
                        model_of_key = self._base
                    else:
                        model_of_key = model
                    if key not in self._shapes:
                        self._shapes[key] = self._make_shape(model_of_key, geom_ids, group)
                    self._shapes[key].envs.append(env_idx)
                    self._shapes[key].bodies.append(body)
        if borrowed:
            log.warning("More than %d different shapes; the rest are drawn alike.", _MAX_SHAPES)

    def _make_shape(self, model: mujoco.MjModel, geom_ids: list[int], group: int) -> _Shape:
        handle = self._scene.server.scene.add_batched_meshes_trimesh(
            f"/variants/{len(self._shapes)}",
            merge_geoms(model, geom_ids),
            batched_wxyzs=np.array([[1.0, 0.0, 0.0, 0.0]]),
            batched_positions=np.zeros((1, 3)),
            lod="off",
            visible=False,
        )
        return _Shape(handle, group)


def _varying_geoms(model: mujoco.MjModel, values: dict[str, np.ndarray]) -> np.ndarray:
    """Which geoms (ngeom,) look unlike those of `model` in some environment."""
    varying = np.zeros(model.ngeom, dtype=bool)
    for name, value in values.items():
        base = np.asarray(getattr(model, name)).reshape(value.shape[1:])
        close = np.isclose(value, base[None]).reshape(*value.shape[:2], -1)
        equal = np.asarray(close.all(axis=(0, 2)))
        if name == "mat_rgba":
            has_material = model.geom_matid >= 0
            varying |= has_material & ~equal[np.maximum(model.geom_matid, 0)]
        else:
            varying |= ~equal
    return varying


def _drawn_geoms(model: mujoco.MjModel, body: int, group: int) -> list[list[int]]:
    """Drawn geoms of one body and group, split where textures keep them from being merged."""
    ids = np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == group))
    drawn = [int(i) for i in ids if model.geom_rgba[i, 3] > 0]
    return group_geoms_by_visual_compat(model, drawn) if drawn else []
