"""Objective of a sweep: a value that does not contain what its settings change."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mjlab.cli.train_config import goal_return, return_differences
from mjlab.rl.evaluation import Bound
from mjlab.rl.plot import DEFAULT_TAG
from mjlab.tasks.registry import list_profiles, load_rl_cfg

if TYPE_CHECKING:
    from mjlab.cli.train_config import TrainConfig

EVALUATED = "Evaluation/mean_return"
"""Default objective of tasks with evaluations: mean return of the last evaluation."""
EXPLORED = "Train/exploring_return"
"""Default objective of other tasks: return of the exploring episodes."""

# Episodes without a time limit have no return, and are not evaluated.
_LONGEST_EPISODE_S = 1e6
# Parts of tags that name returns, or what is learned from them.
_OF_RETURNS = ("return", "reward", "loss/")


@dataclass(frozen=True)
class Objective:
    """Value that a sweep compares."""

    tag: str = EVALUATED
    """TensorBoard tag."""
    minimize: bool = False
    """Prefer low values."""
    is_ranked: bool = True
    """Order settings by the value. False: the settings change what the value is."""
    reason: str = ""
    """Sentence about the choice. Empty: default of the task, or of the user."""
    past_goal: float | None = None
    """Return that is the goal of the task, and means something else in each setting. Runs train past
    it."""
    others: tuple[str, ...] = ()
    """Further results of evaluations that the settings can be compared by."""

    @property
    def label(self) -> str:
        """Tag without its group, `mean_return`."""
        return self.tag.rpartition("/")[2]

    @property
    def is_rate(self) -> bool:
        """True for a fraction of the episodes of an evaluation."""
        return self.is_evaluated and self.label in ("success_rate", "failure_rate")

    @property
    def is_evaluated(self) -> bool:
        """True for a result of evaluations."""
        return self.tag.startswith("Evaluation/")


def choose_objective(
    task: str, cfgs: list[TrainConfig], tag: str | None = None, minimize: bool = False
) -> Objective:
    """Return the objective of settings with the configs `cfgs`.

    If they differ in what enters a return, returns cannot be compared: a reward of weight 10 has ten
    times the return of weight 1. The objective is then the success rate, if the task defines success
    other than by a return, or a metric of its evaluations. Without these, settings are not ranked.

    Args:
        task: Name of the task.
        cfgs: Configs of all settings; of ranges, those of the ends.
        tag: TensorBoard tag to compare. None: default.
        minimize: Prefer low values.
    """
    first = cfgs[0]
    changes = sorted({name for cfg in cfgs[1:] for name in return_differences(first.env, cfg.env)})
    if not changes:
        return Objective(tag or _default_tag(first), minimize)
    is_reward = all(name.startswith("rewards.") for name in changes)
    named = ", ".join(changes[:3]) + (" and others" if len(changes) > 3 else "")
    why = f"because the settings change the {'reward' if is_reward else 'return'} ({named})"
    goal = next((g for cfg in cfgs if (g := goal_return(cfg.agent.evaluation)) is not None), None)
    found = [_measures(task, cfg, changes) for cfg in cfgs]
    common = [name for name in found[0] if all(name in measures for measures in found)]
    metrics = [*first.agent.evaluation.metrics]
    if tag is None and common:
        name, *others = dict.fromkeys([*common, *metrics])
        is_low = minimize or found[0][name]
        reason = f"compared by {name}{', lowest first' if is_low else ''}, {why}"
        return Objective(f"Evaluation/{name}", is_low, True, reason, goal, tuple(others))
    name = (tag or EVALUATED).removeprefix("Evaluation/")
    if name in common or name in metrics or not _contains_return(tag or EVALUATED):
        return Objective(tag or EVALUATED, minimize, past_goal=goal)
    others: tuple[str, ...] = ()
    if first.env.episode_length_s >= _LONGEST_EPISODE_S:
        use = "set env.episode_length_s, because endless episodes are not evaluated"
    elif common:
        use = f"leave out --objective to compare {common[0]}"
    elif metrics:
        use = f"use --objective Evaluation/{metrics[0]}, with --minimize if low values are good"
        tag, others = tag or f"Evaluation/{metrics[0]}", tuple(metrics[1:])
    else:
        use = "define success or metrics in the task's EvaluationCfg"
    reason = f"not ranked, {why}; {use}"
    return Objective(tag or _default_tag(first), minimize, False, reason, goal, others)


def _measures(task: str, cfg: TrainConfig, changes: Iterable[str]) -> dict[str, bool]:
    """Return the results of evaluations without the return, the best first; True: low is good."""
    evaluation = cfg.agent.evaluation
    measures: dict[str, bool] = {}
    if cfg.env.episode_length_s >= _LONGEST_EPISODE_S:
        return measures
    # Of episodes that end by other conditions, neither length nor failures can be compared.
    ends_alike = not any(name.startswith("terminations.") for name in changes)
    success = evaluation.criterion
    if callable(success) or (success == "survival" and ends_alike):
        measures["success_rate"] = False
    ends = {"failure_rate"} if ends_alike else set()
    if all(name.startswith(("rewards.", "curriculum.")) for name in changes):
        ends.add("mean_length")
    # Goals tell which direction is good; some tasks have goals under a profile only.
    profiles = [load_rl_cfg(task, profile=profile).evaluation for profile in list_profiles(task)]
    for goals in (evaluation, *profiles):
        for bound in Bound.all_of(goals):
            if bound.name in evaluation.metrics or bound.name in ends:
                measures.setdefault(bound.name, bound.is_upper)
    for name in evaluation.metrics:
        if "error" in name:
            measures.setdefault(name, True)
    terms = cfg.env.terminations.values()
    if ends_alike and any(term is not None and not term.time_out for term in terms):
        measures.setdefault("failure_rate", True)
    return measures


def _contains_return(tag: str) -> bool:
    """Return True if the values of a tag depend on the scale of rewards.

    Success rates do unless they are among the measures of the task.
    """
    return tag == "Evaluation/success_rate" or any(part in tag.lower() for part in _OF_RETURNS)


def _default_tag(cfg: TrainConfig) -> str:
    """Return the tag to compare: of evaluations if the task has them, else the exploring return."""
    if Bound.all_of(cfg.agent.evaluation):
        return EVALUATED
    return EXPLORED if cfg.env.episode_length_s < _LONGEST_EPISODE_S else DEFAULT_TAG
