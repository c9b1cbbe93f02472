"""Stepping controller: steps, balance, and rejection of unsupported legs."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs import mdp as envs_mdp
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg, SceneEntityCfg
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.rl.biped import Biped, cpu_with_stepping
from mjlab.tasks.velocity.symmetry import mirror_left_right, mirror_of_joints

FEET = ("left_foot", "right_foot")
G1, GO1 = "Mjlab-Velocity-Flat-Unitree-G1", "Mjlab-Velocity-Flat-Unitree-Go1"


def make_env(
    task: str = G1,
    profile: str | None = "cpu",
    num_envs: int = 4,
    feet: tuple[str, ...] = FEET,
    outward: float = 0.0,
    **params: Any,
):
    cfg = load_env_cfg(task, profile=profile)
    cfg.scene.num_envs, cfg.seed = num_envs, 0
    cfg.events.pop("push_robot")
    if outward:
        pose = cfg.scene.entities["robot"].init_state.joint_pos
        pose |= {"left_hip_roll_joint": outward, "right_hip_roll_joint": -outward}
    if profile is None:
        cfg.commands["gait"] = mdp.GaitClockCommandCfg()
    params["asset_cfg"] = SceneEntityCfg("robot", site_names=feet)
    teacher = ObservationTermCfg(func=mdp.stepping_action, params=params)
    cfg.observations["teacher"] = ObservationGroupCfg(terms={"step": teacher})
    return ManagerBasedRlEnv(cfg, device="cpu")


@pytest.fixture
def env():
    env = make_env(num_envs=8)
    yield env
    env.close()


def lives(env: ManagerBasedRlEnv, steps: int, follow: bool) -> torch.Tensor:
    """Return for how many of `steps` each environment stands, (N,), and lift feet meanwhile."""
    obs, _ = env.reset()
    alive = torch.ones(env.num_envs, dtype=torch.bool)
    life = torch.zeros(env.num_envs)
    for _ in range(steps):
        shown = obs["teacher"]
        actions = torch.where(shown.abs() < 1.0, shown, 0.0) if follow else torch.zeros_like(shown)
        obs, *_ = env.step(actions)
        alive &= ~env.reset_buf.bool()
        life += alive
    return life


def test_driven_robots_step_and_stand(env):
    assert (lives(env, 100, follow=False) < 100).all()
    assert (lives(env, 100, follow=True) == 100).float().mean() > 0.6


def test_feet_lift_in_their_half_of_the_cycle(env):
    """Each foot is highest while its sine of the clock is positive."""
    obs, _ = env.reset()
    clock = env.command_manager.get_term("gait")
    heights, phases = [], []
    for _ in range(90):
        shown = obs["teacher"]
        obs, *_ = env.step(torch.where(shown.abs() < 1.0, shown, 0.0))
        heights.append(env.scene["foot_height_scan"].data.heights.clone())
        phases.append(torch.sin(clock.phase))
    height, sine = torch.stack(heights[40:]).median(dim=1).values, torch.stack(phases[40:])[:, 0]
    for foot, sign in ((0, 1.0), (1, -1.0)):
        swings = sign * sine > 0.5
        assert height[swings, foot].max() > 0.02
        assert height[swings, foot].mean() > 2.0 * height[sign * sine < -0.5, foot].mean()


def test_robots_stand_while_the_teacher_acts():
    """With the clock of training, which steps at once, robots stand for long enough."""
    env = make_env(num_envs=8)
    steps = load_rl_cfg(G1, profile="cpu").algorithm.teacher_steps
    try:
        assert (lives(env, steps, follow=True) == steps).all()
    finally:
        env.close()


def test_the_image_of_what_it_does_is_what_it_does_in_the_mirror(env):
    """Half a stride later, and with the state turned to the other side, the other leg does the same."""
    obs, _ = env.reset()
    for _ in range(20):
        obs, *_ = env.step(0.3 * torch.randn(env.num_envs, 29))
    act = env.observation_manager.get_term_cfg("teacher", "step").func
    feet = env.observation_manager.get_term_cfg("teacher", "step").params["asset_cfg"]
    shown = act(env, feet)
    robot, clock = env.scene["robot"], env.command_manager.get_term("gait")
    joints, velocities = robot.data.joint_pos.clone(), robot.data.root_link_vel_w.clone()
    pose = robot.data.root_link_pose_w.clone()
    _, mirrored = mirror_left_right(env, actions=shown)
    wanted = mirrored[env.num_envs :]
    mirror = mirror_of_joints(env.sim.mj_model, robot)
    flipped = pose.clone()
    flipped[:, 1] *= -1.0
    flipped[:, 4] *= -1.0
    flipped[:, 6] *= -1.0
    velocities = velocities * torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    robot.write_root_link_pose_to_sim(flipped)
    robot.write_root_link_velocity_to_sim(velocities)
    robot.write_joint_position_to_sim(mirror(joints))
    env.sim.forward()
    clock.cycles.add_(0.5).remainder_(1.0)
    found = act(env, feet)
    has_opinion = wanted.abs() < 1.0
    assert torch.equal(found.abs() < 1.0, has_opinion)
    assert (has_opinion.sum(dim=1) == 27).all()
    torch.testing.assert_close(found[has_opinion], wanted[has_opinion], atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("outward", [-0.05, 0.0, 0.15])
def test_swing_feet_return_to_where_the_robot_stands(outward):
    """At rest in the default pose, with feet wider apart than the hips or closer, too."""
    env = make_env(outward=outward)
    try:
        env.reset()
        robot, clock = env.scene["robot"], env.command_manager.get_term("gait")
        state = robot.data.default_root_state.clone()
        state[:, :3] += env.scene.env_origins
        robot.write_root_state_to_sim(state)
        robot.write_joint_state_to_sim(robot.data.default_joint_pos, robot.data.default_joint_vel)
        env.sim.forward()
        cfg = env.observation_manager.get_term_cfg("teacher", "step")
        term = env.action_manager.get_term("joint_pos")
        for cycles, side in ((0.4, "left"), (0.9, "right")):
            clock.cycles.fill_(cycles)
            column = term.target_names.index(f"{side}_hip_roll_joint")
            offset = (cfg.func(env, **cfg.params) * term.scale)[:, column]
            assert offset.tolist() == pytest.approx([0.0] * env.num_envs, abs=0.01)
    finally:
        env.close()


@pytest.mark.parametrize(
    ("task", "profile", "params", "facts"),
    [
        (GO1, None, {"feet": ("FR", "FL", "RR", "RL")}, ("two feet", "4")),
        (G1, "cpu", {"feet": ("left_foot",)}, ("two feet", "1")),
        (G1, "cpu", {"command_name": "twist"}, ("'twist'", "GaitClockCommand")),
        (G1, "cpu", {"action_name": "none-such"}, ("none-such",)),
    ],
)
def test_robots_that_it_does_not_know_are_refused(task, profile, params, facts):
    with pytest.raises((ValueError, KeyError)) as caught:
        make_env(task, profile, **params).close()
    for fact in facts:
        assert fact in str(caught.value)


def test_legs_without_stiffness_are_refused():
    cfg = load_env_cfg(G1, profile="cpu")
    cfg.scene.num_envs = 2
    for actuator in cfg.scene.entities["robot"].articulation.actuators:
        actuator.stiffness = 0.0
    with pytest.raises(ValueError, match="left_hip_pitch_joint.*stiffness"):
        ManagerBasedRlEnv(cfg, device="cpu").close()


def test_it_needs_an_action_of_joint_positions():
    cfg = load_env_cfg(G1, profile="cpu")
    cfg.scene.num_envs = 2
    cfg.actions["joint_pos"] = envs_mdp.JointEffortActionCfg(
        entity_name="robot", actuator_names=(".*",)
    )
    with pytest.raises(ValueError, match="JointPositionAction.*'joint_pos'.*JointEffortAction"):
        ManagerBasedRlEnv(cfg, device="cpu").close()


@pytest.mark.parametrize("has_ankles", [True, False])
def test_tilt_of_soles_counts_for_legs_with_ankles(has_ankles):
    robot = Biped(
        feet=FEET,
        height=0.74,
        minimum_height=0.5,
        feet_distance=0.2,
        bounds={".*": 0.5},
        pose={".*": 1.0},
        has_ankles=has_ankles,
    )
    profile = cpu_with_stepping(robot, solved_below={"failure_rate": 0.2})
    cfg, rl_cfg = load_env_cfg(G1), load_rl_cfg(G1)
    profile.easing(cfg, profile.policy(cfg, rl_cfg))
    assert ("soles" in cfg.rewards) == has_ankles
