"""Fields of MuJoCo that every engine has to treat alike."""

from __future__ import annotations

# Inputs of the next step that a reset sets to zero.
ZERO_INPUTS = (
    "time",
    "qvel",
    "act",
    "qacc_warmstart",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "userdata",
)
# All that somebody writes before a step, or that a step itself carries on.
INPUTS = (*ZERO_INPUTS, "qpos", "eq_active", "mocap_pos", "mocap_quat")

# Which geoms may touch each other.
COLLISION_MASKS = ("geom_contype", "geom_conaffinity")

# What mj_setConst writes: sums over the tree, and what depends on the configuration qpos0.
FIXED_CONSTANTS = ("body_subtreemass",)
CONSTANTS_AT_QPOS0 = (
    "dof_invweight0",
    "body_invweight0",
    "tendon_length0",
    "tendon_invweight0",
    "actuator_acc0",
    "actuator_biasprm",
    "eq_data",
    "cam_pos0",
    "cam_poscom0",
    "cam_mat0",
    "light_pos0",
    "light_poscom0",
    "light_dir0",
)
