"""The figures of an evaluation."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import torch

# Two-sided 95 % of the normal distribution.
_Z95 = 1.959964
# Fewer episodes say little of what happens in one of a hundred.
_MANY_EPISODES = 200

FIGURES = ("mean_return", "mean_length", "success_rate", "failure_rate")
"""Fields of `EvaluationResult` that `EvaluationResult.figure` knows, beside the metrics."""


@dataclasses.dataclass(frozen=True)
class MeanAndInterval:
    """A mean over episodes."""

    mean: float
    """The mean."""
    interval: tuple[float, float] | None
    """95 % confidence interval of the mean (Student's t); None for one episode."""


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

    def figure(self, name: str) -> float:
        """Return a figure by name: a metric of the task, or a field such as `failure_rate`.

        Raises:
            ValueError: there is no such figure; the message lists those there are.
        """
        if name in self.metrics:
            return self.metrics[name].mean
        value = getattr(self, name, None) if name in FIGURES else None
        if value is None:
            known = [*self.metrics, *(f for f in FIGURES if getattr(self, f) is not None)]
            raise ValueError(
                f"An evaluation of this task has no figure {name!r}; it has {', '.join(known)}."
            )
        return float(value)

    def judged(self, name: str) -> float:
        """Return a figure as bounds judge it: rates by the middle of their Wilson interval.

        That is nearer to 1/2 than the fraction observed, the more so the fewer the episodes are: no
        failure in 4 episodes is judged as 24 %, in 200 as 0.9 %.

        Raises:
            ValueError: see `figure`.
        """
        intervals = {"failure_rate": self.failure_interval, "success_rate": self.success_interval}
        interval = None if name in self.metrics else intervals.get(name)
        return self.figure(name) if interval is None else sum(interval) / 2


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
