"""Settings of a run: differences from the registered config, recorded and applied again.

Settings map dotted paths of flags to plain values: `{"env.decimation": 2, "env.rewards.upright": None}`.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import enum
import importlib
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from mjlab.utils.os import regular_file, to_plain
from mjlab.utils.setting_paths import OF_THE_MACHINE, is_below

C = TypeVar("C")
Settings = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Unread:
    """Object in a YAML file of releases 1.x that only they can read: a function, or an enum."""

    tag: str
    """Its tag."""


# Flags of the machine, the session and its log, and not of the policy.
_OF_THE_SESSION = (
    *(f"env.{path}" for path in OF_THE_MACHINE),
    "agent.seed", "agent.resume", "agent.load_run", "agent.load_checkpoint", "agent.run_name",
    "agent.experiment_name", "agent.logger", "agent.wandb_project", "agent.wandb_tags",
    "agent.neptune_project", "agent.upload_model", "agent.save_git_diff", "agent.upload_git_diff",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Difference:
    """Value of a config that differs from a recorded one. Values are plain; removed terms are None."""

    path: str
    """Dotted path, such as `env.rewards.upright.weight`."""
    now: Any
    """Value of the config."""
    recorded: Any
    """Recorded value."""


def is_of_the_session(path: str) -> bool:
    """Return True for flags of the machine, the session and its log, and not of the policy."""
    return is_below(path, _OF_THE_SESSION)


def differences(cfg: Any, recorded: Any, path: str) -> Iterator[Difference]:
    """Yield the differences between a config and the plain form of another, in depth.

    Fields that `recorded` lacks are skipped, because earlier versions did not have them.

    Args:
        cfg: Dataclass, dict, list, tuple or value.
        recorded: Result of `to_plain`, or read from YAML.
        path: Path of `cfg`: "env", "agent" or "options".
    """
    if is_of_the_session(path):
        return
    if is_dataclass(cfg) and isinstance(recorded, Mapping):
        for field in dataclasses.fields(cfg):
            if field.name in recorded:
                inner = f"{path}.{field.name}"
                yield from differences(getattr(cfg, field.name), recorded[field.name], inner)
    elif isinstance(cfg, Mapping) and isinstance(recorded, Mapping):
        own = {to_plain(key): value for key, value in cfg.items()}
        values = (*own.values(), *recorded.values())
        if own.keys() != recorded.keys() and all(_is_plain(value) for value in values):
            # Such as another set of joint patterns: it holds as a whole.
            yield Difference(path, to_plain(cfg), dict(recorded))
            return
        for key in dict.fromkeys((*own, *recorded)):
            yield from differences(own.get(key), recorded.get(key), f"{path}.{key}")
    elif _holds_configs(cfg) and isinstance(recorded, list) and len(cfg) == len(recorded):
        for number, (one, other) in enumerate(zip(cfg, recorded, strict=True)):
            yield from differences(one, other, f"{path}.{number}")
    elif (now := to_plain(cfg)) != recorded and not isinstance(recorded, Unread):
        yield Difference(path, now, recorded)


def _is_plain(value: Any) -> bool:
    return value is not None and not is_dataclass(value) and not isinstance(value, Mapping)


def _holds_configs(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and any(is_dataclass(item) for item in value)


def typed_settings(cfg: Any, path: str, flags: list[str]) -> Settings:
    """Return the settings that the command line `flags` sets, with their values in the parsed `cfg`.

    A typed value counts even if it is the registered one.

    Args:
        cfg: Config.
        path: Path of the config: "env", "agent" or "options".
        flags: Command line.
    """
    names = {_flag(word.partition("=")[0]) for word in flags if word.startswith("--")}

    def typed(value: Any, leaf: str) -> Iterator[tuple[str, Any]]:
        # Options of a task look like flags of the command.
        if f"--{_flag(leaf.removeprefix('options.'))}" in names and not is_dataclass(value):
            yield leaf, to_plain(value)
        elif is_dataclass(value):
            for field in dataclasses.fields(value):
                yield from typed(getattr(value, field.name), f"{leaf}.{field.name}")
        elif isinstance(value, Mapping) or _holds_configs(value):
            items = value.items() if isinstance(value, Mapping) else enumerate(value)
            for key, item in items:
                yield from typed(item, f"{leaf}.{to_plain(key)}")

    return {leaf: value for leaf, value in typed(cfg, path) if not is_of_the_session(leaf)}


def _flag(path: str) -> str:
    """Return `path` as it is spelled in flags, where a key that begins with a dot loses it."""
    return path.replace("_", "-").replace("..", ".")


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the plain data of a config in YAML; empty if missing or unreadable.

    Nothing is imported: Python objects in files of releases 1.x are read as lists or `Unread`.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        pass

    def construct(loader: Any, tag: str, node: Any) -> Any:
        return loader.construct_sequence(node, deep=True) if tag == "tuple" else Unread(tag)

    Loader.add_multi_constructor("tag:yaml.org,2002:python/", construct)
    try:
        # A subclass of the safe loader.
        params = yaml.load(regular_file(path).read_text(encoding="utf-8"), Loader)
        if not isinstance(params, dict):
            raise ValueError(f"expected entries, got {type(params).__name__}")
        return params
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        warn_unreadable(path, error)
        return {}


def warn_unreadable(path: Path, error: Exception) -> None:
    """Warn that a file of a run folder was left out."""
    reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:100]
    message = f"{path} cannot be read ({reason}); using the rest of the run folder."
    warnings.warn(message, UserWarning, stacklevel=3)


# Application.


def apply_settings(cfg: C, settings: Mapping[str, Any], path: str) -> tuple[C, dict[str, str]]:
    """Return a copy of `cfg` with the settings below `path`, and the reasons for those left out.

    Values are converted to the types of the fields. Runs may be of other people: in the config of
    the learner, which imports names such as `module:function`, only networks of this package are
    accepted.
    """
    left_out: dict[str, str] = {}
    for name, value in settings.items():
        first, _, rest = name.partition(".")
        if first != path or not rest or is_of_the_session(name):
            continue
        try:
            is_safe = name == "agent.teacher_checkpoint" or _is_safe(name, value)
            if path == "agent" and not is_safe:
                raise TypeError("code named by a run is not imported; set it by its flag")
            cfg = _updated(cfg, type(cfg), rest.split("."), value)
        except (KeyError, IndexError, AttributeError):
            left_out[name] = "not part of this config"
        except (TypeError, ValueError, RecursionError) as error:
            left_out[name] = str(error)
    return cfg, left_out


def with_changes(cfg: Any, changed: Any, registered: Any) -> Any:
    """Return a copy of `cfg` with the changes from `registered` to `changed`, in depth.

    Changed entries of dicts that `cfg` lacks, such as rewards for training only, are left out.
    """
    if is_dataclass(cfg) and type(cfg) is type(changed) is type(registered):
        made = copy.copy(cfg)
        for field in dataclasses.fields(cfg):
            parts = (getattr(one, field.name) for one in (cfg, changed, registered))
            # Also fields of frozen dataclasses.
            object.__setattr__(made, field.name, with_changes(*parts))
        return made
    if isinstance(cfg, dict) and isinstance(changed, dict) and isinstance(registered, dict):
        removed = registered.keys() - changed.keys()
        made = {key: value for key, value in cfg.items() if key not in removed}
        for key, value in changed.items():
            if key not in registered:
                made[key] = copy.deepcopy(value)
            elif key in made:
                made[key] = with_changes(made[key], value, registered[key])
        return made
    is_list = _holds_configs(cfg) and type(cfg) is type(changed) is type(registered)
    if is_list and len(cfg) == len(changed) == len(registered):
        return type(cfg)(map(with_changes, cfg, changed, registered))
    return copy.deepcopy(cfg if to_plain(changed) == to_plain(registered) else changed)


def _updated(holder: Any, declared: Any, parts: list[str], value: Any) -> Any:
    """Return a copy of `holder` with the plain `value` at `parts`."""
    if not parts:
        return _typed(value, declared, holder)
    key, *rest = parts
    if is_dataclass(holder):
        if key not in {field.name for field in dataclasses.fields(holder)}:
            raise KeyError(key)
        new = _updated(getattr(holder, key), _field_types(holder).get(key, Any), rest, value)
        holder = copy.copy(holder)
        # Also fields of frozen dataclasses.
        object.__setattr__(holder, key, new)
        return holder
    if isinstance(holder, dict):
        names = {str(to_plain(name)): name for name in holder}
        # Keys may contain dots.
        while key not in names and rest:
            key, rest = f"{key}.{rest[0]}", rest[1:]
        name, inner = names.get(key, key), _type_of_values(declared)
        if value is None and not rest and (name not in holder or is_dataclass(holder[name])):
            # A term that is switched off, or that this config does not have.
            return {**holder, name: None} if name in holder else holder
        if name not in holder and (isinstance(value, dict) or _is_config(inner)):
            raise KeyError(name)
        return {**holder, name: _updated(holder.get(name), inner, rest, value)}
    if isinstance(holder, (list, tuple)):
        items = list(holder)
        items[int(key)] = _updated(items[int(key)], Any, rest, value)
        return type(holder)(items)
    raise KeyError(key)


def _type_of_values(declared: Any) -> Any:
    """Return the type of the values of a dict, also if it may be None."""
    options = (declared, *get_args(declared))
    return next((get_args(o)[1] for o in options if get_origin(o) is dict), Any)


def _is_config(declared: Any) -> bool:
    return any(is_dataclass(option) for option in (declared, *get_args(declared)))


def _field_types(cfg: Any) -> dict[str, Any]:
    try:
        return get_type_hints(type(cfg))
    except NameError:
        # Annotations imported under TYPE_CHECKING cannot be resolved.
        return {}


def _typed(value: Any, declared: Any, current: Any) -> Any:
    """Return the plain `value` as the type `declared`, or as that of `current` where any is allowed.

    Raises:
        TypeError: it has another type.
    """
    origin, arguments = get_origin(declared), get_args(declared)
    if declared is Any:
        numbers = isinstance(current, int | float) and isinstance(value, int | float)
        return value if current is None or numbers else _typed(value, type(current), current)
    if origin in (Union, UnionType):
        for option in arguments:
            with contextlib.suppress(TypeError):
                return _typed(value, option, current)
    elif value is None and declared is NoneType:
        return None
    elif origin is Literal and value in arguments:
        return value
    elif (kind := origin or declared) in (tuple, list) and isinstance(value, list):
        each = arguments[:1] * len(value) if kind is list or ... in arguments else arguments
        each = each if len(each) == len(value) else (Any,) * len(value)
        items = zip(value, each, [*(current or ()), *[None] * len(value)], strict=False)
        return kind(_typed(*item) for item in items)
    elif kind is dict and isinstance(value, dict):
        each_value, now = (*arguments, Any, Any)[1], current if isinstance(current, dict) else {}
        return {key: _typed(item, each_value, now.get(key)) for key, item in value.items()}
    elif isinstance(declared, enum.EnumType) and value in declared.__members__:
        return declared[value]
    elif declared is float and type(value) is int:
        return float(value)
    elif type(value) is kind:
        return value
    raise TypeError(f"expected {getattr(declared, '__name__', declared)}, got {value!r}")


def _is_safe(path: str, value: Any) -> bool:
    """Return True if nothing in `value` is imported, except networks of this package."""
    if isinstance(value, dict):
        return all(_is_safe(f"{path}.{key}", item) for key, item in value.items())
    if isinstance(value, list):
        return all(_is_safe(path, item) for item in value)
    return not isinstance(value, str) or value.isidentifier() or _is_own_network(path, value)


def _is_own_network(path: str, value: str) -> bool:
    from torch import nn

    module, _, name = value.partition(":")
    if not path.endswith(".class_name") or not module.startswith("mjlab."):
        return False
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return False
    return isinstance(found, type) and issubclass(found, nn.Module)
