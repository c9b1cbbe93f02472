"""Help of the commands with hundreds of flags: one screen, or one topic in full.

- `train TASK --help` prints the flags people use, by purpose (`SCREENS`), with the defaults of the task.
- `train TASK --help TOPIC` prints every flag of a branch of the config (`agent`, `rewards`, `env.sim`),
  one flag (`learning-rate`), the flags without a dot (`train`), or every flag (`all`).

Flags that cannot be set, such as functions, are not listed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from operator import attrgetter
from typing import Annotated, Any, get_type_hints

import mjlab
from mjlab.utils.errors import BadCallError
from mjlab.utils.string import name_list, suggest

TOPICS = ("rewards", "env.sim")
"""Topics named on every screen, beside the branches of the config."""
ALL = "all"
"""Topic of all flags."""
_FLAG_COLUMN, _NOTE_COLUMN = 10, 53
MISSING = object()
"""Value of `lookup` for an unknown path."""
OPTIONS = "options"
"""Field with the options of a task. Their flags are not below `--options.`."""
TERM_DICTS = frozenset(
    ("observations", "terms", "actions", "rewards", "terminations", "events", "commands", "curriculum",
     "metrics", "recorders")
)  # fmt: skip
"""Fields with terms by name; None removes a term. Observation terms are in `terms` of their group."""
# Branches whose parts can be named without the branch: `rewards` for `env.rewards`.
# `seed` is that of the agent, which sets the environment's.
_SHORTENED = ("", f"{OPTIONS}.", "agent.", "env.")


@dataclass(frozen=True)
class Row:
    """Line of a help screen: one flag."""

    path: str
    """Path of the flag in the config. `*` is the first entry of a dict."""
    value: str = ""
    """Placeholder of the value. Empty for a switch."""
    note: str = ""
    """Meaning, in a few words."""
    default: str | None = None
    """Default in words. None: value in the config."""
    source: str | None = None
    """Attribute with the default if the config has None at `path`."""
    learner: str | None = None
    """Learner that has the flag. None: all."""

    @property
    def flag(self) -> str:
        """Flag of `path`."""
        return _flag_of(self.path)


Screen = Mapping[str, Sequence[Row]]
"""Rows of a help screen, by heading."""

_PROFILE = Row("profile", "NAME", "cpu, ... (see list-envs)", "")
_DEVICE = Row("device", "cpu|cuda:0", "", "a GPU if available")
_NUM_ENVS = Row("num_envs", "N", "environments", source="env.scene.num_envs")
_ENGINE = Row("engine", "auto|native|warp", "", source="env.sim.engine")
_TASK = (
    Row("env.episode_length_s", "X", "seconds"),
    Row("env.rewards.*.weight", "X", "any term"),
)

_RUN = (
    _PROFILE,
    Row("learner", "ppo|sac|distillation", "", source="learner_name"),
    _NUM_ENVS,
    _ENGINE,
    _DEVICE,
    Row("gpu_ids", "[0,1]|all", "one process each"),
)
_ITERATIONS = Row("agent.max_iterations", "N")
_WATCH = (
    Row("live", "", "page while it learns"),
    Row("live_port", "N"),
    Row("video", "", "clips while training"),
    Row("result_video", "", "one clip at the end"),
)
_SAVE = (
    Row("agent.save_interval", "N", "iterations"),
    Row("agent.logger", "tensorboard|wandb"),
)
_LEARNING = (
    Row("agent.algorithm.learning_rate", "X", learner="ppo"),
    Row("agent.algorithm.entropy_coef", "X", learner="ppo"),
    Row("agent.actor.hidden_dims", "[N,...]", learner="ppo"),
    Row("agent.algorithm.actor_learning_rate", "X", learner="sac"),
    Row("agent.algorithm.batch_size", "N", learner="sac"),
    Row("agent.algorithm.num_updates", "N", "per step", learner="sac"),
    Row("agent.actor.hidden_dims", "[N,...]", learner="sac"),
    Row("agent.teacher_checkpoint", "FILE", "required", learner="distillation"),
    Row("agent.algorithm.learning_rate", "X", learner="distillation"),
    Row("agent.student.hidden_dims", "[N,...]", learner="distillation"),
    Row("agent.num_steps_per_env", "N", "per iteration"),
    Row("agent.evaluation.stop_when_solved", "False", "train to the end"),
)
_TRAINED_TASK = (*_TASK, Row("enable_nan_guard", "", "dump states before a NaN"))
_POLICY = (
    Row("agent", "trained|zero|random"),
    Row("checkpoint_file", "FILE", ".pt or .onnx", "the newest"),
    Row("log_root", "DIR"),
    Row("wandb_run_path", "PATH", "entity/project/run"),
    Row("learner", "ppo|sac|distillation", "", "any"),
    Row("profile", "NAME", "", "that of the run"),
)
_PAGE = (
    Row("viewer", "viser|native|none", "", "a page in the browser"),
    Row("num_envs", "N", "environments", source="env.scene.num_envs"),
    Row("num_steps", "N", "steps", "until stopped"),
    Row("no_terminations", "", "episodes never end"),
    Row("port", "N"),
    Row("host", "ADDRESS"),
    Row("open_browser", "False", "only print the address", ""),
)
_RECORD = (
    Row("video", "", "record a clip instead"),
    Row("video_length", "N", "frames"),
    Row("video_format", "mp4|gif"),
    Row("video_width", "N", "pixels", ""),
    Row("video_height", "N", "pixels", ""),
    Row("camera", "NAME", "", "the task's view"),
)
_MACHINE = (_ENGINE, _DEVICE)

_PLAY: Screen = {
    "watch": _PAGE,
    "policy": _POLICY,
    "record": _RECORD,
    "run": _MACHINE,
    "task": _TASK,
}

# Seeds and names of the runs are those of `--seeds`.
_SEEDS: Screen = {
    "run": (*_RUN, _ITERATIONS),
    "watch": _WATCH,
    "save": (Row("log_root", "DIR"), *_SAVE),
    "learning": _LEARNING,
    "task": _TRAINED_TASK,
}

SCREENS: Mapping[str, Screen] = {
    "train": {
        "run": (*_RUN, Row("agent.seed", "N", "-1 draws one"), _ITERATIONS),
        "watch": _WATCH,
        "save": (Row("log_root", "DIR"), Row("agent.run_name", "TEXT"), *_SAVE),
        "resume": (
            Row("agent.resume", "True"),
            Row("agent.load_run", "REGEX", "", "the newest"),
            Row("agent.load_checkpoint", "REGEX", "", "the newest"),
        ),
        "learning": _LEARNING,
        "task": _TRAINED_TASK,
    },
    "train-seeds": _SEEDS,
    "sweep": {**_SEEDS, "save": _SAVE},
    "play": _PLAY,
    "demo": _PLAY,
    "evaluate": {
        "run": (
            Row("num_episodes", "N", "episodes"),
            Row("num_envs", "N", "episodes at once", "all"),
            Row("max_steps", "N", "episode", "the task's"),
            Row("seed", "N"),
            Row("json", "", "print only JSON"),
            *_MACHINE,
        ),
        "policy": _POLICY,
        "task": _TASK,
    },
    "profile-env": {
        "run": (
            Row("num_envs", "N", "environments"),
            Row("steps", "N", "timed steps"),
            Row("warm_up", "N", "steps before"),
            Row("seed", "N"),
            Row("json", "", "print only JSON"),
            *_MACHINE,
        ),
        "policy": _POLICY,
        "task": _TASK,
    },
}
"""Help screens, by command."""


def requested_topic(flags: Sequence[str]) -> str | None:
    """Return the topic after `--help` or `-h`; "" for the screen, None without `--help`."""
    for position, word in enumerate(flags):
        name, _, topic = word.partition("=")
        if name in ("-h", "--help"):
            following = "".join(flags[position + 1 : position + 2])
            # `--help --agent.seed` asks for a flag; in `--help --profile cpu` the profile is one.
            is_flag = following.startswith("--") and "." in following
            if following.startswith("-") and not is_flag:
                following = ""
            return topic or following.lstrip("-").partition("=")[0]
    return None


def print_help(default: Any, topic: str, prog: str) -> None:
    """Print the help of a command.

    Args:
        default: Config of the command, a dataclass with the defaults.
        topic: Topic, or "" for the screen. Commands without a screen then list their flags without a
            dot.
        prog: Command and task, for the first line.

    Raises:
        BadCallError: unknown topic; the message names the nearest ones.
    """
    command = _command_of(prog)
    if not topic and command in SCREENS:
        print(screen_text(default, SCREENS[command], prog))
        return
    branches = _branches(default)
    if topic == ALL or (not topic and not branches):
        _print_flags(type(default), default, prog, default.__doc__ or "")
    elif not topic or topic == command:
        own = {name for name, _ in _entries(default)} - set(branches)
        _print_flags(*_restricted(default, own), prog, "Flags without a dot.")
        if not topic:
            print(f"{'more':<{_FLAG_COLUMN}}--help {' | '.join([*branches, ALL])}")
    else:
        _print_topic(default, topic, prog)


def screen_text(default: Any, screen: Screen, prog: str) -> str:
    """Return the help screen of a command, with the defaults in brackets."""
    learner = getattr(default, "learner_name", None)
    options = getattr(default, OPTIONS, None)
    lines = [f"usage: {prog} [flags]", ""]
    for heading, rows in screen.items():
        shown = [row for row in rows if row.learner in (None, learner)]
        if heading == "task":
            shown += [Row(f"{OPTIONS}.{name}", "TEXT") for name, _ in _entries(options)]
        texts = [text for row in shown if (text := _row_text(default, row)) is not None]
        first = f"{heading:<{_FLAG_COLUMN}}"
        lines += [(" " * _FLAG_COLUMN if n else first) + text for n, text in enumerate(texts)]
    branches = _branches(default)
    topics = " | ".join([_command_of(prog), *branches, *TOPICS, ALL])
    fields = " and ".join(f"--{name}." for name in branches)
    lines += [
        f"{'more':<{_FLAG_COLUMN}}--help {topics}, or a flag",
        "",
        f"Defaults in brackets. {fields} lead to all fields of the config.",
    ]
    return "\n".join(lines)


def flags_of(command: str) -> list[str]:
    """Return the flags on the screen of a command, without those of single terms."""
    rows = [row for rows in SCREENS.get(command, {}).values() for row in rows]
    return list(dict.fromkeys(row.flag for row in rows if "*" not in row.path))


def values_of(command: str, flag: str) -> list[str]:
    """Return the values of a flag on the screen of a command, for flags with a few."""
    rows = [row for rows in SCREENS.get(command, {}).values() for row in rows if row.flag == flag]
    return [value for row in rows if "|" in row.value for value in row.value.split("|")]


# Screen.


def _command_of(prog: str) -> str:
    """Return the command in `prog`, such as "mjlab train TASK", "play TASK" or "train"."""
    words = prog.split()
    return next((word for word in words if word in SCREENS), words[0] if words else "")


def _row_text(default: Any, row: Row) -> str | None:
    """Return a line of the screen, or None if the config lacks the flag."""
    path, value = lookup(default, row.path)
    if value is MISSING:
        return None
    if value is None and row.source is not None:
        value = attrgetter(row.source)(default)
    text = row.default if row.default is not None else _words(value)
    if text and not text.startswith("["):
        text = f"[{text}]"
    left = f"{_flag_of(path)} {row.value}".rstrip()
    note = f"{row.note} {text}".strip()
    return f"{left:<{_NOTE_COLUMN - _FLAG_COLUMN - 2}}  {note}".rstrip()


def _words(value: Any) -> str:
    """Return a default in words; "" for empty texts, and for switches that are off."""
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(str, value))}]"
    return "" if value is False else str(value)


def lookup(config: Any, path: str) -> tuple[str, Any]:
    """Return the path of an entry, spelled as in the config, and its value or `MISSING`.

    An empty path is the config itself.
    """
    names: list[str] = []
    for part in filter(None, path.split(".")):
        entries = dict(_entries(config))
        if part == "*":
            part = next((name for name, value in entries.items() if value is not None), part)
        # tyro prints `smooth_reward` as `smooth-reward` and accepts both.
        spelled = {name.replace("_", "-"): name for name in entries}
        name = part if part in entries else spelled.get(part.replace("_", "-"))
        if name is None:
            return path, MISSING
        names.append(name)
        config = entries[name]
    return ".".join(names), config


# Topics.


def _print_topic(default: Any, topic: str, prog: str) -> None:
    """Print the flags of a branch, or one flag."""
    path, value = _find(default, topic)
    parent, _, name = path.rpartition(".")
    holder = lookup(default, parent)[1]
    if _is_branch(value):
        kind = type(value) if is_dataclass(value) else _declared_type(holder, name)
        note = f"Flags of {_flag_of(path)}."
        if name in TERM_DICTS:
            note += f" `{_flag_of(path)}.NAME None` removes a term."
        _print_flags(*_prefixed(kind, value, path), prog, note)
    elif is_dataclass(holder):
        is_fixed = callable(value) or value == {}
        note = f"{_flag_of(path)} cannot be set on the command line." if is_fixed else ""
        _print_flags(*_prefixed(*_restricted(holder, {name}), parent), prog, note)
    else:
        # An entry of a dict of values.
        _print_topic(default, parent, prog)


def _find(default: Any, topic: str) -> tuple[str, Any]:
    """Return path and value of a topic. Raises BadCallError if unknown or ambiguous."""
    for prefix in _SHORTENED:
        path, value = lookup(default, prefix + topic)
        if value is not MISSING:
            return path, value
    return _unique_path(default, topic)


def _unique_path(default: Any, topic: str) -> tuple[str, Any]:
    """Return path and value of the only entry whose path ends with `topic`.

    Raises:
        BadCallError: no such entry, or several.
    """
    wanted = f".{topic.replace('_', '-')}"
    paths = dict(_paths(default))
    found = [path for path in paths if path.replace("_", "-").endswith(wanted)]
    if len(found) == 1:
        return found[0], paths[found[0]]
    if found:
        names = [_flag_of(path).removeprefix("--") for path in found]
        raise BadCallError(
            f"--help {topic}: expected one topic, got {name_list(names, near=[topic])}; add a prefix."
        )
    names = [path.rpartition(".")[2] for path in paths]
    names = list(dict.fromkeys(name.replace("_", "-") for name in (*names, ALL)))
    raise BadCallError(f"--help: unknown topic {topic!r}; {suggest(topic, names)}")


def _print_flags(kind: Any, default: Any, prog: str, description: str) -> None:
    import tyro

    from mjlab.cli.flag_values import flag_rules

    try:
        tyro.cli(
            kind,
            default=default,
            args=["--help"],
            prog=prog,
            description=description,
            config=(*mjlab.TYRO_FLAGS, tyro.conf.SuppressFixed),
            registry=flag_rules(),
        )
    except SystemExit as ended:
        if ended.code:
            raise


def _prefixed(kind: Any, value: Any, path: str) -> tuple[Any, Any]:
    """Return a class with the flags of `kind` below `path`, named as in the whole config."""
    if not path:
        return kind, value
    import tyro

    annotation: Any = Annotated[kind, tyro.conf.arg(name="" if path == OPTIONS else path)]
    wrapper = dataclasses.make_dataclass("Topic", [("topic", annotation)])
    return wrapper, wrapper(value)


def _restricted(config: Any, shown: set[str]) -> tuple[type, Any]:
    """Return a class that hides the fields of `config` outside `shown` from help, and an instance.

    Only for help: a parser of this class would reject the hidden flags.
    """
    import tyro

    kind = type(config)
    hidden = [f.name for f in dataclasses.fields(config) if f.name not in shown]
    hints: Any = get_type_hints(kind, include_extras=True)
    subclass = dataclasses.make_dataclass(
        kind.__name__,
        [
            (name, Annotated[hints[name], tyro.conf.Suppress], dataclasses.field(default=None))
            for name in hidden
        ],
        bases=(kind,),
        kw_only=True,
        namespace={"__doc__": kind.__doc__, "__module__": kind.__module__},
    )
    # Values are those of a valid config.
    instance = object.__new__(subclass)
    instance.__dict__.update(vars(config))
    return subclass, instance


def _declared_type(holder: Any, name: str) -> Any:
    if isinstance(holder, Mapping):
        return type(holder[name])
    return get_type_hints(type(holder), include_extras=True)[name]


def _entries(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the named parts of a branch."""
    if is_dataclass(value):
        yield from ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
    elif isinstance(value, Mapping):
        yield from ((str(key), entry) for key, entry in value.items())
    elif isinstance(value, (list, tuple)):
        yield from ((str(index), entry) for index, entry in enumerate(value))


def _branches(default: Any) -> list[str]:
    """Return the fields of a command's config with flags below them."""
    return [name for name, value in _entries(default) if _is_branch(value) and name != OPTIONS]


def _is_branch(value: Any) -> bool:
    """Return True for configs, and for dicts, lists and tuples of configs."""
    if is_dataclass(value):
        return True
    is_collection = isinstance(value, (Mapping, list, tuple))
    return is_collection and any(is_dataclass(entry) for _, entry in _entries(value))


def _paths(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and value of all branches and flags below `config`."""
    for name, value in _entries(config):
        path = f"{prefix}{name}"
        if not callable(value):
            yield path, value
        if _is_branch(value):
            yield from _paths(value, f"{path}.")


def _flag_of(path: str) -> str:
    return "--" + path.removeprefix(f"{OPTIONS}.").replace("_", "-")
