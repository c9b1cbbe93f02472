"""Playing a policy without looking at it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.viewer.protocols import ended, forget

if TYPE_CHECKING:
    from mjlab.viewer.base import EnvProtocol, PolicyProtocol


@dataclass(frozen=True)
class HeadlessResult:
    """What happened in `run_headless`."""

    num_steps: int
    """Environment steps taken."""
    mean_step_reward: float
    """Reward a step, averaged over steps and environments."""
    num_episodes: int
    """Episodes that ended, over all environments."""


def run_headless(
    env: EnvProtocol,
    policy: PolicyProtocol,
    num_steps: int,
    on_step: Callable[[int], None] | None = None,
) -> HeadlessResult:
    """Step `env` with `policy` as fast as it goes.

    Args:
        env: An environment, or the vector wrapper rsl_rl uses; its `step` returns four or five
            things, of which the second is the reward (num_envs,).
        policy: Maps observations to actions (num_envs, num_actions).
        num_steps: Environment steps to take.
        on_step: Called with the number of steps done, after each.

    Raises:
        ValueError: The number of steps is negative.
    """
    if num_steps < 0:
        raise ValueError(f"num_steps is {num_steps}; it must be 0 or more.")
    reward_sum = torch.zeros((), device=env.device, dtype=torch.float64)
    episodes = torch.zeros((), device=env.device, dtype=torch.int64)
    with torch.no_grad():
        for step in range(num_steps):
            result = env.step(policy(env.get_observations()))
            reward_sum += result[1].double().mean()
            done = ended(result)
            forget(policy, done)
            episodes += (done != 0).sum()
            if on_step is not None:
                on_step(step + 1)
    return HeadlessResult(num_steps, float(reward_sum) / max(num_steps, 1), int(episodes))
