"""Reading the list of public names, and comparing it with what the package offers."""

from __future__ import annotations

import ast
import dataclasses
import enum
import importlib
import inspect
import math
import re
import tempfile
import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjlab import compat

LIST = Path(__file__).parent / "data" / "public_interface.txt"
COMMAND_LINE = LIST.with_name("command_line.txt")
OLDER = Path(__file__).parent / "data" / "older_interface.txt"
KINDS = Path(__file__).parent / "data" / "config_kinds.txt"

# Technical names that modules of 1.6 happened to import or define.
NOISE = {
    "Dict = Dict  [type alias]",
    "Tuple = Tuple  [type alias]",
    "T: TypeVar",
}

_EMPTY = inspect.Parameter.empty
# Bases that say how a class is made, not what it is.
_TECHNICAL_BASES = {"ABC", "Generic", "Protocol", "object", ""}


@dataclass(frozen=True)
class Entry:
    """One public name: a constant, a function, a class, or the list of exports."""

    module: str
    name: str
    line: str
    members: tuple[str, ...] = field(default=(), repr=False)

    @property
    def path(self) -> str:
        return f"{self.module}.{self.name}"


def entries() -> list[Entry]:
    """Return all entries of the list."""
    found: list[Entry] = []
    module = ""
    for line in LIST.read_text().splitlines():
        if line.startswith("## "):
            module = line[3:].strip()
        elif line.startswith(" "):
            found[-1] = dataclasses.replace(found[-1], members=(*found[-1].members, line.strip()))
        elif line.strip() and line not in NOISE:
            found.append(Entry(module, _name(line), line))
    return found


def older_entries() -> list[Entry]:
    """Return the names that releases before 1.6 had; members of classes are `Class.member`."""
    found: list[Entry] = []
    module = ""
    for line in OLDER.read_text().splitlines():
        text = line.partition("   [")[0].strip()
        if line.startswith("## "):
            module = line[3:].strip()
        elif line.startswith("# Fields whose default"):
            break
        elif module and text:
            name = re.match(r"(?:def |class |exported )?([\w.@]+(?: \w+)?)", text)
            assert name, line
            found.append(Entry(module, name.group(1), text))
    return found


def is_offered(entry: Entry) -> bool:
    """Return whether a name of an earlier release is there, with its signature."""
    module = importlib.import_module(entry.module)
    if entry.line.startswith("def "):
        return not problems(dataclasses.replace(entry, name=_name(entry.line)))
    if entry.line.startswith(("class ", "exported ")):
        return hasattr(module, entry.name.split()[0])
    owner, _, member = entry.line.partition(".")
    member = re.sub(r"^@\w+ ", "", member)
    name = re.match(r"\w+", member).group()
    cls = getattr(module, owner)
    # Fields that are gone are arguments of the constructor still.
    return hasattr(cls, name) or name in compat._FIELDS.get(owner, {})


def command_line() -> dict[str, list[str]]:
    """Return the fields of the command lines' config classes, by the path of the class."""
    found: dict[str, list[str]] = {}
    current = ""
    for line in COMMAND_LINE.read_text().splitlines():
        if line.startswith("class "):
            current = line.split()[1]
            found[current] = []
        elif line.startswith(" "):
            found[current].append(line.strip().partition(":")[0])
    return found


def config_kinds() -> dict[str, tuple[list[str], list[str]]]:
    """Return the positional and the keyword-only parameters of config classes, by path."""
    found = {}
    for line in KINDS.read_text().splitlines():
        if not line.startswith("#"):
            path, _, parameters = line.partition(":")
            positional, keyword_only = (
                [name.strip() for name in part.split(",") if name.strip()]
                for part in parameters.split("|")
            )
            found[path] = (positional, keyword_only)
    return found


def resolve(path: str) -> Any:
    """Return what `module.Class.Nested` names."""
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError:
        return getattr(resolve(module), name)


def _name(line: str) -> str:
    if line.startswith("exports:"):
        return "exports"
    match = re.match(r"(?:def |class )?(\w+)", line)
    assert match, line
    return match.group(1)


def problems(entry: Entry) -> list[str]:
    """Return, one line each, what of an entry the package lacks or has otherwise."""
    module = importlib.import_module(entry.module)
    if entry.name == "exports":
        names = [name.strip() for name in entry.line.removeprefix("exports:").split(",")]
        return [f"{name} is not exported" for name in names if not hasattr(module, name)]
    if not hasattr(module, entry.name):
        return ["is missing"]
    value = getattr(module, entry.name)
    if entry.line.startswith("def "):
        return list(_signature_problems(entry.line.removeprefix("def "), value))
    if entry.line.startswith("class "):
        return list(_class_problems(entry, value))
    return list(_constant_problems(entry.line, value))


