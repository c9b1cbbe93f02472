"""Curriculum terms: change a term's config in stages, by number of environment steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import torch

from mjlab.utils.errors import UnknownAttributeError, UnknownNameError, check_exists

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.curriculum_manager import CurriculumTermCfg


__all__ = [
    "RewardCurriculumStage",
    "TerminationCurriculumStage",
    "modify_reward_weight",
    "reward_curriculum",
    "termination_curriculum",
]


class RewardCurriculumStage(TypedDict, total=False):
    """Stage of a reward curriculum: changes from a number of environment steps on."""

    step: int
    """First `common_step_counter` of the stage; required."""
    weight: float
    """New weight of the reward term."""
    params: dict[str, Any]
    """New values of parameters that the term already has."""


class TerminationCurriculumStage(TypedDict, total=False):
    """Stage of a termination curriculum: changes from a number of environment steps on."""

    step: int
    """First `common_step_counter` of the stage; required."""
    time_out: bool
    """Count the termination term as a time-out."""
    params: dict[str, Any]
    """New values of parameters that the term already has."""


class _StagedCurriculum:
    """Curriculum that applies stages, in order, to the live config of a term."""

    _kind = ""

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        name, stages = cfg.params[f"{self._kind}_name"], cfg.params["stages"]
        owner = f"{self._kind} {name!r}"
        term_cfg = getattr(env, f"{self._kind}_manager").get_term_cfg(name)
        known = {field.name for field in dataclasses.fields(term_cfg)} - {"func", "params"}
        previous = None
        for stage in stages:
            if "step" not in stage:
                raise ValueError(f"Curriculum of {owner}: expected key 'step' in stage {stage!r}.")
            if previous is not None and stage["step"] < previous:
                raise ValueError(
                    f"Curriculum of {owner}: expected stages in ascending order of step, got "
                    f"{stage['step']} after {previous}."
                )
            previous = stage["step"]
            for field in _fields(stage):
                check_exists(f"field of {owner}", field, sorted(known), UnknownAttributeError)
            for param in stage.get("params", {}):
                check_exists(f"parameter of {owner}", param, term_cfg.params, UnknownNameError)

    def _apply(
        self, env: ManagerBasedRlEnv, name: str, stages: Sequence[Any]
    ) -> dict[str, torch.Tensor]:
        cfg = getattr(env, f"{self._kind}_manager").get_term_cfg(name)
        logged: dict[str, torch.Tensor] = {}
        for stage in stages:
            if env.common_step_counter >= stage["step"]:
                cfg.params.update(stage.get("params", {}))
                for field in _fields(stage):
                    setattr(cfg, field, stage[field])
        for stage in stages:
            named = {field: getattr(cfg, field) for field in _fields(stage)}
            named |= {param: cfg.params[param] for param in stage.get("params", {})}
            for key, value in named.items():
                if isinstance(value, (bool, int, float, torch.Tensor)):
                    logged[key] = torch.as_tensor(value)
        return logged


class reward_curriculum(_StagedCurriculum):
    """Changes weight and parameters of a reward term in stages.

    Params:
        reward_name: Name of the reward term.
        stages: Dicts with `step`, fields of the term's config (`weight`) and `params`, applied from
            that number of environment steps on. Later stages take precedence.

    Returns the current value of every field and parameter in the stages, for logging.

    Raises at construction: `ValueError` for an unknown term or decreasing steps, `AttributeError`
    for unknown fields of the config, `KeyError` for unknown parameters of the term.
    """

    _kind = "reward"

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor,
        reward_name: str,
        stages: list[RewardCurriculumStage],
    ) -> dict[str, torch.Tensor]:
        return self._apply(env, reward_name, stages)


class termination_curriculum(_StagedCurriculum):
    """Changes `time_out` and parameters of a termination term in stages.

    Parameters as in `reward_curriculum`, with `termination_name` as the name of the term.
    """

    _kind = "termination"

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor,
        termination_name: str,
        stages: list[TerminationCurriculumStage],
    ) -> dict[str, torch.Tensor]:
        return self._apply(env, termination_name, stages)


def modify_reward_weight(
    env: ManagerBasedRlEnv, env_ids: torch.Tensor, term_name: str, weight: float, num_steps: int
) -> float:
    """Set the weight of a reward term after `num_steps` environment steps; return the weight.

    For several changes, and for parameters, see `reward_curriculum`.

    Raises:
        ValueError: unknown term.
    """
    cfg = env.reward_manager.get_term_cfg(term_name)
    if env.common_step_counter > num_steps:
        cfg.weight = weight
    return cfg.weight


def _fields(stage: Any) -> list[str]:
    return [key for key in stage if key not in ("step", "params")]
