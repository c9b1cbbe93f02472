"""Curriculum manager: terms that change the task during training."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import offers_older_attributes
from mjlab.managers.manager_base import ManagerTermBaseCfg, NullManager, TermListManager
from mjlab.utils.indexing import as_index

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass
class CurriculumTermCfg(ManagerTermBaseCfg):
    """Curriculum term configuration: `func(env, env_ids, **params)` is called at resets.

    The return value is logged: None, a number, a tensor with one element, or a dict of those.
    """


@offers_older_attributes
class CurriculumManager(TermListManager):
    """Calls its terms at every reset, before the state of the old episode is overwritten."""

    _title = "curriculum"
    _cfg_type = CurriculumTermCfg
    _leading = ("env", "env_ids")
    _transient = {"_is_held", "after_term"}

    def __init__(self, cfg: Mapping[str, CurriculumTermCfg | None], env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self._state: dict[str, Any] = dict.fromkeys(self._term_names)
        self._is_held = False
        self.after_term: Callable[[str], None] | None = None
        """Function called with the name of each term after its call. Default None."""

    @contextmanager
    def held(self) -> Generator[None]:
        """Call no terms within this context, so that resets do not change the curricula."""
        before, self._is_held = self._is_held, True
        try:
            yield
        finally:
            self._is_held = before

    def compute(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Call all terms for the environments about to reset, and store their results.

        Does nothing inside `held`.
        """
        if self._is_held:
            return
        index = as_index(env_ids)
        for name, cfg in zip(self._term_names, self._term_cfgs, strict=True):
            self._state[name] = cfg.func(self._env, index, **cfg.params)
            if self.after_term is not None:
                self.after_term(name)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, float]:
        """Return `Curriculum/<term>` or `Curriculum/<term>/<key>`, and reset the terms."""
        log: dict[str, float] = {}
        for name, state in self._state.items():
            if isinstance(state, dict):
                items = {f"{name}/{key}": value for key, value in state.items()}
            else:
                items = {name: state}
            log |= {
                f"Curriculum/{key}": value.item() if isinstance(value, torch.Tensor) else value
                for key, value in items.items()
                if value is not None
            }
        super().reset(env_ids)
        return log

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return the last results of each term. The results do not depend on `env_idx`."""
        terms = []
        for name, state in self._state.items():
            values = list(state.values()) if isinstance(state, dict) else [state]
            terms.append((name, [float(v) for v in values if v is not None]))
        return terms


class NullCurriculumManager(NullManager, CurriculumManager):
    """Curriculum manager without terms."""
