"""Evaluations measure the task with its curricula as they are in training."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import CurriculumTermCfg, TerminationTermCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.checkpoint import curricula_of, load_checkpoint
from mjlab.rl.evaluation import (
    EvaluationResult,
    curricula_text,
    evaluate_policy,
    load_curricula,
    make_evaluation_env,
)
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.terrains import TerrainEntityCfg, TerrainGeneratorCfg
from mjlab.terrains.primitive_terrains import BoxFlatTerrainCfg

TASK = "Mjlab-Cartpole-Balance"
STEPS = 8


def grows(env: Any, env_ids: Any) -> float:
    """Widen the start, and the length of episodes, at each reset: the memory is the config."""
    params = env.event_manager.get_term_cfg("reset_slider").params
    params["position_range"] = tuple(value + 0.1 for value in params["position_range"])
    return params["position_range"][1]


def eases(env: Any, env_ids: Any) -> None:
    """Shrink the reward and leave a mark; evaluations leave it out."""
    env.reward_manager.get_term_cfg("smooth_reward").weight = 0.25
    env.eased = True


def start(env: Any) -> tuple[float, float]:
    return env.unwrapped.event_manager.get_term_cfg("reset_slider").params["position_range"]


@pytest.fixture
def make() -> Iterator[Callable[..., RslRlVecEnvWrapper]]:
    envs: list[RslRlVecEnvWrapper] = []

    def build(num_envs: int = 2, edit: Any = lambda cfg: None) -> RslRlVecEnvWrapper:
        cfg = load_env_cfg(TASK)
        cfg.scene.num_envs, cfg.seed, cfg.episode_length_s = num_envs, 1, STEPS * 0.05
        cfg.sim.num_threads, cfg.sim.engine = 1, "native"
        cfg.events["reset_slider"].params["position_range"] = (0.0, 0.01)
        cfg.curriculum["grows"] = CurriculumTermCfg(func=grows)
        edit(cfg)
        envs.append(RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu")))
        return envs[-1]

    yield build
    for env in envs:
        env.close()


def agent() -> dict[str, Any]:
    cfg = asdict(load_rl_cfg(TASK))
    cfg["num_steps_per_env"] = STEPS
    cfg["evaluation"] = {"num_episodes": 4}
    for model in ("actor", "critic"):
        cfg[model]["hidden_dims"] = (4,)
    return cfg


def first_positions(env: RslRlVecEnvWrapper, num_episodes: int | None = None) -> list[float]:
    """Return the cart's positions at the first steps of an evaluation's episodes."""
    seen: list[torch.Tensor] = []

    def policy(_: Any) -> torch.Tensor:
        if (env.episode_length_buf == 0).all():
            seen.append(env.unwrapped.scene["cartpole"].data.joint_pos[:, 0].clone())
        return torch.zeros(env.num_envs, 1)

    evaluate_policy(env, policy, num_episodes, seed=1)
    return torch.cat(seen).tolist()


def test_evaluations_are_of_the_training_state(make, tmp_path):
    runner = MjlabOnPolicyRunner(make(), agent(), str(tmp_path))
    runner.learn(3)
    now = start(runner.env)
    assert now == pytest.approx((0.4, 0.41))
    name = "events.reset_slider.params.position_range"
    for _ in range(2):
        assert runner.evaluate().curricula[name] == pytest.approx(now)
    assert start(runner.env) == now
    runner.learn(5)
    assert runner.evaluate().curricula[name] == pytest.approx(start(runner.env))
    assert runner.last_evaluation is not None
    assert "position_range 0.6 to 0.61" in curricula_text(runner.last_evaluation.curricula)

    # The checkpoint has the same state.
    other = make(4)
    state = curricula_of(load_checkpoint(tmp_path / "model_4.pt"))
    assert state is not None
    load_curricula(other, state)
    assert all(0.6 <= position <= 0.61 for position in first_positions(other))


def test_curricula_stand_still_in_all_rounds(make):
    env = make(2)
    low, high = start(env)
    positions = first_positions(env, 6)
    assert len(positions) == 6
    assert all(low <= position <= high for position in positions)
    assert start(env) == (low, high)


def test_what_only_eases_training_is_off(make, tmp_path):
    def edit(cfg: Any) -> None:
        cfg.curriculum["eases"] = CurriculumTermCfg(func=eases)

    runner = MjlabOnPolicyRunner(make(2, edit), agent(), str(tmp_path))
    as_evaluated = copy.deepcopy(runner.env.cfg)
    del as_evaluated.curriculum["eases"]
    runner.evaluate_in(as_evaluated)
    runner.learn(2)
    curricula = runner.evaluate().curricula
    assert not any("weight" in name or "eased" in name for name in curricula)
    assert curricula["events.reset_slider.params.position_range"] == pytest.approx(
        start(runner.env)
    )
    weight = runner.env.unwrapped.reward_manager.get_term_cfg("smooth_reward").weight
    assert weight == 0.25
    full = make_evaluation_env(runner.env, 2, 3, as_evaluated)
    load_curricula(full, runner.env.unwrapped.curriculum_state())
    assert full.unwrapped.reward_manager.get_term_cfg("smooth_reward").weight == 1.0
    full.close()


def test_evaluations_have_the_length_of_training_episodes(make, tmp_path):
    def longer(env: Any, env_ids: Any) -> None:
        env.cfg.episode_length_s = 2 * STEPS * 0.05

    def edit(cfg: Any) -> None:
        cfg.curriculum["longer"] = CurriculumTermCfg(func=longer)

    runner = MjlabOnPolicyRunner(make(2, edit), agent(), str(tmp_path))
    result = runner.evaluate()
    assert result.mean_length == 2 * STEPS
    assert result.num_unfinished == 0
    assert result.curricula["episode_length_s"] == 2 * STEPS * 0.05


def test_a_task_without_curricula_shows_none(make):
    env = make(2, lambda cfg: cfg.curriculum.clear())
    result = evaluate_policy(env, lambda _: torch.zeros(2, 1))
    assert result.curricula == {}
    assert curricula_text(result.curricula) == ""
    assert EvaluationResult.from_dict(result.to_dict()).curricula == {}


def test_logged_numbers_show_curricula_without_edits(make):
    """The curriculum's memory and effect are its own: only its logged number tells them."""
    hidden = {"level": 0.0}

    def climbs_alone(env: Any, env_ids: Any) -> float:
        hidden["level"] += 1.0
        return hidden["level"]

    def constant(env: Any, env_ids: Any) -> float:
        return 7.0

    def edit(cfg: Any) -> None:
        terms = {"alone": climbs_alone, "constant": constant}
        cfg.curriculum = {name: CurriculumTermCfg(func=func) for name, func in terms.items()}

    env = make(2, edit)
    assert env.unwrapped.curricula_in_use() == {}
    env.reset()
    assert env.unwrapped.curricula_in_use() == {"Curriculum/alone": 2.0}


