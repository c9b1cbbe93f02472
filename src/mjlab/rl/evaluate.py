"""Scoring a policy: one episode in each of many environments, without exploration."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch

from mjlab.rl.rng import preserved_rng
from mjlab.rl.threads import threads_for_policy

if TYPE_CHECKING:
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

# Two-sided 95 % of the normal distribution.
_Z95 = 1.959964
# Whether all episodes have ended is asked this often, because asking makes the host wait for a GPU.
_STEPS_BETWEEN_CHECKS = 16
_LONGEST_EPISODE = 1_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Figures over the episodes of an evaluation.

    The return of an episode is the sum of its weighted rewards before scaling by the step's
    duration.
    """

    num_episodes: int
    """Episodes scored."""
    mean_return: float
    """Mean return."""
    return_interval: tuple[float, float]
    """95 % confidence interval of the mean return (normal approximation)."""
    std_return: float
    """Standard deviation of the return between episodes."""
    min_return: float
    """Lowest return."""
    max_return: float
    """Highest return."""
    mean_length: float
    """Mean length of an episode, in environment steps."""
    success_rate: float | None = None
    """Fraction of episodes that succeeded; None where the task does not define success."""
    success_interval: tuple[float, float] | None = None
    """95 % confidence interval of the success rate (Wilson)."""
    num_unfinished: int = 0
    """Episodes that were cut off by `max_steps`."""
    duration: float = 0.0
    """Time taken, in seconds."""
    returns: tuple[float, ...] = dataclasses.field(default=(), repr=False)
    """Return of each episode."""

    def to_dict(self) -> dict[str, Any]:
        """Return all figures but the single returns."""
        figures = dataclasses.asdict(self)
        del figures["returns"]
        return figures

    def to_json(self) -> str:
        """Return the figures as JSON."""
        return json.dumps(self.to_dict(), indent=2)


Policy = Callable[[Any], torch.Tensor]


def evaluate_policy(
    env: RslRlVecEnvWrapper,
    policy: Policy,
    num_episodes: int | None = None,
    *,
    max_steps: int | None = None,
    success_return: float | None = None,
    success_func: Callable[[Any], torch.Tensor] | None = None,
    seed: int | None = None,
) -> EvaluationResult:
    """Play episodes and score them.

    Each environment is scored once in a round, on its first episode after a reset, so that short
    episodes do not count more often than long ones. Where more episodes are asked for than there
    are environments, there are several rounds. On the CPU, torch gets as many threads as the policy
    is worth.

    Args:
        env: The environments; their state is not kept.
        policy: `policy(observations) -> actions (num_envs, num_actions)`, usually
            `runner.get_inference_policy()`, which does not explore.
        num_episodes: Episodes to score; None: one for each environment.
        max_steps: Episodes are cut off after this many steps; None: the task's episode length.
        success_return: An episode with at least this return is a success.
        success_func: Instead, `func(env) -> (num_envs,) bool`; its value one step before the end
            of an episode decides.
        seed: Seed of the evaluation; None leaves the generators as they are.

    Raises:
        ValueError: `num_episodes` is not positive, or the episodes have no end.
    """
    num_episodes = env.num_envs if num_episodes is None else num_episodes
    max_steps = _resolve_max_steps(env, num_episodes, max_steps)
    if seed is not None:
        env.seed(seed)
    start = time.perf_counter()
    rounds = []
    with threads_for_policy(policy, env.num_envs, env.device), torch.inference_mode():
        for first in range(0, num_episodes, env.num_envs):
            count = min(env.num_envs, num_episodes - first)
            rounds.append(_play_round(env, policy, count, max_steps, success_func))
    returns, lengths, finished, successes = (
        torch.cat(column) for column in zip(*rounds, strict=False)
    )
    if success_func is None:
        successes = None if success_return is None else returns >= success_return
    return _summarize(returns, lengths, finished, successes, time.perf_counter() - start)


