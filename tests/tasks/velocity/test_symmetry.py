"""Mirror images are what the robot would sense and do on the other side."""

from __future__ import annotations

from dataclasses import asdict

import pytest
import torch
from tensordict import TensorDict

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg, SceneEntityCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity.symmetry import mirror_left_right

FLAT_GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
TASKS = [FLAT_GO1, "Mjlab-Velocity-Flat-Unitree-G1", "Mjlab-Velocity-Rough-Unitree-Go1"]


def make_env(task, edit=None):
    """Two environments on flat ground in which nothing is random."""
    cfg = load_env_cfg(task)
    cfg.scene.num_envs = 2
    cfg.scene.terrain.terrain_type, cfg.scene.terrain.terrain_generator = "plane", None
    cfg.events, cfg.curriculum = {}, {}
    cfg.commands["twist"].rel_standing_envs = 0.0
    cfg.observations["actor"].enable_corruption = False
    if edit is not None:
        edit(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def mirrored_rows(env, actions):
    """Return `actions` (1, n) and below it its mirror image."""
    return mirror_left_right(env, actions=actions)[1]


def put_before_mirror(env):
    """Give environment 0 a random state and environment 1 its mirror image."""
    robot = env.scene["robot"]
    pose = robot.data.default_root_state[:, :7].clone()
    pose[:, :3] = env.scene.env_origins + torch.tensor([0.0, 0.0, 0.6])
    quat = torch.nn.functional.normalize(
        torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.2 * torch.randn(4), dim=0
    )
    pose[0, 3:], pose[1, 3:] = quat, quat * torch.tensor([1.0, -1.0, 1.0, -1.0])
    # Slow turns, because the gauge of velocity (the IMU) is not in the middle of the Go1.
    velocity = (torch.randn(6) * torch.tensor([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])).repeat(2, 1)
    velocity[1] *= torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    # Actions and joints are in the same order, and both measured from the default pose.
    offsets = mirrored_rows(env, 0.1 * torch.randn(1, len(robot.joint_names)))
    speeds = mirrored_rows(env, torch.randn(1, len(robot.joint_names)))
    robot.write_root_state_to_sim(torch.cat([pose, velocity], dim=1))
    robot.write_joint_state_to_sim(robot.data.default_joint_pos + offsets, speeds)
    command = torch.randn(3)
    signs = torch.tensor([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]])
    env.command_manager.get_term("twist").vel_command_b[:] = command * signs
    env.scene.write_data_to_sim()
    env.sim.forward()
    env.sim.sense()


@pytest.mark.parametrize("task", TASKS)
def test_the_mirror_image_is_what_a_mirrored_robot_senses(task):
    env = make_env(task)
    torch.manual_seed(0)
    assert env.action_manager.get_term("joint_pos").target_names == list(
        env.scene["robot"].joint_names
    )
    for _ in range(3):
        put_before_mirror(env)
        seen = env.observation_manager.compute(update_history=True)
        both, _ = mirror_left_right(env, TensorDict(seen, batch_size=[2]))
        assert both.batch_size == torch.Size([4])
        for group, values in seen.items():
            torch.testing.assert_close(both[group][:2], values)
            torch.testing.assert_close(both[group][2], values[1], atol=0.05, rtol=0.05)
    env.close()


@pytest.mark.parametrize("task", TASKS[:2])
def test_mirrored_actions_lead_to_mirrored_motion(task):
    env = make_env(task)
    torch.manual_seed(0)
    put_before_mirror(env)
    env.step(mirrored_rows(env, 0.3 * torch.randn(1, env.action_manager.total_action_dim)))
    robot = env.scene["robot"]
    moved = robot.data.joint_pos - robot.data.default_joint_pos
    # Masses of the two sides differ by some grams.
    torch.testing.assert_close(mirrored_rows(env, moved[:1])[1], moved[1], atol=0.01, rtol=0)
    across = (robot.data.root_link_pos_w - env.scene.env_origins)[:, 1]
    assert across[0].abs() > 1e-3
    torch.testing.assert_close(across[0], -across[1], atol=2e-3, rtol=0)
    env.close()


def test_a_mirror_image_of_the_mirror_image_is_the_original():
    env = make_env(FLAT_GO1)
    seen = TensorDict(env.observation_manager.compute(), batch_size=[2])
    seen = seen.apply(torch.randn_like)
    actions = torch.randn(2, 12)
    once = mirror_left_right(env, seen, actions)
    twice = mirror_left_right(env, once[0][2:], once[1][2:])
    for group in set(seen.keys()):
        torch.testing.assert_close(twice[0][group][2:], seen[group])
    torch.testing.assert_close(twice[1][2:], actions)
    env.close()


def unknown_term(cfg):
    cfg.observations["actor"].terms["clock"] = ObservationTermCfg(
        func=lambda env: torch.zeros(env.num_envs, 1)
    )


def a_selection_of_joints(cfg):
    cfg.observations["actor"].terms["joint_vel"].params["asset_cfg"] = SceneEntityCfg(
        "robot", joint_names=("FL_.*",)
    )


def a_history(cfg):
    cfg.observations["actor"].terms["projected_gravity"].history_length = 3


def a_pose_that_leans(cfg):
    cfg.scene.entities["robot"].init_state.joint_pos = {"FL_hip_joint": 0.4}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (unknown_term, "does not know what 'actor/clock' is"),
        (a_selection_of_joints, "expects 12 numbers of 'actor/joint_vel', which has 3"),
        (a_history, "expects 3 numbers of 'actor/projected_gravity', which has 9"),
        (a_pose_that_leans, "Joint 'FR_hip_joint' is not the mirror image of 'FL_hip_joint'"),
    ],
)
def test_what_has_no_known_mirror_image_is_refused(edit, message):
    env = make_env(FLAT_GO1, edit)
    with pytest.raises(ValueError, match=message):
        mirror_left_right(env, actions=torch.zeros(2, 12))
    env.close()


def test_the_cpu_profile_learns_from_mirror_images(tmp_path):
    cfg, rl_cfg = load_env_cfg(FLAT_GO1, profile="cpu"), load_rl_cfg(FLAT_GO1, profile="cpu")
    cfg.scene.num_envs = 8
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    runner = MjlabOnPolicyRunner(env, asdict(rl_cfg), str(tmp_path), "cpu")
    sizes = []
    runner.alg.actor.register_forward_pre_hook(
        lambda module, args: sizes.append(args[0].batch_size[0])
    )
    runner.learn(1)
    # A mini-batch is a quarter of 8 environments times 12 steps, and its mirror image.
    assert max(sizes) == 2 * 8 * 12 // 4
    path = tmp_path / "symmetric.pt"
    runner.save(str(path))
    runner.load(str(path))
    env.close()