def test_many_curricula_are_counted():
    curricula = {**{f"rewards.r{i}.weight": float(i) for i in range(9)}, "terrain_levels": [0, 9]}
    text = curricula_text(curricula)
    assert text.startswith("rewards.r0.weight 0; ")
    assert text.endswith("rewards.r4.weight 4; 4 more; terrain levels 0 to 9")


def climbs(env: Any, env_ids: Any) -> float:
    terrain = env.scene.terrain
    terrain.terrain_levels[env_ids] = (terrain.terrain_levels[env_ids] + 1) % 5
    return terrain.terrain_levels.float().mean().item()


def on_terrain(cfg: Any) -> None:
    sub_terrains: Any = {"a": BoxFlatTerrainCfg(), "b": BoxFlatTerrainCfg()}
    cfg.scene.terrain = TerrainEntityCfg(
        terrain_type="generator",
        terrain_generator=TerrainGeneratorCfg(
            size=(2.0, 2.0), num_rows=5, num_cols=2, curriculum=True, border_width=0.0,
            sub_terrains=sub_terrains,
        ),
        max_init_terrain_level=1,
    )  # fmt: skip
    cfg.curriculum["climbs"] = CurriculumTermCfg(func=climbs)
    # Episodes of several lengths in each round.
    cfg.terminations["early"] = TerminationTermCfg(
        func=lambda env: env.episode_length_buf > torch.arange(env.num_envs) % 3
    )


