"""What a training run reports while it runs, and who is told."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjlab.rl.evaluation_result import EvaluationResult


@dataclass(frozen=True, kw_only=True)
class IterationStats:
    """Figures of one finished iteration."""

    iteration: int
    """Iterations finished, this one included."""
    total_iterations: int
    """Iterations that the run is to have."""
    total_steps: int
    """Environment steps since the run began, over all environments."""
    collection_time: float
    """Time spent stepping the environments and the policy, in seconds."""
    learning_time: float
    """Time spent updating the policy, in seconds."""
    steps_per_second: float
    """Environment steps per second, over both."""
    time_left: float
    """Estimated time until the last iteration, in seconds."""
    mean_reward: float | None
    """Mean sum of rewards over the last 100 finished episodes, as the environment scales them;
    None until one has finished."""
    mean_episode_length: float | None
    """Mean length of those, in environment steps."""
    mean_step_reward: float
    """Mean weighted reward of a step of this iteration, before scaling by the step's duration."""
    learning_rate: float
    """Learning rate after this iteration."""
    action_std: float
    """Mean standard deviation of the actions."""
    losses: dict[str, float] = field(default_factory=dict)
    """Mean losses of the update, by name."""
    environment: dict[str, float] = field(default_factory=dict)
    """Means of what the environment logged, by name (`Episode_Reward/...`, `Metrics/...`)."""


class TrainingObserver:
    """Is told what happens during `MjlabOnPolicyRunner.learn`; override what is of interest.

    Methods are called on the training thread, so they should be quick.
    """

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Training starts; `first_iteration` iterations were finished before."""

    def on_iteration(self, stats: IterationStats) -> None:
        """An iteration has finished."""

    def on_evaluation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """The policy was evaluated after `iteration` iterations; `solved` if it met all conditions.

        Training does not stop yet: `on_confirmation` follows, unless training goes on anyway.
        """

    def on_confirmation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """A policy that met all conditions was evaluated in other episodes; `solved` if it did again.

        Training stops then.
        """

    def on_checkpoint(self, path: str) -> None:
        """A checkpoint was written."""

    def on_stop_requested(self, signal_name: str) -> None:
        """SIGINT, SIGTERM or SIGHUP arrived; the running iteration is being finished."""

    def on_end(self, reason: str) -> None:
        """Training ended: `finished`, `solved`, `interrupted` or `failed`."""
