"""Recorder manager: terms that record data during rollouts, for data sets and logs."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.managers.manager_base import (
    ManagerTermBase,
    ManagerTermBaseCfg,
    NullManager,
    TermListManager,
    label_errors,
)
from mjlab.utils.errors import UnknownNameError, UnsupportedError, WrongTypeError, check_exists

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass
class RecorderTermCfg(ManagerTermBaseCfg):
    """Recorder term configuration: `func` is a `RecorderTerm` subclass, built with `(cfg, env)`."""


class RecorderTerm(ManagerTermBase):
    """Base class of recorders. All hooks do nothing by default."""

    def __init__(self, cfg: RecorderTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)
        self.cfg = cfg

    def __call__(self) -> None:
        """Raise `NotImplementedError`: recorders have hooks instead."""
        raise UnsupportedError(
            f"{self.name}: recorders are not callable; override hooks such as record_post_step."
        )

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        """Record environments that are about to reset.

        `env.obs_buf` still holds the observation the policy acted on; action, reward and dones are
        those of the step that ended the episodes.
        """

    def record_post_reset(self, env_ids: torch.Tensor) -> None:
        """Record environments that were reset. Observations are those of the new episodes."""

    def record_post_step(self) -> None:
        """Record all environments at the end of a step."""

    def close(self) -> None:
        """Release resources. Called when the environment closes."""


class RecorderManager(TermListManager):
    """Calls the hooks of all recorders."""

    _title = "recorders"
    _cfg_type = RecorderTermCfg

    def __init__(self, cfg: Mapping[str, RecorderTermCfg | None], env: ManagerBasedRlEnv) -> None:
        self._terms: dict[str, RecorderTerm] = {}
        super().__init__(cfg, env)

    def __contains__(self, name: str) -> bool:
        return name in self._terms

    def get_term(self, name: str) -> RecorderTerm:
        """Return the recorder `name`. Raises `KeyError`, listing the valid names, if unknown."""
        check_exists("RecorderManager term", name, self._terms, UnknownNameError)
        return self._terms[name]

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        """Call `record_pre_reset` of all recorders. Called before `env_ids` reset."""
        for term in self._terms.values():
            term.record_pre_reset(env_ids)

    def record_post_reset(self, env_ids: torch.Tensor) -> None:
        """Call `record_post_reset` of all recorders. Called once `env_ids` have new observations."""
        for term in self._terms.values():
            term.record_post_reset(env_ids)

    def record_post_step(self) -> None:
        """Call `record_post_step` of all recorders. Called at the end of a step."""
        for term in self._terms.values():
            term.record_post_step()

    def close(self) -> None:
        """Close all recorders."""
        for term in self._terms.values():
            term.close()

    def _prepare_terms(self) -> None:
        self._term_names, self._term_cfgs = [], []
        for name, cfg in self._enabled(self.cfg, RecorderTermCfg, quiet=True):
            if not (inspect.isclass(cfg.func) and issubclass(cfg.func, RecorderTerm)):
                raise WrongTypeError(
                    f"{self._label(name)} func: expected a subclass of RecorderTerm, got "
                    f"{cfg.func!r}."
                )
            self._resolve_params(name, cfg)
            with label_errors(self._label(name)):
                term = cfg.func(cfg, self._env)
            cfg.func = term
            self._terms[name] = term
            self._term_names.append(name)
            self._term_cfgs.append(cfg)
            self._live_cfgs[name] = cfg


class NullRecorderManager(NullManager, RecorderManager):
    """Recorder manager without terms."""