@pytest.mark.parametrize(("num_envs", "num_episodes"), [(20, 20), (3, 10), (1, 5), (2, 10)])
def test_levels_of_terrain_are_evaluated_evenly(make, num_envs, num_episodes):
    env = make(num_envs, on_terrain)
    terrain = env.unwrapped.scene.terrain
    before = terrain.terrain_levels.clone()
    levels: list[int] = []
    rows: list[torch.Tensor] = []

    def policy(_: Any) -> torch.Tensor:
        rows.append(terrain.terrain_levels.clone())
        return torch.zeros(num_envs, 1)

    result = evaluate_policy(env, policy, num_episodes)
    for row in rows:
        if not levels or row.tolist() != levels[-num_envs:]:
            levels += row.tolist()
    counts = torch.bincount(torch.tensor(levels[:num_episodes]), minlength=5)
    assert counts.max() - counts.min() <= 1
    assert result.curricula["terrain_levels"] == [0, 4]
    assert "terrain levels 0 to 4" in curricula_text(result.curricula)
    assert torch.equal(terrain.terrain_levels, before)


def test_each_column_of_a_terrain_is_even(make):
    env = make(20, on_terrain)
    terrain = env.unwrapped.scene.terrain
    terrain.spread_levels()
    for column in (0, 1):
        levels = terrain.terrain_levels[terrain.terrain_types == column]
        assert torch.bincount(levels, minlength=5).tolist() == [2] * 5
    expected = terrain.terrain_origins[terrain.terrain_levels, terrain.terrain_types]
    assert torch.equal(terrain.env_origins, expected)


def test_rough_terrain_of_a_robot_is_evaluated_on_all_levels():
    cfg = load_env_cfg("Mjlab-Velocity-Rough-Unitree-Go1", profile="cpu", evaluate=True)
    cfg.scene.num_envs, cfg.seed = 10, 1
    cfg.sim.engine = "native"
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    env.unwrapped.common_step_counter = 5000 * 24
    result = evaluate_policy(env, lambda _: torch.zeros(10, 12), max_steps=2)
    env.close()
    assert result.curricula == {
        "commands.twist.ranges.lin_vel_x": [-1.5, 2.0],
        "commands.twist.ranges.ang_vel_z": [-0.7, 0.7],
        "terrain_levels": [0, 9],
    }


@pytest.mark.parametrize(
    ("task", "eased"),
    [
        ("Mjlab-Velocity-Flat-Unitree-Go1", {"event_manager", "reward_manager"}),
        ("Mjlab-Velocity-Flat-Unitree-G1", {"event_manager", "command_manager"}),
        ("Mjlab-Tracking-Flat-Unitree-G1", {"event_manager", "reward_manager"}),
    ],
)
def test_profiles_ease_training_only(task, eased):
    cfg = load_env_cfg(task, profile="cpu")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 2, 1, "native"
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    evaluated = make_evaluation_env(env, 3, 1, load_env_cfg(task, profile="cpu", evaluate=True))
    state = env.unwrapped.curriculum_state()
    load_curricula(evaluated, state)
    assert {name for name, edits in state["config_edits"].items() if edits} == eased
    assert evaluated.unwrapped.curricula_in_use() == {}
    env.close()
    evaluated.close()
