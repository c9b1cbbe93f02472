"""Flags of the commands: from `argv` to a config.

- tyro reads the flags of a dataclass; `--env.rewards.<term> None` switches a term off.
- `--profile` and `--learner` are read first, because the other flags and their defaults depend on
  them. A command that resumes a run uses those of the run. All other flags are parsed once.
- Tasks can add flags (`mjlab.tasks.registry.TaskOptions`).
"""

from __future__ import annotations

import copy
import dataclasses
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro

import mjlab
from mjlab.cli.flag_values import flag_rules
from mjlab.cli.help import TERM_DICTS, print_help, requested_topic
from mjlab.runs.settings import apply_settings
from mjlab.tasks.registry import (
    PolicyOrigin,
    TaskOptions,
    list_profiles,
    load_options_cls,
    load_rl_cfg,
)
from mjlab.utils.logging import print_notice
from mjlab.utils.ranges import check_ranges

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.runs import Run

C = TypeVar("C")

# Terms that are switched off are None.
warnings.filterwarnings(
    "ignore", r"The field `.*` is annotated with type `dict\[str, mjlab\.", module="tyro"
)

CPU_PROFILE = "cpu"
"""Name of the profile that `train` suggests on a CPU."""
# Field of the task options.
_FIELD = "options"


def parse_flags(config_type: type[C], default: C, flags: list[str], prog: str) -> C:
    """Return `default` updated by `flags`; exits on an unknown flag, and after `--help [TOPIC]`.

    `--env.rewards.<term> None` removes the term (same for all other kinds of terms). `None` also
    removes a nested config if the field may be None, such as the noise of a term. A bare `--video`
    is `--video True`.

    Raises:
        ValueError: a typed number is out of its range.
    """
    config = _parsed(config_type, default, flags, prog)
    check_ranges(config, typed_values(flags))
    return config


def _parsed(config_type: type[C], default: C, flags: list[str], prog: str) -> C:
    topic = requested_topic(flags)
    if topic is not None:
        print_help(default, topic, prog)
        sys.exit(0)
    edited, remaining = switch_terms_off(default, flags)
    return tyro.cli(
        config_type,
        default=edited,
        args=_with_values(config_type, remaining),
        prog=prog,
        config=mjlab.TYRO_FLAGS,
        registry=flag_rules(),
    )


def _with_values(config_type: Any, flags: list[str]) -> list[str]:
    """Return `flags` with the value True after bare switches."""
    fields = dataclasses.fields(config_type)
    switches = {field.name for field in fields if field.type in ("bool", bool)}
    words: list[str] = []
    for word, following in pairwise([*flags, "--"]):
        words.append(word)
        if _name_of(word) in switches and "=" not in word and following.startswith("--"):
            words.append("True")
    return words


def _name_of(word: str) -> str:
    """Return the name of the setting in a flag, such as `agent.seed`; "" for other words."""
    name = word.partition("=")[0]
    return name.removeprefix("--").replace("-", "_") if name.startswith("--") else ""


def typed_values(flags: list[str]) -> dict[str, str]:
    """Return the texts in the command line `flags` by name of the setting, such as `agent.seed`.

    The text of a switch without a value is "True".
    """
    texts = {}
    for word, following in pairwise([*flags, "--"]):
        _, equals, value = word.partition("=")
        if name := _name_of(word):
            texts[name] = value if equals else "True" if following.startswith("--") else following
    return texts


def is_given(flag: str, flags: list[str]) -> bool:
    """Return True if the command line `flags` sets `flag`, spelled with `-` or `_`."""
    return _name_of(flag) in typed_values(flags)


def previewed(default: C, flags: list[str]) -> C:
    """Return a copy of `default` with the texts of its flags outside `env` as values.

    For choices by names, patterns and switches that the defaults of all flags depend on; the parser
    reads and checks all flags later.
    """
    own: Any = copy.copy(default)
    agent = getattr(own, "agent", None)
    if is_dataclass(agent):
        own.agent = agent = copy.copy(agent)
    for path, text in typed_values(flags).items():
        holder, name = (agent, path[6:]) if path.startswith("agent.") else (own, path)
        if name in vars(holder):
            setattr(holder, name, {"True": True, "False": False, "None": None}.get(text, text))
    return own


def parse_own_flags(default: C, flags: list[str], prog: str) -> tuple[C, list[str]]:
    """Return `default` updated by its flags, and the words of all others; prints help with `--help`.

    Raises:
        ValueError: a typed number is out of its range.
    """
    if requested_topic(flags) is not None:
        print_help(default, "", prog)
    config, others = tyro.cli(
        type(default),
        default=default,
        args=_with_values(type(default), flags),
        prog=prog,
        config=(tyro.conf.FlagConversionOff,),
        add_help=False,
        return_unknown_args=True,
    )
    check_ranges(config, typed_values(flags))
    return config, others


# Profile and learner.


def parse_for_run(
    make_default: Callable[..., C],
    select: Callable[[C], Run | None],
    flags: list[str],
    prog: str,
) -> C:
    """Return the defaults for the selected run, profile and learner, updated by `flags`.

    Args:
        make_default: Function of the keywords `run`, and `profile` and `learner` if in `flags`, that
            returns the defaults: with the settings of the run, or those of the task without a run.
        select: Function of the previewed flags that returns the run they select; None without a run.
        flags: Command line.
        prog: Name of the command, for messages.

    Raises:
        UnknownProfileError: unknown profile; the message lists the profiles of the task.
        ValueError: unknown learner.
    """
    texts = typed_values(flags)
    choices = {name: texts[name] for name in ("profile", "learner") if name in texts}
    requested = {name: None if text == "None" else text for name, text in choices.items()}
    default = make_default(run=None, **requested)
    if requested_topic(flags) is None and (run := select(previewed(default, flags))) is not None:
        default = make_default(run=run, **requested)
    return _parsed(type(default), default, flags, prog)


