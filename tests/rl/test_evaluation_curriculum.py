"""Evaluations use the training step of the saved policy; curricula do not advance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.mdp import reward_curriculum
from mjlab.managers import CurriculumTermCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.evaluation import evaluate_policy
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

TASK = "Mjlab-Cartpole-Swingup"
CHANGE = 100
NUM_STEPS = 20


def staged_env(step: int | None, num_envs: int = 2) -> RslRlVecEnvWrapper:
    """Return environments at step `step`, whose rewards cost at `CHANGE` what they earned before.

    No curriculum if `step` is None.
    """
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed, cfg.episode_length_s = num_envs, 1, NUM_STEPS * 0.02
    cfg.sim.num_threads, cfg.sim.engine = 1, "native"
    (name,) = cfg.rewards
    stages = [{"step": 0, "weight": 1.0}, {"step": CHANGE, "weight": -1.0}]
    if step is not None:
        params = {"reward_name": name, "stages": stages}
        cfg.curriculum["turn"] = CurriculumTermCfg(func=reward_curriculum, params=params)
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    env.unwrapped.common_step_counter = step or 0
    return env


@pytest.fixture
def closing() -> Iterator[list[RslRlVecEnvWrapper]]:
    envs: list[RslRlVecEnvWrapper] = []
    yield envs
    for env in envs:
        env.close()


@pytest.mark.parametrize(("step", "sign"), [(0, 1), (CHANGE - 1, 1), (CHANGE, -1), (10**6, -1)])
def test_the_step_stands_still_in_an_evaluation(closing, step, sign):
    closing += [staged_env(None), staged_env(step)]
    zeros = torch.zeros(2, 1)
    # Three rounds: episodes of all of them begin and end under the same weight.
    plain, staged = (evaluate_policy(env, lambda _: zeros, 6, seed=3) for env in closing)
    assert plain.mean_return > 0.0
    assert staged.returns == tuple(sign * value for value in plain.returns)
    assert closing[1].unwrapped.common_step_counter == step
    closing[1].step(zeros)
    assert closing[1].unwrapped.common_step_counter == step + 1


def test_evaluations_beside_training_and_of_its_checkpoint_are_of_its_step(closing, tmp_path: Path):
    def runner(step: int) -> MjlabOnPolicyRunner:
        closing.append(staged_env(step))
        cfg = asdict(load_rl_cfg(TASK))
        cfg["evaluation"]["num_episodes"] = 2
        for model in ("actor", "critic"):
            cfg[model]["hidden_dims"] = (8,)
        torch.manual_seed(1)
        return MjlabOnPolicyRunner(closing[-1], cfg)

    before = runner(CHANGE - 1)
    scores = [before.evaluate().returns for _ in range(2)]
    assert min(scores[0]) > 0.0
    assert scores[0] == scores[1]
    before.env.unwrapped.common_step_counter = CHANGE
    assert before.evaluate().returns == tuple(-value for value in scores[0])

    before.env.unwrapped.common_step_counter = CHANGE - 1
    before.save(str(tmp_path / "model.pt"))
    loaded = runner(0)
    loaded.load(str(tmp_path / "model.pt"), load_cfg={"actor": True})
    scored = evaluate_policy(closing[-1], loaded.get_inference_policy(), seed=1)
    assert min(scored.returns) > 0.0
    assert closing[-1].unwrapped.common_step_counter == CHANGE - 1
