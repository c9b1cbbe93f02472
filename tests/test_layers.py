"""Layers of the package: rules on imports that the import linter cannot express.

The layers are those of `[tool.importlinter]` in `pyproject.toml`, the highest first. The linter checks imports
at run time; these tests check the modules that it leaves out, annotations, task families and circles.
"""

from __future__ import annotations

import importlib.util
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]

# Modules whose public path lies in another layer, and a module of the layer where they stand.
STANDS_WITH = {
    "mjlab.tasks.tracking.scripts": "mjlab.scripts",
    "mjlab.utils.wrappers": "mjlab.viewer.base",
}
# Imported by name when an older name is used.
ABOVE_ALL = tuple(f"mjlab.compat.{name}" for name in ("older", "older_scripts", "older_terms"))
# Packages of several layers; their names are loaded on first use.
OF_SEVERAL_LAYERS = {"mjlab", "mjlab.viewer", "mjlab.viewer.native"}

# Names that annotations may take from a higher layer.
UPWARD = {"Entity", "EntityData", "ManagerBasedRlEnv"}

FAMILIES = {f"mjlab.tasks.{name}" for name in ("cartpole", "manipulation", "tracking", "velocity")}
# Modules outside a task family that import it: a command of motion tracking, and older names.
USERS_OF_FAMILIES = ("mjlab.scripts.csv_to_npz", *ABOVE_ALL)


@pytest.fixture(scope="module")
def stats() -> Any:
    """Tool that reads the sources and their imports."""
    spec = importlib.util.spec_from_file_location("layers_stats", ROOT / "tools" / "stats.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def sources(stats) -> list[Any]:
    """Source files of the package."""
    return stats.read_sources(ROOT)


@pytest.fixture(scope="module")
def imports(stats, sources) -> dict[str, set[str]]:
    """Modules that each module imports at run time, in functions too."""
    return stats.import_graph(sources, annotations=False, lazy=True)


def layer_table() -> dict[str, int]:
    """Return the height of each module of the table, 1 for the lowest."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    [layers] = [contract["layers"] for contract in contracts if contract["type"] == "layers"]
    heights = {
        module: height
        for height, layer in enumerate(reversed(layers), start=1)
        for module in layer.split(" | ")
    }
    heights |= {module: heights[other] for module, other in STANDS_WITH.items()}
    return heights | dict.fromkeys(ABOVE_ALL, len(layers) + 1)


HEIGHTS = layer_table()


def within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def height(module: str) -> int:
    """Return the height of a module: that of the longest name in the table it lies within, or 0."""
    names = [name for name in HEIGHTS if within(module, name)]
    return HEIGHTS[max(names, key=len)] if names else 0


def test_every_module_has_a_layer(imports) -> None:
    assert {module for module in imports if height(module) == 0} == OF_SEVERAL_LAYERS


def test_every_name_of_the_table_is_a_module(imports) -> None:
    assert set(HEIGHTS) <= set(imports)


def test_imports_at_run_time_point_downward(imports) -> None:
    upward = {
        (module, other)
        for module, others in imports.items()
        for other in others
        if height(other) > height(module) > 0
    }
    assert not upward


def test_annotations_look_upward_to_three_classes_only(sources) -> None:
    upward = {
        (source.module, name)
        for source in sources
        for base, name in source.imported_names
        if within(base, "mjlab")
        and max(height(base), height(f"{base}.{name}")) > height(source.module) > 0
    }
    assert {name for _, name in upward} <= UPWARD, upward


def test_no_modules_import_each_other_at_run_time(stats, sources) -> None:
    assert stats.circles(stats.import_graph(sources, annotations=False, lazy=False)) == []


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_task_families_are_imported_by_themselves_only(imports, family) -> None:
    users = {
        (module, other)
        for module, others in imports.items()
        for other in others
        if within(other, family)
        and not within(module, family)
        and not module.startswith(USERS_OF_FAMILIES)
    }
    assert not users


def test_all_task_families_are_listed(sources) -> None:
    folders = {
        f"mjlab.tasks.{source.path.parts[1]}"
        for source in sources
        if source.package == "tasks" and len(source.path.parts) > 2
    }
    assert folders == FAMILIES
