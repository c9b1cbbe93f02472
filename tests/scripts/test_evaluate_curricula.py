"""`train` and `evaluate` name the state of the curricula that they measure."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from commands import SMALL

from mjlab.managers import CurriculumTermCfg
from mjlab.rl.checkpoint import curricula_of, load_checkpoint
from mjlab.tasks import registry

BASE = "Mjlab-Cartpole-Balance"
NAME = "Test-Growing"
PATH = "rewards.smooth_reward.weight"
SHORT = ("--num-episodes", "4", "--device", "cpu")


def grows(env: Any, env_ids: Any) -> None:
    env.reward_manager.get_term_cfg("smooth_reward").weight += 1.0


@pytest.fixture(scope="module")
def growing() -> Iterator[str]:
    def env_cfg(play: bool = False) -> Any:
        cfg = registry.load_env_cfg(BASE, play=play)
        cfg.curriculum["grows"] = CurriculumTermCfg(func=grows)
        cfg.episode_length_s = 8 * 0.05
        return cfg

    def rl_cfg() -> Any:
        cfg = registry.load_rl_cfg(BASE)
        cfg.experiment_name = "growing"
        # Solved at once.
        cfg.evaluation.solved_return = -1.0
        cfg.evaluation.num_episodes = 4
        return cfg

    registry.register_mjlab_task(NAME, env_cfg, rl_cfg=rl_cfg)
    yield NAME
    del registry._tasks[NAME]


@pytest.mark.slow
def test_the_state_of_curricula_is_printed(run, growing, tmp_path):
    flags = (*SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "9")
    outcome = run("train", growing, *flags)
    assert outcome.status == 0, outcome.err
    (folder,) = (tmp_path / "growing").iterdir()
    checkpoint = sorted(folder.glob("model_*.pt"))[-1]
    state = curricula_of(load_checkpoint(checkpoint))
    assert state is not None
    weight = state["config_edits"]["reward_manager"]["smooth_reward"]["weight"]
    assert weight > 2.0
    (ending,) = [line for line in outcome.out.splitlines() if line.startswith("Finished")]
    assert f"{PATH} {weight:g}" in ending

    outcome = run("evaluate", growing, *SHORT, "--checkpoint-file", str(checkpoint))
    assert outcome.status == 0, outcome.err
    assert f"Curricula    {PATH} {weight:g}" in outcome.out
    assert "does not hold" not in outcome.err
    outcome = run(
        "evaluate", growing, *SHORT, "--checkpoint-file", str(checkpoint), "--json", "True"
    )
    assert json.loads(outcome.out)["curricula"] == {PATH: weight}

    (exported,) = folder.glob("*.onnx")
    outcome = run("evaluate", growing, *SHORT, "--checkpoint-file", str(exported))
    assert outcome.status == 0, outcome.err
    assert "does not hold the state of the task's curricula: they are at their beginning" in (
        outcome.out + outcome.err
    )
