"""Curriculum terms that change a term's config at given numbers of environment steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import torch

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.curriculum_manager import CurriculumTermCfg


class RewardCurriculumStage(TypedDict, total=False):
    """What changes from a number of environment steps on."""

    step: int
    """First `common_step_counter` of the stage; required."""
    weight: float
    """New weight of the reward term."""
    params: dict[str, Any]
    """New values of parameters that the term already has."""


class TerminationCurriculumStage(TypedDict, total=False):
    """What changes from a number of environment steps on."""

    step: int
    """First `common_step_counter` of the stage; required."""
    time_out: bool
    """Whether the termination term counts as a time-out."""
    params: dict[str, Any]
    """New values of parameters that the term already has."""


class _StagedCurriculum:
    """Applies stages, in order, to the live config of a term."""

    _kind = ""
    _name_param = ""

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        name, stages = cfg.params[self._name_param], cfg.params["stages"]
        _check_stages(f"{self._kind} {name!r}", self._live_cfg(env, name), stages)

    def _live_cfg(self, env: ManagerBasedRlEnv, name: str) -> Any:
        raise NotImplementedError

    def _apply(
        self, env: ManagerBasedRlEnv, name: str, stages: Sequence[Any]
    ) -> dict[str, torch.Tensor]:
        cfg = self._live_cfg(env, name)
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
    """Changes weight and parameters of a reward term, stage by stage.

    Params:
        reward_name: Name of the reward term.
        stages: Dicts with `step` and what changes from that number of environment steps on:
            fields of the term's config (`weight`) and `params`. Later stages win.

    Returns, for logging, the current value of every field and parameter that any stage names.

    Raises, when built: `ValueError` for an unknown term or steps that decrease, `AttributeError`
    for fields that the config does not have, `KeyError` for parameters that the term does not have.
    """

    _kind, _name_param = "reward", "reward_name"

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor,
        reward_name: str,
        stages: list[RewardCurriculumStage],
    ) -> dict[str, torch.Tensor]:
        return self._apply(env, reward_name, stages)

    def _live_cfg(self, env: ManagerBasedRlEnv, name: str) -> Any:
        return env.reward_manager.get_term_cfg(name)


class termination_curriculum(_StagedCurriculum):
    """Changes `time_out` and parameters of a termination term, stage by stage.

    As `reward_curriculum`, with `termination_name` for the name of the term.
    """

    _kind, _name_param = "termination", "termination_name"

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor,
        termination_name: str,
        stages: list[TerminationCurriculumStage],
    ) -> dict[str, torch.Tensor]:
        return self._apply(env, termination_name, stages)

    def _live_cfg(self, env: ManagerBasedRlEnv, name: str) -> Any:
        return env.termination_manager.get_term_cfg(name)


def _fields(stage: Any) -> list[str]:
    return [key for key in stage if key not in ("step", "params")]


def _check_stages(term: str, cfg: Any, stages: Sequence[Any]) -> None:
    known = {field.name for field in dataclasses.fields(cfg)} - {"func", "params"}
    previous = None
    for stage in stages:
        if "step" not in stage:
            raise ValueError(f"Curriculum of {term}: the stage {stage!r} has no 'step'.")
        if previous is not None and stage["step"] < previous:
            raise ValueError(
                f"Curriculum of {term}: stages must be in order of their steps, but "
                f"{stage['step']} comes after {previous}."
            )
        previous = stage["step"]
        unknown = [field for field in _fields(stage) if field not in known]
        if unknown:
            raise AttributeError(
                f"Curriculum of {term}: {type(cfg).__name__} has no fields {unknown} that a stage "
                f"could set. It has {sorted(known)}; parameters go into 'params'."
            )
        missing = [param for param in stage.get("params", {}) if param not in cfg.params]
        if missing:
            raise KeyError(
                f"Curriculum of {term}: the term has no parameters {missing}; "
                f"it has {sorted(cfg.params)}."
            )
