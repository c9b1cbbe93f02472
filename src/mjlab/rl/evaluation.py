"""Evaluation: policies scored on episodes without exploration, and tasks judged solved or not.

`evaluate_policy` plays one episode in each of many environments. `SolvedCheck` does so beside a
training run, which stops on two evaluations. The first is of the same episodes each time, so that
what changes is the policy. A noisy policy that is tried often enough passes it by luck, hence the
second, of episodes that no evaluation of the run has had before.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
import json
import logging
import math
import operator
import re
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import torch

from mjlab.utils.errors import check_positive
from mjlab.utils.random import evaluation_seed, preserved_rng
from mjlab.utils.string import suggest
from mjlab.utils.torch import threads_for_policy

if TYPE_CHECKING:
    from mjlab.rl.config import EvaluationCfg
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

logger = logging.getLogger(__name__)

Policy = Callable[[Any], torch.Tensor]
PerEnv = Callable[[Any], torch.Tensor]
"""`func(env) -> (num_envs,)`: something that is known of every environment at every step."""
FIGURES = ("mean_return", "mean_length", "success_rate", "failure_rate")
"""Fields of `EvaluationResult` that `EvaluationResult.value` knows, beside the metrics."""

# Whether all episodes have ended is asked this often, because asking makes the host wait for a GPU.
_STEPS_BETWEEN_CHECKS = 16
_LONGEST_EPISODE = 1_000_000
# Fewer episodes say little of what happens in one of a hundred.
_MANY_EPISODES = 200
# Two-sided 95 % of the normal distribution.
_Z95 = 1.959964
# What the docstring of a success function says of the tensor.
_OPENING = re.compile(r"^Return (?:where|whether|if) ")
_SHAPE = re.compile(r",? \([^()]*,\)(?: bool)?\.?$")


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
    check_positive("num_episodes", num_episodes)
    if max_steps is None:
        max_steps = int(env.max_episode_length)
        if not 0 < max_steps <= _LONGEST_EPISODE:
            raise ValueError(
                f"Episodes of this task have {max_steps} steps, which is no end to wait for; "
                "set env.episode_length_s, or give max_steps."
            )
    check_positive("max_steps", max_steps)
    if seed is not None:
        env.seed(seed)
    start = time.perf_counter()
    rounds = []
    with (
        threads_for_policy(policy, env.num_envs, env.device),
        torch.inference_mode(),
        _undisturbed(env),
    ):
        for first in range(0, num_episodes, env.num_envs):
            count = min(env.num_envs, num_episodes - first)
            # Commands that take turns, such as motions, go through them over all rounds.
            manager: Any = getattr(env.unwrapped, "command_manager", None)
            for name in manager.active_terms if manager is not None else ():
                manager.get_term(name).take_turns_from(first)
            rounds.append(_play_round(env, policy, count, max_steps, success_func, metrics or {}))
    episodes = functools.reduce(operator.add, rounds)
    successes = episodes.succeeded if success_func is not None else None
    if successes is None and success_is_survival:
        successes = ~episodes.failed
    if successes is None and success_return is not None:
        successes = episodes.returns >= success_return
    if successes is not None:
        successes = successes & episodes.finished
    return summarize(episodes, successes, time.perf_counter() - start)


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
    return_interval: tuple[float, float] | None
    """95 % confidence interval of the mean return (Student's t); None for one episode."""
    std_return: float | None
    """Sample standard deviation of the return between episodes; None for one episode."""
    min_return: float
    """Lowest return."""
    max_return: float
    """Highest return."""
    mean_length: float
    """Mean length of an episode, in environment steps."""
    success_rate: float | None = None
    """Fraction of episodes that succeeded, unfinished ones not among them; None where the task does
    not define success."""
    success_interval: tuple[float, float] | None = None
    """95 % confidence interval of the success rate (Wilson)."""
    failure_rate: float | None = None
    """Fraction of episodes that a termination ended before their time was over."""
    failure_interval: tuple[float, float] | None = None
    """95 % confidence interval of the failure rate (Wilson)."""
    terminations: dict[str, float] = dataclasses.field(default_factory=dict)
    """For each termination of the task, the fraction of episodes in whose last step it was true."""
    metrics: dict[str, MeanAndInterval] = dataclasses.field(default_factory=dict)
    """The task's metrics, each averaged over an episode's steps and then over episodes."""
    num_unfinished: int = 0
    """Episodes that `max_steps` cut off before the time of an episode of the task was over."""
    duration: float = 0.0
    """Time taken, in seconds."""
    returns: tuple[float, ...] = dataclasses.field(default=(), repr=False)
    """Return of each episode."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks to bear in mind with these figures, in sentences."""
        notes = []
        if self.num_unfinished:
            notes.append(
                f"{self.num_unfinished} of {self.num_episodes} episodes were cut off by max_steps. "
                "They count as neither successes nor failures."
            )
        if self.num_episodes == 1:
            notes.append("One episode gives no interval of a mean.")
        if self.num_episodes < _MANY_EPISODES:
            notes.append(
                f"Below {_MANY_EPISODES} episodes, rare failures may be missing, which makes the "
                "intervals of means optimistic. Judge failures by the interval of their rate."
            )
        return tuple(notes)

    def to_dict(self) -> dict[str, Any]:
        """Return all figures but the single returns, and `notes`."""
        figures = dataclasses.asdict(self)
        del figures["returns"]
        return {**figures, "notes": list(self.notes)}

    @classmethod
    def from_dict(cls, figures: Mapping[str, Any]) -> EvaluationResult:
        """Return the result that `to_dict` made `figures` of, without the single returns.

        Further entries of `figures` are left out.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        own: dict[str, Any] = {name: value for name, value in figures.items() if name in names}
        own["metrics"] = {name: MeanAndInterval(**value) for name, value in own["metrics"].items()}
        return cls(**own)

    def to_json(self) -> str:
        """Return the figures as JSON."""
        return json.dumps(self.to_dict(), indent=2)

    def value(self, name: str) -> float:
        """Return a figure by name: a metric of the task, or a field such as `failure_rate`.

        Raises:
            ValueError: there is no such figure; the message lists those there are.
        """
        if name in self.metrics:
            return self.metrics[name].mean
        value = getattr(self, name, None) if name in FIGURES else None
        if value is None:
            known = [*self.metrics, *(f for f in FIGURES if getattr(self, f) is not None)]
            raise ValueError(f"Evaluation of this task: no figure {name!r}; {suggest(name, known)}")
        return float(value)

    def judged(self, name: str) -> float:
        """Return a figure as bounds judge it: rates by the middle of their Wilson interval.

        That is nearer to 1/2 than the fraction observed, the more so the fewer the episodes are: no
        failure in 4 episodes is judged as 24 %, in 200 as 0.9 %.

        Raises:
            ValueError: see `value`.
        """
        intervals = {"failure_rate": self.failure_interval, "success_rate": self.success_interval}
        interval = None if name in self.metrics else intervals.get(name)
        return self.value(name) if interval is None else sum(interval) / 2


@dataclasses.dataclass(frozen=True)
class MeanAndInterval:
    """A mean over episodes."""

    mean: float
    """The mean."""
    interval: tuple[float, float] | None
    """95 % confidence interval of the mean (Student's t); None for one episode."""


class SolvedCheck:
    """Evaluates the policy, beside the run and without touching it, when it may have solved the
    task.

    `last_iteration` is the number of iterations that were finished at the last evaluation.
    """

    def __init__(self, env: Any, algorithm: Any, cfg: dict[str, Any], seed: int) -> None:
        """Take the run's environments and algorithm, and an `EvaluationCfg` as a dict.

        Raises:
            ValueError: a condition names what is not measured.
        """
        self._env = env
        self._algorithm = algorithm
        self._cfg = cfg
        self._seed = seed
        self._below: dict[str, float] = cfg.get("solved_below") or {}
        self._above: dict[str, float] = cfg.get("solved_above") or {}
        target = cfg.get("solved_return")
        self._has_target = target is not None or bool(self._below or self._above)
        self._min_interval = int(cfg.get("min_interval", 3))
        self._num_episodes = int(cfg.get("num_episodes", 256))
        known = {*(cfg.get("metrics") or {}), *FIGURES}
        defining_success = ("success_func", "success_return", "solved_return")
        is_defined = any(cfg.get(name) is not None for name in defining_success)
        if not is_defined and not cfg.get("success_is_survival"):
            known.discard("success_rate")
        for name in (*self._below, *self._above):
            if name not in known:
                raise ValueError(
                    f"EvaluationCfg solved_below, solved_above: {name!r} is not measured; "
                    f"{suggest(name, sorted(known))} Others must be in `metrics`."
                )
        # Bounds on rates that so few episodes never meet, even if none of them fails.
        allowed = {"failure_rate": self._below.get("failure_rate", 1.0)}
        allowed["success_rate"] = 1.0 - self._above.get("success_rate", 0.0)
        for name, failures in allowed.items():
            if failures > 0.0 and self._num_episodes < (needed := episodes_to_show(failures)):
                logger.warning(
                    "EvaluationCfg: %d episodes never meet the bound on %s, because they say too little "
                    "of failures as rare as %.3g %%; use num_episodes >= %d.",
                    self._num_episodes, name, 100.0 * failures, needed,
                )  # fmt: skip
        self._eval_env: Any = None
        self.last_iteration = 0

    def should_evaluate(self, iteration: int, mean_step_reward: float) -> bool:
        """Return whether the training data hint that the policy may be good enough.

        Args:
            iteration: Iterations finished.
            mean_step_reward: Mean weighted reward of a step of the last one, before scaling by the
                step's duration.
        """
        if not self._has_target or iteration - self.last_iteration < self._min_interval:
            return False
        if iteration < self._cfg.get("first_iteration", 0):
            return False
        trigger = self._cfg.get("trigger_return")
        if trigger is None:
            solved_return = self._cfg.get("solved_return")
            if solved_return is None:
                return True
            trigger = self._cfg["trigger_fraction"] * solved_return
        return mean_step_reward * int(self._env.max_episode_length) >= trigger

    def is_solved_by(self, result: EvaluationResult) -> bool:
        """Return whether `result` is good enough in all that the config asks for."""
        if not self._has_target:
            return False
        target = self._cfg.get("solved_return")
        if target is not None and result.mean_return < target:
            return False
        # Written so that NaN meets nothing.
        return all(result.judged(name) <= most for name, most in self._below.items()) and all(
            result.judged(name) >= least for name, least in self._above.items()
        )

    @property
    def stops_training(self) -> bool:
        """Whether training ends when the task is solved."""
        return bool(self._cfg.get("stop_when_solved", True))

    def evaluate(self) -> EvaluationResult:
        """Score the policy in environments of their own, built at the first call.

        The episodes are the same each time.
        """
        if self._eval_env is None:
            self._eval_env = self._make_env(evaluation_seed(self._seed))
        return self._score(self._eval_env, evaluation_seed(self._seed))

    def confirm(self, iteration: int) -> EvaluationResult:
        """Score the policy after `iteration` iterations in other environments, and other episodes.

        No other evaluation of the run has them. They follow from the seed and the iteration, so
        that a resumed run has the same ones.
        """
        seed = evaluation_seed(self._seed, iteration)
        env = self._make_env(seed)
        try:
            return self._score(env, seed)
        finally:
            env.close()

    def _make_env(self, seed: int) -> Any:
        return make_evaluation_env(
            self._env, self._num_episodes, seed, self._cfg.get("prepare_env")
        )

    def _score(self, env: Any, seed: int) -> EvaluationResult:
        # Curricula count the steps of training.
        counter = getattr(self._env.unwrapped, "common_step_counter", None)
        if counter is not None:
            env.unwrapped.common_step_counter = counter
        policy = self._algorithm.get_policy()
        hidden_state = policy.get_hidden_state()
        success_return = self._cfg.get("success_return")
        if success_return is None:
            success_return = self._cfg.get("solved_return")
        self._algorithm.eval_mode()
        try:
            with preserved_rng():
                return evaluate_policy(
                    env,
                    policy,
                    success_return=success_return,
                    success_func=self._cfg.get("success_func"),
                    success_is_survival=bool(self._cfg.get("success_is_survival")),
                    metrics=self._cfg.get("metrics"),
                    seed=seed,
                )
        finally:
            self._algorithm.train_mode()
            policy.reset(hidden_state=hidden_state)

    def close(self) -> None:
        """Close the environments, if there are any."""
        if self._eval_env is not None:
            self._eval_env.close()
            self._eval_env = None


def success_definition(cfg: EvaluationCfg) -> str | None:
    """Return what makes an episode a success, or None where the task does not say.

    Of a function that is the first line of its docstring, without what is said of the tensor.
    """
    if (func := cfg.success_func) is not None:
        while isinstance(func, functools.partial):
            func = func.func
        name = getattr(func, "__name__", type(func).__name__)
        first_line = (inspect.getdoc(func) or "").split("\n")[0].strip()
        words = _OPENING.sub("", _SHAPE.sub("", first_line)).rstrip(".")
        return f"{f'{words} ({name})' if words else name}, one step before the end"
    if cfg.success_is_survival:
        return "no termination ended the episode before its time was over"
    target = required_return(cfg)
    return None if target is None else f"return of at least {target:g}"


def required_return(cfg: EvaluationCfg) -> float | None:
    """Return from which return an episode is a success; None where the return does not decide."""
    if cfg.success_func is not None or cfg.success_is_survival:
        return None
    return cfg.solved_return if cfg.success_return is None else cfg.success_return


# Playing episodes.


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


def reward_unit(env: Any) -> float:
    """Return what one unit of weighted reward is worth in the rewards that `env` returns.

    That is the duration of a step, in seconds, where the environment scales rewards by it.
    """
    unwrapped = env.unwrapped
    scaled = getattr(unwrapped.cfg, "scale_rewards_by_dt", False)
    return float(unwrapped.step_dt) if scaled else 1.0


@contextmanager
def _undisturbed(env: RslRlVecEnvWrapper) -> Generator[None]:
    """Hold curricula within the block, of steps and of terrain; then restore the state of before.

    What outlives a reset, such as counters of terms, would let evaluations depend on those before.
    """
    unwrapped: Any = env.unwrapped
    terrain = getattr(getattr(unwrapped, "scene", None), "terrain", None)
    state = unwrapped.state_dict() if hasattr(unwrapped, "state_dict") else None
    try:
        with ExitStack() as stack:
            if terrain is not None:
                stack.enter_context(terrain.levels_held())
            if hasattr(unwrapped, "common_steps_held"):
                stack.enter_context(unwrapped.common_steps_held())
            yield
    finally:
        if state is not None:
            try:
                unwrapped.load_state_dict(state)
            except ValueError as error:
                logger.warning(
                    "The state of the evaluated environments is not restored, so that another "
                    "evaluation in them may differ. %s", error,
                )  # fmt: skip


def _play_round(
    env: RslRlVecEnvWrapper,
    policy: Policy,
    count: int,
    max_steps: int,
    success_func: PerEnv | None,
    metrics: Mapping[str, PerEnv],
) -> Episodes:
    """Play the first episode of each of the first `count` environments."""
    unwrapped = env.unwrapped

    def zeros(dtype: torch.dtype) -> torch.Tensor:
        return torch.zeros(env.num_envs, dtype=dtype, device=env.device)

    running = ~zeros(torch.bool)
    running[count:] = False
    returns, lengths = zeros(torch.float64), zeros(torch.long)
    failed, succeeded = zeros(torch.bool), zeros(torch.bool)
    sums = {name: zeros(torch.float64) for name in metrics}
    manager: Any = getattr(unwrapped, "termination_manager", None)
    terminations = {name: zeros(torch.bool) for name in (manager.active_terms if manager else ())}
    reset_policy = getattr(policy, "reset", None)
    observations, _ = env.reset()
    if reset_policy is not None:
        reset_policy()
    for step in range(max_steps):
        if success_func is not None:
            succeeded = torch.where(running, success_func(unwrapped).bool(), succeeded)
        for name, func in metrics.items():
            # Not multiplied, because zero times infinity would be NaN.
            sums[name] += torch.where(running, func(unwrapped), 0.0)
        observations, rewards, dones, _ = env.step(policy(observations).to(env.device))
        returns += rewards * running
        lengths += running
        ended = running & (dones != 0)
        failed |= ended & unwrapped.reset_terminated
        for name, ended_by in terminations.items():
            ended_by |= ended & manager.get_term(name)
        running &= dones == 0
        if reset_policy is not None:
            reset_policy(dones)
        if (step + 1) % _STEPS_BETWEEN_CHECKS == 0 and not running.any():
            break
    first = slice(count)
    return Episodes(
        returns=returns[first] / reward_unit(env),
        lengths=lengths[first],
        finished=~running[first] | (lengths[first] >= int(env.max_episode_length)),
        failed=failed[first],
        succeeded=succeeded[first],
        terminations={name: ended_by[first] for name, ended_by in terminations.items()},
        metrics={name: total[first] / lengths[first] for name, total in sums.items()},
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Episodes:
    """What was recorded of E episodes; `+` puts two records together."""

    returns: torch.Tensor
    """Sum of weighted rewards, (E,)."""
    lengths: torch.Tensor
    """Steps, (E,) int64."""
    finished: torch.Tensor
    """True if the episode terminated or reached the task's episode length, (E,) bool."""
    failed: torch.Tensor
    """Whether a termination ended it before its time was over, (E,) bool."""
    succeeded: torch.Tensor
    """Value of the task's success function one step before the end, (E,) bool."""
    terminations: dict[str, torch.Tensor]
    """For each termination, whether it was true in the last step, (E,) bool."""
    metrics: dict[str, torch.Tensor]
    """For each metric, its mean over the steps of the episode, (E,)."""

    def __add__(self, other: Episodes) -> Episodes:
        joined: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            mine, theirs = getattr(self, field.name), getattr(other, field.name)
            if isinstance(mine, dict):
                joined[field.name] = {k: torch.cat((v, theirs[k])) for k, v in mine.items()}
            else:
                joined[field.name] = torch.cat((mine, theirs))
        return Episodes(**joined)


# Statistics.


def summarize(
    episodes: Episodes, successes: torch.Tensor | None, duration: float
) -> EvaluationResult:
    """Return the figures of `episodes`; `successes` (E,) bool, or None where not defined."""
    returns = episodes.returns
    count = len(returns)
    mean_return = mean_and_interval(returns)
    rate = None if successes is None else successes.double().mean().item()
    failures = episodes.failed.double().mean().item()
    return EvaluationResult(
        num_episodes=count,
        mean_return=mean_return.mean,
        return_interval=mean_return.interval,
        std_return=returns.std().item() if count > 1 else None,
        min_return=returns.min().item(),
        max_return=returns.max().item(),
        mean_length=episodes.lengths.double().mean().item(),
        success_rate=rate,
        success_interval=None if rate is None else wilson_interval(rate, count),
        failure_rate=failures,
        failure_interval=wilson_interval(failures, count),
        terminations={k: v.double().mean().item() for k, v in episodes.terminations.items()},
        metrics={name: mean_and_interval(v) for name, v in episodes.metrics.items()},
        num_unfinished=int((~episodes.finished).sum().item()),
        duration=duration,
        returns=tuple(returns.tolist()),
    )


def mean_and_interval(values: torch.Tensor) -> MeanAndInterval:
    """Return the mean of `values` (E,) and its 95 % confidence interval, x +- t_(E-1) s / sqrt(E)."""
    mean, count = values.double().mean().item(), len(values)
    if count == 1:
        return MeanAndInterval(mean, None)
    # Not at the top: it takes a tenth of a second, which a run that is not evaluated saves.
    from scipy.special import stdtrit

    half = float(stdtrit(count - 1, 0.975)) * values.double().std().item() / math.sqrt(count)
    return MeanAndInterval(mean, (mean - half, mean + half))


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


def episodes_to_show(rate: float) -> int:
    """Return how many episodes without a failure are judged as a failure rate of at most `rate`.

    The middle of `wilson_interval(0, n)` is z^2 / (2 (n + z^2)).
    """
    return max(1, math.ceil(_Z95**2 * (0.5 / rate - 1.0)))
