"""Help of the commands with hundreds of flags: one screen, or one topic in full.

- `train TASK --help` prints the flags that `mjlab.utils.screen.shown` marks, by purpose, with the
  defaults of the task.
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
_HEADINGS = ("run", "watch", "policy", "save", "resume", "record", "learning", "task")
_FLAG_COLUMN, _DEFAULT_COLUMN = 10, 53
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
_SHORTENED = ("", f"{OPTIONS}.", "agent.", "env.")


def requested_topic(flags: Sequence[str]) -> str | None:
    """Return the topic after `--help` or `-h`; "" for the screen, None without `--help`."""
    for position, word in enumerate(flags):
        name, _, topic = word.partition("=")
        if name in ("-h", "--help"):
            following = "".join(flags[position + 1 : position + 2])
            # `--help --agent.seed` and `--help --num-envs` ask for a flag; `--help --profile cpu` does not.
            is_last = position + 2 == len(flags)
            is_flag = following.startswith("--") and (is_last or "." in following)
            if following.startswith("-") and not is_flag:
                following = ""
            return topic or following.lstrip("-").partition("=")[0]
    return None


def print_help(default: Any, topic: str, prog: str) -> None:
    """Print the help of a command.

    Args:
        default: Config of the command, a dataclass with the defaults.
        topic: Topic, or "" for the screen. Commands without a screen then list all flags.
        prog: Command and task, for the first line.

    Raises:
        BadCallError: unknown topic; the message names the nearest ones.
    """
    command = prog.split()[-2] if " " in prog else prog
    rows = screen_rows(default)
    if rows and not topic:
        print(_screen_text(default, rows, prog, command))
        return
    branches = _branches(default)
    if topic == ALL or not topic:
        _print_flags(type(default), default, prog, default.__doc__ or "")
    elif topic == command:
        own = {name for name, _ in _entries(default)} - set(branches)
        _print_flags(*_restricted(default, own), prog, "Flags without a dot.")
    else:
        _print_topic(default, topic, prog)


# Screen.


@dataclass(frozen=True)
class Row:
    """Line of a help screen: one flag."""

    heading: str
    """Purpose of the flag."""
    flag: str
    """Flag with its dashes."""
    placeholder: str
    """Placeholder of the value. Empty for a switch."""
    default: Any
    """Default of the task."""


def screen_rows(default: Any) -> list[Row]:
    """Return the flags of the screen of a command, by heading; empty if it has none."""
    rows = [Row("task", _flag_of(f"{OPTIONS}.{name}"), "TEXT", value)
            for name, value in _entries(getattr(default, OPTIONS, None))]  # fmt: skip
    for path, field, value in _shown_fields(default):
        heading, placeholder, source = field.metadata["screen"]
        value = attrgetter(source)(default) if value is None and source else value
        rows.append(Row(heading, _flag_of(path), placeholder, value))
    # The command's own flags come before those of its branches.
    return sorted(rows, key=lambda row: (_HEADINGS.index(row.heading), "." in row.flag))


def _shown_fields(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield path, field and value of the fields that `shown` marks; of a dict, in the first entry."""
    if isinstance(config, Mapping):
        for name, entry in [(n, e) for n, e in config.items() if is_dataclass(e)][:1]:
            yield from _shown_fields(entry, f"{prefix}{name}.")
    elif is_dataclass(config):
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            if "screen" in field.metadata:
                yield f"{prefix}{field.name}", field, value
            elif field.name != OPTIONS:
                yield from _shown_fields(value, f"{prefix}{field.name}.")


def _screen_text(default: Any, rows: Sequence[Row], prog: str, command: str) -> str:
    lines, heading = [f"usage: {prog} [flags]", ""], ""
    for row in rows:
        left = f"{'' if row.heading == heading else row.heading:<{_FLAG_COLUMN}}"
        heading = row.heading
        left += f"{row.flag} {row.placeholder}"
        lines.append(f"{left:<{_DEFAULT_COLUMN - 2}}  {_in_brackets(row.default)}".rstrip())
    branches = _branches(default)
    topics = " | ".join([command, *branches, *TOPICS, ALL])
    fields = " and ".join(f"--{name}." for name in branches)
    lines += [
        f"{'more':<{_FLAG_COLUMN}}--help {topics}, or a flag",
        "",
        "Defaults in brackets; `--help FLAG` explains a flag.",
        f"{fields} lead to all fields of the config.",
    ]
    return "\n".join(lines)


def _in_brackets(value: Any) -> str:
    """Return a default in brackets; "" for None, empty texts and switches that are off."""
    if value is None or value is False or value == "":
        return ""
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(str, value))}]"
    return f"[{value:g}]" if isinstance(value, float) else f"[{value}]"


def lookup(config: Any, path: str) -> tuple[str, Any]:
    """Return the path of an entry, spelled as in the config, and its value or `MISSING`.

    An empty path is the config itself.
    """
    names: list[str] = []
    for part in filter(None, path.split(".")):
        entries = dict(_entries(config))
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