def _constant_problems(line: str, value: Any) -> Iterator[str]:
    if re.match(r"\w+: ", line):
        yield from _kind_problems(line.partition(": ")[2], value)
        return
    _, _, text = line.partition(" = ")
    if text.endswith("[type alias]"):
        yield from _alias_problems(text.removesuffix("[type alias]").strip(), value)
        return
    expected = _parsed(text)
    if isinstance(expected, ast.expr) and not _agrees(expected, value):
        yield f"is {value!r}, not {text}"


def _kind_problems(text: str, value: Any) -> Iterator[str]:
    """Compare a value with a description: `dict of 3: a, b`, `frozenset of 2: a, b` or a class.

    Up to four elements of a collection are listed, those of a dict in order; sets may hold more.
    """
    kind, _, elements = text.partition(" of ")
    if kind not in {base.__name__ for base in type(value).__mro__}:
        yield f"is of type {type(value).__name__}, not {kind}"
    elif elements:
        size, _, names = elements.partition(": ")
        listed = [name.strip() for name in names.split(",")]
        if len(value) < int(size) or (kind == "dict" and len(value) > int(size)):
            yield f"has {len(value)} elements, not {size}"
        if kind == "dict" and list(value)[: len(listed)] != listed:
            yield f"starts with {list(value)[: len(listed)]}, not {listed}"
        yield from (f"lacks {name}" for name in listed if name not in value)


def _alias_problems(text: str, value: Any) -> Iterator[str]:
    expected = _parsed(text)
    if expected is None or not text.startswith("Literal["):
        return
    # Aliases of other kinds are compared by type checkers.
    choices = ast.literal_eval(text.removeprefix("Literal"))
    if list(typing.get_args(value)) != choices:
        yield f"allows {list(typing.get_args(value))}, not {choices}"


def _class_problems(entry: Entry, cls: Any) -> Iterator[str]:
    if not inspect.isclass(cls):
        yield f"is {type(cls).__name__}, not a class"
        return
    match = re.match(r"class \w+\((.*?)\)", entry.line)
    bases = [base.strip() for base in match.group(1).split(",")] if match else []
    ancestors = {base.__name__ for base in cls.__mro__}
    for base in bases:
        if base not in _TECHNICAL_BASES and base not in ancestors:
            yield f"does not derive from {base}"
    fields = [m for m in entry.members if _is_field(m)] if "[dataclass]" in entry.line else []
    if fields and not dataclasses.is_dataclass(cls):
        yield "is not a dataclass"
        return
    yield from _field_problems(fields, cls)
    for member in entry.members:
        if member not in fields:
            yield from _member_problems(member, cls)


def _is_field(member: str) -> bool:
    return re.match(r"\w+: ", member) is not None


def _field_problems(members: list[str], cls: Any) -> Iterator[str]:
    own = {f.name: f for f in dataclasses.fields(cls)} if members else {}
    positions = list(own)
    last = -1
    for member in members:
        name, _, rest = member.partition(": ")
        if name not in own:
            yield f"field {name} is missing"
            continue
        found = own[name]
        if not found.kw_only and positions.index(name) < last:
            yield f"field {name} comes too early"
        last = max(last, positions.index(name))
        _, equals, text = rest.partition(" = ")
        default = _default_of(found)
        if not equals:
            continue
        if default is _EMPTY:
            yield f"field {name} has no default, not {text}"
            continue
        expected = _parsed(text)
        if isinstance(expected, ast.expr) and not _agrees(expected, default):
            yield f"field {name} has the default {default!r}, not {text}"


def _default_of(found: dataclasses.Field) -> Any:
    if found.default is not dataclasses.MISSING:
        return found.default
    if found.default_factory is not dataclasses.MISSING:
        return found.default_factory()
    return _EMPTY


def _member_problems(member: str, cls: Any) -> Iterator[str]:
    kind, text = "", member
    if member.startswith("@"):
        kind, _, text = member.partition(" ")
    name = _name(text)
    if kind == "@property":
        if not hasattr(cls, name) and name not in _instance_attributes(cls):
            yield f"property {name} is missing"
        elif callable(getattr(cls, name, None)) and not isinstance(
            inspect.getattr_static(cls, name), property
        ):
            yield f"property {name} is a method"
        return
    if re.match(r"\w+ = ", member):
        yield from _value_problems(member, cls)
        return
    if "(" not in text:
        return
    if member.startswith("class "):
        yield from (f"{name}: {line}" for line in _nested_class_problems(text, name, cls))
        return
    if not hasattr(cls, name):
        yield f"method {name} is missing"
        return
    function = inspect.getattr_static(cls, name)
    if kind in ("@staticmethod", "@classmethod") and type(function).__name__ != kind[1:]:
        yield f"{name} is not a {kind[1:]}"
    yield from (f"{name}: {line}" for line in _signature_problems(text, getattr(cls, name)))


def _nested_class_problems(text: str, name: str, cls: Any) -> Iterator[str]:
    """Compare a nested config with `class Name(field, field)`."""
    nested = getattr(cls, name, None)
    if not dataclasses.is_dataclass(nested):
        yield "is missing or no dataclass"
        return
    fields = [found.name for found in dataclasses.fields(nested)]
    listed = [field.strip() for field in text.partition("(")[2].rstrip(")").split(",")]
    if fields[: len(listed)] != listed:
        yield f"has fields {fields}, not {listed}"


