"""Repeated evaluations: results depend on policy and seed, not on earlier steps."""

from __future__ import annotations

import pytest
import torch
from velocity_tasks import GO1_FLAT, GO1_ROUGH

from mjlab.rl import RslRlVecEnvWrapper
from mjlab.rl.evaluation import evaluate_policy, make_evaluation_env
from mjlab.utils.noise import NoiseModelWithAdditiveBiasCfg


def push(observations) -> torch.Tensor:
    return observations["actor"][:, 9:21] * 3.0 + 0.2


def score(env: RslRlVecEnvWrapper, **kwargs):
    return evaluate_policy(env, push, max_steps=12, seed=7, **kwargs)


def on_all_levels(cfg) -> None:
    """Start on any level, so that robots that do not get far can be sent down."""
    if cfg.scene.terrain.terrain_generator is not None:
        cfg.scene.terrain.max_init_terrain_level = None


@pytest.mark.parametrize("task", [GO1_FLAT, GO1_ROUGH])
def test_evaluating_twice_with_one_seed_gives_the_same_figures(make_env, task):
    env = RslRlVecEnvWrapper(make_env(task, edit=on_all_levels))
    first, second = (score(env) for _ in range(2))
    assert first.returns == second.returns
    assert first.mean_length == second.mean_length
    assert len(set(first.returns)) == 4


def test_evaluations_keep_terrain_levels(make_env):
    env = make_evaluation_env(RslRlVecEnvWrapper(make_env(GO1_ROUGH, edit=on_all_levels)), 6, 2)
    terrain = env.unwrapped.scene.terrain
    kept = (
        terrain.terrain_levels.clone(),
        terrain.terrain_types.clone(),
        terrain.env_origins.clone(),
    )
    assert kept[0].max() > 0
    levels = {"level": lambda env: terrain.terrain_levels.float()}
    result = score(env, num_episodes=12, metrics=levels)
    # Both rounds together are on all levels evenly.
    assert result.metrics["level"].mean == pytest.approx((terrain.max_terrain_level - 1) / 2)
    assert result.curricula["terrain_levels"] == [0, terrain.max_terrain_level - 1]
    now = terrain.terrain_levels, terrain.terrain_types, terrain.env_origins
    for before, after in zip(kept, now, strict=True):
        assert torch.equal(before, after)
    # In training, robots that did not get far move down.
    with torch.inference_mode():
        env.step(torch.zeros(6, 12))
        env.reset()
    assert (terrain.terrain_levels < kept[0]).any()
    env.close()


def test_an_environment_goes_on_without_inference_mode_after_an_evaluation(make_env):
    """Whatever was allocated while evaluating is written again, from outside of it."""

    def with_memory(cfg) -> None:
        group = cfg.observations["actor"]
        group.history_length = 2
        for term in group.terms.values():
            term.delay_max_lag, term.delay_hold_prob = 2, 0.5
            if term.noise is not None:
                term.noise = NoiseModelWithAdditiveBiasCfg(
                    noise_cfg=term.noise, bias_noise_cfg=term.noise
                )

    env = make_env(GO1_ROUGH, edit=with_memory)
    with torch.inference_mode():
        env.reset()
        env.step(torch.zeros(4, 12))
        env.reset(env_ids=torch.tensor([1]))
        env.step(torch.zeros(4, 12))
    env.reset(env_ids=torch.tensor([0, 2]))
    env.step(torch.zeros(4, 12))
    env.reset()
    for _ in range(3):
        observations, *_ = env.step(torch.zeros(4, 12))
    assert torch.isfinite(observations["actor"]).all()
