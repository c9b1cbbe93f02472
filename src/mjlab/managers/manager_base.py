"""What all managers share: a named, ordered list of terms, made from their configs.

A manager resolves each term once, when it is built: selections of scene elements in its parameters
are looked up, a class is replaced by an instance of it, and what does not fit is refused by name.
At run time a manager only calls its terms.
"""

from __future__ import annotations

import contextlib
import copy
import inspect
import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import torch

from mjlab.managers.build_checks import check_term
from mjlab.managers.config_edits import changes, plain_values, write_changes
from mjlab.managers.env_ids import EnvIds, as_index
from mjlab.managers.error_labels import errors_named
from mjlab.managers.real_values import check_real
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.table import format_table
from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass
class ManagerTermBaseCfg:
    """A term: what to call, and the parameters to call it with."""

    func: Any
    """A function, or a class that is built with `(cfg, env)` and whose instance is then called.
    An instance with a `reset(env_ids)` method is reset with its environments."""

    params: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the call. Values that are `SceneEntityCfg` are resolved first."""


@stateful
class ManagerTermBase:
    """Base of terms that are classes, for those that want its properties.

    Attributes that are tensors or numbers are run-time state: they are saved with a checkpoint and
    restored, except for those named in a class attribute `_transient`.
    """

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env = env

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._env.num_envs

    @property
    def device(self) -> str:
        """Device of the tensors that the term gets and returns."""
        return self._env.device

    @property
    def name(self) -> str:
        """Name of the term's class."""
        return type(self).__name__

    def reset(self, env_ids: torch.Tensor | slice | None) -> Any:
        """Start a new episode in the given environments (None: all)."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Compute the term's value; terms that managers call override this."""
        raise NotImplementedError(f"{self.name} must define __call__ to be used as a term.")


