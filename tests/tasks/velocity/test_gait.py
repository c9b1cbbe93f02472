"""The gait clock, and terms that follow it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from stand_ins import StandInEnv, contacts
from tensordict import TensorDict
from velocity_tasks import task_cfg

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg, RewardTermCfg, SceneEntityCfg
from mjlab.rl.exporter_utils import (
    OnnxPolicy,
    OnnxPolicyError,
    attach_metadata_to_onnx,
    get_base_metadata,
    metadata_texts,
)
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.symmetry import mirror_left_right

GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
G1 = "Mjlab-Velocity-Flat-Unitree-G1"
OFFSETS = {G1: (0.0, 0.5), GO1: (0.0, 0.5, 0.5, 0.0)}
REST_HEIGHT = {G1: 0.0, GO1: 0.0225}
SITES = {G1: ("left_foot", "right_foot"), GO1: ("FR", "FL", "RR", "RL")}
BODIES = {G1: (".*_ankle_roll_link",), GO1: (".*_calf",)}


def gait_cfg(task: str = G1, num_envs: int = 4, clock_first: bool = False):
    cfg = task_cfg(task, num_envs)
    cfg.events = {name: cfg.events[name] for name in ("reset_base", "reset_robot_joints")}
    cfg.curriculum = {}
    clock = {"gait": mdp.GaitClockCommandCfg()}
    cfg.commands = {**clock, **cfg.commands} if clock_first else {**cfg.commands, **clock}
    for group in ("actor", "critic"):
        cfg.observations[group].terms["gait"] = ObservationTermCfg(
            func=mdp.generated_commands, params={"command_name": "gait"}
        )
    cfg.rewards = {
        "height": RewardTermCfg(
            func=mdp.feet_height_by_phase,
            weight=1.0,
            params={
                "height_sensor_name": "foot_height_scan",
                "offsets": OFFSETS[task],
                "rest_height": REST_HEIGHT[task],
            },
        ),
    }
    return cfg


@pytest.fixture
def make_env() -> Iterator[Any]:
    built: list[ManagerBasedRlEnv] = []

    def make(*args: Any, edit: Any = None, **kwargs: Any) -> ManagerBasedRlEnv:
        cfg = gait_cfg(*args, **kwargs)
        if edit is not None:
            edit(cfg)
        env = ManagerBasedRlEnv(cfg, device="cpu")
        built.append(env)
        env.reset()
        return env

    yield make
    for env in built:
        env.close()


def command(env: ManagerBasedRlEnv, *rows: tuple[float, float, float]) -> None:
    twist: Any = env.command_manager.get_term("twist")
    twist.vel_command_b[:] = torch.tensor(rows)


def clock(env: ManagerBasedRlEnv) -> mdp.GaitClockCommand:
    term = env.command_manager.get_term("gait")
    assert isinstance(term, mdp.GaitClockCommand)
    return term


def no_action(env: ManagerBasedRlEnv) -> torch.Tensor:
    return torch.zeros(env.num_envs, env.action_manager.total_action_dim)


# The clock.


def test_the_phase_advances_by_its_frequency_from_a_random_start(make_env):
    env = make_env(num_envs=64)
    start = clock(env).cycles.clone()
    assert start.std() > 0.2
    assert start.min() >= 0.0
    for _ in range(5):
        env.step(no_action(env))
    advanced = torch.remainder(clock(env).cycles - start, 1.0)
    torch.testing.assert_close(advanced, torch.full_like(advanced, 1.5 * 5 * env.step_dt))


def test_a_reset_redraws_the_phase_of_its_environments_only(make_env):
    env = make_env()
    before = clock(env).cycles.clone()
    env.reset(env_ids=torch.tensor([1, 3]))
    after = clock(env).cycles
    assert (after[[0, 2]] == before[[0, 2]]).all()
    assert (after[[1, 3]] != before[[1, 3]]).all()


@pytest.mark.parametrize("clock_first", [False, True])
def test_the_clock_is_zero_while_standing(make_env, clock_first):
    env = make_env(clock_first=clock_first)
    command(env, (0.5, 0.0, 0.0), (0.05, 0.0, 0.04), (0.0, 0.0, 0.0), (0.0, 0.0, -0.2))
    phase = clock(env).phase
    expected = torch.stack((phase.sin(), phase.cos()), dim=1)
    expected[[1, 2]] = 0.0
    seen = env.observation_manager.compute_group("actor")
    assert isinstance(seen, torch.Tensor)
    torch.testing.assert_close(seen[:, -2:], expected)
    assert clock(env).is_standing.tolist() == [False, True, True, False]


def test_a_clock_without_a_velocity_command_always_runs(make_env):
    def edit(cfg: Any) -> None:
        cfg.commands["gait"].velocity_command_name = None

    env = make_env(edit=edit)
    command(env, *[(0.0, 0.0, 0.0)] * 4)
    assert clock(env).command.norm(dim=1).tolist() == pytest.approx([1.0] * 4)


def test_a_fading_clock_is_linear(make_env):
    def edit(cfg: Any) -> None:
        cfg.commands["gait"].starts, cfg.commands["gait"].fade_s = (0.0, 0.5), 0.2

    env = make_env(num_envs=16, edit=edit)
    assert set(clock(env).cycles.tolist()) == {0.0, 0.5}
    standing = torch.arange(16) % 2 == 1
    rows = torch.where(standing, 0.0, 1.0)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
    twist: Any = env.command_manager.get_term("twist")
    twist.cfg.resampling_time_range = (1e9, 1e9)
    twist.time_left[:] = 1e9
    twist.cfg.rel_heading_envs = 0.0
    twist.is_heading_env[:] = twist.is_standing_env[:] = False
    for row, walks in ((rows, ~standing), (rows.flip(0), standing)):
        twist.vel_command_b[:] = row
        before = clock(env).amplitude.clone()
        for step in range(1, 13):
            env.step(no_action(env))
            change = torch.where(walks, 1.0, -1.0) * min(step / 10, 1.0)
            torch.testing.assert_close(clock(env).amplitude, (before + change).clamp(0.0, 1.0))
    norm = clock(env).command.norm(dim=1)
    torch.testing.assert_close(norm, clock(env).amplitude)
    env.reset()
    assert (clock(env).amplitude == 0.0).all()


def test_a_deployment_can_run_the_clock_from_the_metadata_of_the_policy(make_env):
    def edit(cfg: Any) -> None:
        cfg.commands["gait"] = mdp.GaitClockCommandCfg(
            frequency=1.7, starts=(0.25,), fade_s=0.1, velocity_command_name=None
        )

    env = make_env(G1, edit=edit)
    told = metadata_texts(get_base_metadata(env, "local"))
    env.reset()
    for _ in range(7):
        env.step(no_action(env))
    time = 7 * float(told["step_dt"])
    cycles = float(told["clock_starts"]) + float(told["clock_frequency"]) * time
    amplitude = min(1.0, time / float(told["clock_fade_s"]))
    expected = [
        amplitude * math.sin(2 * math.pi * cycles),
        amplitude * math.cos(2 * math.pi * cycles),
    ]
    assert env.command_manager.get_command(told["clock_command"])[0].tolist() == pytest.approx(
        expected, abs=1e-5
    )


def test_a_policy_is_refused_where_the_clock_is_another(make_env, tmp_path):
    def faster(cfg: Any) -> None:
        cfg.commands["gait"].frequency *= 1.5

    own, other = make_env(G1), make_env(G1, edit=faster)
    path = tmp_path / "policy.onnx"
    export(own, path)
    OnnxPolicy(path).check_fits(own)
    with pytest.raises(OnnxPolicyError, match="clock_frequency: the policy has"):
        OnnxPolicy(path).check_fits(other)


def export(env: ManagerBasedRlEnv, path: Path) -> None:
    """Write a linear policy of the environment."""
    size, count = (
        env.observation_manager.group_obs_dim["actor"][0],
        env.action_manager.total_action_dim,
    )
    torch.onnx.export(
        torch.nn.Linear(size, count), (torch.zeros(1, size),), str(path), dynamo=False,
        input_names=["obs"], output_names=["actions"],
    )  # fmt: skip
    attach_metadata_to_onnx(str(path), get_base_metadata(env, "local"))


def feet_cfg(env: ManagerBasedRlEnv) -> SceneEntityCfg:
    cfg = SceneEntityCfg("robot", site_names=SITES[G1])
    cfg.resolve(env.scene)
    return cfg


def test_root_heights_are_over_the_feet(make_env):
    env = make_env()
    feet, robot = feet_cfg(env), env.scene["robot"]
    height = mdp.height_over_feet(env, feet)
    assert ((height > 0.7) & (height < 0.85)).all()
    cost = mdp.root_height_l2(env, 0.7, feet)
    torch.testing.assert_close(cost, (height - 0.7).square())
    state = robot.data.root_link_pose_w.clone()
    state[:, 2] += torch.tensor([0.0, 0.5, 1.0, -0.1])
    robot.write_root_link_pose_to_sim(state)
    env.sim.forward()
    torch.testing.assert_close(mdp.height_over_feet(env, feet), height)
    low, high = height.min().item() - 1e-3, height.max().item() + 1e-3
    assert not mdp.root_near_feet(env, low, feet).any()
    assert mdp.root_near_feet(env, high, feet).all()


def test_feet_that_come_closer_or_cross_cost_the_square_of_what_is_missing(make_env):
    env = make_env()
    feet, robot = feet_cfg(env), env.scene["robot"]
    roll = [robot.joint_names.index(f"{side}_hip_roll_joint") for side in ("left", "right")]
    pose = robot.data.default_joint_pos.clone()
    pose[:, roll] += torch.tensor([[0.0, 0.0], [-0.15, 0.15], [-0.3, 0.3], [0.2, -0.2]])
    robot.write_joint_state_to_sim(pose, torch.zeros_like(pose))
    # The costs do not depend on where the robot looks.
    state = robot.data.root_link_pose_w.clone()
    state[:, 3:] = torch.tensor([math.cos(0.7), 0.0, 0.0, math.sin(0.7)])
    robot.write_root_link_pose_to_sim(state)
    env.sim.forward()
    cost = mdp.feet_apart_l2(env, 0.2, feet)
    assert cost[0] < 1e-3
    assert cost[2] > cost[1] > 1e-3
    assert cost[3] == 0.0
    apart = (0.2 - cost[[1, 2]].sqrt()).tolist()
    sites = robot.data.site_pos_w[:, feet.site_ids]
    assert apart[0] == pytest.approx((sites[1, 0] - sites[1, 1]).norm().item(), abs=0.01)
    # Each iteration doubles the roll, and with it the shortfall of the distance of hanging legs.
    assert apart[1] < apart[0] - 0.1


def test_observation_and_reward_read_one_phase(make_env):
    """Rewards use the heights and the phase that the policy observed."""
    env = make_env()
    for _ in range(3):
        seen, *_ = env.step(no_action(env))
        sine = seen["actor"][:, -2]
        heights = env.scene["foot_height_scan"].data.heights.clone()
        target = 0.09 * torch.stack((sine.clamp(min=0), (-sine).clamp(min=0)), dim=1).square()
        expected = torch.exp(-(heights - target).square().sum(dim=1) / 0.005)
        _, reward, *_ = env.step(no_action(env))
        torch.testing.assert_close(reward, expected * env.step_dt)


def test_the_phase_resumes_exactly(make_env):
    env, other = make_env(), make_env()
    for _ in range(3):
        env.step(no_action(env))
    state = env.state_dict()
    other.load_state_dict(state)
    for _ in range(3):
        seen, resumed = (one.step(no_action(one)) for one in (env, other))
        assert torch.equal(seen[0]["actor"][:, -2:], resumed[0]["actor"][:, -2:])
        assert torch.equal(seen[1], resumed[1])


# Its mirror image.


@pytest.mark.parametrize("task", [G1, GO1])
def test_the_mirrored_clock_is_half_a_cycle_ahead(make_env, task):
    env = make_env(task, num_envs=2)
    command(env, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    groups = env.observation_manager.compute(update_history=True)
    seen = TensorDict(dict(groups), batch_size=[2])
    both, _ = mirror_left_right(env, seen)
    twice, _ = mirror_left_right(env, both[2:])
    ahead = clock(env).phase + math.pi
    for group in ("actor", "critic"):
        image = both[group][2:, -2:]
        assert image[0].tolist() == pytest.approx(
            [math.sin(ahead[0]), math.cos(ahead[0])], abs=1e-6
        )
        assert image[1].tolist() == [0.0, 0.0]
        torch.testing.assert_close(twice[group][2:], seen[group], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("task", [G1, GO1])
def test_targets_of_the_mirrored_clock_are_those_of_the_other_side(make_env, task):
    env = make_env(task, num_envs=2)
    command(env, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    heights = env.scene["foot_height_scan"].data.heights
    feet = len(OFFSETS[task])
    swapped = [1, 0, 3, 2][:feet]
    heights[0] = REST_HEIGHT[task] + 0.02 * torch.arange(feet)
    heights[1] = heights[0, swapped]
    clock(env).cycles[:] = torch.tensor([0.1, 0.6])
    params = env.reward_manager.get_term_cfg("height").params
    reward = mdp.feet_height_by_phase(env, **params)
    assert reward[0].item() == pytest.approx(reward[1].item(), rel=1e-5)


# Terms.


@pytest.mark.parametrize("task", [G1, GO1])
def test_the_reward_of_heights_is_one_on_target_and_less_off_it(make_env, task):
    env = make_env(task)
    command(env, *[(1.0, 0.0, 0.0)] * 3, (0.0, 0.0, 0.0))
    clock(env).cycles[:] = torch.tensor([0.25, 0.75, 0.5, 0.25])
    first, second = [1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0]
    feet = len(OFFSETS[task])
    swing = torch.tensor([first, second, [0.0] * 4, [0.0] * 4])[:, :feet]
    heights = env.scene["foot_height_scan"].data.heights
    heights[:] = 0.09 * swing + REST_HEIGHT[task]
    params = env.reward_manager.get_term_cfg("height").params
    assert mdp.feet_height_by_phase(env, **params).tolist() == pytest.approx([1.0] * 4)
    heights[:, 0] += 0.03
    expected = [math.exp(-(0.03**2) / 0.005)] * 4
    assert mdp.feet_height_by_phase(env, **params).tolist() == pytest.approx(expected)


TROT = ((0, 3), (1, 2))


def alternation(air_time: torch.Tensor, groups: Any = TROT, speed: float = 1.0, **params: Any):
    env: Any = StandInEnv(len(air_time), feet=contacts(current_air_time=air_time))
    env.command(*[(speed, 0.0, 0.0)] * len(air_time))
    return mdp.feet_alternate(env, "feet", groups, command_name="twist", **params)


def test_feet_alternate_in_stances_of_one_group():
    torch.manual_seed(0)
    air_time = 0.5 * torch.rand(512, 4) * (torch.rand(512, 4) < 0.5)
    reward = alternation(air_time)
    for row, value in zip(air_time.tolist(), reward.tolist(), strict=True):
        swinging = tuple(foot for foot, time in enumerate(row) if time > 0.0)
        assert value == float(swinging in TROT and max(row) < 0.35)
    assert 0.0 < reward.mean() < 1.0
    # Groups and feet within groups in other orders, and mirror images, earn the same.
    for groups in (TROT[::-1], tuple(group[::-1] for group in TROT)):
        assert torch.equal(alternation(air_time, groups), reward)
    assert torch.equal(alternation(air_time[:, [1, 0, 3, 2]]), reward)


@pytest.mark.parametrize(
    ("air_time", "reward"),
    [
        ([0.1, 0.0, 0.0, 0.1], 1.0),
        ([0.0, 0.02, 0.3, 0.0], 1.0),
        ([0.0, 0.0, 0.0, 0.0], 0.0),
        ([0.1, 0.1, 0.1, 0.1], 0.0),
        ([0.1, 0.0, 0.0, 0.0], 0.0),
        ([0.1, 0.0, 0.0, 0.4], 0.0),
    ],
)
def test_a_trot_earns_one(air_time, reward):
    assert alternation(torch.tensor([air_time])).tolist() == [reward]
    assert alternation(torch.tensor([air_time]), speed=0.05).tolist() == [0.0]


@pytest.mark.parametrize("groups", [((0,), (1, 2)), ((0, 3), (1, 3)), ((0, 3), (1, 2, 4))])
def test_each_foot_is_in_one_group(groups):
    with pytest.raises(ValueError, match="each of 4 feet of the sensor 'feet'"):
        alternation(torch.zeros(1, 4), groups)


def test_a_longer_swing_may_be_allowed():
    air_time = torch.tensor([[0.5, 0.0]])
    assert alternation(air_time, ((0,), (1,))).tolist() == [0.0]
    assert alternation(air_time, ((0,), (1,)), longest_swing=0.6).tolist() == [1.0]


def test_heights_by_phase_need_a_gait_clock(make_env):
    def edit(cfg: Any) -> None:
        cfg.rewards["height"].params["command_name"] = "twist"

    env = make_env(edit=edit)
    with pytest.raises(ValueError, match="GaitClockCommand"):
        env.step(no_action(env))


def test_joint_deviations_are_weighted_by_pattern(make_env):
    def edit(cfg: Any) -> None:
        params = {"weights": {".*knee.*": 3.0, "(?!.*knee).*": 0.5}}
        cfg.rewards["pose"] = RewardTermCfg(
            func=mdp.weighted_joint_deviation, weight=1.0, params=params
        )

    env = make_env(edit=edit)
    robot = env.scene["robot"]
    term = env.reward_manager.get_term_cfg("pose")
    position = robot.data.default_joint_pos.clone()
    position[1] += 0.1
    robot.write_joint_state_to_sim(position, torch.zeros_like(position))
    joints = len(robot.joint_names)
    expected = [0.0, 0.01 * (2 * 3.0 + (joints - 2) * 0.5), 0.0, 0.0]
    assert term.func(env, **term.params).tolist() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({".*": 1.0, "kne": 1.0}, "kne"),
        ({".*knee.*": 1.0}, "left_hip_pitch_joint"),
    ],
)
def test_weights_that_do_not_fit_the_joints_are_refused(make_env, weights, message):
    def edit(cfg: Any) -> None:
        cfg.rewards["pose"] = RewardTermCfg(
            func=mdp.weighted_joint_deviation, weight=1.0, params={"weights": weights}
        )

    with pytest.raises(ValueError, match=message):
        make_env(edit=edit)


def tilted(task: str, **feet: Any) -> Any:
    def edit(cfg: Any) -> None:
        params = {"asset_cfg": SceneEntityCfg("robot", **feet)}
        cfg.rewards["tilt"] = RewardTermCfg(func=mdp.feet_tilt, weight=1.0, params=params)

    return edit


@pytest.mark.parametrize("task", [G1, GO1])
@pytest.mark.parametrize("kind", ["site_names", "body_names"])
def test_feet_are_level_in_the_default_pose_and_tilt_with_the_robot(make_env, task, kind):
    feet = {"site_names": SITES, "body_names": BODIES}[kind][task]
    env = make_env(task, edit=tilted(task, **{kind: feet}))
    robot = env.scene["robot"]
    term = env.reward_manager.get_term_cfg("tilt")
    position = robot.data.default_joint_pos.clone()
    robot.write_joint_state_to_sim(position, torch.zeros_like(position))
    pose = robot.data.default_root_state[:, :7].clone()
    # Of yaw, roll and pitch only the latter two tilt, each as far.
    half = 0.2
    axes = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    angle = torch.tensor([0.0, half, half, half]).unsqueeze(1)
    pose[:, 3:] = torch.cat((angle.cos(), angle.sin() * axes), dim=1)
    robot.write_root_link_pose_to_sim(pose)
    env.sim.forward()
    tilt = term.func(env, **term.params)
    count = len(OFFSETS[task])
    assert tilt[:2].tolist() == pytest.approx([0.0, 0.0], abs=1e-9)
    assert tilt[2:].max().item() <= count * math.sin(2 * half) ** 2 + 1e-6
    assert tilt[2:].tolist() == pytest.approx([count * math.sin(2 * half) ** 2] * 2, rel=1e-3)


def test_feet_must_be_named(make_env):
    with pytest.raises(ValueError, match="site_names or body_names"):
        make_env(edit=tilted(G1))
