"""Evaluation: scores of policies without exploration, and the check that a task is solved.

`evaluate_policy` plays one episode per environment. `SolvedCheck` does so during a training run,
which stops after two evaluations of a solved task. The first has the same episodes each time, so that
only the policy changes. A noisy policy passes it by luck if it is tried often enough, hence the
second, on episodes that are new to the run.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import json
import logging
import math
import operator
import time
from collections.abc import Callable, Collection, Generator, Mapping
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

import torch

from mjlab.envs.curriculum_state import config_as_built
from mjlab.rl.config import resolve_success
from mjlab.utils.errors import check_one_of, check_positive
from mjlab.utils.random import evaluation_seed, preserved_rng
from mjlab.utils.string import suggest
from mjlab.utils.torch import threads_for_policy

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.rl.config import EvaluationCfg
    from mjlab.rl.run_logger import IterationStats
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

logger = logging.getLogger(__name__)

Policy = Callable[[Any], torch.Tensor]
PerEnv = Callable[[Any], torch.Tensor]
"""`func(env) -> (num_envs,)`: per-environment value, read at every step."""
Success = PerEnv | str | float | None
"""Success of an episode: a function or its name, `survival`, or a minimum return; see
`EvaluationCfg.success`."""
Progress = Callable[[int, float], None]
"""`func(num_finished, fraction)`: progress of an evaluation."""
RESULT_FIELDS = ("mean_return", "mean_length", "success_rate", "failure_rate")
"""Fields of `EvaluationResult` that `EvaluationResult.value` accepts, besides metrics."""

SHARE = "_share"
"""End of the name of a metric's share of its value for a robot that stands still."""

# Steps between checks for the end of all episodes: each check synchronizes with the GPU.
_STEPS_BETWEEN_CHECKS = 16
_LONGEST_EPISODE = 1_000_000
# Fewer episodes say little about failures in one of a hundred.
_MANY_EPISODES = 200
# Entries of the state of curricula in a line of text.
_MOST_CURRICULA = 6
# Two-sided 95 % quantile of the normal distribution.
_Z95 = 1.959964


