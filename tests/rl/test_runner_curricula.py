"""Curricula continue in resumed runs, with new episodes as well."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import CurriculumTermCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.checkpoint import load_checkpoint, restore_lasting_state, start_episodes
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

TASK = "Mjlab-Cartpole-Swingup"
STEPS = 8


def doubles(env: Any, env_ids: Any) -> float:
    """Double the reward's weight, once per step with resets."""
    term = env.reward_manager.get_term_cfg("smooth_reward")
    term.weight *= 2.0
    return term.weight


def weight(runner: MjlabOnPolicyRunner) -> float:
    return runner.env.unwrapped.reward_manager.get_term_cfg("smooth_reward").weight


@pytest.fixture
def make() -> Iterator[Callable[..., MjlabOnPolicyRunner]]:
    envs: list[RslRlVecEnvWrapper] = []

    def build(log_dir: Path, num_envs: int, edit: Any = lambda cfg: None) -> MjlabOnPolicyRunner:
        cfg = load_env_cfg(TASK)
        cfg.scene.num_envs, cfg.seed, cfg.episode_length_s = num_envs, 1, STEPS * 0.05
        cfg.sim.num_threads, cfg.sim.engine = 1, "native"
        cfg.curriculum["doubles"] = CurriculumTermCfg(func=doubles)
        edit(cfg)
        envs.append(RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu")))
        agent = asdict(load_rl_cfg(TASK))
        agent |= {"num_steps_per_env": STEPS, "save_interval": 100, "evaluation": {}}
        for model in ("actor", "critic"):
            agent[model]["hidden_dims"] = (4,)
        return MjlabOnPolicyRunner(envs[-1], agent, str(log_dir))

    yield build
    for env in envs:
        env.close()


@pytest.mark.parametrize("num_envs", [4, 6, 2])
def test_curricula_continue_in_another_number_of_environments(make, tmp_path, num_envs, caplog):
    first = make(tmp_path / "first", 4)
    first.learn(2)
    assert weight(first) == 8.0
    second = make(tmp_path / "second", num_envs)
    second.load(str(tmp_path / "first" / "model_1.pt"))
    second.learn(3)
    assert weight(second) == 16.0
    assert second.env.unwrapped.common_step_counter == 3 * STEPS
    assert second.logger.tot_timesteps == STEPS * (2 * 4 + num_envs)
    assert ("curricula are resumed" in caplog.text) == (num_envs != 4)


def test_curricula_continue_with_other_observations(make, tmp_path, caplog):
    def edit(cfg: Any) -> None:
        cfg.observations["extra"] = cfg.observations["critic"]
        cfg.rewards["gone"] = None

    make(tmp_path / "first", 4).learn(2)
    second = make(tmp_path / "second", 4, edit)
    second.load(str(tmp_path / "first" / "model_1.pt"))
    second.learn(3)
    assert weight(second) == 16.0
    assert len([r for r in caplog.records if "are resumed" in r.message]) == 1


def test_new_episodes_begin_under_the_restored_curricula(make, tmp_path):
    def edit(cfg: Any) -> None:
        def far(env: Any, env_ids: Any) -> None:
            if env.common_step_counter > 0:
                params = env.event_manager.get_term_cfg("reset_slider").params
                params["position_range"] = (1.0, 1.1)

        cfg.curriculum["far"] = CurriculumTermCfg(func=far)

    make(tmp_path / "first", 4, edit).learn(1)
    second = make(tmp_path / "second", 6, edit)
    state = load_checkpoint(tmp_path / "first" / "model_0.pt")["training_state"]
    assert restore_lasting_state(state, second.env) == []
    start_episodes(second.env)
    assert weight(second) == 4.0
    positions = second.env.unwrapped.scene["cartpole"].data.joint_pos[:, 0]
    assert (positions >= 1.0).all()


def test_errors_of_a_reset_are_not_of_the_checkpoint(make, tmp_path):
    make(tmp_path / "first", 4).learn(1)
    second = make(tmp_path / "second", 6)
    second.load(str(tmp_path / "first" / "model_0.pt"))

    def divides(*args: Any, **params: Any) -> None:
        raise ZeroDivisionError("of the task")

    second.env.unwrapped.event_manager.get_term_cfg("reset_slider").func = divides
    with pytest.raises(ZeroDivisionError, match="of the task"):
        second.learn(2)


def test_a_failed_run_keeps_its_curricula(make, tmp_path):
    first = make(tmp_path / "first", 4)
    step = first.env.step
    calls: list[None] = []

    def fails(actions: torch.Tensor) -> Any:
        calls.append(None)
        if len(calls) > 3 * STEPS:
            raise RuntimeError("out of luck")
        return step(actions)

    first.env.step = fails
    with pytest.raises(RuntimeError, match="out of luck"):
        first.learn(9)
    (saved,) = sorted((tmp_path / "first").glob("model_2.pt"))
    second = make(tmp_path / "second", 4)
    second.load(str(saved))
    second.learn(4)
    assert weight(second) == 2.0 ** (1 + 3 + 1)
