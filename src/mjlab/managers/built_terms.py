"""What managers share whose terms are made by their configs' `build`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from mjlab.managers.error_labels import errors_named
from mjlab.managers.manager_base import ManagerBase

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


class BuildsTerm(Protocol):
    """A config that says in `build` which term it makes."""

    def build(self, env: ManagerBasedRlEnv) -> Any:
        """Return the term."""


class HasCfg(Protocol):
    """A term that keeps its config."""

    cfg: Any


TermT = TypeVar("TermT", bound=HasCfg)


class BuiltTermsManager(ManagerBase, Generic[TermT]):
    """A manager that holds terms by name and keeps its config by reference."""

    _cfg_type: type[BuildsTerm]
    _term_type: type[TermT]

    def __init__(self, cfg: Mapping[str, Any], env: ManagerBasedRlEnv) -> None:
        self.cfg = cfg
        self._terms: dict[str, TermT] = {}
        super().__init__(env)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms, in order."""
        return list(self._terms)

    def get_term(self, name: str) -> TermT:
        """Return a term; raises `KeyError`, with the valid names, if there is none."""
        if name not in self._terms:
            self._unknown(name, self.active_terms, KeyError)
        return self._terms[name]

    def _prepare_terms(self) -> None:
        for name, term_cfg in self._enabled(self.cfg, self._cfg_type):
            with errors_named(self._label(name)):
                term = term_cfg.build(self._env)
            if not isinstance(term, self._term_type):
                raise TypeError(
                    f"{self._label(name)}: {type(term_cfg).__name__}.build must return an "
                    f"instance of {self._term_type.__name__}, got {type(term).__name__}."
                )
            self._terms[name] = term

    def _live_cfgs(self) -> dict[str, Any]:
        return {name: term.cfg for name, term in self._terms.items()}
