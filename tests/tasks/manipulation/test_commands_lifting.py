"""Lifting commands: sampling, placement of objects, and success."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from lifting_stand_ins import ORIGIN_STEP, StandInEnv, lifting_command

from mjlab.tasks.manipulation.mdp import LiftingCommandCfg
from mjlab.viewer.debug_visualizer import NullDebugVisualizer

Range = LiftingCommandCfg.TargetPositionRangeCfg
PoseRange = LiftingCommandCfg.ObjectPoseRangeCfg


def started(**fields: Any) -> tuple[StandInEnv, Any]:
    """Return a stand-in and a command, both just reset."""
    env, term = lifting_command(**fields)
    term.reset(None)
    env.sim.forward()
    term.compute(0.0, torch.arange(env.num_envs))
    env.sim.forwarded.clear()
    return env, term


def put(env: StandInEnv, term: Any, *distances: float) -> None:
    """Put the cubes at given distances from their goals."""
    where = env.objects["cube"].data.root_link_pos_w
    where.copy_(term.target_pos)
    where[:, 1] += torch.tensor(distances)


# Sampling.


@pytest.mark.parametrize("difficulty", ["dynamic", "fixed"])
def test_numbers_are_drawn_in_the_documented_order(difficulty):
    env, term = lifting_command(difficulty=difficulty)
    torch.manual_seed(5)
    term.reset(None)
    torch.manual_seed(5)
    times = 8.0 + 4.0 * torch.rand(4)
    goal = torch.tensor([0.4, 0.0, 0.3]).expand(4, 3)
    if difficulty == "dynamic":
        goal = torch.rand(4, 3) * torch.tensor([0.2, 0.4, 0.2]) + torch.tensor([0.3, -0.2, 0.2])
    position = torch.rand(4, 3) * torch.tensor([0.05, 0.2, 0.03]) + torch.tensor([0.3, -0.1, 0.02])
    yaw = (2.0 * torch.rand(4) - 1.0) * math.pi
    origins = env.scene.env_origins
    torch.testing.assert_close(term.time_left, times)
    torch.testing.assert_close(term.command, goal + origins)
    cube = env.objects["cube"]
    torch.testing.assert_close(cube.pose[:, :3], position + origins)
    expected = torch.stack((torch.cos(yaw / 2), 0 * yaw, 0 * yaw, torch.sin(yaw / 2)), dim=1)
    torch.testing.assert_close(cube.pose[:, 3:], expected)
    assert torch.equal(cube.velocity, torch.zeros(4, 6))


def test_goals_and_objects_keep_their_ranges():
    env, term = lifting_command(
        StandInEnv(num_envs=500),
        difficulty="dynamic",
        target_position_range=Range(x=(0.1, 0.2), y=(-0.4, -0.3), z=(0.5, 0.5)),
        object_pose_range=PoseRange(x=(-0.2, 0.0), y=(0.1, 0.3), z=(0.05, 0.06), yaw=(0.5, 0.6)),
    )
    term.reset(None)
    goal = term.command - env.scene.env_origins
    position = env.objects["cube"].pose[:, :3] - env.scene.env_origins
    for values, low, high in (
        (goal, (0.1, -0.4, 0.5), (0.2, -0.3, 0.5)),
        (position, (-0.2, 0.1, 0.05), (0.0, 0.3, 0.06)),
    ):
        # Origins at 1 km cost some digits.
        low, high = torch.tensor(low), torch.tensor(high)
        assert ((values >= low - 2e-4) & (values <= high + 2e-4)).all()
        spread = values.max(dim=0).values - values.min(dim=0).values
        assert (spread > 0.9 * (high - low) - 1e-6).all()
    yaw = 2.0 * torch.atan2(env.objects["cube"].pose[:, 6], env.objects["cube"].pose[:, 3])
    assert ((yaw >= 0.5) & (yaw <= 0.6)).all()


def test_drawing_for_some_leaves_the_others_alone():
    env, term = started()
    before = term.command.clone(), env.objects["cube"].pose.clone()
    term.cfg.difficulty = "dynamic"
    term.reset(torch.tensor([1, 3]))
    for old, new in zip(before, (term.command, env.objects["cube"].pose), strict=True):
        assert torch.equal(old[[0, 2]], new[[0, 2]])
        assert not torch.equal(old[[1, 3]], new[[1, 3]])


def test_without_a_range_of_poses_the_object_stays_where_it_is():
    env, term = started(object_pose_range=None)
    assert not env.objects["cube"].pose.any()
    term.time_left[:] = 0.0
    term.compute(0.02)
    assert env.sim.forwarded == []


# A new goal within an episode.


def test_a_new_goal_moves_objects_of_its_envs():
    env, term = started(difficulty="dynamic")
    before = term.command.clone(), env.objects["cube"].data.root_link_pos_w.clone()
    term.time_left[:] = torch.tensor([5.0, 0.01, 5.0, 0.02])
    term.compute(0.02)
    after = term.command, env.objects["cube"].data.root_link_pos_w
    for old, new in zip(before, after, strict=True):
        assert torch.equal(old[[0, 2]], new[[0, 2]])
        assert (old[[1, 3]] != new[[1, 3]]).any(dim=1).all()
    assert env.sim.forwarded == [[1, 3]]


def test_a_step_without_a_new_goal_and_a_reset_derive_nothing():
    env, term = started()
    term.compute(0.02)
    # A reset calls forward itself.
    term.reset(torch.tensor([0]))
    term.compute(torch.tensor([0.0, 0.02, 0.02, 0.02]))
    assert env.sim.forwarded == []


# Metrics and success.


def test_metrics_are_of_the_object_as_it_is():
    env, term = started()
    put(env, term, 0.0, 0.03, 0.06, 0.2)
    term.compute(0.02)
    torch.testing.assert_close(
        term.metrics["position_error"], torch.tensor([0.0, 0.03, 0.06, 0.2]), atol=1e-6, rtol=0
    )
    assert term.metrics["at_goal"].tolist() == [1.0, 1.0, 0.0, 0.0]
    torch.testing.assert_close(term.metrics["object_height"], torch.full((4,), 0.3))
    assert term.compute_success().tolist() == [True, True, False, False]


def test_an_object_exactly_as_far_as_the_threshold_is_not_at_its_goal():
    env, term = started(success_threshold=0.25)
    env.objects["cube"].data.root_link_pos_w.copy_(term.target_pos)
    term.target_pos[:, 2] = 0.5
    env.objects["cube"].data.root_link_pos_w[:, 2] = 0.25
    term.compute(0.02)
    assert term.metrics["position_error"].tolist() == [0.25] * 4
    assert not term.compute_success().any()
    assert not term.metrics["at_goal"].any()


def test_success_of_an_episode_outlives_its_goals():
    env, term = started()
    put(env, term, 0.0, 0.0, 1.0, 1.0)
    term.compute(0.02)
    put(env, term, 1.0, 1.0, 1.0, 1.0)
    # Of the first and third environment, the goal's time is over.
    term.time_left[:] = torch.tensor([0.0, 9.0, 0.0, 9.0])
    term.compute(0.02)
    assert term.metrics["goal_success"].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert term.metrics["episode_success"].tolist() == [1.0, 1.0, 0.0, 0.0]
    assert torch.equal(term.episode_success, term.metrics["episode_success"])
    log = term.reset(None)
    assert log["episode_success"] == 0.5
    assert log["goal_success"] == 0.25
    assert not term.episode_success.any()


def test_metrics_of_a_goal_are_taken_before_the_next_is_drawn():
    env, term = started()
    put(env, term, 0.0, 0.0, 0.2, 0.2)
    term.time_left[:] = 0.0
    term.compute(0.02)
    # The goal is another one, and these are how the last one ended.
    torch.testing.assert_close(
        term.metrics["position_error"], torch.tensor([0.0, 0.0, 0.2, 0.2]), atol=1e-6, rtol=0
    )
    assert term.last_goal_met.tolist() == [True, True, False, False]


def test_a_goal_too_young_to_be_met_is_not_judged_but_the_one_before():
    env, term = started()
    # Met: the goal before by the first two, the present one by the second and the third.
    put(env, term, 0.0, 0.0, 1.0, 1.0)
    term.time_left[:] = 0.0
    term.compute(0.02)
    put(env, term, 1.0, 0.0, 0.0, 1.0)
    term.compute(0.02)
    assert term.compute_success().tolist() == [False, True, True, False]
    assert term.goal_is_met().tolist() == [True, True, False, False]
    # From the shortest time that a goal has, it is the present one.
    term.time_left[:] = 10.0
    term.compute(8.0)
    assert term.goal_is_met().tolist() == [False, True, True, False]


def test_the_first_goal_of_an_episode_is_judged_however_young_it_is():
    env, term = started()
    put(env, term, 0.0, 0.0, 1.0, 1.0)
    term.time_left[:] = 0.0
    term.compute(0.02)
    term.reset(None)
    put(env, term, 1.0, 0.0, 1.0, 0.0)
    term.compute(0.02)
    assert term.goal_is_met().tolist() == [False, True, False, True]


def test_environments_that_never_had_a_goal_are_left_out_of_the_log():
    env, term = lifting_command()
    term.reset(torch.tensor([0, 1]))
    put(env, term, 0.0, 0.5, 7.0, 7.0)
    term.compute(0.02, torch.tensor([0, 1]))
    assert term.reset(None)["position_error"] == pytest.approx(0.25, abs=1e-6)


def test_an_empty_reset_draws_and_logs_nothing():
    env, term = started()
    state = torch.get_rng_state()
    assert term.reset(torch.tensor([], dtype=torch.long)) == {}
    assert torch.equal(torch.get_rng_state(), state)


# Visualization.


class Board(NullDebugVisualizer):
    def __init__(self, env_idx: int) -> None:
        super().__init__(env_idx)
        self.spheres: list[tuple] = []

    def add_sphere(self, center, radius, color, label=None) -> None:
        self.spheres.append((center.tolist(), radius, color))


def test_a_sphere_marks_the_goal_of_the_environment_in_view():
    env, term = started(
        debug_vis=True, viz=LiftingCommandCfg.VizCfg(target_color=(0.1, 0.2, 0.3, 0.4))
    )
    board = Board(env_idx=2)
    term.debug_vis(board)
    ((center, radius, color),) = board.spheres
    assert center == pytest.approx([0.4 + 2 * ORIGIN_STEP, 0.0, 0.3], abs=1e-6)
    assert (radius, color) == (0.03, (0.1, 0.2, 0.3, 0.4))
    assert LiftingCommandCfg.VizCfg().target_color == (1.0, 0.5, 0.0, 0.3)


# Config errors.


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"difficulty": "hard"}, "difficulty.*'fixed', 'dynamic'.*'hard'"),
        ({"resampling_time_range": (3.0, 2.0)}, "resampling_time_range"),
    ],
)
def test_a_mistake_in_the_config_is_one_clear_message(fields, message):
    with pytest.raises(ValueError, match=message):
        lifting_command(**fields)


def test_an_object_that_is_not_in_the_scene_is_refused():
    with pytest.raises(KeyError, match="'cueb'"):
        lifting_command(entity_name="cueb")


def test_the_config_builds_the_term():
    env = StandInEnv()
    cfg = LiftingCommandCfg(entity_name="cube", resampling_time_range=(1.0, 1.0))
    assert cfg.build(env).cfg is cfg
    assert cfg.difficulty == "fixed"
