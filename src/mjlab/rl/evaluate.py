"""Scoring a policy: one episode in each of many environments, without exploration."""

from __future__ import annotations

import copy
import dataclasses
import logging
import operator
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager
from functools import reduce
from typing import TYPE_CHECKING, Any

import torch

from mjlab.rl.evaluation_result import Episodes, EvaluationResult, summarize
from mjlab.rl.threads import threads_for_policy
from mjlab.utils.random import preserved_rng

if TYPE_CHECKING:
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

logger = logging.getLogger(__name__)

# Whether all episodes have ended is asked this often, because asking makes the host wait for a GPU.
_STEPS_BETWEEN_CHECKS = 16
_LONGEST_EPISODE = 1_000_000

Policy = Callable[[Any], torch.Tensor]
PerEnv = Callable[[Any], torch.Tensor]
"""`func(env) -> (num_envs,)`: something that is known of every environment at every step."""


def evaluate_policy(
    env: RslRlVecEnvWrapper,
    policy: Policy,
    num_episodes: int | None = None,
    *,
    max_steps: int | None = None,
    success_return: float | None = None,
    success_func: PerEnv | None = None,
    success_is_survival: bool = False,
    metrics: Mapping[str, PerEnv] | None = None,
    seed: int | None = None,
) -> EvaluationResult:
    """Play episodes and score them.

    Each environment is scored once in a round, on its first episode after a reset, so that short
    episodes do not count more often than long ones. Where more episodes are asked for than there
    are environments, there are several rounds. No round or evaluation is harder than the one
    before: steps do not count as steps of training (`common_step_counter` stands still), no
    curriculum moves environments to other terrain, and the environments are left in the state in
    which they were found. On the CPU, torch gets as many threads as the policy is worth.

    An episode that `max_steps` cuts off is not a success, whatever a success is.

    Args:
        env: The environments.
        policy: `policy(observations) -> actions (num_envs, num_actions)`, usually
            `runner.get_inference_policy()`, which does not explore.
        num_episodes: Episodes to score; None: one for each environment.
        max_steps: Episodes are cut off after this many steps; None: the task's episode length,
            after which episodes count as finished.
        success_return: An episode with at least this return is a success.
        success_func: Instead, `func(env) -> (num_envs,) bool`; its value one step before the end
            of an episode decides.
        success_is_survival: Instead, an episode that no termination ended before its time was over
            is a success.
        metrics: For each name, `func(env) -> (num_envs,)`, read before every step and averaged over
            the steps of an episode.
        seed: Seed of the evaluation; None leaves the generators as they are. With the same seed,
            environments in the same state give the same episodes.

    Raises:
        ValueError: `num_episodes` is not positive, or the episodes have no end.
    """
    num_episodes = env.num_envs if num_episodes is None else num_episodes
    max_steps = _resolve_max_steps(env, num_episodes, max_steps)
    if seed is not None:
        env.seed(seed)
    start = time.perf_counter()
    rounds = []
    with (
        threads_for_policy(policy, env.num_envs, env.device),
        torch.inference_mode(),
        _left_as_found(env),
        _training_held(env),
    ):
        for first in range(0, num_episodes, env.num_envs):
            count = min(env.num_envs, num_episodes - first)
            record = _Recorder(env, count, success_func, metrics or {})
            _take_turns(env, first)
            rounds.append(_play_round(env, policy, record, max_steps))
    episodes = reduce(operator.add, rounds)
    successes = episodes.succeeded if success_func is not None else None
    if successes is None and success_is_survival:
        successes = ~episodes.failed
    if successes is None and success_return is not None:
        successes = episodes.returns >= success_return
    if successes is not None:
        successes = successes & episodes.finished
    return summarize(episodes, successes, time.perf_counter() - start)


@contextmanager
def _left_as_found(env: RslRlVecEnvWrapper) -> Generator[None]:
    """Give environments back the state that they had before the block.

    What outlives a reset, such as counters of terms, would let evaluations depend on those before.
    """
    unwrapped: Any = env.unwrapped
    if not hasattr(unwrapped, "state_dict"):
        yield
        return
    state = unwrapped.state_dict()
    try:
        yield
    finally:
        try:
            unwrapped.load_state_dict(state)
        except ValueError as error:
            logger.warning(
                "The state of the evaluated environments is not restored, so that another "
                "evaluation in them may differ. %s", error,
            )  # fmt: skip


@contextmanager
def _training_held(env: RslRlVecEnvWrapper) -> Generator[None]:
    """Within this context no curriculum goes on: not by steps, and not by moving to other terrain."""
    unwrapped: Any = env.unwrapped
    terrain = getattr(getattr(unwrapped, "scene", None), "terrain", None)
    with ExitStack() as stack:
        if terrain is not None:
            stack.enter_context(terrain.levels_held())
        if hasattr(unwrapped, "common_steps_held"):
            stack.enter_context(unwrapped.common_steps_held())
        yield


