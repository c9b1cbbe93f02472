"""Recorders: terms that look on and keep what they want, for data sets and logs."""

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
from mjlab.utils.errors import UnknownNameError, UnsupportedError, WrongTypeError

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass
class RecorderTermCfg(ManagerTermBaseCfg):
    """A recorder: `func` is a subclass of `RecorderTerm`, which is built with `(cfg, env)`."""


class RecorderTerm(ManagerTermBase):
    """Base of recorders; every hook does nothing until overridden."""

    def __init__(self, cfg: RecorderTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)
        self.cfg = cfg

    def __call__(self) -> None:
        """Raise `NotImplementedError`: recorders have hooks instead."""
        raise UnsupportedError(
            f"{self.name} is not called; override its hooks, such as record_post_step."
        )

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        """Look at environments that are about to reset.

        `env.obs_buf` still is what the policy saw; action, reward and dones are those of the step
        that ended the episodes.
        """

    def record_post_reset(self, env_ids: torch.Tensor) -> None:
        """Look at environments that were reset; observations are those of the new episodes."""

    def record_post_step(self) -> None:
        """Look at all environments at the end of a step."""

    def close(self) -> None:
        """Release what the recorder holds; called when the environment closes."""


class RecorderManager(TermListManager):
    """Calls the hooks of all recorders."""

    _cfg_type = RecorderTermCfg

    def __init__(self, cfg: Mapping[str, RecorderTermCfg | None], env: ManagerBasedRlEnv) -> None:
        self._terms: dict[str, RecorderTerm] = {}
        super().__init__(cfg, env)

    def __contains__(self, name: str) -> bool:
        return name in self._terms

    def get_term(self, name: str) -> RecorderTerm:
        """Return a recorder; raises `KeyError`, with the valid names, if there is none."""
        self._check_known(name, self._term_names, UnknownNameError)
        return self._terms[name]

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        """Call this hook of all recorders, before the given environments reset."""
        for term in self._terms.values():
            term.record_pre_reset(env_ids)

    def record_post_reset(self, env_ids: torch.Tensor) -> None:
        """Call this hook of all recorders, after the given environments were observed anew."""
        for term in self._terms.values():
            term.record_post_reset(env_ids)

    def record_post_step(self) -> None:
        """Call this hook of all recorders, at the end of a step."""
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
                    f"{self._label(name)}: func must be a subclass of RecorderTerm, got "
                    f"{cfg.func!r}."
                )
            self._resolve_params(name, cfg)
            with label_errors(self._label(name)):
                term = cfg.func(cfg, self._env)
            cfg.func = term
            self._terms[name] = term
            self._term_names.append(name)
            self._term_cfgs.append(cfg)


class NullRecorderManager(NullManager, RecorderManager):
    """Recorder manager without terms."""
