"""Overhead of the Gymnasium environment over `env.step`: the same environment, alternating.

Ends of episodes are spread over all steps, as in training. With `final observations`, `env.step` records final
observations, as required by the Gymnasium environment.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from measure import Row, alternate, show

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import gymnasium_env
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.torch import prepare_torch

CASES = (
    ("Mjlab-Cartpole-Swingup", "cartpole", 4096),
    ("Mjlab-Velocity-Flat-Unitree-Go1", "Go1 flat", 1024),
)
REACH = 3.0
"""Overhead to reach (%)."""


def measure(keyword: str = "") -> list[Row]:
    """Measure the tasks whose name contains `keyword`."""
    prepare_torch("cpu")
    return [_measure(*case) for case in CASES if keyword in case[0]]


def _measure(task: str, name: str, num_envs: int) -> Row:
    cfg = load_env_cfg(task)
    cfg.scene.num_envs = num_envs
    env = ManagerBasedRlEnv(cfg, device="cpu")
    envs = gymnasium_env(env)
    envs.reset(seed=1)
    env.episode_length_buf.random_(int(env.max_episode_length))
    actions = 0.3 * torch.randn(num_envs, env.action_manager.total_action_dim)
    array = actions.numpy()

    def plain(observes: bool) -> Callable[[], object]:
        def step() -> object:
            env.observes_ends = env.observes_failures = observes
            return env.step(actions)

        return step

    def gymnasium_step() -> object:
        env.observes_ends = env.observes_failures = True
        return envs.step(array)

    steps = max(8192 // num_envs, 4)
    with torch.inference_mode():
        without, observing, adapted = alternate(
            plain(False), plain(True), gymnasium_step, steps=steps, repeats=60
        )
    env.close()
    over = 100.0 * (adapted / observing - 1.0)
    return Row(
        f"{name}, {num_envs} envs: Gymnasium's `step` over `env.step` with final observations",
        f"{over:+.1f} % ({adapted * 1e3:.2f} ms)",
        f"`env.step` {observing * 1e3:.2f} ms; without final observations {without * 1e3:.2f} ms, over "
        f"which it is {100.0 * (adapted / without - 1.0):+.1f} %",
        f"under {REACH:g} %",
        over < REACH,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("keyword", nargs="?", default="", help="part of a task's name")
    print(show(measure(parser.parse_args().keyword)))
