"""Velocity commands: sampling, invariants and metrics."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from stand_ins import StandInEnv, velocity_command, yaw_quat

from mjlab.tasks.velocity.mdp import UniformVelocityCommandCfg
from mjlab.utils.errors import UnknownNameError

ALL = torch.arange(8)
shares = st.floats(0.0, 1.0)
angles = st.floats(-3.1, 3.1)


def started(**fields: Any) -> tuple[StandInEnv, Any]:
    """Return a stand-in and a command whose environments have just been reset."""
    env, term = velocity_command(**fields)
    term.reset(None)
    term.compute(0.0, ALL)
    return env, term


# Drawing.


@pytest.mark.parametrize("count", [1, 7, 33])
def test_draws_have_the_documented_order(count):
    shares = {
        "rel_heading_envs": 0.5,
        "rel_standing_envs": 0.3,
        "rel_world_envs": 0.4,
        "rel_forward_envs": 0.2,
    }
    env = StandInEnv(num_envs=count)
    _, term = velocity_command(env, heading_command=True, **shares)
    torch.manual_seed(5)
    term.reset(None)
    torch.manual_seed(5)
    time = 1.0 + torch.rand(count)
    vx, vy = -2.0 + 3.0 * torch.rand(count), -0.5 + 1.2 * torch.rand(count)
    wz = -0.4 + 1.3 * torch.rand(count)
    target, heading = -3.0 + 6.0 * torch.rand(count), torch.rand(count) < 0.5
    standing, world = torch.rand(count) < 0.3, torch.rand(count) < 0.4
    forward = torch.rand(count) < 0.2
    command = torch.stack((vx, vy, wz), dim=1)
    only_forward = torch.stack((vx.abs().clamp(min=0.3), 0.0 * vy, 0.0 * wz), dim=1)
    torch.testing.assert_close(term.time_left, time)
    torch.testing.assert_close(
        term.vel_command_b, torch.where(forward[:, None], only_forward, command)
    )
    torch.testing.assert_close(term.heading_target, target)
    for flag, expected in (
        (term.is_heading_env, heading),
        (term.is_standing_env, standing),
        (term.is_world_env, world),
        (term.is_forward_env, forward),
    ):
        assert flag.tolist() == expected.tolist()


def test_the_same_seed_gives_the_same_commands():
    runs = []
    for seed in (3, 3, 4):
        torch.manual_seed(seed)
        env, term = started(heading_command=True, rel_world_envs=0.5, rel_standing_envs=0.2)
        for _ in range(200):
            term.compute(0.02)
        runs.append(term.command.clone())
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_kinds_come_in_their_shares_and_independently():
    torch.manual_seed(0)
    count = 40_000
    _, term = velocity_command(
        StandInEnv(num_envs=count),
        heading_command=True,
        rel_heading_envs=0.3,
        rel_standing_envs=0.1,
        rel_world_envs=0.25,
        rel_forward_envs=0.2,
    )
    term.reset(None)
    flags = {
        "heading": (term.is_heading_env, 0.3),
        "standing": (term.is_standing_env, 0.1),
        "world": (term.is_world_env, 0.25),
        "forward": (term.is_forward_env, 0.2),
    }
    for one, (flag, share) in flags.items():
        assert flag.float().mean().item() == pytest.approx(share, abs=0.01), one
        for other, (other_flag, other_share) in flags.items():
            if one != other:
                both = (flag & other_flag).float().mean().item()
                assert both == pytest.approx(share * other_share, abs=0.01), (one, other)
    free = ~term.is_forward_env
    for k, (low, high) in enumerate(((-2.0, 1.0), (-0.5, 0.7), (-0.4, 0.9))):
        drawn = term.vel_command_b[free, k]
        assert drawn.min() >= low
        assert drawn.max() <= high
        assert drawn.mean().item() == pytest.approx((low + high) / 2, abs=0.02)
        assert drawn.std().item() == pytest.approx((high - low) / math.sqrt(12), abs=0.02)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_share_of_zero_is_none_and_of_one_is_all(share):
    _, term = velocity_command(StandInEnv(num_envs=1000), rel_standing_envs=share)
    term.reset(None)
    assert term.is_standing_env.float().mean() == share


def test_commands_are_redrawn_when_their_time_is_over():
    _, term = started(resampling_time_range=(0.1, 0.1))
    first = term.command.clone()
    for _ in range(4):
        term.compute(0.02)
    assert torch.equal(term.command, first)
    term.compute(0.0201)
    assert not (term.command == first).any()
    assert (term.command_counter == 2).all()


# Invariants.


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), forward=shares, yaw=angles)
def test_forward_commands_go_forward_only_and_not_slowly(seed, forward, yaw):
    torch.manual_seed(seed)
    env, term = velocity_command(rel_forward_envs=forward)
    env.data.root_link_quat_w = yaw_quat(torch.full((8,), yaw))
    term.reset(None)
    term.compute(0.0, ALL)
    command = term.command[term.is_forward_env]
    assert (command[:, 0] >= 0.3).all()
    assert (command[:, 1:] == 0.0).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), yaw=angles, stiffness=st.floats(0.1, 5.0))
def test_heading_commands_turn_the_short_way_within_the_range(seed, yaw, stiffness):
    torch.manual_seed(seed)
    env, term = velocity_command(heading_command=True, heading_control_stiffness=stiffness)
    env.data.root_link_quat_w = yaw_quat(torch.full((8,), yaw))
    term.reset(None)
    term.compute(0.0, ALL)
    error = torch.remainder(term.heading_target - yaw + math.pi, 2 * math.pi) - math.pi
    expected = (stiffness * error).clamp(-0.4, 0.9)
    # For errors of half a turn, rounding decides the sign.
    clear = error.abs() < 3.14
    torch.testing.assert_close(term.command[clear, 2], expected[clear], atol=1e-4, rtol=1e-4)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), yaw=angles, forward=shares)
def test_world_commands_keep_their_direction_in_the_world(seed, yaw, forward):
    torch.manual_seed(seed)
    env, term = velocity_command(rel_world_envs=1.0, rel_forward_envs=forward)
    term.reset(None)
    drawn = term.vel_command_w.clone()
    # Also those that only go forward: they go forward as seen from the world.
    assert (drawn[term.is_forward_env, 0] >= 0.3).all()
    for angle in (yaw, -yaw):
        env.data.root_link_quat_w = yaw_quat(torch.full((8,), angle))
        term.compute(0.0)
        in_body = torch.complex(term.command[:, 0], term.command[:, 1])
        in_world = in_body * complex(math.cos(angle), math.sin(angle))
        torch.testing.assert_close(in_world.real, drawn[:, 0], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(in_world.imag, drawn[:, 1], atol=1e-5, rtol=1e-5)
        assert torch.equal(term.command[:, 2], drawn[:, 2])


def test_a_world_command_that_only_goes_forward_keeps_that_command():
    _, term = started(rel_world_envs=1.0, rel_forward_envs=1.0)
    assert (term.command[:, 0] >= 0.3).all()
    assert (term.command[:, 1:] == 0.0).all()


def test_standing_wins_over_every_other_kind():
    _, term = started(
        heading_command=True,
        rel_standing_envs=1.0,
        rel_world_envs=1.0,
        rel_forward_envs=1.0,
    )
    assert (term.command == 0.0).all()


def test_updating_some_environments_leaves_the_others_alone():
    env, term = started(heading_command=True, rel_world_envs=1.0)
    before = term.command.clone(), term.heading_error.clone()
    env.data.root_link_quat_w = yaw_quat(torch.full((8,), 0.4))
    term.compute(0.0, torch.tensor([2, 5]))
    others = [0, 1, 3, 4, 6, 7]
    assert torch.equal(term.command[others], before[0][others])
    assert torch.equal(term.heading_error[others], before[1][others])
    assert (term.command[[2, 5], :2] != before[0][[2, 5], :2]).all()


# Metrics.


def test_command_errors_are_means_over_steps():
    env, term = started(resampling_time_range=(100.0, 100.0))
    steps = 700
    for step in range(steps):
        # The robot follows the command with an error that grows with time.
        env.data.root_link_lin_vel_b[:, :2] = term.command[:, :2]
        env.data.root_link_lin_vel_b[:, 0] += 3.0 * step / steps
        env.data.root_link_ang_vel_b[:, 2] = term.command[:, 2] - 0.5
        term.compute(0.02)
    log = term.reset(ALL)
    assert log["error_vel_xy"] == pytest.approx(1.5 * (steps - 1) / steps, rel=1e-4)
    assert log["error_vel_yaw"] == pytest.approx(0.5, rel=1e-4)
    assert (term.metrics["error_vel_xy"] == 0.0).all()


def test_a_reset_of_others_adds_no_sample():
    env, term = started(resampling_time_range=(100.0, 100.0))
    env.data.root_link_lin_vel_b[:, :2] = term.command[:, :2] + torch.tensor([0.3, 0.4])
    term.compute(0.02)
    before = term.metrics["error_vel_xy"].clone()
    torch.testing.assert_close(before, torch.full((8,), 0.5))
    # Calls of a partial reset, and of a step that resets other environments.
    env.data.root_link_lin_vel_b += 10.0
    term.reset(torch.tensor([1, 2]))
    term.compute(0.0, torch.tensor([1, 2]))
    kept = [0, 3, 4, 5, 6, 7]
    assert torch.equal(term.metrics["error_vel_xy"][kept], before[kept])
    dt = torch.full((8,), 0.02)
    dt[[1, 2]] = 0.0
    env.data.root_link_lin_vel_b -= 10.0
    term.compute(dt)
    torch.testing.assert_close(term.metrics["error_vel_xy"][kept], before[kept])
    assert (term.metrics["error_vel_xy"][[1, 2]] == 0.0).all()
    torch.testing.assert_close(term.elapsed_s[[0, 1]], torch.tensor([0.04, 0.0]))


def test_environments_without_a_step_are_left_out_of_the_mean():
    env, term = started(resampling_time_range=(100.0, 100.0))
    assert term.reset(ALL)["error_vel_yaw"] == 0.0
    term.compute(0.0, ALL)
    env.data.root_link_ang_vel_b[:, 2] = term.command[:, 2] + 0.25
    term.compute(0.02)
    term.reset(torch.tensor([0]))
    assert term.reset(torch.tensor([0, 1]))["error_vel_yaw"] == pytest.approx(0.25, rel=1e-4)


# Moving from the start, in a real environment.


def moving_from_the_start(make_env, **fields):
    def edit(cfg):
        twist = cfg.commands["twist"]
        twist.init_velocity_prob = 1.0
        for name, value in fields.items():
            setattr(twist, name, value)

    env = make_env(edit=edit, num_envs=16)
    env.reset()
    data, term = env.scene["robot"].data, env.command_manager.get_term("twist")
    return data.root_link_lin_vel_b, data.root_link_ang_vel_b, term


@pytest.mark.parametrize("world", [0.0, 1.0])
def test_episodes_may_start_with_the_robot_moving_as_commanded(make_env, world):
    linear, angular, term = moving_from_the_start(
        make_env, rel_world_envs=world, rel_standing_envs=0.0
    )
    assert (term.command.abs().sum(dim=1) > 0.0).all()
    torch.testing.assert_close(linear[:, :2], term.command[:, :2], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(linear[:, 2], torch.zeros(16), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(angular[:, 2], term.command[:, 2], atol=1e-5, rtol=1e-4)


def test_robots_that_are_told_to_stand_do_not_start_moving(make_env):
    linear, angular, _ = moving_from_the_start(make_env, rel_standing_envs=1.0)
    assert (linear.abs() < 1e-6).all()
    assert (angular.abs() < 1e-6).all()


# Ranges at run time.


def test_ranges_change_in_the_term_and_not_in_the_config():
    cfg = UniformVelocityCommandCfg(
        entity_name="robot",
        resampling_time_range=(1.0, 2.0),
        ranges=UniformVelocityCommandCfg.Ranges((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    )
    term = cfg.build(StandInEnv(num_envs=8))  # ty: ignore[invalid-argument-type]
    term.ranges.lin_vel_x = (5.0, 5.0)
    assert term.cfg.ranges.lin_vel_x == (5.0, 5.0)
    assert cfg.ranges.lin_vel_x == (0.0, 0.0)
    term.reset(None)
    assert (term.command[:, 0] == 5.0).all()


# Bad input.


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"ranges": {"heading": (-1.0, 1.0)}}, "ranges.heading: .*heading_command=False, got"),
        (
            {"heading_command": True, "ranges": {"heading": None}},
            "ranges.heading: .*heading_command=True, got None",
        ),
        ({"resampling_time_range": (3.0, 2.0)}, "resampling_time_range"),
    ],
)
def test_what_makes_no_sense_is_refused_when_the_command_is_built(fields, message):
    with pytest.raises(ValueError, match=message):
        velocity_command(**fields)


def test_unknown_entity(make_env):
    name = "robto"

    def edit(cfg):
        cfg.commands["twist"].entity_name = name

    with pytest.raises(UnknownNameError, match=f"'twist': .*'{name}'; did you mean 'robot'"):
        make_env(edit=edit)


# Viewers.


class FakeGui:
    """Keeps what is added; its elements call back when they are used."""

    def __init__(self):
        self.items: dict[str, Any] = {}

    def _add(self, label, **fields):
        item = SimpleNamespace(calls=[], **fields)
        item.on_update = item.on_click = item.calls.append
        self.items[label] = item
        return item

    def add_folder(self, label, **_):
        import contextlib

        return contextlib.nullcontext()

    def add_checkbox(self, label, value, hint=None):
        return self._add(label, value=value)

    def add_slider(self, label, low, high, step, value):
        assert low <= value <= high
        return self._add(label, min=low, max=high, step=step, value=value)

    def add_button(self, label):
        return self._add(label)


def test_sliders_command_the_environment_in_view_while_they_are_enabled():
    _, term = started(resampling_time_range=(100.0, 100.0))
    gui, changes = FakeGui(), []
    term.create_gui("twist", SimpleNamespace(gui=gui), lambda: 3, lambda: changes.append(1))
    drawn = term.command.clone()
    gui.items["Forward (m/s)"].value = -0.5
    gui.items["Turn left (rad/s)"].value = 0.25
    term.compute(0.02)
    assert torch.equal(term.command, drawn)
    gui.items["Enable"].value = True
    term.compute(0.02)
    assert term.command[3].tolist() == [-0.5, 0.0, 0.25]
    others = [0, 1, 2, 4, 5, 6, 7]
    assert torch.equal(term.command[others], drawn[others])
    for call in gui.items["Zero"].calls:
        call(None)
    term.compute(0.02)
    assert term.command[3].tolist() == [0.0, 0.0, 0.0]
    gui.items["Enable"].calls[0](None)
    assert changes == [1]
    # Below the sliders the drawn command has gone on.
    gui.items["Enable"].value = False
    term.compute(0.02)
    assert torch.equal(term.command, drawn)
    # A command that a reset resamples is not overwritten by the one replaced before.
    gui.items["Enable"].value = True
    term.compute(0.02)
    term.reset(torch.tensor([3]))
    redrawn = term.command[3].clone()
    term.compute(0.0)
    gui.items["Enable"].value = False
    term.compute(0.02)
    assert torch.equal(term.command[3], redrawn)
    assert not torch.equal(redrawn, drawn[3])


def test_a_smaller_maximum_pulls_its_slider_in():
    _, term = started()
    gui = FakeGui()
    term.create_gui("twist", SimpleNamespace(gui=gui), lambda: 0)
    slider, maximum = gui.items["Forward (m/s)"], gui.items["Max forward (m/s)"]
    # Up to the larger magnitude of the range (-2, 1).
    assert (slider.min, slider.max) == (-2.0, 2.0)
    slider.value, maximum.value = 1.5, 0.5
    maximum.calls[0](None)
    assert (slider.min, slider.max, slider.value) == (-0.5, 0.5, 0.5)


@pytest.mark.parametrize("measured", [False, True])
def test_arrows_show_the_command_and_if_asked_for_what_the_robot_does(measured):
    env, term = started(debug_vis=True)
    term.cfg.viz.show_measured = measured
    quarter_turn = torch.full((8,), math.pi / 2)
    env.data.root_link_quat_w = yaw_quat(quarter_turn)
    env.data.root_link_pos_w = torch.tensor([[1.0, 2.0, 3.0]]).repeat(8, 1)
    env.data.root_link_lin_vel_b = torch.tensor([[0.0, 1.0, 9.0]]).repeat(8, 1)
    env.data.root_link_ang_vel_b = torch.tensor([[9.0, 9.0, -0.5]]).repeat(8, 1)
    term.vel_command_b[:] = torch.tensor([2.0, 0.0, 1.0])
    arrows, legend = [], []
    visualizer = SimpleNamespace(
        get_env_indices=lambda count: [count - 1],
        add_legend=lambda color, meaning: legend.append((color, meaning)),
        add_arrow=lambda start, end, color: arrows.append((start.tolist(), (end - start).tolist())),
    )
    term.debug_vis(visualizer)  # ty: ignore[invalid-argument-type]
    # Above the root by 0.2 m, and half as long as the numbers.
    number = 4 if measured else 2
    assert [start for start, _ in arrows] == [pytest.approx([1.0, 2.0, 3.1])] * number
    assert len(set(legend)) == number
    expected = [[0.0, 1.0, 0.0], [0.0, 0.0, 0.5], [-0.5, 0.0, 0.0], [0.0, 0.0, -0.25]][:number]
    assert [arrow for _, arrow in arrows] == [pytest.approx(e, abs=1e-6) for e in expected]
