"""A student learns to act as a trained teacher does."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from rl_fake_env import FakeEnv, FakeEnvCfg, runner_cfg

from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.config import (
    RslRlDistillationAlgorithmCfg,
    RslRlDistillationRunnerCfg,
    RslRlModelCfg,
    gaussian_distribution,
)


@pytest.fixture(scope="module")
def teacher(tmp_path_factory) -> Path:
    """Return the checkpoint of a policy of PPO."""
    folder = tmp_path_factory.mktemp("teacher")
    torch.manual_seed(1)
    MjlabOnPolicyRunner(RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg())), runner_cfg(), str(folder)).learn(
        3
    )
    return folder / "model_2.pt"


def student_runner(
    folder: Path | None = None,
    of_teacher: dict[str, Any] | None = None,
    of_algorithm: dict[str, Any] | None = None,
    **of_student: Any,
) -> MjlabOnPolicyRunner:
    student = {"hidden_dims": (16,), "distribution_cfg": gaussian_distribution(0.3), **of_student}
    cfg = RslRlDistillationRunnerCfg(
        num_steps_per_env=6,
        save_interval=2,
        obs_groups={"student": ("critic",), "teacher": ("actor",)},
        student=RslRlModelCfg(**student),
        teacher=RslRlModelCfg(
            hidden_dims=(8,),
            obs_normalization=True,
            distribution_cfg=gaussian_distribution(),
            **(of_teacher or {}),
        ),
        algorithm=RslRlDistillationAlgorithmCfg(
            gradient_length=3, learning_rate=1e-2, **(of_algorithm or {})
        ),
    )
    env = RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg()))
    return MjlabOnPolicyRunner(env, asdict(cfg), None if folder is None else str(folder))


def test_the_student_acts_as_the_teacher_in_the_end(teacher):
    torch.manual_seed(2)
    runner = student_runner()
    runner.load_teacher(str(teacher))
    observations = runner.env.get_observations()

    def distance() -> float:
        shown = runner.alg.teacher(observations)
        return (runner.alg.get_policy()(observations) - shown).square().mean().item()

    before = distance()
    weights = {k: v.clone() for k, v in runner.alg.teacher.state_dict().items()}
    runner.learn(60)
    assert distance() < 0.05 * before
    for name, value in runner.alg.teacher.state_dict().items():
        assert torch.equal(value, weights[name])


@pytest.mark.parametrize(
    "of_student",
    [
        {},
        {"class_name": "RNNModel", "rnn_type": "lstm", "rnn_hidden_dim": 4},
        {"of_algorithm": {"teacher_iterations": 5}},
    ],
)
def test_a_resumed_run_takes_the_same_course(teacher, tmp_path, of_student):
    torch.manual_seed(3)
    whole = student_runner(**of_student)
    whole.load_teacher(str(teacher))
    whole.learn(6)

    torch.manual_seed(3)
    first = student_runner(tmp_path, **of_student)
    first.load_teacher(str(teacher))
    first.learn(3)
    torch.manual_seed(99)
    second = student_runner(tmp_path, **of_student)
    # The checkpoint has the teacher too.
    second.load(str(tmp_path / "model_2.pt"))
    second.learn(6)
    expected, found = (runner.alg.student.state_dict() for runner in (whole, second))
    assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_the_teacher_acts_in_fewer_and_fewer_environments(teacher):
    torch.manual_seed(4)
    runner = student_runner(
        of_algorithm={"teacher_iterations": 4}, distribution_cfg=gaussian_distribution(1e-4)
    )
    runner.load_teacher(str(teacher))
    act, driven = runner.alg.act, []

    def acting(observations):
        actions = act(observations)
        distance = (actions - runner.alg.teacher(observations)).abs().amax(dim=1)
        driven.append(distance < 1e-3)
        return actions

    runner.alg.act = acting
    runner.learn(6)
    of_iterations = torch.stack(driven).unflatten(0, (6, 6))
    # The same environments in all steps of an iteration.
    assert (of_iterations == of_iterations[:, :1]).all()
    shares = of_iterations[:, 0].float().mean(dim=1)
    assert shares[0] == 1.0
    assert 0.0 < shares[1:4].mean() < 1.0
    assert (shares[4:] == 0.0).all()


def test_a_teacher_with_memory_keeps_it_from_one_iteration_to_the_next(tmp_path):
    memory = {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 4}
    networks = {name: {**runner_cfg()[name], **memory} for name in ("actor", "critic")}
    torch.manual_seed(1)
    env = RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg()))
    MjlabOnPolicyRunner(env, runner_cfg(**networks), str(tmp_path)).learn(2)
    runner = student_runner(of_teacher=memory)
    runner.load_teacher(str(tmp_path / "model_1.pt"))
    shown = []
    act = runner.alg.act

    def acting(observations):
        shown.append((observations.clone(), runner.alg.teacher.get_hidden_state()))
        return act(observations)

    runner.alg.act = acting
    runner.learn(3)
    assert shown[0][1] is None
    # Without an end in between, what the teacher remembers is what it has seen since.
    for (seen, before), (_, after) in zip(shown[1:], shown[2:], strict=False):
        runner.alg.teacher.reset(hidden_state=before.clone())
        runner.alg.teacher(seen)
        expected = runner.alg.teacher.get_hidden_state()
        kept = (after != 0).any(dim=-1).flatten()
        assert kept.any()
        assert torch.equal(after[:, kept], expected[:, kept])


def test_without_a_teacher_nothing_is_learned(tmp_path):
    with pytest.raises(
        ValueError, match="expected a teacher, got none.*--agent.teacher-checkpoint"
    ):
        student_runner(tmp_path).learn(1)
    assert not list(tmp_path.iterdir())


def test_a_teacher_of_another_network_is_refused(teacher, tmp_path):
    runner = student_runner(tmp_path)
    runner.alg._raw_teacher.mlp = torch.nn.Linear(2, 2)
    with pytest.raises(CheckpointError, match="its teacher does not fit"):
        runner.load_teacher(str(teacher))
    runner = student_runner(tmp_path)
    with pytest.raises(CheckpointError, match="its student does not fit"):
        runner.load(str(teacher))


def test_a_student_without_a_deviation_is_refused():
    with pytest.raises(ValueError, match="agent.student distribution_cfg: expected a distribution"):
        student_runner(distribution_cfg=None)