@stateful
class ManagerBase(ABC):
    """Base of all managers; a subclass builds its terms in `_prepare_terms`."""

    _transient = {"cfg", "_term_names", "_value_shape", "_built_values"}

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env = env
        self._value_shape = torch.Size((env.num_envs,))
        # Instances of class-based terms by label; kept here so that their state is saved.
        self._class_terms: dict[str, Any] = {}
        self._prepare_terms()
        self._built_values = {label: plain_values(cfg) for label, cfg in self._live_cfgs().items()}

    def __str__(self) -> str:
        """Return a table of the active terms."""
        header, rows = self._table()
        title = f"<{type(self).__name__}> with {len(rows)} active terms"
        return format_table(title, header, rows)

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._env.num_envs

    @property
    def device(self) -> str:
        """Device of all tensors."""
        return self._env.device

    @property
    @abstractmethod
    def active_terms(self) -> list[str] | dict[Any, list[str]]:
        """Names of the terms that are switched on, in order."""

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, Any]:
        """Start a new episode in the given environments (None: all) and return what to log."""
        self._reset_class_terms(env_ids)
        return {}

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return, for one environment, the name and the current values of each term."""
        return []

    def config_edits(self) -> dict[str, Any]:
        """Return what was changed in the configs of terms since they were built.

        It is run-time state (the stage of a curriculum, say) for `apply_config_edits` to restore:
        nested dicts of numbers, strings, tensors and sequences of those.
        """
        edits = {
            label: changes(self._built_values[label], plain_values(cfg))
            for label, cfg in self._live_cfgs().items()
        }
        return {label: edit for label, edit in edits.items() if edit}

    def apply_config_edits(self, edits: Mapping[str, Any]) -> None:
        """Bring configs to where they were when `config_edits` returned this.

        What it does not name is set to the value as built, because the configs may have been edited
        since, by a first reset say. Changes of terms that are gone are skipped.
        """
        for label, cfg in self._live_cfgs().items():
            undone = changes(plain_values(cfg), self._built_values[label])
            write_changes(cfg, copy.deepcopy(undone))
            write_changes(cfg, edits.get(label, {}))

    def _live_cfgs(self) -> dict[str, Any]:
        """Return the config that each term reads, by label."""
        return {}

    @abstractmethod
    def _prepare_terms(self) -> None:
        """Build the terms from the config."""

    def _table(self) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
        """Return the header and the rows of the printed table."""
        return ["name"], [[name] for name in self.active_terms]

    # Resolving terms.

    def _enabled(
        self, cfg: Mapping[str, T | None], kind: type[T], quiet: bool = False
    ) -> Iterator[tuple[str, T]]:
        """Yield the terms that are not None, having checked that they are of the right kind."""
        for name, term_cfg in cfg.items():
            if term_cfg is None:
                if not quiet:
                    logger.info("%s: term %r is None, so it is off.", type(self).__name__, name)
                continue
            if not isinstance(term_cfg, kind):
                raise TypeError(
                    f"{self._label(name)} must be a {kind.__name__} (or None to switch it off), "
                    f"got {type(term_cfg).__name__}: {term_cfg!r}."
                )
            yield name, term_cfg

    def _resolve_term(self, name: str, cfg: ManagerTermBaseCfg, leading: Sequence[str]) -> None:
        """Resolve the selections in `cfg.params`, and replace a class by an instance of it.

        Args:
            name: Name of the term, for messages.
            cfg: Config of the term, which this manager owns: it is changed.
            leading: Names of the positional arguments of the call, before the parameters.
        """
        self._resolve_params(name, cfg)
        if not callable(cfg.func):
            raise TypeError(
                f"{self._label(name)}: func must be a function or a class, got {cfg.func!r}."
            )
        self._make_callable(name, cfg, leading)

    def _make_callable(self, name: str, cfg: ManagerTermBaseCfg, leading: Sequence[str]) -> None:
        """Replace a class by an instance of it, and check that the term can be called."""
        if inspect.isclass(cfg.func):
            with errors_named(self._label(name)):
                cfg.func = cfg.func(cfg=cfg, env=self._env)
            if not callable(cfg.func):
                raise TypeError(f"{self._label(name)}: {type(cfg.func).__name__} has no __call__.")
        self._check_parameters(name, cfg, leading)
        with errors_named(self._label(name)):
            check_term(cfg.func, self._env, cfg.params)
        self._keep_class_term(name, cfg.func)

    def _resolve_params(self, name: str, cfg: ManagerTermBaseCfg) -> None:
        """Look up, in the scene, the top-level parameters that select elements of an entity."""
        for key, value in cfg.params.items():
            if not isinstance(value, SceneEntityCfg):
                continue
            try:
                value.resolve(self._env.scene)
            except (ValueError, KeyError) as error:
                message = f"{self._label(name)}, parameter {key!r}: {error.args[0]}"
                raise type(error)(message) from error

    def _check_parameters(self, name: str, cfg: ManagerTermBaseCfg, leading: Sequence[str]) -> None:
        """Raise TypeError now if calling the term would, because its parameters do not fit."""
        try:
            signature = inspect.signature(cfg.func)
        except (ValueError, TypeError):
            return
        try:
            signature.bind(*leading, **cfg.params)
        except TypeError as error:
            raise TypeError(
                f"{self._label(name)}: {_function_name(cfg.func)}{signature} cannot be called with "
                f"({', '.join(leading)}) and the parameters {list(cfg.params)}: {error}."
            ) from error

    def _keep_class_term(self, name: str, func: Any) -> None:
        if inspect.isroutine(func):
            return
        # A term written as a plain class has run-time state like any other. Types that do not
        # come from a class statement (functools.partial, say) cannot be marked and hold none.
        with contextlib.suppress(TypeError):
            stateful(type(func))
        self._class_terms[name] = func

    def _reset_class_terms(self, env_ids: EnvIds) -> None:
        for term in self._class_terms.values():
            reset = getattr(term, "reset", None)
            if callable(reset):
                reset(env_ids=as_index(env_ids))

    # Messages.

    def _label(self, name: str) -> str:
        return f"{type(self).__name__} term {name!r}"

    def _check_value(self, name: str, value: Any) -> None:
        """Raise unless `value` is a tensor with one entry for each environment."""
        if not isinstance(value, torch.Tensor):
            raise TypeError(
                f"{self._label(name)} must return a tensor of shape {tuple(self._value_shape)}, "
                f"got {type(value).__name__}: {value!r}."
            )
        if value.shape != self._value_shape:
            raise ValueError(
                f"{self._label(name)} returned shape {tuple(value.shape)}, expected "
                f"{tuple(self._value_shape)}: one value for each environment. Reduce the other "
                "dimensions (sum, mean, squeeze) in the term."
            )
        check_real(self._label(name), value)

    def _unknown(self, name: str, known: Sequence[str], error: type[Exception]) -> NoReturn:
        raise error(f"{type(self).__name__} has no term {name!r}. Its terms: {list(known)}.")


class TermListManager(ManagerBase):
    """A manager of one list of terms, whose config it copies."""

    _transient = {"_term_cfgs"}
    _cfg_type: type[ManagerTermBaseCfg] = ManagerTermBaseCfg
    _leading: Sequence[str] = ("env",)

    def __init__(self, cfg: Mapping[str, Any], env: ManagerBasedRlEnv) -> None:
        # Terms are copied one by one, so that one config used twice becomes two terms.
        self.cfg = {name: copy.deepcopy(term_cfg) for name, term_cfg in cfg.items()}
        super().__init__(env)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms that are switched on, in order."""
        return self._term_names

    def get_term_cfg(self, term_name: str) -> Any:
        """Return the live config of a term: what is changed in it takes effect at the next call.

        Raises `ValueError`, with the valid names, if there is no such term.
        """
        if term_name not in self._term_names:
            self._unknown(term_name, self._term_names, ValueError)
        return self._term_cfgs[self._term_names.index(term_name)]

    def _live_cfgs(self) -> dict[str, Any]:
        return dict(zip(self._term_names, self._term_cfgs, strict=True))

    def _prepare_terms(self) -> None:
        self._term_names: list[str] = []
        self._term_cfgs: list[Any] = []
        for name, term_cfg in self._enabled(self.cfg, self._cfg_type):
            self._resolve_term(name, term_cfg, self._leading)
            self._term_names.append(name)
            self._term_cfgs.append(term_cfg)


def _function_name(func: Any) -> str:
    return getattr(func, "__qualname__", type(func).__name__)
