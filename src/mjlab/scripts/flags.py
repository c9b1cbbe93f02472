"""Flags of the commands: from `argv` to a config.

- tyro reads the flags of a dataclass; `--env.rewards.<term> None` switches a term off.
- `--profile` and `--learner` decide which other flags exist and their defaults, so that they are
  read first. A command that continues a run takes those of the run.
- Tasks add flags of their own (`mjlab.tasks.registry.TaskOptions`).
"""

from __future__ import annotations

import ast
import copy
import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

import mjlab
from mjlab.scripts.run_folder import read_run_info
from mjlab.tasks.registry import (
    PolicyOrigin,
    TaskOptions,
    list_profiles,
    load_options_cls,
    load_rl_cfg,
)
from mjlab.utils.logging import print_notice

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnvCfg

C = TypeVar("C")

CPU_PROFILE = "cpu"
"""Name of the profile that `train` suggests on a CPU."""
_CHOICES = ("profile", "learner")
# Field that holds the options of a task.
_FIELD = "options"
# Fields that hold terms by name. Observation terms are below their group, as `terms`.
_TERM_DICTS = frozenset(
    (
        "observations",
        "terms",
        "actions",
        "rewards",
        "terminations",
        "events",
        "commands",
        "curriculum",
        "metrics",
        "recorders",
    )
)

_Spec = PrimitiveConstructorSpec | UnsupportedTypeAnnotationError | None
_SEQUENCES = (tuple, list)


def parse_flags(config_type: type[C], default: C, flags: list[str], prog: str) -> C:
    """Return `default` with the fields replaced that `flags` name; exits on an unknown flag.

    `--env.rewards.<term> None`, and the like for every other kind of term, switches the term off;
    `None` also removes a config inside another where the field may be None, such as a term's noise.
    """
    arguments = _arguments(config_type, default, flags, prog)
    return tyro.cli(config_type, **arguments)


def parse_known_flags(
    config_type: type[C], default: C, flags: list[str], prog: str
) -> tuple[C, list[str]]:
    """Return what `parse_flags` does, and the flags that are unknown, which have no effect."""
    arguments = _arguments(config_type, default, flags, prog)
    return tyro.cli(config_type, return_unknown_args=True, **arguments)


def _arguments(config_type: Any, default: Any, flags: list[str], prog: str) -> dict[str, Any]:
    edited, flags = switch_terms_off(default, flags)
    return {
        "default": edited,
        "args": _with_explicit_switches(config_type, flags),
        "prog": prog,
        "config": mjlab.TYRO_FLAGS,
        "registry": flag_rules(),
    }


def is_given(flag: str, flags: list[str]) -> bool:
    """Return whether the command line `flags` sets `flag`, with `-` or `_` between its words."""
    return any(word.partition("=")[0].replace("_", "-") == flag for word in flags)


def _with_explicit_switches(config_type: Any, flags: list[str]) -> list[str]:
    """Read a bare `--video` as `--video True`, for the switches of `config_type` itself."""
    switches = {
        "--" + field.name.replace("_", "-")
        for field in dataclasses.fields(config_type)
        if field.type in ("bool", bool)
    }
    explicit: list[str] = []
    for position, flag in enumerate(flags):
        explicit.append(flag)
        following = flags[position + 1] if position + 1 < len(flags) else None
        bare = following is None or following.startswith("--")
        if flag.replace("_", "-") in switches and bare:
            explicit.append("True")
    return explicit


# Profile and learner.


def parse_with_choices(
    make_default: Callable[..., C],
    recorded: Callable[[C, Mapping[str, str | None]], Mapping[str, str | None]],
    flags: list[str],
    prog: str,
) -> C:
    """Return what `flags` make of the defaults under the choices that they name.

    Args:
        make_default: Returns the defaults under choices, given as keywords; those not given are the
            task's.
        recorded: Returns the choices of the run at hand that differ from the task's. Its arguments
            are what the flags make of the defaults, and the choices that they name, which it need
            not look for.
        flags: The command line.
        prog: The command, for messages.

    Raises:
        UnknownProfileError: the task has no such profile; the message lists those it has.
        ValueError: the learner is unknown.
    """
    given = asked_choices(flags)
    default = make_default(**given)
    if len(given) == len(_CHOICES):
        return parse_flags(type(default), default, flags, prog)
    # The learner of the run at hand may have flags that the task's has not.
    cfg, unknown = parse_known_flags(type(default), default, flags, prog)
    choices = {**recorded(cfg, given), **given}
    if choices == given and not unknown:
        return cfg
    default = make_default(**choices)
    return parse_flags(type(default), default, flags, prog)


