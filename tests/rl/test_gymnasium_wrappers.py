"""Interfaces of Gymnasium around the vector environment: images, wrappers, `gymnasium.make`."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium import wrappers as single  # noqa: E402
from gymnasium.wrappers import vector  # noqa: E402
from rl_ending_env import TASK  # noqa: E402

import mjlab.gymnasium  # noqa: E402, F401
from mjlab.envs import ManagerBasedRlEnv  # noqa: E402
from mjlab.rl import gymnasium_env  # noqa: E402
from mjlab.tasks.registry import load_env_cfg  # noqa: E402
from mjlab.viewer.offscreen_renderer import open_renderer  # noqa: E402

NAME = f"mjlab/{TASK}"


def make(num_envs: int = 3, auto_reset: bool = True, group: str | None = "actor") -> Any:
    """Return cartpoles with episodes of a few steps, and small images."""

    def edit(cfg: Any) -> None:
        cfg.episode_length_s, cfg.auto_reset = 0.1, auto_reset
        cfg.viewer.width, cfg.viewer.height = 64, 48

    return gymnasium.make_vec(
        NAME, num_envs=num_envs, group=group, device="cpu", render_mode="rgb_array", edit=edit,
        clip_actions=1.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def renders() -> None:
    import mujoco

    try:
        open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except RuntimeError as error:
        pytest.skip(str(error))


def run(env: Any, steps: int = 12) -> None:
    """Step through several episodes, and reset those that ended if the environment does not."""
    env.reset(seed=1)
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        ended = np.asarray(terminated) | np.asarray(truncated)
        if ended.any() and not env.unwrapped.env.unwrapped.cfg.auto_reset:
            env.reset(options={"reset_mask": ended})


@pytest.mark.parametrize("num_envs", [1, 3])
def test_render_shows_each_environment(renders, num_envs):
    env = make(num_envs)
    env.reset(seed=1)
    frames = env.render()
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * num_envs
    # Poles that start at other angles look different.
    env.env.sim.data.qpos[:, 1] = 0.7 * np.pi * env.env.sim.data.qpos.new_tensor(range(num_envs))
    env.env.sim.forward()
    frames = env.render()
    assert len({frame.tobytes() for frame in frames}) == num_envs
    assert env.env.render().shape == (48, 64, 3)
    env.close()


def test_render_without_a_mode_is_none():
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs = 2
    env = gymnasium_env(ManagerBasedRlEnv(cfg, device="cpu"))
    assert env.render() is None
    env.close()


@pytest.mark.parametrize(
    "num_envs",
    [
        1,
        pytest.param(3, marks=pytest.mark.slow),
    ],
)
def test_videos_are_recorded(renders, tmp_path, num_envs):
    pytest.importorskip("moviepy")
    env = vector.RecordVideo(make(num_envs), str(tmp_path), episode_trigger=lambda k: k < 2)
    run(env)
    env.close()
    assert list(tmp_path.glob("*.mp4"))


SAME: dict[str, Callable[[Any], Any]] = {
    "ClipAction": vector.ClipAction,
    "RescaleAction": lambda env: vector.RescaleAction(env, -1.0, 1.0),
    "TransformAction": lambda env: vector.TransformAction(env, lambda action: 0.5 * action),
    "VectorizeTransformAction": lambda env: vector.VectorizeTransformAction(env, single.ClipAction),
    "TransformReward": lambda env: vector.TransformReward(env, lambda reward: 2.0 * reward),
    "VectorizeTransformReward": lambda env: vector.VectorizeTransformReward(
        env, single.TransformReward, func=lambda reward: reward
    ),
    "ClipReward": lambda env: vector.ClipReward(env, -1.0, 1.0),
    "NormalizeReward": vector.NormalizeReward,
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
    "DictInfoToList": vector.DictInfoToList,
}
DISABLED: dict[str, Callable[[Any], Any]] = {
    "TransformObservation": lambda env: vector.TransformObservation(env, lambda rows: 2.0 * rows),
    "ReshapeObservation": lambda env: vector.ReshapeObservation(env, (5, 1)),
    "DtypeObservation": lambda env: vector.DtypeObservation(env, np.float64),
}


@pytest.mark.parametrize("name", [*SAME, *DISABLED])
def test_wrappers_run_without_auto_reset(name):
    env = {**SAME, **DISABLED}[name](make(auto_reset=False))
    run(env)
    env.close()


@pytest.mark.parametrize("name", SAME)
def test_wrappers_run_with_auto_reset(name):
    env = SAME[name](make())
    run(env)
    env.close()


@pytest.mark.parametrize("name", [*DISABLED, "NormalizeObservation"])
def test_wrappers_of_observations_need_no_auto_reset(name):
    env = make()
    with pytest.raises(ValueError, match="autoreset_mode"):
        {**DISABLED, "NormalizeObservation": vector.NormalizeObservation}[name](env)
    env.close()


def test_make_names_make_vec():
    with pytest.raises(NotImplementedError, match=rf'make_vec\("{NAME}", num_envs=1\)'):
        gymnasium.make(NAME)


@pytest.mark.slow
def test_nothing_is_printed_at_exit(renders):
    program = (
        "import gymnasium\n"
        f"env = gymnasium.make_vec('mjlab.gymnasium:{NAME}', num_envs=2, group='actor', "
        "device='cpu', render_mode='rgb_array')\n"
        "env.reset(seed=1)\n"
        "assert len(env.render()) == 2\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
