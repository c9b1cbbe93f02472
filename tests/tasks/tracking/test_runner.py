"""Motion tracking runner: exports with reference, motions in the run folder, failure statistics."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from tracking_tasks import G1, G1_BLIND, part_of

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import CommandTerm, CommandTermCfg
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.rl.exporter_utils import OnnxPolicyError, load_onnx_policy
from mjlab.scripts.evaluate import EvaluateConfig, run_evaluate
from mjlab.tasks.registry import load_rl_cfg, load_runner_cls
from mjlab.tasks.tracking.motion_file import MotionFileError
from mjlab.tasks.tracking.motion_sources import record_motions, recorded_motions, shipped_motions
from mjlab.tasks.tracking.options import MotionOptions
from mjlab.tasks.tracking.rl import MotionTrackingOnPolicyRunner


def weights(runner) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in runner.alg.get_policy().parameters()])


def test_the_tasks_are_trained_by_this_runner():
    for task in (G1, G1_BLIND):
        assert load_runner_cls(task) is MotionTrackingOnPolicyRunner


@pytest.mark.parametrize(("task", "size"), [(G1, 160), (G1_BLIND, 154)])
def test_the_exported_policy_carries_the_reference(make_runner, tmp_path, task, size):
    runner = make_runner(task=task)
    folder = tmp_path / "2026-01-02_dance"
    runner.save(str(folder / "model_7.pt"))
    session = onnxruntime.InferenceSession(folder / "2026-01-02_dance.onnx")
    assert [(i.name, i.shape) for i in session.get_inputs()] == [
        ("obs", [1, size]), ("time_step", [1, 1]),
    ]  # fmt: skip
    assert [(o.name, o.shape) for o in session.get_outputs()] == [
        ("actions", [1, 29]), ("joint_pos", [1, 29]), ("joint_vel", [1, 29]),
        ("body_pos_w", [1, 14, 3]), ("body_quat_w", [1, 14, 4]),
        ("body_lin_vel_w", [1, 14, 3]), ("body_ang_vel_w", [1, 14, 3]),
    ]  # fmt: skip
    motion = runner.motion_command.motion
    obs = torch.randn(1, size)
    policy = runner.alg.get_policy()
    policy.eval()
    with torch.inference_mode():
        expected = policy({"actor": obs}).numpy()
    last = motion.time_step_total - 1
    for step, frame in ((0.0, 0), (17.9, 17), (300.0, 300), (1e6, last), (-3.0, 0)):
        found = session.run(None, {"obs": obs.numpy(), "time_step": np.array([[step]], np.float32)})
        np.testing.assert_allclose(found[0], expected, atol=1e-5)
        for output, values in zip(session.get_outputs()[1:], found[1:], strict=True):
            np.testing.assert_array_equal(values[0], getattr(motion, output.name)[frame].numpy())


def test_the_exported_policy_says_what_its_reference_is_of(make_runner, tmp_path):
    runner = make_runner()
    runner.save(str(tmp_path / "run" / "model_0.pt"))
    model = onnx.load(tmp_path / "run" / "run.onnx")
    assert model.opset_import[0].version == 18
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["anchor_body_name"] == "torso_link"
    assert metadata["body_names"].split(",") == list(runner.motion_command.body_names)
    assert metadata["motion_names"] == "squat,wave"
    assert (metadata["motion_starts"], metadata["motion_lengths"]) == ("0,221", "221,261")
    assert metadata["command_names"] == "motion"
    assert metadata["observation_names"].startswith("command,motion_anchor_pos_b")
    assert len(metadata["joint_names"].split(",")) == 29


def test_the_exported_policy_is_played_and_scored_as_its_checkpoint_is(make_runner, tmp_path):
    runner = make_runner()
    folder = tmp_path / "run"
    runner.save(str(folder / "model_0.pt"))
    policy = load_onnx_policy(folder / "run.onnx", runner.env, "cpu")
    observations = runner.env.get_observations()
    with torch.inference_mode():
        expected = runner.get_inference_policy()(observations)
    torch.testing.assert_close(policy(observations), expected, atol=1e-5, rtol=1e-4)
    part_of("wave", slice(0, 25), folder / "motion" / "short.npz")
    cfg = EvaluateConfig(checkpoint_file=str(folder / "run.onnx"), num_episodes=3, device="cpu")
    cfg.options = MotionOptions(motion_file=str(folder / "motion" / "short.npz"))
    results = run_evaluate(G1, cfg)
    assert results["mean_length"] == 24
    assert results["policy"].endswith("run.onnx")
    # Different observations: without state estimation.
    with pytest.raises(OnnxPolicyError, match="observation_names"):
        run_evaluate(G1_BLIND, cfg)


def test_a_policy_without_metadata_is_one_warning(make_runner, tmp_path, caplog):
    runner = make_runner()
    path = tmp_path / "run" / "run.onnx"
    runner.save(str(path.with_name("model_0.pt")))
    load_onnx_policy(path, runner.env, "cpu")
    assert "no metadata" not in caplog.text
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.save(model, path)
    load_onnx_policy(path, runner.env, "cpu")
    assert caplog.text.count("run.onnx has no metadata") == 1


def test_the_motions_are_kept_in_the_folder_of_the_run(make_runner, tmp_path):
    runner = make_runner(tmp_path / "run")
    runner.learn(1)
    files = recorded_motions(tmp_path / "run")
    assert [path.name for path in files] == ["squat.npz", "wave.npz"]
    for path in files:
        assert path.read_bytes() == shipped_motions()[path.stem].read_bytes()
    entries = json.loads((tmp_path / "run" / "motion" / "motions.json").read_text())
    assert entries[0]["source"] == str(shipped_motions()["squat"].resolve())
    assert len(entries[0]["sha256"]) == 64


def test_a_record_is_made_once_and_checked(tmp_path):
    squat, wave = (shipped_motions()[name] for name in ("squat", "wave"))
    new = record_motions([squat, wave, squat], tmp_path, "org/dances/all:latest")
    assert [path.name for path in new] == [
        "squat.npz", "wave.npz", "squat-2.npz", "motions.json",
    ]  # fmt: skip
    assert record_motions([wave], tmp_path) == []
    assert [path.name for path in recorded_motions(tmp_path)] == [p.name for p in new[:3]]
    (tmp_path / "motion" / "wave.npz").write_bytes(squat.read_bytes())
    with pytest.raises(MotionFileError, match="is missing or was changed since"):
        recorded_motions(tmp_path)
    (tmp_path / "motion" / "motions.json").write_text("{]")
    with pytest.raises(MotionFileError, match="is damaged"):
        recorded_motions(tmp_path)
    assert recorded_motions(tmp_path / "elsewhere") == []


def test_a_resumed_run_goes_on_as_the_uninterrupted_one(make_runner, tmp_path):
    whole = make_runner(tmp_path / "whole")
    whole.learn(4, init_at_random_ep_len=True)
    first = make_runner(tmp_path / "first")
    first.learn(2, init_at_random_ep_len=True)
    resumed = make_runner(tmp_path / "resumed")
    resumed.load(str(tmp_path / "first" / "model_1.pt"))
    resumed.learn(4)
    assert torch.equal(weights(resumed), weights(whole))
    for name in ("time_steps", "motion_ids", "body_pos_relative_w"):
        assert torch.equal(
            getattr(resumed.motion_command, name), getattr(whole.motion_command, name)
        )
    assert torch.equal(resumed.motion_command.sampler.failed, whole.motion_command.sampler.failed)


@pytest.mark.parametrize("num_envs", [6, 4])
def test_a_resumed_run_remembers_where_the_robot_fails(make_runner, tmp_path, num_envs):
    runner = make_runner(tmp_path / "run")
    runner.motion_command.sampler.failed.copy_(torch.arange(11.0) / 10)
    runner.save(str(tmp_path / "run" / "model_0.pt"))
    resumed = make_runner(num_envs=num_envs)
    resumed.load(str(tmp_path / "run" / "model_0.pt"))
    torch.testing.assert_close(resumed.motion_command.sampler.failed, torch.arange(11.0) / 10)


def test_statistics_of_another_motion_are_left_out(make_runner, tmp_path, caplog):
    runner = make_runner(tmp_path / "run")
    runner.save(str(tmp_path / "run" / "model_0.pt"))
    other = make_runner(motion="squat")
    other.load(str(tmp_path / "run" / "model_0.pt"))
    assert other.motion_command.sampler.failed.sum() == 0
    assert "checkpoint has 11 segments, the motions have 5" in caplog.text


def test_a_run_at_wandb_uses_the_artifact_and_uploads_its_motions(
    make_runner, tmp_path, monkeypatch
):
    calls = []
    run = SimpleNamespace(use_artifact=lambda name: calls.append(("use", name)))
    wandb = SimpleNamespace(
        run=run, save=lambda path, base_path: calls.append((Path(path).name, Path(base_path).name))
    )
    monkeypatch.setitem(__import__("sys").modules, "wandb", wandb)
    runner = make_runner(logger="wandb", registry_name="org/dances/squat", motion="squat")
    for number in (0, 1):
        runner.save(str(tmp_path / "run" / f"model_{number}.pt"))
    assert calls == [
        ("squat.npz", "run"), ("motions.json", "run"), ("use", "org/dances/squat:latest"),
    ]  # fmt: skip
    entries = json.loads((tmp_path / "run" / "motion" / "motions.json").read_text())
    assert entries[0]["source"] == "org/dances/squat"


def test_motions_that_cannot_be_recorded_cost_no_checkpoint(make_runner, tmp_path, caplog):
    runner = make_runner()
    runner.motion_command.motion_files = (tmp_path / "gone.npz",)
    runner.save(str(tmp_path / "run" / "model_0.pt"))
    assert (tmp_path / "run" / "model_0.pt").is_file()
    assert (tmp_path / "run" / "run.onnx").is_file()
    assert "Not written: record of the motions" in caplog.text


def test_a_task_without_motion_is_refused():
    from mjlab.tasks.registry import load_env_cfg

    cfg = load_env_cfg("Mjlab-Cartpole-Balance")
    env = ManagerBasedRlEnv(cfg, device="cpu")
    rl_cfg = asdict(load_rl_cfg("Mjlab-Cartpole-Balance"))
    with pytest.raises(ValueError, match="Unknown motion command"):
        MotionTrackingOnPolicyRunner(RslRlVecEnvWrapper(env), rl_cfg)
    env.close()


@dataclass(kw_only=True)
class OwnMotionCfg(CommandTermCfg):
    """Config of a custom motion command."""

    entity_name: str = "robot"
    anchor_body_name: str = "torso_link"
    body_names: tuple[str, ...] = ()

    def build(self, env):
        return OwnMotion(self, env)


class OwnMotion(CommandTerm):
    """Custom class: the reference is the current robot state."""

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.robot = env.scene[cfg.entity_name]
        self.ids = [self.robot.body_names.index(name) for name in cfg.body_names]
        self.anchor = self.robot.body_names.index(cfg.anchor_body_name)
        self.body_pos_relative_w = torch.zeros(env.num_envs, len(self.ids), 3)
        self.body_quat_relative_w = torch.zeros(env.num_envs, len(self.ids), 4)
        self.body_quat_relative_w[..., 0] = 1.0

    @property
    def command(self):
        return torch.cat((self.robot.data.joint_pos, self.robot.data.joint_vel), dim=1)

    @property
    def robot_anchor_pos_w(self):
        return self.robot.data.body_link_pos_w[:, self.anchor]

    @property
    def robot_anchor_quat_w(self):
        return self.robot.data.body_link_quat_w[:, self.anchor]

    anchor_pos_w, anchor_quat_w = robot_anchor_pos_w, robot_anchor_quat_w

    @property
    def robot_body_pos_w(self):
        return self.robot.data.body_link_pos_w[:, self.ids]

    @property
    def robot_body_quat_w(self):
        return self.robot.data.body_link_quat_w[:, self.ids]

    @property
    def robot_body_lin_vel_w(self):
        return self.robot.data.body_link_lin_vel_w[:, self.ids]

    body_lin_vel_w = robot_body_lin_vel_w

    @property
    def robot_body_ang_vel_w(self):
        return self.robot.data.body_link_ang_vel_w[:, self.ids]

    body_ang_vel_w = robot_body_ang_vel_w

    def _resample_command(self, env_ids):
        pass

    def _update_command(self, env_ids=None):
        self.body_pos_relative_w.copy_(self.robot_body_pos_w)
        self.body_quat_relative_w.copy_(self.robot_body_quat_w)


def to_own_motion(cfg):
    ours = cfg.commands["motion"]
    cfg.commands["motion"] = OwnMotionCfg(
        resampling_time_range=(10.0, 10.0), body_names=tuple(ours.body_names)
    )
    cfg.terminations = {"time_out": cfg.terminations["time_out"]}
    cfg.curriculum = {}


def test_any_command_named_motion_trains_with_the_terms_of_tracking(make_runner, tmp_path):
    runner = make_runner(tmp_path / "run", motion=None, edit=to_own_motion, num_envs=2)
    assert isinstance(runner.motion_command, OwnMotion)
    runner.learn(1)
    env = runner.env.unwrapped
    # The reference is the robot state at the last command update.
    for name in ("motion_body_pos", "motion_body_ori"):
        index = env.reward_manager.active_terms.index(name)
        assert env.reward_manager.get_active_iterable_terms(0)[index][1][0] > 0.0
    assert (tmp_path / "run" / "run.onnx").is_file()
    assert not (tmp_path / "run" / "motion").exists()
    assert runner.onnx_metadata()["anchor_body_name"] == "torso_link"
    runner.load(str(tmp_path / "run" / "model_0.pt"))