def evaluate_policy(
    env: RslRlVecEnvWrapper,
    policy: Policy,
    num_episodes: int | None = None,
    *,
    max_steps: int | None = None,
    success: Success = None,
    metrics: Mapping[str, PerEnv] | None = None,
    standing_still: Mapping[str, PerEnv] | None = None,
    seed: int | None = None,
    progress: Progress | None = None,
    is_stopped: Callable[[], bool] | None = None,
) -> EvaluationResult:
    """Play episodes and score them.

    Each environment is scored once per round, on its first episode after a reset, so that short
    episodes do not count more often than long ones. If `num_episodes` exceeds the number of
    environments, several rounds are played. All rounds and evaluations are equally hard: curricula
    stay in their state (steps do not count as training steps, `common_step_counter`), environments
    on a generated terrain are distributed evenly over all its levels, and the state of the
    environments is restored. On the CPU, the number of torch threads depends on the size of the policy.

    Episodes truncated by `max_steps` are never successes.

    Args:
        env: Environments.
        policy: `policy(observations) -> actions (num_envs, num_actions)`, usually
            `runner.get_inference_policy()`, which does not explore.
        num_episodes: Number of episodes to score; None: one per environment.
        max_steps: Number of steps until episodes are truncated; None: the task's episode length,
            after which episodes count as finished.
        success: Success of an episode: a minimum return; `survival`, no termination before the time
            limit; or `func(env) -> (num_envs,) bool`, or its name `module:function`, read one step
            before the end. None: not defined.
        metrics: Functions by name, `func(env) -> (num_envs,)`, read before every step and averaged
            over the steps of an episode.
        standing_still: Functions like those of `metrics`, by the metric's name: its value for a robot that
            stands still. The result has the metric's share of it, `NAME_share`, unless that is 0.
        seed: Seed of the evaluation; None: generators are not seeded. With the same seed,
            environments in the same state give the same episodes.
        progress: Function called every few steps with the number of finished episodes, and with the
            fraction of the evaluation that is done.
        is_stopped: Function called before every step; True stops the evaluation.

    Raises:
        EvaluationStopped: `is_stopped` returned True.
        ValueError: `num_episodes` is not positive, episodes are too long, or `standing_still` names
            no metric.
    """
    metrics, standing_still = metrics or {}, standing_still or {}
    for name in standing_still:
        check_one_of("evaluate_policy standing_still", name, metrics)
    num_episodes = env.num_envs if num_episodes is None else num_episodes
    check_positive("num_episodes", num_episodes)
    if max_steps is None:
        max_steps = time_limit(env)
        if max_steps is None:
            raise ValueError(
                f"max_steps: expected an episode length of 1 to {_LONGEST_EPISODE} steps, got "
                f"{env.max_episode_length}; set env.episode_length_s, or max_steps."
            )
    check_positive("max_steps", max_steps)
    if seed is not None:
        env.seed(seed)
    start = time.perf_counter()
    rounds, levels = [], set()
    success = resolve_success(success)
    success_func = None if isinstance(success, str | int | float) else success
    unwrapped = env.unwrapped
    terrain = unwrapped.scene.terrain
    with (
        threads_for_policy(policy, env.num_envs, env.device),
        torch.inference_mode(),
        _preserved_state(env),
    ):
        curricula = unwrapped.curricula_in_use()
        for first in range(0, num_episodes, env.num_envs):
            count = min(env.num_envs, num_episodes - first)
            if terrain is not None and terrain.terrain_levels is not None:
                terrain.spread_levels(first)
                levels |= set(terrain.terrain_levels[:count].tolist())
            # Commands that take turns, such as motions, continue their order over all rounds.
            for name in unwrapped.command_manager.active_terms:
                unwrapped.command_manager.get_term(name).take_turns_from(first)

            def report(running: int, step: int, first: int = first, count: int = count) -> None:
                if progress is not None:
                    done = first + count - running
                    progress(done, (done + running * step / max_steps) / num_episodes)

            rounds.append(
                _play_round(
                    env,
                    policy,
                    count,
                    max_steps,
                    success_func,
                    metrics,
                    standing_still,
                    report,
                    is_stopped,
                )
            )
    episodes = functools.reduce(operator.add, rounds)
    successes = None
    if success == "survival":
        successes = ~episodes.failed & episodes.finished
    elif isinstance(success, int | float):
        successes = (episodes.returns >= success) & episodes.finished
    elif success is not None:
        successes = episodes.succeeded & episodes.finished
    if levels:
        curricula["terrain_levels"] = [min(levels), max(levels)]
    result = summarize(episodes, successes, time.perf_counter() - start)
    return dataclasses.replace(result, curricula=curricula)


