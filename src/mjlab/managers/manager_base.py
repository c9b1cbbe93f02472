"""Base classes of managers: an ordered dict of terms built from their configs.

Terms are resolved once, when the manager is built: `SceneEntityCfg` parameters become element ids,
classes become instances, and invalid terms raise errors that name them. At run time a manager only
calls its terms.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import inspect
import logging
import warnings
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch

from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.utils.errors import UnknownNameError, UnsupportedError, WrongTypeError, check_exists
from mjlab.utils.indexing import as_index
from mjlab.utils.state import mark_stateful, stateful
from mjlab.utils.string import counted
from mjlab.utils.tables import Table, Tabular, function_name

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)
T = TypeVar("T")
TermT = TypeVar("TermT")


@dataclass
class ManagerTermBaseCfg:
    """Base term configuration: a callable and its parameters."""

    func: Any
    """Function, or class constructed with `(cfg, env)` whose instance is called. Instances with a
    `reset(env_ids)` method are reset with their environments."""

    params: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the call. `SceneEntityCfg` values are resolved first."""


@stateful
class ManagerTermBase:
    """Optional base class of class-based terms.

    Tensor and number attributes are run-time state: checkpoints save and restore them, except
    attributes listed in the class attribute `_transient`.
    """

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env = env

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._env.num_envs

    @property
    def device(self) -> str:
        """Device of the term's input and output tensors."""
        return self._env.device

    @property
    def name(self) -> str:
        """Name of the term's class."""
        return type(self).__name__

    def reset(self, env_ids: torch.Tensor | slice | None) -> Any:
        """Start a new episode in `env_ids` (None: all)."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Compute the term's value. Terms called by a manager override `__call__`."""
        raise UnsupportedError(f"{self.name} must define __call__ to be used as a term.")


