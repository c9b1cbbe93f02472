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

# Results that MuJoCo's reset clears too.
RESULTS_ZERO_ON_RESET = frozenset({"qacc", "act_dot", "sensordata"})

# Derived fields that a forward pass computes in its last stage, beside columns of `sensordata`.
ACCELERATION_FIELDS = frozenset(
    {"qacc", "qacc_smooth", "qfrc_smooth", "qfrc_constraint", "qfrc_actuator", "qfrc_inverse"}
    | {"actuator_force", "act_dot", "cacc", "cfrc_int", "cfrc_ext"}
    | {"solver", "solver_niter", "solver_nnz", "solver_fwdinv"}
)

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
