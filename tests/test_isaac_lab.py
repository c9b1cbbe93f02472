"""Names that a port from Isaac Lab types: found here, or answered with the name here."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import pytest

from mjlab import managers
from mjlab.compat.isaac_lab import ATTRIBUTES, FIELDS
from mjlab.entity import Entity, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, mdp
from mjlab.sensor import ContactSensor, ContactSensorCfg
from mjlab.sensor.contact_sensor import ContactData
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.config_fields import check_fields_exist

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "isaac_lab.md"
TYPED = {
    "data": "root_pos_w root_quat_w root_lin_vel_w root_ang_vel_w root_lin_vel_b root_ang_vel_b "
    "root_state_w body_pos_w body_quat_w body_lin_vel_w body_state_w projected_gravity_b joint_pos "
    "joint_vel joint_acc joint_pos_target applied_torque computed_torque default_joint_pos "
    "default_root_state soft_joint_pos_limits joint_limits heading_w GRAVITY_VEC_W default_mass "
    "joint_stiffness joint_effort_limits",
    "entity": "find_joints find_bodies write_root_pose_to_sim write_root_velocity_to_sim "
    "write_root_state_to_sim write_joint_state_to_sim set_joint_position_target "
    "set_external_force_and_torque num_joints num_bodies joint_names body_names root_physx_view "
    "permanent_wrench_composer is_fixed_base actuators num_instances write_data_to_sim",
    "mdp": "base_lin_vel base_ang_vel projected_gravity generated_commands joint_pos_rel "
    "joint_vel_rel last_action height_scan joint_pos joint_vel image body_pose_w root_pos_w "
    "base_pos_z imu_orientation "
    "lin_vel_z_l2 ang_vel_xy_l2 flat_orientation_l2 base_height_l2 joint_torques_l2 joint_vel_l1 "
    "joint_vel_l2 joint_acc_l2 joint_deviation_l1 joint_pos_limits joint_vel_limits "
    "applied_torque_limits action_rate_l2 action_l2 undesired_contacts contact_forces "
    "track_lin_vel_xy_exp track_ang_vel_z_exp is_alive is_terminated is_terminated_term "
    "time_out bad_orientation root_height_below_minimum joint_pos_out_of_limit illegal_contact "
    "command_resample joint_vel_out_of_limit "
    "reset_root_state_uniform reset_joints_by_scale reset_joints_by_offset "
    "push_by_setting_velocity apply_external_force_torque reset_scene_to_default "
    "randomize_rigid_body_mass randomize_rigid_body_material randomize_actuator_gains "
    "randomize_joint_parameters randomize_physics_scene_gravity randomize_rigid_body_com "
    "reset_root_state_with_random_orientation "
    "JointPositionActionCfg JointVelocityActionCfg JointEffortActionCfg "
    "RelativeJointPositionActionCfg DifferentialInverseKinematicsActionCfg "
    "BinaryJointPositionActionCfg JointPositionToLimitsActionCfg EMAJointPositionToLimitsActionCfg "
    "UniformVelocityCommandCfg UniformPoseCommandCfg NullCommandCfg modify_reward_weight "
    "modify_env_param modify_term_cfg terrain_levels_vel",
    "env": "num_envs device step_dt physics_dt max_episode_length episode_length_buf "
    "common_step_counter action_manager reward_manager termination_manager command_manager "
    "observation_manager event_manager scene sim reset_buf reset_terminated reset_time_outs extras "
    "obs_buf rew_buf single_action_space action_space",
    "contact_data": "net_forces_w net_forces_w_history force_matrix_w last_air_time "
    "current_air_time",
    "contact": "compute_first_contact compute_first_air",
    "managers": "ObservationGroupCfg RewardTermCfg SceneEntityCfg ManagerTermBase CommandTermCfg "
    "ActionTermCfg RecorderTermCfg",
}


@pytest.fixture(scope="module")
def owners() -> Iterator[dict[str, Any]]:
    """Objects of a stepped environment by the keys of `TYPED`."""
    cfg = load_env_cfg("Mjlab-Reach-Yam")
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.step(env.action_manager.action)
    robot = env.scene["robot"]
    yield {
        "data": robot.data,
        "entity": robot,
        "mdp": mdp,
        "env": env,
        "contact_data": ContactData(),
        "contact": ContactSensor,
        "managers": managers,
    }
    env.close()


def answer(owner: Any, name: str) -> str | None:
    """Return None if the attribute exists, else the error message."""
    try:
        getattr(owner, name)
    except AttributeError as error:
        return str(error)
    return None


def test_names_are_found_or_answered(owners: dict[str, Any]) -> None:
    typed = [(key, name) for key, names in TYPED.items() for name in names.split()]
    assert len(typed) == 153
    answers = {pair: answer(owners[pair[0]], pair[1]) for pair in typed}
    found = [pair for pair, text in answers.items() if text is None]
    unanswered = [
        pair for pair, text in answers.items() if text is not None and "; use " not in text
    ]
    assert len(found) >= 96
    assert not unanswered


def test_the_page_lists_what_errors_answer() -> None:
    section = PAGE.read_text(encoding="utf-8").split("## Names in terms")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.+) \|$", section, re.MULTILINE)
    listed = {(name, text.replace("`", "")) for name, text in rows}
    expected = {pair for names in (*ATTRIBUTES.values(), FIELDS) for pair in names.items()}
    assert listed == expected


def test_answers_name_what_exists(owners: dict[str, Any]) -> None:
    """Counterparts that are plain attributes exist, and none of the names does here."""
    for key, owner in (("EntityData", "data"), ("Entity", "entity"), ("ManagerBasedRlEnv", "env")):
        for name, text in ATTRIBUTES[key].items():
            assert not hasattr(owners[owner], name), name
            if re.fullmatch(r"\w+", text):
                assert hasattr(owners[owner], text), text
    for name, text in ATTRIBUTES["mdp"].items():
        assert not hasattr(mdp, name), name
        if function := re.match(r"dr\.(\w+)", text):
            assert hasattr(mdp.dr, function[1]), text


@pytest.mark.parametrize(
    ("make", "name", "use"),
    [
        (
            lambda: mdp.JointPositionActionCfg(asset_name="robot", actuator_names=(".*",)),
            "asset_name",
            "entity_name",
        ),
        (lambda: ContactSensorCfg(name="touch", prim_path="/World"), "prim_path", "primary"),
        (lambda: EntityCfg(spawn=None), "spawn", "spec_fn"),
        (
            lambda: mdp.UniformPoseCommandCfg(
                entity_name="robot", body_name="hand", resampling_time_range=(1.0, 1.0)
            ),
            "body_name",
            "frame_name",
        ),
    ],
)
def test_fields_are_answered(make: Any, name: str, use: str) -> None:
    with pytest.raises(TypeError, match=f"'{name}'; use {use}"):
        make()


def test_assigned_fields_are_answered() -> None:
    cfg: Any = mdp.JointPositionActionCfg(entity_name="robot", actuator_names=(".*",))
    cfg.asset_name = "arm"
    with pytest.warns(UserWarning, match=r"asset_name \(did you mean 'entity_name'\?\)"):
        check_fields_exist("action", cfg)


def test_errors_within_a_property_keep_their_message() -> None:
    class Arm(Entity):
        @property
        def num_instances(self) -> int:
            return self.no_such_name  # ty: ignore[unresolved-attribute]

    arm = Arm(EntityCfg(spec_fn=mujoco.MjSpec))
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = arm.num_instances
    with pytest.raises(
        AttributeError, match="'Arm' object has no attribute 'root_physx_view'; use"
    ):
        _ = arm.root_physx_view  # ty: ignore[unresolved-attribute]