@stateful
class ManagerBase(Tabular, ABC):
    """Base class of managers. Subclasses build their terms in `_prepare_terms`."""

    _transient = {"cfg", "_term_names", "_value_shape", "_live_cfgs"}
    # Name of the table of terms.
    _title = "terms"

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env = env
        self._value_shape = torch.Size((env.num_envs,))
        # Instances of class-based terms by label, referenced so that checkpoints save their state.
        self._class_terms: dict[str, Any] = {}
        # Config read by each term, by label.
        self._live_cfgs: dict[str, Any] = {}
        self._prepare_terms()

    def __repr__(self) -> str:
        count = sum(len(table.rows) for table in self.tables())
        return f"<{type(self).__name__}> with {counted(count, 'active term')}"

    def tables(self) -> list[Table]:
        """Return the table of the active terms."""
        return [Table(self._title, ("term",), [(name,) for name in self.active_terms])]

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
        """Names of the enabled terms, in order."""

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, Any]:
        """Start a new episode in `env_ids` (None: all) and return values to log.

        Resets class-based terms; the log is empty.
        """
        for term in self._class_terms.values():
            reset = getattr(term, "reset", None)
            if callable(reset):
                reset(env_ids=as_index(env_ids))
        return {}

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return the name and the current values of each term in one environment."""
        return []

    def live_cfgs(self) -> dict[str, Any]:
        """Return the config that each term reads, by label."""
        return self._live_cfgs

    # Hooks and helpers of subclasses.

    @abstractmethod
    def _prepare_terms(self) -> None:
        """Build the terms from the config, and set `_live_cfgs`."""

    def _label(self, name: str) -> str:
        return f"{type(self).__name__} term {name!r}"

    def _enabled(
        self, cfg: Mapping[str, T | None], kind: type[T], quiet: bool = False
    ) -> Iterator[tuple[str, T]]:
        """Yield the terms that are not None. Raises `TypeError` if a term lacks fields of `kind`."""
        for name, term_cfg in cfg.items():
            if term_cfg is None:
                if not quiet:
                    logger.info("%s: term %r is None (disabled).", type(self).__name__, name)
                continue
            # Packages may use config classes with the same fields.
            if not all(hasattr(term_cfg, field.name) for field in dataclasses.fields(kind)):  # ty: ignore
                raise WrongTypeError(
                    f"{self._label(name)}: expected {kind.__name__}, or None to disable the term, "
                    f"got {type(term_cfg).__name__}: {term_cfg!r}."
                )
            yield name, term_cfg

    def _resolve_term(self, name: str, cfg: ManagerTermBaseCfg, leading: Sequence[str]) -> None:
        """Resolve the selections in `cfg.params`, and replace a class by its instance.

        Args:
            name: Name of the term, for messages.
            cfg: Config of the term, owned by this manager and modified in place.
            leading: Names of the positional arguments of the call, before the parameters.
        """
        self._resolve_params(name, cfg)
        with label_errors(self._label(name)):
            if inspect.isclass(cfg.func):
                cfg.func = cfg.func(cfg=cfg, env=self._env)
            self._check_call(cfg, leading)
        if not inspect.isroutine(cfg.func):
            # Plain classes have run-time state too.
            mark_stateful(cfg.func, self.num_envs)
            self._class_terms[name] = cfg.func

    def _check_call(self, cfg: ManagerTermBaseCfg, leading: Sequence[str]) -> None:
        """Raise the `TypeError` of the call now: events and curricula are called late."""
        try:
            # Of a decorated term, that of the decorator's function.
            signature = inspect.signature(cfg.func, follow_wrapped=False)
        except ValueError:
            return  # Compiled functions may have none.
        try:
            signature.bind(*leading, **cfg.params)
        except TypeError as error:
            raise WrongTypeError(f"params: {error}; the term takes {signature}.") from error
        for name, parameter in signature.parameters.items():
            default = parameter.default
            is_used = name not in cfg.params and isinstance(default, SceneEntityCfg)
            if is_used and default.selected_kinds():
                warnings.warn(
                    f"Parameter {name!r} of {function_name(cfg.func)}: expected a selection in params, "
                    "got the default, which is not resolved; the term uses all elements.",
                    UserWarning,
                    stacklevel=2,
                )

    def _resolve_params(self, name: str, cfg: ManagerTermBaseCfg) -> None:
        """Resolve the `SceneEntityCfg` parameters in the scene, also those within containers."""
        for key, value in cfg.params.items():
            self._resolve_selections(f"{self._label(name)}, parameter {key!r}", value)

    def _resolve_selections(self, label: str, value: Any, is_nested: bool = False) -> None:
        """Resolve every `SceneEntityCfg` in a dict, list, tuple or dataclass, in place."""
        if isinstance(value, SceneEntityCfg):
            try:
                with label_errors(label):
                    # A nested selection of no elements needs no ids, and its entity may be optional.
                    if value.selected_kinds() or not is_nested:
                        value.resolve(self._env.scene)
            except (KeyError, ValueError) as error:
                # Releases 1.x leave nested selections unresolved.
                if not is_nested:
                    raise
                warnings.warn(
                    f"{error.args[0]} The selection stays unresolved: its ids are those of all elements.",
                    UserWarning,
                    stacklevel=2,
                )
            # A nested selection may be empty on purpose.
            for field in () if is_nested else value.empty_selections():
                warnings.warn(
                    f"{label}: expected {field} of entity {value.name!r}, got none; name the elements, "
                    "or set the term to None.",
                    UserWarning,
                    stacklevel=2,
                )
            return
        if isinstance(value, (list, tuple)):
            inner = list(enumerate(value))
        else:
            inner = list(value.items()) if isinstance(value, dict) else config_items(value) or ()
        for key, item in inner:
            self._resolve_selections(f"{label}[{key!r}]", item, is_nested=True)

    def _evaluate(self, name: str, cfg: ManagerTermBaseCfg) -> torch.Tensor:
        """Call a term. Raises unless it returns a tensor with one value per environment."""
        value = cfg.func(self._env, **cfg.params)
        shape = getattr(value, "shape", None)
        if shape != self._value_shape:
            raise ValueError(
                f"{self._label(name)}: expected a tensor of shape {tuple(self._value_shape)}, one value "
                f"per environment, got {repr(value) if shape is None else tuple(shape)}; reduce other "
                "dimensions (sum, mean, squeeze) in the term."
            )
        return value


class TermListManager(ManagerBase):
    """Manager of one list of function or class terms. The config is copied."""

    _transient = {"_term_cfgs"}
    _cfg_type: type[ManagerTermBaseCfg] = ManagerTermBaseCfg
    _leading: Sequence[str] = ("env",)
    # Config fields shown in the table, by column.
    _shown: Mapping[str, str] = {}

    def __init__(self, cfg: Mapping[str, Any], env: ManagerBasedRlEnv) -> None:
        # One copy per term: a config used twice must become two terms.
        self.cfg = {name: copy.deepcopy(term_cfg) for name, term_cfg in cfg.items()}
        super().__init__(env)

    def tables(self) -> list[Table]:
        """Return the table of the active terms."""
        columns = ("term", *self._shown, "function", "parameters")
        rows = [
            (
                name,
                *(getattr(cfg, field) for field in self._shown.values()),
                function_name(cfg.func),
                cfg.params,
            )
            for name, cfg in self._live_cfgs.items()
        ]
        return [Table(self._title, columns, rows)]

    @property
    def active_terms(self) -> list[str]:
        """Names of the enabled terms, in order."""
        return self._term_names

    def get_term_cfg(self, term_name: str) -> Any:
        """Return the live config of a term. Edits take effect at the next call.

        Raises `ValueError`, listing the valid names, if the term is unknown.
        """
        check_exists(f"{type(self).__name__} term", term_name, self._term_names)
        return self._term_cfgs[self._term_names.index(term_name)]

    def _prepare_terms(self) -> None:
        self._term_names: list[str] = []
        self._term_cfgs: list[Any] = []
        for name, term_cfg in self._enabled(self.cfg, self._cfg_type):
            self._resolve_term(name, term_cfg, self._leading)
            self._term_names.append(name)
            self._term_cfgs.append(term_cfg)
            self._live_cfgs[name] = term_cfg


class BuiltTermsManager(ManagerBase, Generic[TermT]):
    """Manager of terms constructed by `build` of their configs. The config is kept by reference."""

    _cfg_type: type[Any]
    # Class of the terms. `object`: terms of any class.
    _term_type: type[Any] = object

    def __init__(self, cfg: Mapping[str, Any], env: ManagerBasedRlEnv) -> None:
        self.cfg = cfg
        self._terms: dict[str, TermT] = {}
        super().__init__(env)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms, in order."""
        return list(self._terms)

    def live_cfgs(self) -> dict[str, Any]:
        """Return the config that each term reads, by name. Curricula may replace `term.cfg`."""
        return {
            name: getattr(self._terms[name], "cfg", cfg) for name, cfg in self._live_cfgs.items()
        }

    def get_term(self, name: str) -> TermT:
        """Return the term `name`. Raises `KeyError`, listing the valid names, if unknown."""
        if name not in self._terms:
            check_exists(f"{type(self).__name__} term", name, self._terms, UnknownNameError)
        return self._terms[name]

    def _prepare_terms(self) -> None:
        for name, term_cfg in self._enabled(self.cfg, self._cfg_type):
            for key, value in config_items(term_cfg) or ():
                self._resolve_selections(
                    f"{self._label(name)}, field {key!r}", value, is_nested=True
                )
            with label_errors(self._label(name)):
                term = term_cfg.build(self._env)
            if not isinstance(term, self._term_type):
                raise WrongTypeError(
                    f"{self._label(name)}: expected {type(term_cfg).__name__}.build to return "
                    f"{self._term_type.__name__}, got {type(term).__name__}."
                )
            mark_stateful(term, self.num_envs)
            self._terms[name] = term
            self._live_cfgs[name] = getattr(term, "cfg", term_cfg)