def _take_turns(env: RslRlVecEnvWrapper, first_episode: int) -> None:
    """Tell commands that take turns, such as motions, which episode the next reset begins with."""
    manager: Any = getattr(env.unwrapped, "command_manager", None)
    for name in manager.active_terms if manager is not None else ():
        manager.get_term(name).take_turns_from(first_episode)


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
    env: RslRlVecEnvWrapper, policy: Policy, record: _Recorder, max_steps: int
) -> Episodes:
    """Record the first episode of each environment that `record` looks at."""
    reset_policy = getattr(policy, "reset", None)
    observations, _ = env.reset()
    if reset_policy is not None:
        reset_policy()
    for step in range(max_steps):
        record.before_step()
        observations, rewards, dones, _ = env.step(policy(observations).to(env.device))
        record.after_step(rewards, dones != 0)
        if reset_policy is not None:
            reset_policy(dones)
        if (step + 1) % _STEPS_BETWEEN_CHECKS == 0 and not record.running.any():
            break
    return record.episodes()


class _Recorder:
    """Takes down the first episode of the first `count` environments."""

    def __init__(
        self,
        env: RslRlVecEnvWrapper,
        count: int,
        success_func: PerEnv | None,
        metrics: Mapping[str, PerEnv],
    ) -> None:
        self._env, self._count = env, count
        self._success_func, self._metrics = success_func, metrics

        def zeros(dtype: torch.dtype) -> torch.Tensor:
            return torch.zeros(env.num_envs, dtype=dtype, device=env.device)

        self.running = ~zeros(torch.bool)
        self.running[count:] = False
        self._returns, self._lengths = zeros(torch.float64), zeros(torch.long)
        self._failed, self._succeeded = zeros(torch.bool), zeros(torch.bool)
        self._sums = {name: zeros(torch.float64) for name in metrics}
        self._terminations: Any = getattr(env.unwrapped, "termination_manager", None)
        names = self._terminations.active_terms if self._terminations else ()
        self._ended_by = {name: zeros(torch.bool) for name in names}

    def before_step(self) -> None:
        unwrapped = self._env.unwrapped
        if self._success_func is not None:
            value = self._success_func(unwrapped).bool()
            self._succeeded = torch.where(self.running, value, self._succeeded)
        for name, func in self._metrics.items():
            # Not multiplied, because zero times infinity would be NaN.
            self._sums[name] += torch.where(self.running, func(unwrapped), 0.0)

    def after_step(self, rewards: torch.Tensor, dones: torch.Tensor) -> None:
        self._returns += rewards * self.running
        self._lengths += self.running
        ended = self.running & dones
        self._failed |= ended & self._env.unwrapped.reset_terminated
        for name, ended_by in self._ended_by.items():
            ended_by |= ended & self._terminations.get_term(name)
        self.running &= ~dones

    def episodes(self) -> Episodes:
        first = slice(self._count)
        lengths = self._lengths[first]
        return Episodes(
            returns=self._returns[first] / reward_unit(self._env),
            lengths=lengths,
            finished=~self.running[first] | (lengths >= int(self._env.max_episode_length)),
            failed=self._failed[first],
            succeeded=self._succeeded[first],
            terminations={name: value[first] for name, value in self._ended_by.items()},
            metrics={name: total[first] / lengths for name, total in self._sums.items()},
        )


def reward_unit(env: Any) -> float:
    """Return what one unit of weighted reward is worth in the rewards that `env` returns.

    That is the duration of a step, in seconds, where the environment scales rewards by it.
    """
    unwrapped = env.unwrapped
    scaled = getattr(unwrapped.cfg, "scale_rewards_by_dt", False)
    return float(unwrapped.step_dt) if scaled else 1.0


def make_evaluation_env(
    env: RslRlVecEnvWrapper,
    num_envs: int,
    seed: int,
    prepare: Callable[[Any], None] | None = None,
) -> RslRlVecEnvWrapper:
    """Build environments like those of `env` beside them, to evaluate while training goes on.

    `prepare` edits their config in place before.

    The random number generators are left as they were, so that a run takes the same course
    whether or not it is evaluated.
    """
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

    unwrapped = env.unwrapped
    cfg = copy.deepcopy(unwrapped.cfg)
    cfg.seed = seed
    cfg.scene = dataclasses.replace(cfg.scene, num_envs=num_envs)
    if prepare is not None:
        prepare(cfg)
    with preserved_rng():
        beside = type(unwrapped)(cfg=cfg, device=unwrapped.device)
        return RslRlVecEnvWrapper(beside, clip_actions=env.clip_actions)
