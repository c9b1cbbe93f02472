"""Counterparts of Isaac Lab's names: plain data for error messages, and for the name map of the docs.

Names that are the same here, in the same place, are not listed.
"""

from __future__ import annotations

_WRENCH = "write_external_wrench_to_sim"
_ACTUATORS = "EntityCfg.articulation.actuators"
_STAGED = "reward_curriculum or termination_curriculum"
_VELOCITY = "in mjlab.tasks.velocity.mdp"
_SCALED = "JointPositionActionCfg with scale and offset"

ATTRIBUTES: dict[str, dict[str, str]] = {
    "EntityData": {
        "root_pos_w": "root_link_pos_w",
        "root_quat_w": "root_link_quat_w",
        "root_pose_w": "root_link_pose_w",
        "root_vel_w": "root_com_vel_w",
        "root_lin_vel_w": "root_com_lin_vel_w",
        "root_ang_vel_w": "root_link_ang_vel_w",
        "root_lin_vel_b": "root_com_lin_vel_b, or root_link_lin_vel_b at the origin of the link",
        "root_ang_vel_b": "root_link_ang_vel_b",
        "root_state_w": "root_link_pose_w and root_com_vel_w",
        "body_pos_w": "body_link_pos_w",
        "body_quat_w": "body_link_quat_w",
        "body_pose_w": "body_link_pose_w",
        "body_vel_w": "body_com_vel_w",
        "body_lin_vel_w": "body_com_lin_vel_w",
        "body_ang_vel_w": "body_link_ang_vel_w",
        "body_state_w": "body_link_pose_w and body_com_vel_w",
        "applied_torque": "qfrc_actuator",
        "computed_torque": "qfrc_actuator, with effort limits applied",
        "joint_limits": "joint_pos_limits",
        "default_joint_limits": "default_joint_pos_limits",
        "GRAVITY_VEC_W": "gravity_vec_w",
        "FORWARD_VEC_B": "forward_vec_b",
        "default_mass": 'env.sim.get_default_field("body_mass")',
        "default_inertia": 'env.sim.get_default_field("body_inertia")',
        "joint_stiffness": f"the gains of {_ACTUATORS}, in the model actuator_gainprm",
        "joint_damping": f"the gains of {_ACTUATORS}, in the model actuator_biasprm",
        "joint_effort_limits": f"effort_limit of {_ACTUATORS}, in the model actuator_forcerange",
    },
    "Entity": {
        "write_root_pose_to_sim": "write_root_link_pose_to_sim",
        "write_root_velocity_to_sim": "write_root_com_velocity_to_sim",
        "write_joint_damping_to_sim": "dr.joint_damping",
        "write_joint_stiffness_to_sim": "dr.pd_gains",
        "set_external_force_and_torque": _WRENCH,
        "permanent_wrench_composer": _WRENCH,
        "instantaneous_wrench_composer": _WRENCH,
        "root_physx_view": "env.sim.model and env.sim.data",
        "num_instances": "env.num_envs",
    },
    "ManagerBasedRlEnv": {
        "rew_buf": "reward_buf",
    },
    "ContactData": {
        "net_forces_w": 'force with reduce="netforce", of the opposite sign',
        "net_forces_w_history": "force_history",
        "force_matrix_w": "force of a sensor with a secondary",
        "force_matrix_w_history": "force_history of a sensor with a secondary",
    },
    "mdp": {
        # Observations.
        "joint_pos": "joint_pos_rel, relative to the default positions",
        "joint_vel": "joint_vel_rel",
        "image": "camera_rgb or camera_depth in mjlab.tasks.manipulation.mdp",
        "body_pose_w": "body_link_pose_w of EntityData",
        "root_pos_w": "root_link_pos_w of EntityData",
        "root_quat_w": "root_link_quat_w of EntityData",
        "base_pos_z": "root_link_pos_w[:, 2:3] of EntityData",
        "imu_orientation": "builtin_sensor of a framequat sensor",
        "imu_ang_vel": "builtin_sensor of a gyro",
        "imu_lin_acc": "builtin_sensor of an accelerometer",
        # Rewards.
        "joint_vel_limits": "joint_velocity_hinge_penalty in mjlab.tasks.manipulation.mdp",
        "applied_torque_limits": "joint_torques_l2, the nearest; actuators clip at their effort_limit",
        "contact_forces": "undesired_contacts, or soft_landing in mjlab.tasks.velocity.mdp",
        "track_lin_vel_xy_exp": f"track_linear_velocity {_VELOCITY}",
        "track_ang_vel_z_exp": f"track_ang_vel_z_exp {_VELOCITY}",
        "feet_slide": f"feet_slip {_VELOCITY}",
        "is_terminated_term": "env.termination_manager.get_term(name)",
        # Terminations.
        "command_resample": "time_left of the command term",
        "joint_vel_out_of_limit": "joint_vel of EntityData; joints have no velocity limits",
        # Events.
        "randomize_rigid_body_mass": "dr.body_mass",
        "randomize_rigid_body_com": "dr.body_com_offset",
        "randomize_rigid_body_material": "dr.geom_friction",
        "randomize_actuator_gains": "dr.pd_gains",
        "randomize_joint_parameters": "dr.joint_friction, dr.joint_armature or dr.joint_limits",
        "randomize_physics_scene_gravity": "env.sim.model.opt.gravity",
        "reset_root_state_with_random_orientation": (
            "reset_root_state_uniform with roll, pitch and yaw in pose_range"
        ),
        # Actions.
        "DifferentialInverseKinematicsActionCfg": "DifferentialIKActionCfg",
        "JointPositionToLimitsActionCfg": _SCALED,
        "EMAJointPositionToLimitsActionCfg": _SCALED,
        # Commands and curricula.
        "NullCommandCfg": "no command: commands={}",
        "modify_env_param": _STAGED,
        "modify_term_cfg": _STAGED,
        "terrain_levels_vel": f"terrain_levels_vel {_VELOCITY}",
    },
}
"""Counterpart here, by owner and name. `mdp`: modules of terms."""

FIELDS: dict[str, str] = {
    "asset_name": "entity_name",
    "joint_names": "actuator_names",
    "joint_names_expr": "target_names_expr",
    "body_name": "frame_name",
    "effort_limit_sim": "effort_limit",
    "prim_path": "primary",
    "filter_prim_paths_expr": "secondary",
    "spawn": "spec_fn",
    "actuators": "articulation",
}
"""Field of configs here, by name. For classes that have the field."""