class NullManager:
    """Mixin of managers without terms. The constructor takes no environment."""

    def __init__(self) -> None:
        super().__init__({}, SimpleNamespace(num_envs=0, device="cpu"))  # ty: ignore
        self.cfg = None

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return an empty list."""
        return []


@contextlib.contextmanager
def label_errors(label: str) -> Generator[None]:
    """Prefix messages of `KeyError`, `TypeError` and `ValueError` in the block with `label`.

    Errors raised while a term is built state the cause but not the term. The error type is kept,
    unless the type cannot be constructed from a message alone; the error then becomes the
    `KeyError`, `TypeError` or `ValueError` it derives from.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError) as error:
        # str() of a KeyError is the repr of its message; the argument is the message itself.
        details = error.args[0] if len(error.args) == 1 else error
        message = f"{label}: {details}"
        try:
            labeled = type(error)(message)
        except TypeError:
            kind = next(k for k in (KeyError, TypeError, ValueError) if isinstance(error, k))
            labeled = kind(message)
        raise labeled from error


def config_items(cfg: Any) -> list[tuple[str, Any]] | None:
    """Return the string keys of a dict or the fields of a config, with values; else None."""
    if isinstance(cfg, dict):
        return [(key, value) for key, value in cfg.items() if isinstance(key, str)]
    if dataclasses.is_dataclass(cfg) and not isinstance(cfg, type):
        return [(field.name, getattr(cfg, field.name)) for field in dataclasses.fields(cfg)]
    return None
