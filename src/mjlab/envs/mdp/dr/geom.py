"""Randomization of geoms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import torch

from mjlab.envs.mdp.dr._core import (
    GEOM,
    MATERIAL,
    ROBOT,
    choose_ids,
    field_term,
    model_field,
    preserve_absent_geoms,
    rotation_term,
    select,
)
from mjlab.managers.event_manager import RecomputeLevel, requires_model_fields

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.dr._core import Selection
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = ["geom_friction", "geom_matid", "geom_pos", "geom_quat", "geom_rgba", "geom_size"]

geom_friction = field_term(
    __name__,
    "geom_friction",
    GEOM,
    "Randomize geom friction: axis 0 sliding, 1 torsional (needs condim >= 4), 2 rolling (condim 6). "
    "A contact uses the larger value of its two geoms unless their priorities differ.",
    default_axes=(0,),
)

# Spatial tendons wrap around geoms.
geom_pos = field_term(
    __name__,
    "geom_pos",
    GEOM,
    "Randomize geom positions x, y, z (m) in the body frame.",
    recompute=RecomputeLevel.set_const_0,
)
geom_quat = rotation_term(
    __name__,
    "geom_quat",
    GEOM,
    "Perturb geom orientations in the body frame.",
    recompute=RecomputeLevel.set_const_0,
)
geom_rgba = field_term(
    __name__,
    "geom_rgba",
    GEOM,
    "Randomize geom colors r, g, b, a in [0, 1]. Visible only on geoms without material.",
)


@requires_model_fields("geom_matid")
def geom_matid(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    asset_cfg: SceneEntityCfg = ROBOT,
    shared_random: bool = False,
) -> None:
    """Assign each selected geom one of the selected materials, uniformly at random.

    Args:
        env_ids: Environments to change. None: all.
        asset_cfg: Entity, geoms (`geom_names`) and materials to choose from (`material_names`).
        shared_random: Choose one material per environment for all geoms.

    Raises:
        ValueError: no material is selected.
    """
    geoms = select(env, env_ids, asset_cfg, GEOM)
    materials = select(env, env_ids, asset_cfg, MATERIAL)
    field = model_field(env, "geom_matid")
    chosen = choose_ids(geoms, materials, shared_random)
    field[geoms.index] = preserve_absent_geoms(geoms, chosen, field)


# Sizes.

_PRIMITIVES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}


def check_primitive_geoms(selection: Selection) -> None:
    """Raise `ValueError` if a selected geom is not a primitive."""
    types = selection.env.sim.mj_model.geom_type
    invalid = {
        name: mujoco.mjtGeom(int(types[geom])).name.removeprefix("mjGEOM_").lower()
        for name, geom in zip(selection.names, selection.columns.tolist(), strict=True)
        if int(types[geom]) not in _PRIMITIVES
    }
    if invalid:
        raise ValueError(
            f"geom_size: expected geoms of type {', '.join(_PRIMITIVES.values())}, got {invalid}; "
            "select others with geom_names of the SceneEntityCfg."
        )


def refresh_geom_bounds(selection: Selection) -> None:
    """Recompute bounding sphere radii and boxes of the selected geoms from their sizes."""
    env = selection.env
    sizes, radii = model_field(env, "geom_size"), model_field(env, "geom_rbound")
    boxes = model_field(env, "geom_aabb")
    types = torch.as_tensor(env.sim.mj_model.geom_type, device=env.device)[selection.columns]
    new_radii, new_boxes = radii[selection.index], boxes[selection.index]
    for kind in types.unique().tolist():
        index = selection.rows[:, None], selection.columns[types == kind][None, :]
        radius, half = _bounds(kind, sizes[index])
        new_radii[:, types == kind] = radius
        # The box is (center, half sizes); the center of a primitive does not move.
        new_boxes[:, types == kind, 1] = half
    radii[selection.index] = preserve_absent_geoms(selection, new_radii, radii)
    boxes[selection.index] = preserve_absent_geoms(selection, new_boxes, boxes)


def _bounds(kind: int, size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return bounding radii, (...), and half sizes, (..., 3), of primitives of one type."""
    a, b, c = size.unbind(-1)
    shape = _PRIMITIVES[kind]
    if shape == "sphere":
        return a, torch.stack((a, a, a), dim=-1)
    if shape == "capsule":
        return a + b, torch.stack((a, a, a + b), dim=-1)
    if shape == "cylinder":
        return torch.sqrt(a * a + b * b), torch.stack((a, a, b), dim=-1)
    radius = size.amax(dim=-1) if shape == "ellipsoid" else size.norm(dim=-1)
    return radius, torch.stack((a, b, c), dim=-1)


geom_size = field_term(
    __name__,
    "geom_size",
    GEOM,
    "Randomize sizes of primitive geoms (m) and recompute their bounding volumes. Mass and "
    "inertia are unchanged. Planes, height fields, meshes and SDFs are not supported.",
    operation="scale",
    also_writes=("geom_rbound", "geom_aabb"),
    recompute=RecomputeLevel.set_const_0,
    before=check_primitive_geoms,
    after=refresh_geom_bounds,
)
