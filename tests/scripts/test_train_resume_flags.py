"""Flags typed on resume: each acts, or is an error that names it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from commands import TASK

from mjlab.rl.checkpoint import load_checkpoint

SAC = (
    "--learner", "sac", "--agent.algorithm.batch-size", "64", "--agent.algorithm.num-updates", "1",
    "--agent.algorithm.learning-starts", "2", "--agent.algorithm.replay-steps", "40",
)  # fmt: skip


@pytest.fixture(scope="module")
def of_sac(train, tmp_path_factory) -> Path:
    return train(tmp_path_factory.mktemp("sac"), 2, *SAC)


@pytest.fixture
def resume(run, trained, tmp_path) -> Callable[..., Any]:
    """Return a function that resumes a copy of a run: outcome, content and config of the new one."""
    number = 0

    def resume(*flags: str, of: Path = trained) -> tuple[Any, dict[str, Any], dict[str, Any]]:
        nonlocal number
        number += 1
        first = shutil.copytree(of, tmp_path / str(number) / "cartpole" / of.name)
        root = ("--log-root", str(first.parents[1]), "--agent.max-iterations", "3")
        outcome = run("train", TASK, "--device", "cpu", "--agent.resume", "True", *root, *flags)
        new = [path for path in first.parent.iterdir() if path != first]
        if not new:
            return outcome, {}, {}
        params = {
            name: yaml.safe_load((new[0] / "params" / f"{name}.yaml").read_text())
            for name in ("env", "agent")
        }
        return outcome, load_checkpoint(new[0] / "model_2.pt"), params

    return resume


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return True if all weights of two checkpoints are equal."""
    pairs = [
        (value, other[part][name])
        for part in ("actor_state_dict", "critic_state_dict")
        for name, value in one[part].items()
    ]
    return all(torch.equal(value, its) for value, its in pairs)


def rates(content: dict[str, Any]) -> list[float]:
    return [group["lr"] for group in content["optimizer_state_dict"]["param_groups"]]


def test_rates_and_seeds_act(resume):
    flags = ("--agent.algorithm.schedule", "fixed")
    found = []
    for rate, seed in (("1e-5", "5"), ("1e-6", "6")):
        typed = (*flags, "--agent.algorithm.learning-rate", rate, "--agent.seed", seed)
        outcome, content, params = resume(*typed)
        assert outcome.status == 0, outcome.err
        assert rates(content) == [float(rate)] == [params["agent"]["algorithm"]["learning_rate"]]
        assert params["agent"]["seed"] == params["env"]["seed"] == int(seed)
        found.append(content)
    assert not same(*found)


def test_a_seed_draws_new_numbers(resume):
    plain, of_5, again, of_6 = (
        resume(*flags)[1]
        for flags in ((), ("--agent.seed", "5"), ("--agent.seed", "5"), ("--agent.seed", "6"))
    )
    assert same(of_5, again)
    assert not same(of_5, of_6)
    assert not same(of_5, plain)


def test_flags_of_the_run_typed_again_change_nothing(resume):
    """Job scripts repeat their command."""
    plain = resume()[1]
    typed = ("--agent.seed", "7", "--agent.algorithm.learning-rate", "1e-3", "--num-envs", "16")
    outcome, content, _ = resume(*typed)
    assert same(content, plain)
    assert "restart" not in outcome.err


def test_another_optimizer_is_told(resume):
    outcome, content, _ = resume("--agent.algorithm.optimizer", "sgd")
    assert "the checkpoint has the state of adam, this run uses sgd" in outcome.err
    assert content["optimizer_state_dict"]["param_groups"][0]["momentum"] == 0


def test_settings_of_sac_act(resume, of_sac):
    typed = (
        "--agent.algorithm.critic-learning-rate",
        "1e-5",
        "--agent.algorithm.weight-decay",
        "0.5",
    )
    outcome, content, _ = resume(*typed, of=of_sac)
    assert outcome.status == 0, outcome.err
    assert rates(content) == [1e-5, 3e-4, 3e-4]
    groups = content["optimizer_state_dict"]["param_groups"]
    assert [group["weight_decay"] for group in groups] == [0.5, 0.5, 0.0]


@pytest.mark.parametrize(
    ("flags", "sac", "told"),
    [
        (("--agent.obs-groups.critic", "('actor',)"), False, "critic: trained with"),
        (("--agent.actor.distribution-cfg.init-std", "0.3"), True, "distribution-cfg.init-std"),
    ],
)
def test_a_flag_that_cannot_act_is_an_error(resume, trained, of_sac, flags, sac, told):
    outcome, content, _ = resume(*flags, of=of_sac if sac else trained)
    assert outcome.status == 1
    assert told in outcome.message
    # Without a run folder.
    assert not content


ENV = {
    "env.decimation": "2",
    "env.sim.mujoco.timestep": "0.005",
    "env.rewards.smooth-reward.weight": "9.0",
    "env.scene.entities.cartpole.articulation.actuators.0.armature": "0.5",
    "env.events.reset-slider.params.position-range": "(-1.0, 1.0)",
}


# `tests/envs/test_env_state.py` holds the kinds of settings.
@pytest.mark.slow
@pytest.mark.parametrize("name", ENV)
def test_flags_of_the_environment_act(resume, name):
    outcome, content, params = resume(f"--{name}", ENV[name])
    assert outcome.status == 0, outcome.err
    path = name.replace("-", "_").removeprefix("env.")
    value: Any = params["env"]
    for key in path.split("."):
        value = value[int(key) if isinstance(value, list) else key]
    expected = list(map(float, ENV[name].strip("()").split(",")))
    assert value == (expected if isinstance(value, list) else expected[0])
    # The state of the episodes would undo it.
    assert f"{path} {value}, was " in outcome.err.replace("\n", " ")
    assert not same(content, resume()[1])


def test_a_replay_of_another_run_is_an_error(resume, of_sac, train, tmp_path):
    other = train(tmp_path / "other", 2, *SAC)
    mixed = shutil.copytree(of_sac, tmp_path / "mixed")
    shutil.copy(other / "replay_model_1.pt", mixed)
    outcome, content, _ = resume(of=mixed)
    assert outcome.status == 1
    assert "replay_model_1.pt" in outcome.message
    assert "delete this file" in outcome.message
    assert not content
    (mixed / "replay_model_1.pt").unlink()
    outcome, content, _ = resume(of=mixed)
    assert outcome.status == 0
    assert "replay starts empty" in outcome.err
