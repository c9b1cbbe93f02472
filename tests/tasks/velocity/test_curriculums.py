"""Curricula: terrain levels and command ranges."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from stand_ins import StandInEnv, velocity_command
from velocity_tasks import GO1_ROUGH

from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.mdp.curriculums import VelocityStage
from mjlab.terrains import TerrainFileCfg

ALL = torch.arange(4)


class Terrain:
    """Grid of two sub-terrains and 5 levels that records the moved environments."""

    def __init__(self, num_cols: int = 2) -> None:
        generator = SimpleNamespace(size=(8.0, 6.0), sub_terrains={"flat": 1, "stairs": 2})
        self.cfg = SimpleNamespace(terrain_generator=generator)
        self.terrain_generator = SimpleNamespace(cfg=generator)
        self.terrain_origins = torch.zeros(5, num_cols, 3)
        self.terrain_levels = torch.tensor([0, 1, 2, 4])
        self.terrain_types = torch.tensor([0, 0, 1, 1])
        self.moves: list[tuple[list[int], list[int], list[int]]] = []

    def update_env_origins(
        self, env_ids: torch.Tensor, move_up: torch.Tensor, move_down: torch.Tensor
    ) -> None:
        self.moves.append((env_ids.tolist(), move_up.long().tolist(), move_down.long().tolist()))


def walked(*distances: float, speed: float = 0.5, counter: int = 100) -> Any:
    """Return an environment whose robots ended this far from their origins."""
    env: Any = StandInEnv(len(distances))
    env.command(*[(speed, 0.0, 9.0)] * len(distances))
    env.scene.terrain = Terrain()
    env.scene.env_origins = torch.tensor([[10.0, 20.0, 0.0]]).repeat(len(distances), 1)
    env.data.root_link_pos_w = env.scene.env_origins.clone()
    env.data.root_link_pos_w[:, 1] += torch.tensor(distances)
    # Height does not count.
    env.data.root_link_pos_w[:, 2] = 50.0
    env.common_step_counter = counter
    env.max_episode_length_s = 10.0
    env.episode_length_buf = torch.full((len(distances),), 500)
    return env


def levels(env: Any, ids: torch.Tensor = ALL, **params: Any) -> Any:
    result = mdp.terrain_levels_vel(env, ids, "twist", **params)
    return result, env.scene.terrain.moves[-1]


# Levels.


def test_those_who_walked_far_go_up_and_those_who_did_not_go_down():
    # Half of what 0.5 m/s give in 10 s are 2.5 m, and half a cell are 4 m.
    _, moves = levels(walked(0.0, 2.4, 2.6, 4.1))
    assert moves == ([0, 1, 2, 3], [0, 0, 0, 1], [1, 1, 0, 0])


def test_who_goes_up_does_not_go_down_however_much_was_asked_for():
    _, moves = levels(walked(4.1, 3.9, 0.0, 0.0, speed=3.0))
    assert moves[1:] == ([1, 0, 0, 0], [0, 1, 1, 1])


def test_levels_stay_until_the_first_step():
    for first_step, up in ((100, 1), (101, 0)):
        _, moves = levels(walked(0.0, 2.4, 2.6, 4.1), first_step=first_step)
        assert moves[1:] == ([0, 0, 0, up], [up, up, 0, 0])


def test_only_environments_that_reset_are_moved():
    _, moves = levels(walked(4.1, 4.1, 0.0, 0.0), torch.tensor([1, 3]))
    assert moves == ([1, 3], [1, 0], [0, 1])


def test_no_level_jumps_at_the_first_reset():
    _, moves = levels(walked(9.0, 9.0, 0.0, 0.0, counter=0))
    assert moves[1:] == ([0] * 4, [0] * 4)


def test_an_environment_that_has_not_made_a_step_stays_where_it_is():
    env = walked(9.0, 9.0, 0.0, 0.0)
    env.episode_length_buf[[1, 2]] = 0
    _, moves = levels(env)
    assert moves[1:] == ([1, 0, 0, 0], [0, 0, 0, 1])


def test_levels_stay_after_a_resume(make_env):
    env = make_env(GO1_ROUGH, num_envs=16)
    before = env.scene.terrain.terrain_levels.clone()
    env.reset()
    assert torch.equal(env.scene.terrain.terrain_levels, before)
    # A checkpoint of a long run was loaded, which sets the counter, and no step was made yet.
    env.common_step_counter = 10_000
    env.reset()
    assert torch.equal(env.scene.terrain.terrain_levels, before)
    env.step(torch.zeros(16, 12))
    env.reset()
    assert (env.scene.terrain.terrain_levels <= before).all()
    assert (env.scene.terrain.terrain_levels < before).any()


def test_rough_task_runs_on_ground_from_a_file(make_env, tmp_path):
    """Environments stand on the ground, and their scans see it; there are no levels."""
    x = np.linspace(-6, 6, 121)
    np.save(tmp_path / "slope.npy", np.tile(0.1 * x, (121, 1)))

    def edit(cfg):
        cfg.scene.terrain.terrain_type = "heightmap"
        cfg.scene.terrain.terrain_file = TerrainFileCfg(path=str(tmp_path / "slope.npy"))

    env = make_env(GO1_ROUGH, num_envs=4, edit=edit)
    env.reset()
    for _ in range(3):
        env.step(torch.zeros(4, 12))
    origins = env.scene.env_origins
    torch.testing.assert_close(origins[:, 2], 0.1 * (origins[:, 0] + 1.0), atol=0.011, rtol=0.0)
    hits = env.scene["terrain_scan"].data.hit_pos_w
    torch.testing.assert_close(hits[..., 2], 0.1 * hits[..., 0], atol=1e-3, rtol=0.0)
    terrain_levels = mdp.terrain_levels_vel(env, torch.arange(4), "twist")
    assert terrain_levels == {}


def test_with_the_elapsed_time_an_episode_cut_short_does_not_send_down():
    env = walked(0.3, 0.2, 0.3, 0.0)
    _, term = velocity_command(env)
    env.command_manager.get_term = {"twist": term}.__getitem__
    # One second at 0.5 m/s: half of it are 0.25 m. The third was there for all of 10 s.
    term._samples[:] = torch.tensor([50.0, 50.0, 500.0, 0.0])
    _, moves = levels(env, use_elapsed_time=True)
    assert moves[1:] == ([0] * 4, [0, 1, 1, 0])
    assert levels(env)[1][2] == [1, 1, 1, 1]


def test_the_time_since_the_reset_does_not_start_at_a_random_number(make_env):
    def edit(cfg):
        cfg.curriculum["terrain_levels"].params["use_elapsed_time"] = True

    env = make_env(GO1_ROUGH, edit=edit)
    env.reset()
    # As in training, so that environments do not time out together.
    env.episode_length_buf = torch.tensor([900, 500, 0, 100])
    for _ in range(3):
        env.step(torch.zeros(4, 12))
    elapsed = env.command_manager.get_term("twist").elapsed_s
    torch.testing.assert_close(elapsed, torch.full((4,), 0.06))


def test_mean_and_largest_level_are_logged_and_the_mean_of_each_kind():
    result, _ = levels(walked(0.0, 0.0, 0.0, 0.0))
    assert {k: v.item() for k, v in result.items()} == {
        "mean": 1.75, "max": 4.0, "flat": 0.5, "stairs": 3.0,
    }  # fmt: skip


def test_a_kind_without_environments_is_not_logged():
    env = walked(0.0, 0.0, 0.0, 0.0)
    env.scene.terrain.terrain_types[:] = 1
    assert set(levels(env)[0]) == {"mean", "max", "stairs"}


def test_where_kinds_are_mixed_in_columns_only_the_whole_is_logged():
    env = walked(0.0, 0.0, 0.0, 0.0)
    env.scene.terrain = Terrain(num_cols=20)
    assert set(levels(env)[0]) == {"mean", "max"}


def test_on_a_plane_there_are_no_levels():
    env = walked(0.0, 0.0, 0.0, 0.0)
    env.scene.terrain.terrain_origins = None
    assert mdp.terrain_levels_vel(env, ALL, "twist") == {}


# Ranges of commands.

STAGES: list[VelocityStage] = [
    {"step": 0, "lin_vel_x": (-1.0, 1.0), "ang_vel_z": (-0.5, 0.5)},
    {"step": 10, "lin_vel_x": (-1.5, 2.0), "ang_vel_z": None},
    {"step": 20, "lin_vel_x": (-2.0, 3.0)},
]


@pytest.mark.parametrize(
    ("counter", "forward"),
    [(0, (-1.0, 1.0)), (9, (-1.0, 1.0)), (10, (-1.5, 2.0)), (99, (-2.0, 3.0))],
)
def test_later_stages_win_and_what_they_do_not_give_stays(counter, forward):
    env, term = velocity_command(StandInEnv(4))
    env.command_manager = SimpleNamespace(get_term_cfg={"twist": term.cfg}.__getitem__)
    env.common_step_counter = counter
    logged = mdp.commands_vel(env, ALL, "twist", STAGES)  # ty: ignore[invalid-argument-type]
    assert term.ranges.lin_vel_x == forward
    assert term.ranges.lin_vel_y == (-0.5, 0.7)
    assert term.ranges.ang_vel_z == (-0.5, 0.5)
    assert {k: v.item() for k, v in logged.items()} == pytest.approx({
        "lin_vel_x_min": forward[0], "lin_vel_x_max": forward[1],
        "lin_vel_y_min": -0.5, "lin_vel_y_max": 0.7,
        "ang_vel_z_min": -0.5, "ang_vel_z_max": 0.5,
    })  # fmt: skip


def test_stages_change_no_config_that_others_hold(make_env):
    env = make_env()
    before = copy.deepcopy(env.cfg.commands)
    env.common_step_counter = 10**6
    env.reset()
    assert env.command_manager.get_term("twist").ranges.lin_vel_x == (-2.0, 3.0)
    assert env.cfg.commands == before


@pytest.mark.parametrize("key", ["lin_vel", "lin_vel_X", "heading"])
def test_unknown_ranges_of_stages_are_ignored(make_env, key):
    def edit(cfg):
        stages = [{"step": 0, key: (0.0, 1.0), "ang_vel_z": (0.0, 0.7)}]
        cfg.curriculum["command_vel"].params["velocity_stages"] = stages

    env = make_env(edit=edit)
    with pytest.warns(UserWarning, match=f"velocity_stages: .*'{key}'.*ignored"):
        env.reset()
    assert env.command_manager.get_term("twist").cfg.ranges.ang_vel_z == (0.0, 0.7)


def test_older_stages_of_reward_weights_are_still_offered():
    from mjlab.tasks.velocity.mdp import curriculums

    cfg = SimpleNamespace(weight=1.0)
    env: Any = SimpleNamespace(
        common_step_counter=11, reward_manager=SimpleNamespace(get_term_cfg=lambda name: cfg)
    )
    with pytest.warns(FutureWarning, match="reward_weight is deprecated"):
        weight = curriculums.reward_weight(env, ALL, "upright", [{"step": 10, "weight": 3.0}])
    assert weight.item() == cfg.weight == 3.0
