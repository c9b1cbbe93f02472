"""Speed of `env.step`: over a bare `mjbatch` loop, and of two threads over one."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import mjbatch
import mujoco
import numpy as np
import torch
from report import Row, show

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg

TASK = "Mjlab-Cartpole-Swingup"
NUM_ENVS = 4096
STEPS_PER_SAMPLE = 20
SAMPLES = 15


def make_env(num_threads: int) -> ManagerBasedRlEnv:
    """Return the task's environments, reset."""
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs = NUM_ENVS
    cfg.sim.num_threads = num_threads
    cfg.sim.engine = "native"
    cfg.seed = 1
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def env_sample(env: ManagerBasedRlEnv, actions: torch.Tensor) -> Callable[[], None]:
    """Return a function that steps the environments once."""
    return lambda: env.step(actions) and None


def bare_sample(
    model: mujoco.MjModel, decimation: int, actions: torch.Tensor, num_threads: int
) -> Callable[[], None]:
    """Return a function that does the physics of one environment step, and nothing else.

    State goes in and out as double-precision views, which cost `mjbatch` nothing.
    """
    batch = mjbatch.Batch(model, NUM_ENVS, num_threads)
    qpos, ctrl = batch.bind("qpos"), batch.bind("ctrl")
    batch.bind("qvel")
    qpos[:, 1] = np.pi
    controls = actions.numpy().astype(float)

    def step() -> None:
        ctrl[:] = controls
        batch.step(nstep=decimation)
        batch.forward()

    return step


def alternate(*samples: Callable[[], None]) -> list[float]:
    """Return the median time of each sample, in seconds, taking turns so that noise hits all."""
    for sample in samples:
        for _ in range(5):
            sample()
    times: list[list[float]] = [[] for _ in samples]
    for _ in range(SAMPLES):
        for sample, taken in zip(samples, times, strict=True):
            begin = time.perf_counter()
            for _ in range(STEPS_PER_SAMPLE):
                sample()
            taken.append((time.perf_counter() - begin) / STEPS_PER_SAMPLE)
    return [statistics.median(taken) for taken in times]


def measure() -> list[Row]:
    """Measure both ratios."""
    torch.set_num_threads(1)
    actions = torch.rand(NUM_ENVS, 1, generator=torch.Generator().manual_seed(0)) * 2 - 1
    env = make_env(num_threads=2)
    bare = bare_sample(env.sim.mj_model, env.cfg.decimation, actions, num_threads=2)
    env_time, bare_time = alternate(env_sample(env, actions), bare)
    # A task that reads derived quantities makes the native engine run the forward as well.
    reading = make_env(num_threads=2)
    _ = reading.sim.data.xpos
    reading_time, bare_again = alternate(env_sample(reading, actions), bare)
    one, two = make_env(num_threads=1), env
    one_time, two_time = alternate(env_sample(one, actions), env_sample(two, actions))
    over_bare, over_one = bare_time / env_time, one_time / two_time
    over_bare_reading = bare_again / reading_time
    return [
        Row(
            f"cartpole, {NUM_ENVS} envs, 2 threads: `env.step` over the bare loop",
            f"{over_bare:.2f} ({NUM_ENVS / env_time:,.0f} env-steps/s)",
            f"bare `mjbatch` loop: {NUM_ENVS / bare_time:,.0f} env-steps/s",
            "at least 0.85",
            over_bare >= 0.85,
        ),
        Row(
            "the same, with `xpos` read: the task alone reads only `qpos` and `qvel`, for which the "
            "native engine leaves out the forward",
            f"{over_bare_reading:.2f} ({NUM_ENVS / reading_time:,.0f} env-steps/s)",
            f"bare `mjbatch` loop: {NUM_ENVS / bare_again:,.0f} env-steps/s",
            "at least 0.85",
            over_bare_reading >= 0.85,
        ),
        Row(
            f"cartpole, {NUM_ENVS} envs: `env.step`, 2 threads over 1",
            f"{over_one:.2f} ({NUM_ENVS / two_time:,.0f} env-steps/s)",
            f"1 thread: {NUM_ENVS / one_time:,.0f} env-steps/s",
            "at least 1.8",
            over_one >= 1.8,
        ),
    ]


if __name__ == "__main__":
    print(show(measure()))
