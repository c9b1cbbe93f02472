"""Warnings about files of entities that state what a composed scene does not follow."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.entity.building import KEY_NAME, short_name
from mjlab.entity.indexing import element_ids
from mjlab.utils.spec import read_setting
from mjlab.utils.string import suggest, unmatched_patterns

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.scene.scene import Scene

# Depth of an initial contact that is a mistake (m). The feet of Go1 start 0.016 m deep.
_DEEP = 0.03

# Distance of an initial position from a joint limit that is not a mistake (rad or m).
_NEAR_LIMIT = 1e-3

_LINKS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_BODY, _PLANE = int(mujoco.mjtObj.mjOBJ_BODY), int(mujoco.mjtGeom.mjGEOM_PLANE)

logger = logging.getLogger(__name__)


def report_settings(name: str, stated: dict[str, Any], spec: mujoco.MjSpec) -> None:
    """Warn of sizes and camera settings of an entity's XML that the scene does not follow.

    Other visual settings are logged at level INFO: the scene has a look of its own.

    Args:
        name: Name of the entity.
        stated: Settings of its XML; see `pop_settings`.
        spec: Spec of the scene.
    """
    for path, value in stated.items():
        kept = read_setting(spec, path)
        if np.array_equal(kept, value, equal_nan=True) or path.startswith("nuser_"):
            # MuJoCo computes the number of user values from the elements.
            continue
        place = f"sim.{path}" if path in ("njmax", "nconmax") else f"spec.{path}"
        message = (
            f"Entity {name!r}: {path} is {_show(kept)} in the scene, not {_show(value)} as in the XML; "
            f"to follow it, set {place} = {_show(value)}"
            + ("." if place.startswith("sim") else " in SceneCfg.spec_fn.")
        )
        if path.startswith(("visual.map", "n", "memory")):
            warnings.warn(message, UserWarning, stacklevel=3)
        else:
            logger.info(message)


def _show(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"({', '.join(map(_show, value.tolist()))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def warn_oddities(scene: Scene, model: mujoco.MjModel) -> None:
    """Warn once of each oddity. Call with bound entities and their compiled model."""
    entities = {n: entity for n, entity in scene.entities.items() if entity is not scene.terrain}
    data = _initial_data(scene, entities, model)
    grounds = [] if scene.terrain is None else ["the terrain"]
    for name, entity in entities.items():
        _warn_initial_joints(name, entity, model)
        if scene.env_origins.any():
            _warn_world_elements(name, entity, model)
        if not entity.is_fixed_base:
            _warn_buried(name, entity, model, data)
        grounds += [
            f"geom {short or '(unnamed)'!r} of entity {name!r}"
            for short, geom in zip(entity.geom_names, entity.indexing.geom_ids, strict=True)
            if _is_level_plane(model, geom) and model.geom_contype[geom]
        ]
    if len(grounds) > 1:
        _warn(
            f"The scene has {len(grounds)} grounds, {' and '.join(grounds)}, and robots touch all of "
            "them; remove the planes from the XML, or set SceneCfg.terrain=None."
        )


def _initial_data(
    scene: Scene, entities: dict[str, Entity], model: mujoco.MjModel
) -> mujoco.MjData:
    """Return the configured initial state at the origin of the first environment."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(KEY_NAME).id)
    origin = scene.env_origins[0].cpu().numpy()
    data.mocap_pos += origin
    for entity in entities.values():
        if not entity.is_fixed_base:
            data.qpos[entity.indexing.free_joint_q_adr[:3].cpu().numpy()] += origin
    mujoco.mj_fwdPosition(model, data)
    return data


