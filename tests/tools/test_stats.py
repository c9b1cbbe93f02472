"""Numbers of `tools/stats.py`, on small packages."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import textwrap
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "stats.py"
BY_NAME = "private functions called once"
RESOLVED = "private functions called once, resolved"


@pytest.fixture(scope="module")
def stats() -> ModuleType:
    spec = importlib.util.spec_from_file_location("stats_tool", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def count(stats, tmp_path):
    """Return a function that writes files of the package and returns the report about them."""

    def write(files: dict[str, str]) -> dict[str, Any]:
        for name, text in files.items():
            path = tmp_path / name if name.endswith(".md") else tmp_path / "src" / "mjlab" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(textwrap.dedent(text))
        return stats.report(tmp_path)

    return write


# Lines.

SOURCE = '''\
"""Module docstring,
of two lines."""

import os  # A comment.
from a import (
    b,
)

TEXT = """
A string that is no docstring.
"""


@decorated
def long(
    one,
    two,
):
    """Docstring."""
    # A comment.

    import sys
    def inner():
        return 1
    raise ValueError(
        "Bad."
    )


class Thing:
    size: int = 1
    """Field."""
    def get(self): return "# not a comment"
'''


def test_lines_by_kind(count):
    rows = count({"a.py": SOURCE})["rows"]
    assert rows["code lines"] == 21
    assert rows["import lines"] == 5
    assert rows["signature lines"] == 7
    assert rows["body lines"] == 4
    assert rows["bodies (%)"] == 19.05
    assert (rows["raise statements"], rows["raise lines"]) == (1, 3)
    assert rows["docstrings"] == 3


def test_lengths_of_files_and_functions(count):
    report = count({"a.py": SOURCE, "b.py": "x = 1\n" * 7, "sim/__init__.py": ""})
    rows, names = report["rows"], report["names"]
    assert (rows["median file"], rows["median file without __init__"]) == (7, 14)
    assert (rows["largest file"], names["largest file"]) == (21, "a.py")
    assert (rows["longest function"], names["longest function"]) == (10, "a.py long")
    assert (rows["functions"], rows["function length, median"]) == (3, 2)


def test_rows_of_packages_add_up(count):
    report = count({"a.py": SOURCE, "sim/b.py": SOURCE, "sim/c.py": "", "rl/d/e.py": SOURCE})
    packages = report["packages"]
    assert list(packages) == ["(top)", "rl", "sim"]
    for row in ("files", "code lines", "raise lines", "functions", "docstrings"):
        assert sum(part[row] for part in packages.values()) == report["rows"][row]


# Docstrings.


def test_question_openings(count):
    text = '"""What it is."""\nx = 1\n"""Whether."""\ny = 1\n"""Whatever."""\nz = "How so"\n'
    rows = count({"a.py": text})["rows"]
    assert (rows["question openings"], rows["docstrings"]) == (2, 3)
    assert rows["question openings (%)"] == 66.67


@pytest.mark.parametrize(
    ("docstring", "riddles"),
    [
        ("Start anew, with memory of its own.", 2),
        ("Nobody asks, likewise.", 2),
        ("This is\n    no joint.", 1),
        ("There is no joint; it is no longer here.", 0),
        ("Newest values.", 0),
    ],
)
def test_riddles(count, docstring, riddles):
    text = f'def f():\n    """{docstring}"""\n\n# Started anew.\n'
    assert count({"a.py": text})["rows"]["riddles"] == riddles


# Private functions.


def private(count, **files: str) -> tuple[list[str], list[str]]:
    """Return the private functions called once, by name and resolved."""
    found = count({f"{name}.py": text for name, text in files.items()})["called once"]
    by_name, resolved = ([item.split()[1] for item in found[row]] for row in (BY_NAME, RESOLVED))
    return by_name, resolved


def test_a_function_called_once(count):
    a = "def _once(): ...\ndef _twice(): ...\ndef _never(): ...\n_once(), _twice(), _twice()\n"
    assert private(count, a=a) == (["_once"], ["_once"])


def test_imports_are_no_references(count):
    b = "from mjlab.a import _f\n_f()\n"
    assert private(count, a="def _f(): ...\n", b=b) == (["_f"], ["_f"])


def test_a_callback_is_not_called_once(count):
    assert private(count, a="def _f(): ...\nsorted(x, key=_f)\n") == ([], [])


def test_functions_with_the_same_name(count):
    a = "def _f(): ...\n_f()\n"
    assert private(count, a=a, b=a) == ([], ["_f", "_f"])


def test_hooks_and_overrides_are_left_out(count):
    a = """
        class Base:
            def run(self): self._hook(), self._step()
            def _hook(self): ...
            def _step(self): ...
        class Child(Base):
            def _hook(self): ...
        """
    assert private(count, a=a) == (["_step"], ["_step"])


@pytest.mark.parametrize(
    ("decorator", "counted"),
    [("staticmethod", True), ("contextlib.contextmanager", True), ("lru_cache(maxsize=1)", True)]
    + [("property", False), ("override", False), ("button.on_click", False)],
)
def test_decorated_functions(count, decorator, counted):
    a = f"class A:\n    @{decorator}\n    def _f(): ...\n    def run(self): self._f()\n"
    assert bool(private(count, a=a)[0]) == counted


def test_number_of_private_functions(count):
    a = """
        def _f():
            def _nested(): ...
        class A:
            def __init__(self): ...
            @property
            def _x(self): ...
            @_x.setter
            def _x(self, value): ...
        if True:
            def _g(): ...
        """
    assert count({"a.py": a})["rows"]["private functions"] == 3


# Imports.


def test_own_modules_of_a_file(count):
    a = """
        import torch, mjlab.c
        from mjlab.sim import d, Name
        from . import c
        def f():
            from mjlab.e import Other
        """
    files = dict.fromkeys(["c.py", "e.py", "sim/d.py", "sim/__init__.py"], "")
    init = "from mjlab import a, c, e\nfrom mjlab.sim import d, Name\n"
    report = count({"a.py": a, "__init__.py": init, **files})
    assert report["rows"]["most own modules without __init__"] == 4
    assert report["names"]["most own modules without __init__"] == "a.py"
    assert report["rows"]["most own modules imported"] == 5


LAZY = "def f():\n    from mjlab.a import X\n"
TYPING = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mjlab.a import X\n"


@pytest.mark.parametrize(
    ("text", "kinds"),
    [
        ("from mjlab.a import X\n", [1, 1, 1, 1]),
        ("try:\n    import mjlab.a\nexcept ImportError: ...\n", [1, 1, 1, 1]),
        (LAZY, [0, 1, 0, 1]),
        (TYPING, [0, 0, 1, 1]),
        ("if TYPE_CHECKING: ...\nelse:\n    from mjlab import a\n", [1, 1, 1, 1]),
        ("from mjlab import c\n", [0, 0, 0, 0]),
    ],
)
def test_kinds_of_circles(count, text, kinds):
    files = {"a.py": "from mjlab import b", "b.py": text, "c.py": "", "__init__.py": ""}
    found = count(files)["circles"]
    assert [len(groups) for groups in found.values()] == kinds
    assert all(groups in ([], [["mjlab.a", "mjlab.b"]]) for groups in found.values())


def test_circles_are_whole_and_apart(count):
    after = {"a": "b", "b": "c", "c": "a", "d": "e", "e": "d", "f": "a"}
    files = {f"{name}.py": f"import mjlab.{other}\n" for name, other in after.items()}
    found = count(files)["circles"]["at run time"]
    assert found == [["mjlab.a", "mjlab.b", "mjlab.c"], ["mjlab.d", "mjlab.e"]]


def test_a_submodule_does_not_import_its_package(count):
    files = {"sim/__init__.py": "from mjlab.sim.a import X\n", "sim/a.py": "import mjlab.sim.b\n"}
    assert count({**files, "sim/b.py": ""})["circles"]["at run time"] == []
    found = count({"sim/b.py": "from mjlab.sim import X\n"})["circles"]["at run time"]
    assert found == [["mjlab.sim", "mjlab.sim.a", "mjlab.sim.b"]]


# Patterns.


def test_patterns_in_sources_and_documentation(count):
    text = "# It has to.\n# That goes on.\nx = 1  # They end the line.\n# Reason.\n# It goes on.\n"
    files = {"README.md": "It has to.\n", "docs/a.md": "have to\n", "docs/_build/b.md": "has to\n"}
    found = count({"a.py": text, **files})["patterns"]
    assert found["has to, have to"] == [1, 2]
    assert found["comment opens with It, They, That ..."] == [2, None]


# Command.


def run(*args: str | Path) -> str:
    """Return the output of the tool."""
    command = [sys.executable, str(TOOL), *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_before_and_after(count, tmp_path):
    count({"sim/a.py": "x = 1\n"})
    numbers = tmp_path / "numbers.json"
    assert "before" not in run(tmp_path, "--json", numbers)
    assert json.loads(numbers.read_text())["rows"]["code lines"] == 1
    count({"sim/a.py": "x = 1\ny = 2\nz = 3\n", "rl/b.py": "x = 1\n"})
    lines = [line.split() for line in run(tmp_path, "--against", numbers).splitlines()]
    assert ["code", "lines", "1", "4"] in lines
    assert next(line for line in lines if line[:1] == ["sim"])[:5] == ["sim", "1", "1", "->", "3"]


def test_tables_have_rows_that_are_counted(stats, count):
    report = count({"a.py": SOURCE})
    assert set(stats.TO_REACH) <= set(report["rows"])
    assert set(stats.COLUMNS.values()) <= set(report["packages"]["(top)"])