def asked_choices(flags: list[str]) -> dict[str, str | None]:
    """Return the choices that `flags` name; None where they say `None`."""
    choices: dict[str, str | None] = {}
    for position, flag in enumerate(flags):
        name, equals, value = flag.partition("=")
        name = name.removeprefix("--")
        if name not in _CHOICES or name == flag:
            continue
        if not equals:
            # Without a value, the parser has a message for it.
            value = flags[position + 1] if position + 1 < len(flags) else "None"
        choices[name] = None if value == "None" else value
    return choices


def profile_of_run(task: str, run_dir: Path) -> str | None:
    """Return the profile of `task` that the run in `run_dir` was made with, or None."""
    profile = read_run_info(run_dir).get("profile")
    if not isinstance(profile, str):
        return None
    if profile not in list_profiles(task):
        print_notice(
            f"The run in {run_dir} was made with the profile {profile!r}, which {task} does not "
            "have; the task's own settings are used."
        )
        return None
    return profile


def suggest_profile(task: str, profile: str | None, device: str) -> None:
    """Say in one line that there is a profile for training on a CPU, if it is of use here."""
    if profile is None and device == "cpu" and CPU_PROFILE in list_profiles(task):
        print_notice(
            f"Training on the CPU: `train {task} --profile {CPU_PROFILE}` has settings for a "
            "few cores."
        )


def tell_foreign_learner(task: str, profile: str | None, learner: str) -> None:
    """Say in one line that a profile has no settings for a learner, if it has those of another."""
    from mjlab.rl.learners import learner_of

    # A student is made like the profile's teacher.
    if profile is None or learner == "distillation":
        return
    tuned = learner_of(load_rl_cfg(task, profile=profile))
    if tuned != learner:
        print_notice(
            f"The profile {profile!r} of {task} has settings for the learner {tuned!r}: its environment "
            f"is used, while networks, algorithm and iterations of {learner!r} are those without it."
        )


# Flags of tasks.


def with_task_options(cfg: C, task: str) -> C:
    """Return the flags of a command with those of the task's own, if it has any.

    Args:
        cfg: A dataclass, the flags with their defaults.
        task: Name of the task.

    Raises:
        UnknownTaskError, TaskImportError: there is no such task, or its options cannot be imported.
        ValueError: an option of the task has the name of a flag of the command.
    """
    options = load_options_cls(task)
    if options is None:
        return cfg
    own: Any = cfg
    values = {field.name: getattr(own, field.name) for field in dataclasses.fields(own)}
    taken = sorted({field.name for field in dataclasses.fields(options)} & values.keys())
    if taken:
        raise ValueError(
            f"The options of task {task!r} ({options.__name__}) have {taken}, which are flags of "
            "the command already; give them other names."
        )
    # Without a prefix, as if the fields were the command's own.
    annotation: Any = Annotated[options, tyro.conf.arg(name="")]  # ty: ignore[invalid-type-form]
    kind: Any = dataclasses.make_dataclass(
        type(cfg).__name__,
        [(_FIELD, annotation, dataclasses.field(default_factory=options))],
        bases=(type(cfg),),
        namespace={"__doc__": type(cfg).__doc__, "__module__": type(cfg).__module__},
    )
    return kind(**values)


def options_of(task: str, cfg: Any) -> TaskOptions:
    """Return the task's options in the flags of a command, or their defaults."""
    options = getattr(cfg, _FIELD, None)
    if options is not None:
        return options
    return (load_options_cls(task) or TaskOptions)()


def prepare_env_cfg(
    task: str,
    cfg: Any,
    env_cfg: ManagerBasedRlEnvCfg,
    checkpoint: Path | None,
    wandb_run_path: str | None = None,
) -> None:
    """Let the task get what it needs before its environment is built; `env_cfg` is edited.

    Args:
        task: Name of the task.
        cfg: The flags of the command, or None for the task's defaults.
        env_cfg: The environment's config.
        checkpoint: The checkpoint of the policy that is to act, if there is one.
        wandb_run_path: Where the checkpoint was fetched from, if it was.

    Raises:
        ValueError: what the task needs is not there.
    """
    origin = PolicyOrigin(task, checkpoint, wandb_run_path)
    options_of(task, cfg).prepare(env_cfg, origin)


# Terms switched off.


def switch_terms_off(default: C, flags: list[str]) -> tuple[C, list[str]]:
    """Return `default` without the terms and configs `flags` set to None, and the remaining flags.

    All other flags remain, for tyro to judge. `default` itself is not modified.
    """
    config = copy.deepcopy(default)
    remaining: list[str] = []
    for flag, value, words in _flag_values(flags):
        holder, name = _term_at(config, flag) if value == "None" else (None, "")
        if holder is None:
            remaining += words
        elif isinstance(holder, dict):
            holder[name] = None
        else:
            setattr(holder, name, None)
    return config, remaining