def _warn_initial_joints(name: str, entity: Entity, model: mujoco.MjModel) -> None:
    """Warn of patterns of the initial state without a joint, and of positions beyond the limits."""
    init, names = entity.cfg.init_state, entity.joint_names
    for field in ("joint_pos", "joint_vel"):
        unmatched = unmatched_patterns(getattr(init, field) or {}, names) if names else []
        if unmatched:
            _warn(
                f"Entity {name!r} init_state.{field}: expected patterns of joints, got {unmatched} "
                f"without a joint, so these values are not used; {suggest(unmatched[0], names)}"
            )
    ids = entity.indexing.joint_ids.tolist()
    positions = np.array(entity.initial_state.joint_pos)
    low, high = model.jnt_range[ids].reshape(-1, 2).T
    limited = model.jnt_limited[ids].astype(bool)
    beyond = limited & ((positions < low - _NEAR_LIMIT) | (positions > high + _NEAR_LIMIT))
    if not beyond.any():
        return
    hinges = limited & (model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_HINGE)
    listed = [
        f"{names[i]!r} at {positions[i]:.4g} (limits {low[i]:.4g} to {high[i]:.4g})"
        for i in beyond.nonzero()[0]
    ]
    remedy = "change the positions or the limits"
    # Limits in rad that were read as degrees are below 2 pi degrees.
    if (beyond & hinges).any() and np.abs(model.jnt_range[ids][hinges]).max() < math.radians(6.3):
        remedy = 'if the limits are in rad in the MJCF, add <compiler angle="radian"/>'
    elif (np.abs(positions[beyond & hinges]) > 2.0 * math.pi).any():
        remedy = "positions of hinges are in rad, not in degrees"
    _warn(
        f"Entity {name!r} init_state.joint_pos: expected positions within the joint limits, got "
        f"{', '.join(listed)}. The limits push the joints back at every step; {remedy}."
    )


def _warn_world_elements(name: str, entity: Entity, model: mujoco.MjModel) -> None:
    """Warn of elements in the world: all environments share them.

    Level planes reach all environments; cameras and lights may show several.
    """
    ix, spec = entity.indexing, entity.spec
    fixed = {
        "bodies": [
            body.name
            for body, i in zip(spec.bodies[1:], ix.body_ids, strict=True)
            if model.body_parentid[i] == 0 and i != ix.root_body_id
        ],
        "geoms": [
            geom.name
            for geom, i in zip(spec.geoms, ix.geom_ids, strict=True)
            if model.geom_bodyid[i] == 0 and not _is_level_plane(model, i)
        ],
        "sites": [
            site.name
            for site, i in zip(spec.sites, ix.site_ids, strict=True)
            if model.site_bodyid[i] == 0
        ],
        "equalities": [
            equality.name or f"of body {short_name(equality.name1)!r}"
            for equality, i in zip(
                spec.equalities, element_ids(model, "equalities", spec.equalities), strict=True
            )
            if model.eq_type[i] in _LINKS and model.eq_objtype[i] == _BODY
            and 0 in (model.eq_obj1id[i], model.eq_obj2id[i])
        ],
    }  # fmt: skip
    listed = [f"{kind} {_names(own)}" for kind, own in fixed.items() if own]
    if listed:
        _warn(
            f"Entity {name!r}: {', '.join(listed)} are fixed to the world, so all environments share "
            "them at the world's origin; move them to a separate entity, because each environment "
            "places its own fixed bases, or to the terrain."
        )


def _warn_buried(name: str, entity: Entity, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Warn of a floating base whose initial state is deep in geoms of the world.

    Objects without a configured position are placed by an event or a command.
    """
    pos, key = entity.cfg.init_state.pos, entity.xml_key
    if not (any(pos) or entity.is_articulated or key):
        return
    ground = (model.body_weldid == 0) & (model.body_mocapid[model.body_rootid] < 0)
    depth = 0.0
    for contact in data.contact[: data.ncon]:
        bodies = [model.geom_bodyid[geom] for geom in contact.geom if geom >= 0]
        is_own = entity.indexing.root_body_id in model.body_rootid[bodies]
        if is_own and ground[bodies].any():
            depth = max(depth, -float(contact.dist))
    if depth > _DEEP:
        known = key is not None and key.root_pos not in (None, tuple(pos))
        hint = f" (keyframe {key.name!r} of the XML has {key.root_pos})" if known else ""
        _warn(
            f"Entity {name!r}: the initial state is {depth:.3f} m deep in the ground; set "
            f"init_state.pos, now {tuple(pos)}{hint}."
        )


def _is_level_plane(model: mujoco.MjModel, geom: int) -> bool:
    """Return True for a plane that is the same in all environments."""
    x, y = model.geom_quat[geom][1:3]
    return int(model.geom_type[geom]) == _PLANE and abs(x) + abs(y) < 1e-6


def _names(names: Iterable[str]) -> str:
    return str([short_name(name) or "(unnamed)" for name in names])


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=5)
