"""Velocity runner: exact resume from checkpoints, and export of policies."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import onnx
import pytest
import torch
from velocity_tasks import GO1_FLAT, task_cfg

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.tasks.registry import load_rl_cfg, load_runner_cls
from mjlab.tasks.velocity.rl import VelocityOnPolicyRunner
from mjlab.utils.random import seed_rng


@pytest.fixture
def make_runner():
    """Build runners of a small policy in small environments, writing to a folder."""
    built = []

    def make(log_dir: Path | None, counter: int = 0) -> VelocityOnPolicyRunner:
        seed_rng(1)
        env = ManagerBasedRlEnv(task_cfg(GO1_FLAT, num_envs=6), device="cpu")
        # Near the second stage of the curriculum, so that it begins during training.
        env.common_step_counter = counter
        built.append(env)
        cfg = asdict(load_rl_cfg(GO1_FLAT))
        cfg["num_steps_per_env"], cfg["save_interval"] = 4, 100
        for model in ("actor", "critic"):
            cfg[model]["hidden_dims"] = (16,)
        folder = None if log_dir is None else str(log_dir)
        return VelocityOnPolicyRunner(RslRlVecEnvWrapper(env), cfg, folder, "cpu")

    yield make
    for env in built:
        env.close()


def weights(runner: VelocityOnPolicyRunner) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in runner.alg.get_policy().parameters()])


def twist(runner: VelocityOnPolicyRunner):
    return runner.env.unwrapped.command_manager.get_term("twist")


def test_the_task_is_trained_by_its_runner():
    for robot in ("Go1", "G1"):
        assert load_runner_cls(f"Mjlab-Velocity-Flat-Unitree-{robot}") is VelocityOnPolicyRunner


def test_a_run_resumes_with_its_curriculum(make_runner, tmp_path):
    whole = make_runner(tmp_path / "whole", counter=119_990)
    whole.learn(4, init_at_random_ep_len=True)
    first = make_runner(tmp_path / "first", counter=119_990)
    first.learn(2, init_at_random_ep_len=True)
    # Widened by hand, where the curriculum would not do it again.
    resumed = make_runner(tmp_path / "resumed")
    resumed.load(str(tmp_path / "first" / "model_1.pt"))
    resumed.learn(4)
    assert torch.equal(weights(resumed), weights(whole))
    assert torch.equal(twist(resumed).command, twist(whole).command)
    assert twist(resumed).ranges == twist(whole).ranges


def test_ranges_that_were_in_use_are_in_the_checkpoint(make_runner, tmp_path):
    runner = make_runner(tmp_path / "run")
    runner.learn(1)
    twist(runner).ranges.lin_vel_y = (-0.125, 0.125)
    runner.save(str(tmp_path / "run" / "model_0.pt"))
    resumed = make_runner(None)
    resumed.load(str(tmp_path / "run" / "model_0.pt"))
    resumed.learn(2)
    assert twist(resumed).ranges.lin_vel_y == (-0.125, 0.125)


def test_saving_writes_the_policy_beside_the_checkpoint(make_runner, tmp_path):
    folder = tmp_path / "2026-01-02_walk"
    runner = make_runner(None)
    runner.save(str(folder / "model_7.pt"))
    assert sorted(p.name for p in folder.iterdir()) == ["2026-01-02_walk.onnx", "model_7.pt"]
    model = onnx.load(folder / "2026-01-02_walk.onnx")
    assert [node.name for node in model.graph.input] == ["obs"]
    batch, size = model.graph.input[0].type.tensor_type.shape.dim
    assert (batch.dim_value, size.dim_value) == (1, 48)
    assert [node.name for node in model.graph.output] == ["actions"]
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["run_path"] == "local"
    assert metadata["command_names"] == "twist"
    names = metadata["observation_names"].split(",")
    assert names == [
        "base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos", "joint_vel", "actions",
        "command",
    ]  # fmt: skip
    joints = metadata["joint_names"].split(",")
    assert len(joints) == 12
    calf = joints.index("FR_calf_joint")
    for key, value in (
        ("joint_stiffness", 35.76429597),
        ("joint_damping", 2.276825796),
        ("action_scale", 0.2485020258),
        ("default_joint_pos", -1.8),
    ):
        # In full precision: three decimals would corrupt them.
        assert float(metadata[key].split(",")[calf]) == pytest.approx(value, rel=1e-6), key


def test_training_exports_once_for_each_checkpoint(make_runner, tmp_path, monkeypatch):
    runner = make_runner(tmp_path / "run")
    exported = []
    monkeypatch.setattr(runner, "export_policy", lambda path=None: exported.append(path))
    runner.learn(1)
    assert exported == [str((tmp_path / "run" / "run.onnx").resolve())]


def test_an_export_that_fails_costs_no_checkpoint(make_runner, tmp_path, monkeypatch, caplog):
    runner = make_runner(None)

    def fail(*args):
        raise RuntimeError("no such operator")

    monkeypatch.setattr(runner, "export_policy_to_onnx", fail)
    runner.save(str(tmp_path / "model_0.pt"))
    assert (tmp_path / "model_0.pt").is_file()
    assert "no such operator" in caplog.text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param(
            lambda sim: sim.pop("library"),
            "native engine before mujoco.batch",
            marks=pytest.mark.slow,
        ),
        (lambda sim: sim.update(engine="warp"), "'native', got 'warp'"),
    ],
)
def test_a_checkpoint_of_another_engine_gives_weights_but_not_episodes(
    make_runner, tmp_path, caplog, change, words
):
    first = make_runner(tmp_path / "first")
    first.learn(2)
    path = tmp_path / "first" / "model_1.pt"
    checkpoint = torch.load(path, weights_only=True)
    change(checkpoint["training_state"]["env"]["sim"])
    torch.save(checkpoint, path)
    resumed = make_runner(tmp_path / "resumed")
    resumed.load(str(path))
    assert torch.equal(weights(resumed), weights(first))
    before = resumed.env.unwrapped.sim.data.qpos.clone()
    with pytest.raises(ValueError, match=words):
        resumed.env.unwrapped.load_state_dict(checkpoint["training_state"]["env"])
    assert torch.equal(resumed.env.unwrapped.sim.data.qpos, before)
    resumed.learn(3)
    assert resumed.current_learning_iteration == 3
    (warning,) = [record.getMessage() for record in caplog.records if words in record.getMessage()]
    assert "episodes and random numbers restart" in warning
    policy_only = make_runner(None)
    policy_only.load(str(path), load_cfg={"actor": True})
