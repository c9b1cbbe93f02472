"""Evaluations: every environment plays a motion once; errors compare matching times."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
import torch
from tracking_tasks import G1, part_of, task_cfg, unperturbed

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.rl.evaluation import evaluate_policy
from mjlab.scripts.evaluate import EvaluateConfig, run_evaluate
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.tracking.mdp.metrics import TRACKING_ERRORS, play_motions_once
from mjlab.tasks.tracking.motion_file import read_motion
from mjlab.tasks.tracking.motion_sources import shipped_motions
from mjlab.tasks.tracking.options import MotionOptions
from mjlab.utils.os import to_plain


@pytest.fixture
def short(tmp_path):
    """Motion of 0.5 s, too short to fall."""
    return part_of("wave", slice(0, 25), tmp_path / "short.npz")


def evaluated(motion, policy=None, num_envs=4, edit=None, seed=3, **kwargs):
    cfg = task_cfg(motion, num_envs=num_envs)
    play_motions_once(cfg)
    if edit is not None:
        edit(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    zero = torch.zeros(num_envs, 29)
    try:
        return evaluate_policy(
            RslRlVecEnvWrapper(env),
            policy or (lambda observations: zero),
            metrics=TRACKING_ERRORS,
            success="survival",
            seed=seed,
            **kwargs,
        )
    finally:
        env.close()


def test_the_task_measures_these_and_calls_survival_success():
    evaluation = load_rl_cfg(G1).evaluation
    assert list(evaluation.metrics) == [
        "mpkpe", "r_mpkpe", "joint_vel_error", "ee_pos_error", "ee_ori_error",
    ]  # fmt: skip
    assert evaluation.success == "survival"
    # Settings passed by a training run.
    assert asdict(evaluation)["metrics"] == TRACKING_ERRORS


@pytest.mark.parametrize("profile", [None, "cpu"])
@pytest.mark.parametrize("task", [G1, f"{G1}-No-State-Estimation"])
def test_evaluations_play_motions_once(task, profile):
    cfg = load_env_cfg(task)
    play_motions_once(cfg)
    assert to_plain(load_env_cfg(task, profile=profile, evaluate=True)) == to_plain(cfg)


def test_each_episode_is_the_motion_from_its_start_to_its_end(short):
    result = evaluated(short)
    # Frames 1 to 24 are to be reached.
    assert result.mean_length == 24
    assert result.success_rate == 1.0
    assert result.terminations["motion_ended"] == 1.0
    assert result.num_unfinished == 0


def test_a_motion_longer_than_an_episode_is_played_to_its_end(tmp_path, short):
    cfg = task_cfg("squat")
    cfg.episode_length_s = 2.0
    play_motions_once(cfg)
    assert cfg.episode_length_s > 221 * 0.02
    assert "push_robot" not in cfg.events
    assert cfg.commands["motion"].sampling_mode == "start"
    # Noise, randomization and perturbed starts stay.
    assert cfg.observations["actor"].enable_corruption
    assert cfg.commands["motion"].pose_range
    assert "foot_friction" in cfg.events


def test_several_motions_are_played_by_as_many_environments_each(short, tmp_path):
    other = part_of("wave", slice(0, 15), tmp_path / "other.npz")
    result = evaluated(f"{short},{other}")
    assert result.mean_length == (24 + 14) / 2


class Motions:
    """Records the motion of each scored episode; `fall` of the robots are thrown over at once."""

    def __init__(self, env: ManagerBasedRlEnv, fall: float) -> None:
        self.env, self.fall = env, fall
        self.rounds: list[list[int]] = []

    def __call__(self, observations) -> torch.Tensor:
        if self.rounds and not self.rounds[-1]:
            self.rounds[-1] = self.env.command_manager.get_term("motion").motion_ids.tolist()
        # Robots fall at different times, so the numbers of starts differ.
        return 50.0 * (torch.rand(self.env.num_envs, 1) < self.fall) * torch.ones(1, 29)

    def reset(self, dones=None) -> None:
        if dones is None:
            self.rounds.append([])


def test_motions_are_shared_out_evenly(short, tmp_path):
    motions = [short, *(part_of("wave", slice(0, n), tmp_path / f"{n}.npz") for n in (15, 20))]
    cfg = task_cfg(",".join(map(str, motions)), num_envs=4)
    play_motions_once(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    played, returns = [], []
    for _ in range(2):
        policy = Motions(env, fall=0.1)
        result = evaluate_policy(RslRlVecEnvWrapper(env), policy, 11, seed=3)
        returns.append(result.returns)
        played.append(sum(policy.rounds, [])[:11])
        assert 0.0 < result.failure_rate < 1.0
    env.close()
    # Eleven episodes of three motions, in rounds of four.
    assert played[0] == [episode % 3 for episode in range(11)]
    assert played[0] == played[1]
    assert returns[0] == returns[1]


def test_one_seed_gives_the_same_figures_and_another_one_others(short):
    one, same, other = (evaluated(short, seed=seed) for seed in (3, 3, 4))
    assert one.returns == same.returns
    assert one.metrics == same.metrics
    assert one.metrics["mpkpe"].mean != other.metrics["mpkpe"].mean


def test_errors_are_of_matching_times_and_of_no_state_after_a_reset(tmp_path):
    """The reference stands still for nine frames and is 3 m away in the last one."""
    places = read_motion(shipped_motions()["wave"]).body_pos_w[:10].copy()
    places[9, :, 0] += 3.0
    path = part_of("wave", slice(0, 10), tmp_path / "jump.npz", body_pos_w=places)
    result = evaluated(path, edit=unperturbed)
    assert result.mean_length == 9
    # The policy acts at frames 0 to 8. Any pair of a state with a frame of another time, or with
    # one before a reset, has an error of 3 m.
    assert result.metrics["mpkpe"].mean < 0.05
    assert evaluated(path, edit=unperturbed, max_steps=1).metrics["mpkpe"].mean < 1e-4


def test_the_command_reports_intervals_as_a_table_and_as_json(short, capsys):
    cfg = EvaluateConfig(agent="zero", num_episodes=5, device="cpu", json=True)
    cfg.options = MotionOptions(motion_file=str(short))
    results = run_evaluate(G1, cfg)
    printed = json.loads(capsys.readouterr().out)
    for name in TRACKING_ERRORS:
        low, high = printed["metrics"][name]["interval"]
        assert low <= printed["metrics"][name]["mean"] <= high
    assert printed["success_rate"] == results["success_rate"] == 1.0
    assert printed["success_interval"][0] > 0.5
    assert results["mean_length"] == 24
    cfg.json = False
    run_evaluate(G1, cfg)
    table = capsys.readouterr().out
    for word in ("Success", "95 % interval", *TRACKING_ERRORS):
        assert word in table


def test_the_script_of_the_interface_writes_its_figures(short, tmp_path, capsys):
    from mjlab.tasks.tracking.scripts.evaluate import (
        EvaluateTrackingConfig,
        run_evaluate_tracking,
    )

    path = tmp_path / "out" / "metrics.json"
    cfg = EvaluateTrackingConfig(agent="zero", num_envs=3, device="cpu", output_file=str(path))
    cfg.options = MotionOptions(motion_file=str(short))
    means = run_evaluate_tracking(G1, cfg)
    keys = ["success_rate", *TRACKING_ERRORS]
    assert list(means) == keys
    written = json.loads(path.read_text())
    assert list(written)[:6] == keys
    assert len(written["mpkpe_interval"]) == 2
    assert f"mpkpe            {means['mpkpe']:.4f}" in capsys.readouterr().out
    # As in `evaluate`, the number of environments is that of episodes at once.
    cfg.num_episodes, cfg.json = 5, True
    capsys.readouterr()
    run_evaluate_tracking(G1, cfg)
    printed = json.loads(capsys.readouterr().out)
    assert (printed["num_episodes"], printed["num_envs"]) == (5, 3)
    with pytest.raises(ValueError, match="expected a motion tracking task"):
        run_evaluate_tracking("Mjlab-Cartpole-Balance", cfg)