def _resolve_max_steps(env: RslRlVecEnvWrapper, num_episodes: int, max_steps: int | None) -> int:
    if num_episodes < 1:
        raise ValueError(f"num_episodes is {num_episodes}; at least 1 episode has to be played.")
    if max_steps is None:
        max_steps = int(env.max_episode_length)
        if not 0 < max_steps <= _LONGEST_EPISODE:
            raise ValueError(
                f"Episodes of this task have {max_steps} steps, which is no end to wait for; "
                "set env.episode_length_s, or give max_steps."
            )
    elif max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}; an episode has at least 1 step.")
    return max_steps


def _play_round(
    env: RslRlVecEnvWrapper,
    policy: Policy,
    count: int,
    max_steps: int,
    success_func: Callable[[Any], torch.Tensor] | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Score the first episode of the first `count` environments."""
    reset_policy = getattr(policy, "reset", None)
    observations, _ = env.reset()
    if reset_policy is not None:
        reset_policy()
    returns = torch.zeros(env.num_envs, dtype=torch.float64, device=env.device)
    lengths = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
    running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    running[count:] = False
    succeeded = torch.zeros_like(running)
    for step in range(max_steps):
        if success_func is not None:
            succeeded = torch.where(running, success_func(env.unwrapped).bool(), succeeded)
        observations, rewards, dones, _ = env.step(policy(observations).to(env.device))
        returns += rewards * running
        lengths += running
        running &= dones == 0
        if reset_policy is not None:
            reset_policy(dones)
        if (step + 1) % _STEPS_BETWEEN_CHECKS == 0 and not running.any():
            break
    returns /= reward_unit(env)
    return returns[:count], lengths[:count], ~running[:count], succeeded[:count]


def reward_unit(env: Any) -> float:
    """Return what one unit of weighted reward is worth in the rewards that `env` returns.

    That is the duration of a step, in seconds, where the environment scales rewards by it.
    """
    unwrapped = env.unwrapped
    scaled = getattr(unwrapped.cfg, "scale_rewards_by_dt", False)
    return float(unwrapped.step_dt) if scaled else 1.0


def _summarize(
    returns: torch.Tensor,
    lengths: torch.Tensor,
    finished: torch.Tensor,
    successes: torch.Tensor | None,
    duration: float,
) -> EvaluationResult:
    count = len(returns)
    mean = returns.mean().item()
    std = returns.std().item() if count > 1 else 0.0
    half = _Z95 * std / math.sqrt(count)
    rate = None if successes is None else successes.double().mean().item()
    return EvaluationResult(
        num_episodes=count,
        mean_return=mean,
        return_interval=(mean - half, mean + half),
        std_return=std,
        min_return=returns.min().item(),
        max_return=returns.max().item(),
        mean_length=lengths.double().mean().item(),
        success_rate=rate,
        success_interval=None if rate is None else wilson_interval(rate, count),
        num_unfinished=int((~finished).sum().item()),
        duration=duration,
        returns=tuple(returns.tolist()),
    )


def wilson_interval(rate: float, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate observed over `count` episodes.

    Unlike the normal approximation it stays within [0, 1] and is not empty at 0 and 1:
    (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).
    """
    shrink = 1.0 + _Z95**2 / count
    centre = (rate + _Z95**2 / (2 * count)) / shrink
    half = _Z95 * math.sqrt(rate * (1 - rate) / count + _Z95**2 / (4 * count**2)) / shrink
    # The interval contains the rate; rounding must not say otherwise.
    return max(0.0, min(centre - half, rate)), min(1.0, max(centre + half, rate))


def make_evaluation_env(env: RslRlVecEnvWrapper, num_envs: int, seed: int) -> RslRlVecEnvWrapper:
    """Build environments like those of `env` beside them, to evaluate while training goes on.

    The random number generators are left as they were, so that a run takes the same course
    whether or not it is evaluated.
    """
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

    unwrapped = env.unwrapped
    cfg = copy.deepcopy(unwrapped.cfg)
    cfg.seed = seed
    cfg.scene = dataclasses.replace(cfg.scene, num_envs=num_envs)
    with preserved_rng():
        beside = type(unwrapped)(cfg=cfg, device=unwrapped.device)
        return RslRlVecEnvWrapper(beside, clip_actions=env.clip_actions)
