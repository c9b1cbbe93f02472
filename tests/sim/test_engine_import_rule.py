"""Import rule: engine libraries and modules are used only within their folders."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import mjlab

SOURCES = Path(mjlab.__file__).parent

# Allowed folders of `mjlab` by module name.
RULES = {
    "mujoco.batch": ("sim/native",),
    "warp": ("sim/warp",),
    "mujoco_warp": ("sim/warp",),
    "mjlab.sim.native": ("sim/native", "sim/engine.py"),
    "mjlab.sim.warp": ("sim/warp", "sim/engine.py", "sim/randomization.py", "sim/config.py")
    + ("sim/sim_data.py",),
}

NAME = r"\w+(\.\w+)+(:\w+)?"


def named_modules(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and module of every import, and of every string that is a dotted module name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.lineno, str(node.module)
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Constant) and re.fullmatch(NAME, str(node.value)):
            yield node.lineno, str(node.value).partition(":")[0]


def breaches(path: str, source: str) -> list[str]:
    # Parsing is slow, and most files do not contain these names.
    if not re.search(r"\b(batch|native|warp|mujoco_warp)\b", source):
        return []
    found = set()
    for line, name in named_modules(ast.parse(source)):
        for module, homes in RULES.items():
            is_it = name == module or name.startswith(f"{module}.")
            if is_it and not any(path == home or path.startswith(f"{home}/") for home in homes):
                found.add(f"{path}:{line} names {module}")
    return sorted(found)


def test_only_an_engine_names_its_library_and_modules() -> None:
    paths = sorted(SOURCES.rglob("*.py"))
    assert len(paths) > 100
    found = []
    for path in paths:
        found += breaches(path.relative_to(SOURCES).as_posix(), path.read_text(encoding="utf-8"))
    assert found == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("envs/a.py", "from mujoco import batch"),
        ("sim/simulation.py", "import mujoco.batch"),
        ("sim/warp/engine.py", "from mujoco.batch import Batch"),
        ("sim/native/rays.py", "def f():\n    import warp as wp"),
        ("sim/simulation.py", "import mujoco_warp._src.types"),
        ("entity/variants.py", "from mjlab.sim.warp.engine import put_variant_model"),
        ("scripts/cli.py", "NAMES = ('mjlab.sim.native.engine:NativeEngine',)"),
        ("sim/native/engine.py", "from mjlab.sim.warp import support"),
    ],
)
def test_a_breach_is_found(path: str, source: str) -> None:
    assert len(breaches(path, source)) == 1


def test_plain_mujoco_and_the_facade_are_free() -> None:
    source = "import mujoco, warped\nfrom mjlab.sim import Simulation\nNAME = 'mjlab.sim.engine'"
    assert breaches("envs/a.py", source) == []