def _flag_values(flags: list[str]) -> Iterator[tuple[str, str | None, list[str]]]:
    """Yield every flag with its value, and the words that it was made of.

    `--flag value` and `--flag=value` mean the same; values after the first are words of their own.
    """
    position = 0
    while position < len(flags):
        word = flags[position]
        flag, equals, value = word.partition("=")
        if equals:
            yield flag, value, [word]
        elif word.startswith("--") and flags[position + 1 : position + 2] == ["None"]:
            yield word, "None", [word, "None"]
            position += 1
        else:
            yield word, None, [word]
        position += 1


def _term_at(config: Any, flag: str) -> tuple[Any, str]:
    """Return the dict or config that holds what `flag` names, and its key; (None, "") if none does."""
    if not flag.startswith("--"):
        return None, ""
    holder: Any = None
    value, key, inside = config, "", ""
    for part in flag.removeprefix("--").split("."):
        inside, holder = key, value
        if holder is None:
            return None, ""
        names = list(holder) if isinstance(holder, Mapping) else list(vars(holder))
        # tyro writes `smooth_reward` as `smooth-reward` and takes both.
        spelled = {str(name).replace("_", "-"): name for name in reversed(names)}
        key = spelled.get(part.replace("_", "-"))
        if not isinstance(key, str):
            return None, ""
        value = holder[key] if isinstance(holder, Mapping) else getattr(holder, key)
        if not is_dataclass(value) and not isinstance(value, Mapping | None):
            return None, ""
    is_term = isinstance(holder, dict) and inside in _TERM_DICTS
    return (holder, key) if is_term or _may_be_none(holder, key) else (None, "")


def _may_be_none(holder: Any, key: str) -> bool:
    """Return True if field `key` of a config is declared as a config, or a dict of one, or None."""
    if not is_dataclass(holder):
        return False
    try:
        options = get_args(get_type_hints(type(holder)).get(key))
    except NameError:
        # A class annotated with names that only type checkers import says nothing here.
        return False
    return NoneType in options and any(
        is_dataclass(option) or get_origin(option) is dict for option in options
    )


# Values that tyro alone does not read: lists for tuples, and tensors.


def flag_rules() -> ConstructorRegistry:
    """Return the rules, for `tyro.cli(registry=...)`."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_tensor_rule)
    registry.primitive_rule(_SequenceRule())
    return registry


def _tensor_rule(info: PrimitiveTypeInfo) -> _Spec:
    # A command whose flags are no tensors need not import torch for its `--help`.
    torch = sys.modules.get("torch")
    if torch is None or info.type is not torch.Tensor:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="[FLOAT,...]",
        instance_from_str=lambda args: _tensor(args[0]),
        is_instance=lambda value: isinstance(value, info.type),
        str_from_instance=lambda value: [repr(value.tolist())],
    )


def _tensor(text: str) -> torch.Tensor:
    import torch

    try:
        return torch.tensor(ast.literal_eval(text), dtype=torch.float32)
    except (ValueError, SyntaxError, TypeError) as error:
        raise ValueError(f"expected numbers in brackets, got {text!r}: {error}") from error


class _SequenceRule:
    """tyro's own rule for tuples and lists, given the brackets that the declared type wants."""

    def __init__(self) -> None:
        self._is_asking_tyro = False

    def __call__(self, info: PrimitiveTypeInfo) -> _Spec:
        if self._is_asking_tyro or info.type_origin not in _SEQUENCES:
            return None
        self._is_asking_tyro = True
        try:
            spec = ConstructorRegistry.get_primitive_spec(info)
        finally:
            self._is_asking_tyro = False
        if not isinstance(spec, PrimitiveConstructorSpec):
            return spec
        read = spec.instance_from_str
        return dataclasses.replace(
            spec, instance_from_str=lambda args: read([_bracketed(info.type, a) for a in args])
        )


def _bracketed(declared: Any, text: str) -> str:
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
    return repr(_converted(declared, value)) if isinstance(value, _SEQUENCES) else text


def _converted(declared: Any, value: Any) -> Any:
    """Return `value` with its sequences as tuples and lists, as the type `declared` has them."""
    kind, elements = get_origin(declared), get_args(declared)
    if kind not in _SEQUENCES or not isinstance(value, _SEQUENCES):
        return value
    if kind is list or elements[1:] == (...,):
        elements = elements[:1] * len(value)
    if len(elements) != len(value):
        return kind(value)
    return kind(_converted(*pair) for pair in zip(elements, value, strict=True))
