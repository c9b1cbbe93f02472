"""Recorded episodes: frames, values beside them, and ends."""

from __future__ import annotations

import math

import pytest

from mjlab.runs.policy import constant_policy, make_env
from mjlab.tasks.registry import load_env_cfg
from mjlab.viewer.viser.recording import record_episodes

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"


@pytest.fixture(scope="module")
def env():
    cfg = load_env_cfg(TASK, evaluate=True)
    cfg.scene.num_envs, cfg.seed = 2, 0
    env = make_env(TASK, cfg, "cpu")
    yield env
    env.close()


@pytest.fixture(scope="module")
def recording(env):
    return record_episodes(env, constant_policy(env, "zero"), 2, 0.2, fps=25.0)


def test_frames_have_times_commands_and_rewards(recording, env):
    # A frame for two steps of 0.02 s, and the start of each episode.
    assert recording.times == pytest.approx([0.04 * i for i in range(12)])
    assert {name: len(values) for name, values in recording.commands.items()} == {"twist": 12}
    assert {len(values) for values in recording.rewards.values()} == {12}
    for name, values in recording.rewards.items():
        assert env.unwrapped.reward_manager.get_term_cfg(name).weight != 0.0
        assert [math.isnan(value) for value in values] == ([True] + 5 * [False]) * 2


def test_episodes_end_with_the_recording(recording):
    assert [one.start for one in recording.episodes] == pytest.approx([0.0, 0.24])
    assert [one.seconds for one in recording.episodes] == pytest.approx([0.2, 0.2])
    assert [one.ended_by for one in recording.episodes] == [(), ()]


def test_scene_needs_no_server(recording):
    assert "__VISER_EMBED_DATA__" in recording.html
    assert recording.legend


def test_terminations_end_episodes(env):
    robot = env.unwrapped.scene["robot"]

    def fall(observations):
        pose = robot.data.root_link_pose_w.clone()
        pose[:, 3:] = pose.new_tensor([0.0, 1.0, 0.0, 0.0])
        robot.write_root_link_pose_to_sim(pose)
        return constant_policy(env, "zero")(observations)

    (episode,) = record_episodes(env, fall, 1, 10.0, fps=25.0).episodes
    assert episode.ended_by == ("fell_over",)
    assert episode.seconds < 1.0


def test_the_same_seed_gives_the_same_recording(env):
    twice = []
    for _ in range(2):
        env.seed(3)
        twice.append(record_episodes(env, constant_policy(env, "zero"), 1, 0.1, fps=50.0))
    assert twice[0].commands == twice[1].commands
    assert twice[0].episodes == twice[1].episodes
