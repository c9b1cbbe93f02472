"""Solved or not: evaluations beside a training run, and what a policy must reach in them.

Training stops on two evaluations. The first is of the same episodes each time, so that what changes is
the policy. A noisy policy that is tried often enough passes it by luck, hence the second, of episodes
that no evaluation of the run has had before.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

from mjlab.rl.evaluate import evaluate_policy, make_evaluation_env
from mjlab.rl.evaluation_result import FIGURES, EvaluationResult, episodes_to_show
from mjlab.rl.progress import IterationStats
from mjlab.utils.random import evaluation_seed, preserved_rng

logger = logging.getLogger(__name__)


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
        _check_conditions({**self._below, **self._above}, cfg)
        _warn_of_few_episodes(self._below, self._above, self._num_episodes)
        self._beside: Any = None
        self.last_iteration = 0

    def is_due(self, stats: IterationStats) -> bool:
        """Return whether the training data hint that the policy may be good enough."""
        since = stats.iteration - self.last_iteration
        if not self._has_target or since < self._min_interval:
            return False
        if stats.iteration < self._cfg.get("first_iteration", 0):
            return False
        trigger = self._cfg.get("trigger_return")
        if trigger is None:
            solved_return = self._cfg.get("solved_return")
            if solved_return is None:
                return True
            trigger = self._cfg["trigger_fraction"] * solved_return
        return stats.mean_step_reward * int(self._env.max_episode_length) >= trigger

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
        if self._beside is None:
            self._beside = self._make_env(evaluation_seed(self._seed))
        return self._score(self._beside, evaluation_seed(self._seed))

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
        if self._beside is not None:
            self._beside.close()
            self._beside = None


def _check_conditions(names: Iterable[str], cfg: dict[str, Any]) -> None:
    known = {*(cfg.get("metrics") or {}), *FIGURES}
    defining_success = ("success_func", "success_return", "solved_return")
    is_defined = any(cfg.get(name) is not None for name in defining_success)
    if not is_defined and not cfg.get("success_is_survival"):
        known.discard("success_rate")
    for name in names:
        if name not in known:
            raise ValueError(
                f"EvaluationCfg: solved_below or solved_above names {name!r}, which is not "
                f"measured. Add it to `metrics`, or take one of {', '.join(sorted(known))}."
            )


def _warn_of_few_episodes(
    below: dict[str, float], above: dict[str, float], num_episodes: int
) -> None:
    """Warn of bounds on rates that so few episodes never meet, even if none of them fails."""
    allowed = {"failure_rate": below.get("failure_rate", 1.0)}
    allowed["success_rate"] = 1.0 - above.get("success_rate", 0.0)
    for name, failures in allowed.items():
        if failures > 0.0 and num_episodes < (needed := episodes_to_show(failures)):
            logger.warning(
                "EvaluationCfg: %d episodes never meet the bound on %s, because they say too little "
                "of failures as rare as %.3g %%; use num_episodes >= %d.",
                num_episodes, name, 100.0 * failures, needed,
            )  # fmt: skip
