"""Domain randomization: event terms that vary the physical model between environments.

Use them as the function of an `EventTermCfg`; the model fields they write are then expanded to one
copy per environment, and derived constants are recomputed.
"""

from __future__ import annotations

from mjlab.compat import older_names
from mjlab.envs.mdp.dr import _types
from mjlab.envs.mdp.dr._types import Distribution, Operation
from mjlab.envs.mdp.dr.actuator import effort_limits, pd_gains
from mjlab.envs.mdp.dr.body import (
    body_com_offset,
    body_ipos,
    body_mass,
    body_pos,
    body_quat,
    pseudo_inertia,
)
from mjlab.envs.mdp.dr.camera import (
    cam_fovy,
    cam_intrinsic,
    cam_pos,
    cam_quat,
)
from mjlab.envs.mdp.dr.geom import (
    geom_friction,
    geom_matid,
    geom_pos,
    geom_quat,
    geom_rgba,
    geom_size,
)
from mjlab.envs.mdp.dr.joint import (
    dof_armature,
    dof_damping,
    dof_frictionloss,
    encoder_bias,
    jnt_range,
    jnt_stiffness,
    joint_armature,
    joint_damping,
    joint_default_pos,
    joint_friction,
    joint_limits,
    joint_stiffness,
    qpos0,
)
from mjlab.envs.mdp.dr.light import (
    light_ambient,
    light_attenuation,
    light_cutoff,
    light_diffuse,
    light_dir,
    light_exponent,
    light_pos,
    light_specular,
)
from mjlab.envs.mdp.dr.material import (
    mat_emission,
    mat_rgba,
    mat_shininess,
    mat_specular,
    mat_texid,
    mat_texrepeat,
)
from mjlab.envs.mdp.dr.pair import (
    pair_friction,
)
from mjlab.envs.mdp.dr.site import (
    site_pos,
    site_quat,
)
from mjlab.envs.mdp.dr.tendon import (
    tendon_armature,
    tendon_damping,
    tendon_friction,
    tendon_frictionloss,
    tendon_stiffness,
)

__all__ = [
    "Distribution",
    "Operation",
    "body_com_offset",
    "body_ipos",
    "body_mass",
    "body_pos",
    "body_quat",
    "cam_fovy",
    "cam_intrinsic",
    "cam_pos",
    "cam_quat",
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "effort_limits",
    "encoder_bias",
    "geom_friction",
    "geom_matid",
    "geom_pos",
    "geom_quat",
    "geom_rgba",
    "geom_size",
    "jnt_range",
    "jnt_stiffness",
    "joint_armature",
    "joint_damping",
    "joint_default_pos",
    "joint_friction",
    "joint_limits",
    "joint_stiffness",
    "light_ambient",
    "light_attenuation",
    "light_cutoff",
    "light_diffuse",
    "light_dir",
    "light_exponent",
    "light_pos",
    "light_specular",
    "mat_emission",
    "mat_rgba",
    "mat_shininess",
    "mat_specular",
    "mat_texid",
    "mat_texrepeat",
    "pair_friction",
    "pd_gains",
    "pseudo_inertia",
    "qpos0",
    "site_pos",
    "site_quat",
    "tendon_armature",
    "tendon_damping",
    "tendon_friction",
    "tendon_frictionloss",
    "tendon_stiffness",
]

# Operations and distributions as objects. `__all__` is without them: `abs` is also a builtin.
abs, add, scale = _types.ABS, _types.ADD, _types.SCALE
uniform, log_uniform, gaussian = _types.UNIFORM, _types.LOG_UNIFORM, _types.GAUSSIAN

__getattr__ = older_names(__name__)
