"""Speed of `env.step`: over a bare `mujoco.batch` loop, and of two threads over one."""

from __future__ import annotations

import numpy as np
import torch
from bare import BareLoop
from measure import Row, Sample, alternate, show

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg

TASK = "Mjlab-Cartpole-Swingup"
NUM_ENVS = 4096


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


def measure() -> list[Row]:
    """Measure both ratios."""
    torch.set_num_threads(1)
    actions = torch.rand(NUM_ENVS, 1, generator=torch.Generator().manual_seed(0)) * 2 - 1
    env = make_env(num_threads=2)
    bare = BareLoop(env.sim.mj_model, NUM_ENVS, num_threads=2, decimation=env.cfg.decimation)
    bare.qpos[:, 1] = np.pi
    bare.ctrl[:] = actions.numpy()

    def stepping(env: ManagerBasedRlEnv) -> Sample:
        # As training steps.
        step = torch.inference_mode()(env.step)
        return lambda: step(actions)

    env_time, bare_time = alternate(stepping(env), bare)
    # A task that reads derived quantities makes the native engine run the forward as well.
    reading = make_env(num_threads=2)
    _ = reading.sim.data.xpos
    reading_time, bare_again = alternate(stepping(reading), bare)
    one, two = make_env(num_threads=1), env
    one_time, two_time = alternate(stepping(one), stepping(two))
    over_bare, over_one = bare_time / env_time, one_time / two_time
    over_bare_reading = bare_again / reading_time
    return [
        Row(
            f"cartpole, {NUM_ENVS} envs, 2 threads: `env.step` over the bare loop",
            f"{over_bare:.2f} ({NUM_ENVS / env_time:,.0f} env-steps/s)",
            f"bare `mujoco.batch` loop: {NUM_ENVS / bare_time:,.0f} env-steps/s",
            "at least 0.90",
            over_bare >= 0.90,
        ),
        Row(
            "the same, with `xpos` read: the task reads only `qpos` and `qvel`, so the native engine "
            "skips the forward",
            f"{over_bare_reading:.2f} ({NUM_ENVS / reading_time:,.0f} env-steps/s)",
            f"bare `mujoco.batch` loop: {NUM_ENVS / bare_again:,.0f} env-steps/s",
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
