"""Watching, while training goes on, for the moment when the task is solved."""

from __future__ import annotations

from typing import Any

from mjlab.rl.evaluate import EvaluationResult, evaluate_policy, make_evaluation_env
from mjlab.rl.progress import IterationStats
from mjlab.rl.rng import preserved_rng

# Added to the run's seed, so that evaluation does not start from states seen in training.
_SEED_OFFSET = 1_000_003


class SolvedCheck:
    """Evaluates the policy, beside the run and without touching it, when it may have solved the
    task.

    `last_iteration` is the number of iterations that were finished at the last evaluation.
    """

    def __init__(self, env: Any, algorithm: Any, cfg: dict[str, Any], seed: int) -> None:
        """Take the run's environments and algorithm, and an `EvaluationCfg` as a dict."""
        self._env = env
        self._algorithm = algorithm
        self._cfg = cfg
        self._seed = seed + _SEED_OFFSET
        self._beside: Any = None
        self.last_iteration = 0

    def is_due(self, stats: IterationStats) -> bool:
        """Return whether the training data hint that the policy may be good enough."""
        target = self._cfg.get("solved_return")
        if target is None or stats.iteration - self.last_iteration < self._cfg["min_interval"]:
            return False
        expected = stats.mean_step_reward * int(self._env.max_episode_length)
        return expected >= self._cfg["trigger_fraction"] * target

    def is_solved_by(self, result: EvaluationResult) -> bool:
        """Return whether `result` reaches the return from which the task counts as solved."""
        target = self._cfg.get("solved_return")
        return target is not None and result.mean_return >= target

    @property
    def stops_training(self) -> bool:
        """Whether training ends when the task is solved."""
        return bool(self._cfg.get("stop_when_solved", True))

    def evaluate(self) -> EvaluationResult:
        """Score the policy in environments of their own, built at the first call."""
        if self._beside is None:
            count = self._cfg.get("num_episodes", 256)
            self._beside = make_evaluation_env(self._env, count, self._seed)
        # Curricula count the steps of training.
        counter = getattr(self._env.unwrapped, "common_step_counter", None)
        if counter is not None:
            self._beside.unwrapped.common_step_counter = counter
        policy = self._algorithm.get_policy()
        hidden_state = policy.get_hidden_state()
        success_return = self._cfg.get("success_return")
        if success_return is None:
            success_return = self._cfg.get("solved_return")
        self._algorithm.eval_mode()
        try:
            with preserved_rng():
                return evaluate_policy(
                    self._beside,
                    policy,
                    success_return=success_return,
                    success_func=self._cfg.get("success_func"),
                    seed=self._seed,
                )
        finally:
            self._algorithm.train_mode()
            policy.reset(hidden_state=hidden_state)

    def close(self) -> None:
        """Close the environments, if there are any."""
        if self._beside is not None:
            self._beside.close()
            self._beside = None