def profile_to_suggest(task: str, profile: str | None, device: str) -> str | None:
    """Return the `cpu` profile if `task` has it and is trained on the CPU without a profile."""
    is_of_use = profile is None and device == "cpu" and CPU_PROFILE in list_profiles(task)
    return CPU_PROFILE if is_of_use else None


def suggest_profile(task: str, profile: str | None, device: str) -> None:
    """Print a hint to the profile for this machine when training without a profile."""
    if (name := profile_to_suggest(task, profile, device)) is not None:
        print_notice(f"`uv run mjlab train {task} --profile {name}` has settings for a few cores.")


def report_untuned_learner(task: str, profile: str | None, learner: str) -> None:
    """Print a notice if `profile` has settings for a learner other than `learner`."""
    from mjlab.rl.learners import learner_of

    # A student uses the settings of the teacher's profile.
    if profile is None or learner == "distillation":
        return
    tuned = learner_of(load_rl_cfg(task, profile=profile))
    if tuned != learner:
        print_notice(
            f"The profile {profile!r} of {task} has settings for the learner {tuned!r}: using its "
            f"environment, and the default networks, algorithm and iterations of {learner!r}."
        )


# Task flags.


def with_task_options(cfg: C, task: str, run: Run | None = None) -> C:
    """Return the flags of a command extended by the options of the task.

    Args:
        cfg: Dataclass of flags with their defaults.
        task: Name of the task.
        run: Run with the options to use as defaults.

    Raises:
        UnknownTaskError, TaskImportError: unknown task, or its options cannot be imported.
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
            f"Options {options.__name__} of task {task!r}: expected names other than the flags of the "
            f"command, got {taken}; rename these fields."
        )
    default = options()
    if run is not None:
        default, left_out = apply_settings(default, run.settings, "options")
        for name, reason in left_out.items():
            print_notice(f"{name}: {run.settings[name]} of the run left out: {reason}")
    # No prefix: options look like flags of the command.
    annotation: Any = Annotated[options, tyro.conf.arg(name="")]  # ty: ignore[invalid-type-form]
    kind: Any = dataclasses.make_dataclass(
        type(cfg).__name__,
        [(_FIELD, annotation, dataclasses.field(default_factory=lambda: default))],
        bases=(type(cfg),),
        namespace={"__doc__": type(cfg).__doc__, "__module__": type(cfg).__module__},
    )
    return kind(**values)


def options_of(task: str, cfg: Any) -> TaskOptions:
    """Return the task options in the flags of a command, or their defaults."""
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
    """Let the task options edit `env_cfg` in place before the environment is built.

    Args:
        task: Name of the task.
        cfg: Flags of the command, or None for the defaults of the task.
        env_cfg: Environment config, edited in place.
        checkpoint: Checkpoint of the acting policy, or None.
        wandb_run_path: Weights & Biases run of a downloaded checkpoint, or None.

    Raises:
        ValueError: a resource of the task, such as a motion, was not found.
    """
    origin = PolicyOrigin(task, checkpoint, wandb_run_path)
    options_of(task, cfg).prepare(env_cfg, origin)


# Removal of terms.


def switch_terms_off(default: C, flags: list[str]) -> tuple[C, list[str]]:
    """Return a copy of `default` without the terms and configs set to None, and the remaining flags.

    tyro checks the remaining flags.
    """
    config = copy.deepcopy(default)
    remaining: list[str] = []
    position = 0
    while position < len(flags):
        # `--flag None` or `--flag=None`.
        words = [flags[position]]
        flag, equals, value = words[0].partition("=")
        if not equals and flags[position + 1 : position + 2] == ["None"]:
            value = "None"
            words.append(value)
        position += len(words)
        holder, name = _term_at(config, flag) if value == "None" else (None, "")
        if holder is None:
            remaining += words
        elif isinstance(holder, dict):
            holder[name] = None
        else:
            setattr(holder, name, None)
    return config, remaining


def _term_at(config: Any, flag: str) -> tuple[Any, str]:
    """Return the dict or config that contains the entry `flag`, and its key; (None, "") if not found."""
    if not flag.startswith("--"):
        return None, ""
    holder: Any = None
    value, key, inside = config, "", ""
    for part in flag.removeprefix("--").split("."):
        inside, holder = key, value
        if holder is None:
            return None, ""
        names = list(holder) if isinstance(holder, Mapping) else list(vars(holder))
        # tyro prints `smooth_reward` as `smooth-reward` and accepts both.
        spelled = {str(name).replace("_", "-"): name for name in reversed(names)}
        key = spelled.get(part.replace("_", "-"))
        if not isinstance(key, str):
            return None, ""
        value = holder[key] if isinstance(holder, Mapping) else getattr(holder, key)
        if not is_dataclass(value) and not isinstance(value, Mapping | None):
            return None, ""
    is_term = isinstance(holder, dict) and inside in TERM_DICTS
    return (holder, key) if is_term or _may_be_none(holder, key) else (None, "")


def _may_be_none(holder: Any, key: str) -> bool:
    """Return True if field `key` of a config is an optional config or dict."""
    if not is_dataclass(holder):
        return False
    try:
        options = get_args(get_type_hints(type(holder)).get(key))
    except NameError:
        # Annotations imported under TYPE_CHECKING cannot be resolved.
        return False
    return NoneType in options and any(
        is_dataclass(option) or get_origin(option) is dict for option in options
    )