def _instance_attributes(cls: Any) -> set[str]:
    """Return the attributes that annotations or assignments in methods give to instances."""
    names: set[str] = set()
    for base in cls.__mro__:
        names |= set(getattr(base, "__annotations__", ()))
        if base.__module__.startswith("mjlab"):
            names |= set(re.findall(r"self\.(\w+)(?::[^=\n]+)? = ", inspect.getsource(base)))
    return names


def _value_problems(member: str, cls: Any) -> Iterator[str]:
    name, _, text = member.partition(" = ")
    if not hasattr(cls, name):
        yield f"{name} is missing"
        return
    value = getattr(cls, name)
    value = value.value if isinstance(value, enum.Enum) else value
    expected = _parsed(text)
    if isinstance(expected, ast.expr) and not _agrees(expected, value):
        yield f"{name} is {value!r}, not {text}"


def _signature_problems(text: str, function: Any) -> Iterator[str]:
    if not callable(function):
        yield "is not callable"
        return
    arguments = _arguments(text)
    if arguments is None or {"args", "kwargs"} <= {a for a, _, _ in arguments}:
        return
    parameters = dict(inspect.signature(function).parameters)
    parameters.pop("self", None)
    parameters.pop("cls", None)
    takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    names = list(parameters)
    for position, (name, default, keyword_only) in enumerate(arguments):
        if name not in parameters:
            if not takes_all:
                yield f"parameter {name} is missing"
            continue
        found = parameters[name]
        if not keyword_only and names.index(name) != position:
            yield f"parameter {name} is number {names.index(name)}, not {position}"
        if default is not None and found.default is _EMPTY:
            yield f"parameter {name} has no default"
        elif default is not None and not _agrees(default, found.default):
            yield f"parameter {name} has the default {found.default!r}, not {ast.unparse(default)}"
    listed = {name for name, _, _ in arguments}
    for name, found in parameters.items():
        variable = found.kind in (found.VAR_KEYWORD, found.VAR_POSITIONAL)
        if name not in listed and not variable and found.default is _EMPTY:
            yield f"parameter {name} is required and not in the list"


def _arguments(text: str) -> list[tuple[str, ast.expr | None, bool]] | None:
    """Return name, default and whether it is keyword-only, for each parameter but `self`."""
    source = f"def {_readable(text)}: pass"
    try:
        function = ast.parse(source).body[0]
    except SyntaxError:
        return None
    assert isinstance(function, ast.FunctionDef)
    args = function.args
    plain = [*args.posonlyargs, *args.args]
    padding: list[ast.expr | None] = [None] * (len(plain) - len(args.defaults))
    defaults = [*padding, *args.defaults]
    result = [(a.arg, d, False) for a, d in zip(plain, defaults, strict=True)]
    result += [(a.arg, d, True) for a, d in zip(args.kwonlyargs, args.kw_defaults, strict=True)]
    result += [(a.arg, None, True) for a in (args.vararg, args.kwarg) if a]
    return [argument for argument in result if argument[0] not in ("self", "cls")]


def _readable(text: str) -> str:
    """Return `text` with representations such as `<A.B: 1>` as strings, so that it parses."""
    return re.sub(r"<([^<>]*)>", lambda match: repr(f"<{match.group(1)}>"), text)


def _parsed(text: str) -> ast.expr | None:
    try:
        return ast.parse(_readable(text), mode="eval").body
    except SyntaxError:
        # The list cuts long values off.
        return None


def _agrees(expected: ast.expr, value: Any) -> bool:
    """Return whether a default in the list may be `value`; calls are compared by their class."""
    if isinstance(expected, ast.Call):
        name = ast.unparse(expected.func).rpartition(".")[2]
        return name in {base.__name__ for base in type(value).__mro__}
    try:
        literal = ast.literal_eval(expected)
    except ValueError:
        return True
    if isinstance(literal, str) and (shown := re.fullmatch(r"<\w+\.(\w+): (.*)>", literal)):
        # A member of an enum, or, where that lives above, its plain value.
        plain = value.value if isinstance(value, enum.Enum) else value
        same_name = not isinstance(value, enum.Enum) or value.name == shown.group(1)
        return same_name and plain == ast.literal_eval(shown.group(2))
    if isinstance(literal, str) and literal.startswith("/tmp/"):
        literal = literal.replace("/tmp", tempfile.gettempdir(), 1)
    if isinstance(literal, float) and isinstance(value, (int, float)):
        return math.isclose(literal, value, rel_tol=1e-9)
    if isinstance(value, enum.Enum) and isinstance(literal, (str, int)):
        return value.value == literal
    if isinstance(literal, (tuple, list)) and isinstance(value, (tuple, list)):
        return list(literal) == list(value)
    return literal == value
