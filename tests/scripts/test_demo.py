"""`demo`, and other exported policies that are played."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from mjlab.runs.policy import load_policy, make_env
from mjlab.scripts import demo
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls
from mjlab.viewer.page_server import open_browser

GO1 = demo.DEMOS["go1"]
HEADLESS = ("--viewer", "none", "--num-steps", "3", "--device", "cpu")


@pytest.fixture(scope="module")
def go1_policy(tmp_path_factory) -> Path:
    """An exported policy of the demo's task that has not learned anything."""
    env = make_env(GO1.task, load_env_cfg(GO1.task, play=True), "cpu")
    cfg = load_rl_cfg(GO1.task)
    cfg.actor.hidden_dims = cfg.critic.hidden_dims = (8,)
    path = tmp_path_factory.mktemp("demo") / "go1.onnx"
    try:
        load_runner_cls(GO1.task)(env, asdict(cfg), None, "cpu").export_policy(str(path))
    finally:
        env.close()
    return path


def test_demo_plays_its_policy_without_being_told_anything(run, go1_policy, monkeypatch):
    monkeypatch.setitem(demo.DEMOS, "go1", replace(GO1, policy=go1_policy))
    outcome = run("demo", *HEADLESS)
    assert outcome.status == 0, outcome.err
    assert "3 steps in 1 environment," in outcome.out


def test_a_policy_that_is_missing_is_named(run, monkeypatch, tmp_path):
    monkeypatch.setitem(demo.DEMOS, "go1", replace(GO1, policy=tmp_path / "go1.onnx"))
    outcome = run("demo", *HEADLESS)
    assert outcome.status == 1
    assert f"Checkpoint {tmp_path / 'go1.onnx'} not found" in outcome.message


def test_by_default_one_robot_is_shown_in_the_browser_of_this_machine(monkeypatch):
    cfg = demo.demo_cfg(GO1)
    assert (cfg.viewer, cfg.num_envs, cfg.device, cfg.host) == ("viser", 1, "cpu", "127.0.0.1")
    assert cfg.open_browser
    assert Path(cfg.checkpoint_file) == GO1.policy


def test_help_is_short_and_loads_nothing(run):
    outcome = run("demo", "--help")
    assert outcome.status == 0
    assert "uv run mjlab demo" in outcome.out


@pytest.mark.parametrize("name", demo.DEMOS)
def test_a_bundled_policy_fits_the_task_and_says_how_it_was_made(run, name):
    policy = demo.DEMOS[name].policy
    assert policy.name in (policy.parent / "README.md").read_text()
    assert policy.stat().st_size < 2_000_000
    outcome = run("demo", name, *HEADLESS)
    assert outcome.status == 0, outcome.err


def test_a_robot_without_a_policy_is_told_with_those_that_have_one(run):
    outcome = run("demo", "h1", *HEADLESS)
    assert outcome.status == 1
    assert all(name in outcome.message for name in ("'go1'", "'g1'", "'h1'"))


@pytest.mark.parametrize("name", ["go1", "g1"])
def test_a_bundled_policy_walks_forward_as_told(name):
    bundled = demo.DEMOS[name]
    cfg = load_env_cfg(bundled.task, play=True, profile=bundled.profile)
    twist = cfg.commands["twist"]
    twist.rel_standing_envs = twist.rel_heading_envs = 0.0
    twist.ranges.lin_vel_x, twist.ranges.lin_vel_y = (0.8, 0.8), (0.0, 0.0)
    twist.ranges.ang_vel_z = (0.0, 0.0)
    cfg.scene.num_envs, cfg.seed = 4, 0
    env = make_env(bundled.task, cfg, "cpu")
    try:
        policy = load_policy(bundled.task, env, bundled.policy, "cpu")
        robot = env.unwrapped.scene["robot"].data
        observations, _ = env.reset()
        begin = robot.root_link_pos_w.clone()
        with torch.inference_mode():
            for _ in range(150):
                observations, _, dones, _ = env.step(policy(observations))
                assert not dones.any()
        walked = (robot.root_link_pos_w - begin)[:, :2].norm(dim=-1)
    finally:
        env.close()
    # Three seconds at 0.8 m/s are 2.4 m, less the time to get going.
    assert ((walked > 1.5) & (walked < 2.8)).all()


def test_the_bundled_tracking_policy_follows_its_motions_to_their_end():
    bundled = demo.DEMOS["g1-tracking"]
    cfg = load_env_cfg(bundled.task, play=True)
    cfg.scene.num_envs, cfg.seed = 4, 0
    env = make_env(bundled.task, cfg, "cpu")
    try:
        policy = load_policy(bundled.task, env, bundled.policy, "cpu")
        observations, _ = env.reset()
        ends = torch.zeros(cfg.scene.num_envs)
        with torch.inference_mode():
            # The longer motion, a wave, has 261 frames.
            for _ in range(300):
                observations, _, dones, _ = env.step(policy(observations))
                assert not env.unwrapped.reset_terminated.any()
                ends += dones
    finally:
        env.close()
    assert (ends >= 1).all()


@pytest.mark.parametrize(
    "script",
    [
        "play",
        pytest.param("evaluate", marks=pytest.mark.slow),
    ],
)
def test_exported_policies_are_played_and_evaluated_like_checkpoints(run, trained, script):
    (policy,) = trained.glob("*.onnx")
    flags = HEADLESS if script == "play" else ("--num-episodes", "2", "--max-steps", "4")
    outcome = run(script, "Mjlab-Cartpole-Swingup", "--checkpoint-file", str(policy), *flags)
    assert outcome.status == 0, outcome.err


def test_a_policy_of_another_task_is_refused(run, go1_policy):
    outcome = run("play", "Mjlab-Cartpole-Swingup", "--checkpoint-file", str(go1_policy), *HEADLESS)
    assert outcome.status == 1
    assert "trained in a different environment" in outcome.message
    assert "actions: the policy has 12, not 1" in outcome.message


@pytest.mark.parametrize(
    ("platform", "display", "opened"),
    [("linux", None, False), ("linux", ":1", True), ("darwin", None, True)],
)
def test_a_browser_is_opened_only_where_there_is_a_display(monkeypatch, platform, display, opened):
    seen = []
    monkeypatch.setattr("webbrowser.open", seen.append)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if display is None:
        monkeypatch.delenv("DISPLAY", raising=False)
    else:
        monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    open_browser("http://localhost")
    assert bool(seen) is opened
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1 22")
    open_browser("http://localhost")
    assert len(seen) == opened
