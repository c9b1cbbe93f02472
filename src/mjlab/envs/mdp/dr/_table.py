"""The table of model fields that can be randomized: one row makes one public function.

Where a row has an alias (MuJoCo's own name of the field), both names are the same function.
"""

from __future__ import annotations

from mjlab.envs.mdp.dr import _hooks as hooks
from mjlab.envs.mdp.dr._core import (
    BODY,
    CAMERA,
    DOF,
    GEOM,
    JOINT,
    LIGHT,
    MATERIAL,
    PAIR,
    QPOS,
    SITE,
    TENDON,
    FieldRow,
)
from mjlab.managers.event_manager import RecomputeLevel

# Spatial tendons run through sites and around geoms, and actuators act at sites.
_AT_QPOS0 = RecomputeLevel.set_const_0
_ALL = RecomputeLevel.set_const

_BODIES = (
    FieldRow(
        "body_mass",
        "body_mass",
        BODY,
        "Randomize body masses (kg). The inertia stays; `pseudo_inertia` scales both.",
        operation="scale",
        recompute=_ALL,
        before=hooks.warn_mass_without_inertia,
    ),
    FieldRow(
        "body_com_offset",
        "body_ipos",
        BODY,
        "Randomize centres of mass: offsets x, y, z (m) in the body frame.",
        operation="add",
        recompute=_ALL,
    ),
    FieldRow(
        "body_pos",
        "body_pos",
        BODY,
        "Randomize body positions x, y, z (m) in the parent frame.",
        operation="add",
        recompute=_AT_QPOS0,
    ),
    FieldRow(
        "body_quat",
        "body_quat",
        BODY,
        "Perturb body orientations in the parent frame.",
        rotation=True,
        recompute=_AT_QPOS0,
    ),
)

_GEOMS = (
    FieldRow(
        "geom_friction",
        "geom_friction",
        GEOM,
        "Randomize geom friction: axis 0 slides, 1 spins (needs condim >= 4), 2 rolls (condim 6). "
        "A contact uses the larger value of its two geoms unless their priorities differ.",
        default_axes=(0,),
    ),
    FieldRow(
        "geom_pos",
        "geom_pos",
        GEOM,
        "Randomize geom positions x, y, z (m) in the body frame.",
        recompute=_AT_QPOS0,
    ),
    FieldRow(
        "geom_quat",
        "geom_quat",
        GEOM,
        "Perturb geom orientations in the body frame.",
        rotation=True,
        recompute=_AT_QPOS0,
    ),
    FieldRow(
        "geom_rgba",
        "geom_rgba",
        GEOM,
        "Randomize geom colours r, g, b, a in [0, 1]; seen only on geoms without material.",
    ),
    FieldRow(
        "geom_size",
        "geom_size",
        GEOM,
        "Randomize sizes of primitive geoms (m) and refresh their bounding volumes. Mass and "
        "inertia stay. Planes, height fields, meshes and SDFs are refused.",
        operation="scale",
        also_writes=("geom_rbound", "geom_aabb"),
        recompute=_AT_QPOS0,
        before=hooks.require_primitive_geoms,
        after=hooks.refresh_geom_bounds,
    ),
)

_JOINTS = (
    FieldRow(
        "joint_armature",
        "dof_armature",
        DOF,
        "Randomize joint armature (kg m^2 of a hinge, kg of a slide).",
        recompute=_AT_QPOS0,
    ),
    FieldRow("joint_damping", "dof_damping", DOF, "Randomize joint damping (N m s/rad or N s/m)."),
    FieldRow("joint_friction", "dof_frictionloss", DOF, "Randomize dry joint friction (N m or N)."),
    FieldRow(
        "joint_stiffness",
        "jnt_stiffness",
        JOINT,
        "Randomize the stiffness of joint springs (N m/rad or N/m).",
    ),
    FieldRow(
        "joint_limits",
        "jnt_range",
        JOINT,
        "Randomize joint limits (rad or m), and with them the entity's hard and soft limits. "
        "Axis 0 is the lower end, 1 the upper; one pair for both draws them independently, so "
        "give {0: ..., 1: ...} where the intervals overlap.",
        after=hooks.refresh_entity_limits,
    ),
    FieldRow(
        "joint_default_pos",
        "qpos0",
        QPOS,
        "Shift the kinematic zero of joints (rad or m): the joint angle is qpos - qpos0. Default "
        "joint positions and reset targets of the entity stay.",
        operation="add",
        recompute=_AT_QPOS0,
        after=hooks.normalize_ball_joints,
    ),
)