class EvaluationStopped(Exception):
    """Evaluation that was stopped before its end; the evaluated environments are as before."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Statistics over the episodes of an evaluation.

    The return of an episode is the sum of its weighted rewards before scaling by the step's
    duration.
    """

    num_episodes: int
    """Number of episodes scored."""
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
    """Fraction of successful episodes; unfinished episodes do not succeed. None if the task does not
    define success."""
    success_interval: tuple[float, float] | None = None
    """95 % confidence interval of the success rate (Wilson)."""
    failure_rate: float | None = None
    """Fraction of episodes ended by a termination before the time limit."""
    failure_interval: tuple[float, float] | None = None
    """95 % confidence interval of the failure rate (Wilson)."""
    terminations: dict[str, float] = dataclasses.field(default_factory=dict)
    """Fraction of episodes with the termination true in the last step, by name."""
    metrics: dict[str, MeanAndInterval] = dataclasses.field(default_factory=dict)
    """Metrics of the task, averaged over the steps of an episode and then over episodes; and of those in
    `standing_still`, the share of it, `NAME_share`, unless that is 0."""
    standing_still: dict[str, float] = dataclasses.field(default_factory=dict)
    """Metrics of a robot that stands still, with the same commands; of the yaw error with heading commands,
    the mean over uniform heading errors."""
    curricula: dict[str, Any] = dataclasses.field(default_factory=dict)
    """State of the curricula, which stands still in an evaluation: numbers that differ from the task's
    config, by path (`commands.twist.ranges.lin_vel_x`), and lowest and highest terrain level. Episodes
    are distributed evenly over the levels."""
    num_unfinished: int = 0
    """Number of episodes truncated by `max_steps` before the task's time limit."""
    duration: float = 0.0
    """Duration of the evaluation, in seconds."""
    returns: tuple[float, ...] = dataclasses.field(default=(), repr=False)
    """Return of each episode."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the reliability of the statistics, in sentences."""
        notes = []
        if self.num_unfinished:
            notes.append(
                f"{self.num_unfinished} of {self.num_episodes} episodes were truncated by max_steps. "
                "They count as neither successes nor failures."
            )
        if self.num_episodes == 1:
            notes.append("A mean of one episode has no confidence interval.")
        if self.num_episodes < _MANY_EPISODES:
            notes.append(
                f"Below {_MANY_EPISODES} episodes, rare failures may be missing, so that intervals of "
                "means are optimistic. Judge failures by the interval of the failure rate."
            )
        return tuple(notes)

    def to_dict(self) -> dict[str, Any]:
        """Return all fields except `returns`, and `notes`."""
        values = dataclasses.asdict(self)
        del values["returns"]
        return {**values, "notes": list(self.notes)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EvaluationResult:
        """Return the result for `values` of `to_dict`, without `returns`.

        Unknown entries of `values` are ignored.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        own: dict[str, Any] = {name: value for name, value in values.items() if name in names}
        own["metrics"] = {name: MeanAndInterval(**value) for name, value in own["metrics"].items()}
        return cls(**own)

    def to_json(self) -> str:
        """Return `to_dict` as JSON."""
        return json.dumps(self.to_dict(), indent=2)

    def value(self, name: str) -> float:
        """Return a value by name: a metric of the task, or a field such as `failure_rate`.

        NaN for the share of a metric that is 0 for a robot that stands still.

        Raises:
            ValueError: the name is unknown; the message lists the available names.
        """
        if name in self.metrics:
            return self.metrics[name].mean
        if name.endswith(SHARE) and name.removesuffix(SHARE) in self.standing_still:
            return math.nan
        value = getattr(self, name, None) if name in RESULT_FIELDS else None
        if value is None:
            known = [*self.metrics, *(f for f in RESULT_FIELDS if getattr(self, f) is not None)]
            raise ValueError(f"Unknown evaluation metric {name!r}; {suggest(name, known)}")
        return float(value)

    def judged(self, name: str) -> float:
        """Return a value as compared with bounds: for rates, the center of the Wilson interval.

        The center is nearer to 1/2 than the observed fraction, the more so the fewer the episodes: 0
        failures in 4 episodes count as 24 %, in 200 as 0.9 %.

        Raises:
            ValueError: see `value`.
        """
        intervals = {"failure_rate": self.failure_interval, "success_rate": self.success_interval}
        interval = None if name in self.metrics else intervals.get(name)
        return self.value(name) if interval is None else sum(interval) / 2


@dataclasses.dataclass(frozen=True)
class MeanAndInterval:
    """Mean over episodes, with its confidence interval."""

    mean: float
    """Mean."""
    interval: tuple[float, float] | None
    """95 % confidence interval of the mean (Student's t); None for one episode."""


@dataclasses.dataclass(frozen=True)
class Bound:
    """Condition of a solved task: an upper or lower bound on a value of evaluations."""

    name: str
    """Name of the value, as in `EvaluationResult.value`."""
    limit: float
    """Bound."""
    is_upper: bool
    """True for an upper bound."""
    unit: str = ""
    """Unit of the value; empty for returns and rates."""

    @property
    def is_rate(self) -> bool:
        """True for a fraction of the episodes, shown in percent."""
        return self.name in ("failure_rate", "success_rate")

    @property
    def scale(self) -> float:
        """Factor from a value to what charts show: percent for rates."""
        return 100.0 if self.is_rate else 1.0

    def is_met(self, result: EvaluationResult) -> bool:
        """Return True if `result` meets the bound. NaN does not."""
        value = result.judged(self.name)
        return value <= self.limit if self.is_upper else value >= self.limit

    @staticmethod
    def all_of(cfg: EvaluationCfg) -> list[Bound]:
        """Return the bounds that a solved task meets, that of the return first."""
        target = cfg.solved_return
        bounds = [] if target is None else [Bound("mean_return", target, is_upper=False)]
        units = {"mean_length": "steps", **cfg.units}
        for limits, is_upper in ((cfg.solved_below, True), (cfg.solved_above, False)):
            bounds += [Bound(n, v, is_upper, units.get(n, "")) for n, v in limits.items()]
        return bounds


class SolvedCheck:
    """Evaluation of the policy during a run, in separate environments, when it may have solved the
    task.

    `last_iteration` is the number of iterations finished at the last evaluation, and `env_cfg` the
    config of the environments. None: that of the run's environments.
    """

    def __init__(self, env: Any, algorithm: Any, cfg: EvaluationCfg, seed: int) -> None:
        """Set up the check.

        Args:
            env: Environments of the run.
            algorithm: Algorithm of the run.
            cfg: Conditions and schedule.
            seed: Seed of the run.

        Raises:
            ValueError: a condition names an unknown metric.
        """
        self.cfg = cfg
        self._env = env
        self._algorithm = algorithm
        self._seed = seed
        self._bounds = Bound.all_of(cfg)
        measured = [*cfg.metrics, *(f"{name}{SHARE}" for name in cfg.standing_still)]
        known = {*measured, *RESULT_FIELDS}
        if cfg.criterion is None:
            known.discard("success_rate")
        for bound in self._bounds:
            check_measured(bound, cfg, known)
        for name in cfg.trigger_below:
            if name not in measured:
                raise ValueError(
                    f"EvaluationCfg trigger_below: {name!r} is not in `metrics`; "
                    f"{suggest(name, sorted(measured))}"
                )
        self._eval_env: Any = None
        self.env_cfg: ManagerBasedRlEnvCfg | None = None
        self.last_iteration = 0

    def exploring_metrics(self) -> dict[str, float]:
        """Return the metrics in `trigger_below` of the environments of the run, now."""
        cfg, env = self.cfg, self._env.unwrapped

        def value(name: str) -> float:
            if name in cfg.metrics:
                return cfg.metrics[name](env).mean().item()
            name = name.removesuffix(SHARE)
            return (cfg.metrics[name](env).mean() / cfg.standing_still[name](env).mean()).item()

        return {name: value(name) for name in cfg.trigger_below}

    def should_evaluate(self, stats: IterationStats) -> bool:
        """Return True if the data of the last iteration suggest that the policy may be good enough."""
        cfg = self.cfg
        if not self._bounds and cfg.trigger_return is None and not cfg.trigger_below:
            return False
        return stats.iteration >= cfg.earliest_after(self.last_iteration) and cfg.is_triggered(
            stats.mean_step_reward, int(self._env.max_episode_length), stats.exploring
        )

    def is_solved_by(self, result: EvaluationResult) -> bool:
        """Return True if `result` meets all conditions of the config."""
        return bool(self._bounds) and all(bound.is_met(result) for bound in self._bounds)

    def evaluate(self, is_stopped: Callable[[], bool] = bool) -> EvaluationResult:
        """Score the policy in separate environments, built at the first call.

        The episodes are the same at each call.

        Raises:
            EvaluationStopped: `is_stopped`, called before every step, returned True.
        """
        if self._eval_env is None:
            self._eval_env = self._make_env(evaluation_seed(self._seed), is_stopped)
        return self._score(self._eval_env, evaluation_seed(self._seed), is_stopped)

    def confirm(self, iteration: int, is_stopped: Callable[[], bool] = bool) -> EvaluationResult:
        """Score the policy after `iteration` iterations in new environments, on unused episodes.

        The episodes depend on the seed and the iteration only, so that a resumed run has the same
        episodes.

        Raises:
            EvaluationStopped: `is_stopped`, called before every step, returned True.
        """
        seed = evaluation_seed(self._seed, iteration)
        env = self._make_env(seed, is_stopped)
        with closing(env):
            return self._score(env, seed, is_stopped)

    def _make_env(self, seed: int, is_stopped: Callable[[], bool]) -> RslRlVecEnvWrapper:
        # Building cannot be stopped, and may take long.
        if is_stopped():
            raise EvaluationStopped
        return make_evaluation_env(self._env, self.cfg.num_episodes, seed, self.env_cfg)

    def _score(self, env: Any, seed: int, is_stopped: Callable[[], bool]) -> EvaluationResult:
        training: Any = self._env.unwrapped
        if hasattr(training, "curriculum_state"):
            # The command `evaluate` names parts that do not fit.
            load_curricula(env, training.curriculum_state())
        elif hasattr(training, "common_step_counter"):
            env.unwrapped.common_step_counter = training.common_step_counter
        policy = self._algorithm.get_policy()
        hidden_state = policy.get_hidden_state()
        self._algorithm.eval_mode()
        try:
            with preserved_rng():
                return evaluate_policy(
                    env,
                    policy,
                    success=self.cfg.criterion,
                    metrics=self.cfg.metrics,
                    standing_still=self.cfg.standing_still,
                    seed=seed,
                    is_stopped=is_stopped,
                )
        finally:
            self._algorithm.train_mode()
            policy.reset(hidden_state=hidden_state)

    def close(self) -> None:
        """Close the environments if they were built."""
        if self._eval_env is not None:
            self._eval_env.close()
            self._eval_env = None


def check_measured(bound: Bound, cfg: EvaluationCfg, known: Collection[str]) -> None:
    """Raise ValueError if evaluations do not measure the value of `bound`, and warn if they never meet it.

    Too few episodes never meet a bound on a rate, even without a failure.
    """
    if bound.name not in known:
        raise ValueError(
            f"EvaluationCfg solved_below, solved_above: {bound.name!r} is not measured; "
            f"{suggest(bound.name, sorted(known))} Others must be in `metrics`."
        )
    failures = 1.0
    if bound.is_rate and bound.is_upper == (bound.name == "failure_rate"):
        failures = bound.limit if bound.is_upper else 1.0 - bound.limit
    if failures > 0.0 and cfg.num_episodes < (needed := episodes_to_show(failures)):
        logger.warning(
            "EvaluationCfg: %d episodes never meet the bound on %s: they are too few to show failures "
            "as rare as %.3g %%; use num_episodes >= %d.",
            cfg.num_episodes, bound.name, 100.0 * failures, needed,
        )  # fmt: skip


def curricula_text(curricula: Mapping[str, Any]) -> str:
    """Return `EvaluationResult.curricula` in words: the first entries, and how many follow."""
    words = []
    for name, value in curricula.items():
        numbers = [f"{one:.4g}" for one in (value if isinstance(value, (list, tuple)) else [value])]
        joint = " to " if len(numbers) == 2 else ", "
        words.append(f"{name.replace('terrain_levels', 'terrain levels')} {joint.join(numbers)}")
    # The last entry is that of terrain levels.
    if (more := len(words) - _MOST_CURRICULA) > 0:
        words[_MOST_CURRICULA - 1 : -1] = [f"{more} more"]
    return "; ".join(words)


def success_definition(cfg: EvaluationCfg) -> str | None:
    """Return a description of the success of an episode, None if the task does not define it."""
    criterion = cfg.criterion
    if criterion is None:
        return None
    if callable(criterion):
        name = getattr(criterion, "__name__", type(criterion).__name__)
        return f"{name}, one step before the end"
    if criterion == "survival":
        return "no termination before the time limit"
    return f"return of at least {float(criterion):g}"


# Episodes.


def make_evaluation_env(
    env: RslRlVecEnvWrapper,
    num_envs: int,
    seed: int,
    cfg: ManagerBasedRlEnvCfg | None = None,
) -> RslRlVecEnvWrapper:
    """Build separate environments of `cfg` to evaluate during training in `env`.

    `cfg` of None is the config of `env`. Curricula are at their beginning.

    The state of the random number generators is preserved, so that evaluation does not change the
    course of a run.
    """
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

    unwrapped = env.unwrapped
    if cfg is None:
        has_curricula = hasattr(unwrapped, "curriculum_state")
        cfg = config_as_built(unwrapped) if has_curricula else unwrapped.cfg
    cfg = copy.deepcopy(cfg)
    cfg.seed = seed
    cfg.scene = dataclasses.replace(cfg.scene, num_envs=num_envs)
    with preserved_rng():
        eval_env = type(unwrapped)(cfg=cfg, device=unwrapped.device)
        return RslRlVecEnvWrapper(eval_env, clip_actions=env.clip_actions)


def load_curricula(env: RslRlVecEnvWrapper, state: dict[str, Any]) -> list[str]:
    """Restore the curricula of `env` from a `curriculum_state` of the training environments.

    Edits of curriculum terms that `env` lacks, because they ease training, are left out. Random
    number generators are not affected. Returns the names of other parts that were left out.
    """
    # Tensors created in evaluations can only be written to in inference mode.
    with torch.inference_mode(), preserved_rng():
        left_out = env.unwrapped.load_curriculum_state(state)
    # Curricula may change the length of episodes.
    env.max_episode_length = env.unwrapped.max_episode_length
    eased = {f"curriculum_manager.{name}" for name in state["term_edits"]}
    return [name for name in left_out if name not in eased]


def reward_unit(env: Any) -> float:
    """Return the factor from weighted rewards to the rewards that `env` returns.

    The factor is the step duration in seconds if the environment scales rewards by it, else 1.
    """
    unwrapped = env.unwrapped
    scaled = getattr(unwrapped.cfg, "scale_rewards_by_dt", False)
    return float(unwrapped.step_dt) if scaled else 1.0


def time_limit(env: Any) -> int | None:
    """Return the time limit of episodes in steps, None for endless episodes."""
    steps = env.max_episode_length
    return int(steps) if 0 < steps <= _LONGEST_EPISODE else None


@contextmanager
def _preserved_state(env: RslRlVecEnvWrapper) -> Generator[None]:
    """Hold the curricula within the block; restore the environments' state after it.

    State that outlives a reset, such as counters of terms, would make evaluations depend on earlier
    ones.
    """
    unwrapped = env.unwrapped
    state = unwrapped.state_dict()
    try:
        with unwrapped.curricula_held():
            yield
    finally:
        try:
            unwrapped.load_state_dict(state)
        except ValueError as error:
            logger.warning(
                "The state of the evaluated environments was not restored; another evaluation in them "
                "may differ. %s", error,
            )  # fmt: skip


def _play_round(
    env: RslRlVecEnvWrapper,
    policy: Policy,
    count: int,
    max_steps: int,
    success_func: PerEnv | None,
    metrics: Mapping[str, PerEnv],
    standing_still: Mapping[str, PerEnv],
    report: Callable[[int, int], None],
    is_stopped: Callable[[], bool] | None,
) -> Episodes:
    """Play the first episode of each of the first `count` environments.

    `report` is called with the number of running episodes and the number of steps.
    """
    unwrapped = env.unwrapped

    def zeros(dtype: torch.dtype) -> torch.Tensor:
        return torch.zeros(env.num_envs, dtype=dtype, device=env.device)

    running = ~zeros(torch.bool)
    running[count:] = False
    returns, lengths = zeros(torch.float64), zeros(torch.long)
    failed, succeeded = zeros(torch.bool), zeros(torch.bool)
    sums = {name: zeros(torch.float64) for name in metrics}
    still = {name: zeros(torch.float64) for name in standing_still}
    measured = [*zip(sums.values(), metrics.values(), strict=True)]
    measured += [*zip(still.values(), standing_still.values(), strict=True)]
    manager = unwrapped.termination_manager
    terminations = {name: zeros(torch.bool) for name in manager.active_terms}
    reset_policy = getattr(policy, "reset", None)
    observations, _ = env.reset()
    if reset_policy is not None:
        reset_policy()
    for step in range(max_steps):
        if is_stopped is not None and is_stopped():
            raise EvaluationStopped
        if success_func is not None:
            succeeded = torch.where(running, success_func(unwrapped).bool(), succeeded)
        for total, func in measured:
            # `where` instead of a product: zero times infinity is NaN.
            total += torch.where(running, func(unwrapped), 0.0)
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
        if (step + 1) % _STEPS_BETWEEN_CHECKS == 0:
            num_running = int(running.sum())
            report(num_running, step + 1)
            if num_running == 0:
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
        standing_still={name: total[first] / lengths[first] for name, total in still.items()},
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Episodes:
    """Records of E episodes; `+` concatenates two records."""

    returns: torch.Tensor
    """Sum of weighted rewards, (E,)."""
    lengths: torch.Tensor
    """Number of steps, (E,) int64."""
    finished: torch.Tensor
    """True if the episode terminated or reached the task's episode length, (E,) bool."""
    failed: torch.Tensor
    """True if a termination ended the episode before the time limit, (E,) bool."""
    succeeded: torch.Tensor
    """Value of the task's success function one step before the end, (E,) bool."""
    terminations: dict[str, torch.Tensor]
    """True if the termination was true in the last step, (E,) bool, by name."""
    metrics: dict[str, torch.Tensor]
    """Mean of the metric over the steps of the episode, (E,), by name."""
    standing_still: dict[str, torch.Tensor]
    """The same for a robot that stands still."""

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
    """Return the statistics of `episodes`; `successes` is (E,) bool, None if not defined."""
    returns = episodes.returns
    count = len(returns)
    mean_return = mean_and_interval(returns)
    rate = None if successes is None else successes.double().mean().item()
    failures = episodes.failed.double().mean().item()
    metrics = {name: mean_and_interval(v) for name, v in episodes.metrics.items()}
    for name, still in episodes.standing_still.items():
        # All commands are 0 in a task of standing.
        if still.double().mean() != 0.0:
            metrics[f"{name}{SHARE}"] = ratio_and_interval(episodes.metrics[name], still)
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
        metrics=metrics,
        standing_still={
            name: v.double().mean().item() for name, v in episodes.standing_still.items()
        },
        num_unfinished=int((~episodes.finished).sum().item()),
        duration=duration,
        returns=tuple(returns.tolist()),
    )


def mean_and_interval(values: torch.Tensor) -> MeanAndInterval:
    """Return the mean of `values` (E,) and its 95 % confidence interval, x +- t_(E-1) s / sqrt(E)."""
    mean, count = values.double().mean().item(), len(values)
    if count == 1:
        return MeanAndInterval(mean, None)
    # Imported here: the import takes a tenth of a second, which runs without evaluation save.
    from scipy.special import stdtrit

    half = float(stdtrit(count - 1, 0.975)) * values.double().std().item() / math.sqrt(count)
    return MeanAndInterval(mean, (mean - half, mean + half))


def ratio_and_interval(values: torch.Tensor, references: torch.Tensor) -> MeanAndInterval:
    """Return the ratio R of the means of `values` and `references`, (E,), and its 95 % confidence interval.

    That of the mean of (x - R y) / mean(y): Cochran, Sampling Techniques, 1977, chapter 6.
    """
    mean = references.double().mean()
    ratio = values.double().mean() / mean
    found = mean_and_interval((values - ratio * references) / mean)
    ratio = ratio.item()
    if found.interval is None:
        return MeanAndInterval(ratio, None)
    low, high = found.interval
    return MeanAndInterval(ratio, (ratio + low, ratio + high))


def wilson_interval(rate: float, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate observed over `count` episodes.

    Unlike the normal approximation, the interval stays within [0, 1] and is not empty at 0 and 1:
    (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).
    """
    shrink = 1.0 + _Z95**2 / count
    center = (rate + _Z95**2 / (2 * count)) / shrink
    half = _Z95 * math.sqrt(rate * (1 - rate) / count + _Z95**2 / (4 * count**2)) / shrink
    # Keep the rate in the interval despite rounding.
    return max(0.0, min(center - half, rate)), min(1.0, max(center + half, rate))


def episodes_to_show(rate: float) -> int:
    """Return the number of episodes without failure needed to show a failure rate <= `rate`.

    The center of `wilson_interval(0, n)` is z^2 / (2 (n + z^2)).
    """
    return max(1, math.ceil(_Z95**2 * (0.5 / rate - 1.0)))