_SITES = (
    FieldRow(
        "site_pos",
        "site_pos",
        SITE,
        "Randomize site positions x, y, z (m) in the body frame.",
        recompute=_AT_QPOS0,
    ),
    FieldRow(
        "site_quat",
        "site_quat",
        SITE,
        "Perturb site orientations in the body frame.",
        rotation=True,
        recompute=_AT_QPOS0,
    ),
)

_TENDONS = (
    FieldRow(
        "tendon_armature",
        "tendon_armature",
        TENDON,
        "Randomize tendon armature (kg).",
        recompute=_AT_QPOS0,
    ),
    FieldRow("tendon_damping", "tendon_damping", TENDON, "Randomize tendon damping (N s/m)."),
    FieldRow("tendon_stiffness", "tendon_stiffness", TENDON, "Randomize tendon stiffness (N/m)."),
    FieldRow(
        "tendon_friction", "tendon_frictionloss", TENDON, "Randomize dry tendon friction (N)."
    ),
)

_CAMERAS = (
    FieldRow(
        "cam_pos",
        "cam_pos",
        CAMERA,
        "Randomize camera positions x, y, z (m) in the body frame. Moves cameras of mode fixed "
        "only.",
    ),
    FieldRow(
        "cam_quat",
        "cam_quat",
        CAMERA,
        "Perturb camera orientations in the body frame.",
        rotation=True,
    ),
    FieldRow(
        "cam_fovy",
        "cam_fovy",
        CAMERA,
        "Randomize vertical fields of view (degrees). Cameras with a focal length and a sensor "
        "size do not read it, and are refused when the term is built: see `cam_intrinsic`.",
    ),
    FieldRow(
        "cam_intrinsic",
        "cam_intrinsic",
        CAMERA,
        "Randomize camera intrinsics: focal lengths x, y and principal point x, y (m).",
    ),
)

_LIGHTS = (
    FieldRow("light_pos", "light_pos", LIGHT, "Randomize light positions x, y, z (m), body frame."),
    FieldRow(
        "light_dir",
        "light_dir",
        LIGHT,
        "Randomize light directions x, y, z (body frame), which are then brought to length 1. "
        "Axes that are not targeted start from the default direction.",
        unit=True,
    ),
    FieldRow("light_diffuse", "light_diffuse", LIGHT, "Randomize diffuse colours r, g, b."),
    FieldRow("light_specular", "light_specular", LIGHT, "Randomize specular colours r, g, b."),
    FieldRow("light_ambient", "light_ambient", LIGHT, "Randomize ambient colours r, g, b."),
    FieldRow(
        "light_attenuation",
        "light_attenuation",
        LIGHT,
        "Randomize attenuation: constant, linear and quadratic coefficient.",
    ),
    FieldRow("light_cutoff", "light_cutoff", LIGHT, "Randomize spotlight cutoffs (degrees)."),
    FieldRow("light_exponent", "light_exponent", LIGHT, "Randomize spotlight exponents."),
)

_MATERIALS = (
    FieldRow(
        "mat_rgba",
        "mat_rgba",
        MATERIAL,
        "Randomize material colours r, g, b, a in [0, 1]; a texture is multiplied by it.",
    ),
    FieldRow("mat_texrepeat", "mat_texrepeat", MATERIAL, "Randomize texture repeats x, y."),
    FieldRow("mat_emission", "mat_emission", MATERIAL, "Randomize material emission."),
    FieldRow("mat_specular", "mat_specular", MATERIAL, "Randomize specularity in [0, 1]."),
    FieldRow("mat_shininess", "mat_shininess", MATERIAL, "Randomize shininess in [0, 1]."),
)

_PAIRS = (
    FieldRow(
        "pair_friction",
        "pair_friction",
        PAIR,
        "Randomize friction of contact pairs: tangent 1, tangent 2, spin, roll 1, roll 2.",
        default_axes=(0,),
    ),
)

TABLE = {
    row.name: row
    for row in (
        *_BODIES,
        *_GEOMS,
        *_JOINTS,
        *_SITES,
        *_TENDONS,
        *_CAMERAS,
        *_LIGHTS,
        *_MATERIALS,
        *_PAIRS,
    )
}
