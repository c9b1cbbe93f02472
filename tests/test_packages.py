"""Task packages, tried by `tools/packages.py`: those of `tests/packages`, and broken ones."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import textwrap
from pathlib import Path
from types import ModuleType

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "packages.py"
OWN_PACKAGES = sorted((Path(__file__).parent / "packages").glob("*/pyproject.toml"))


def run_tool(tmp_path: Path, *args: str | Path) -> tuple[int, list[dict], str]:
    """Return the exit status, the trials and the output of the tool."""
    trials = tmp_path / "trials.json"
    command = [sys.executable, TOOL, *args, "--json", trials]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    assert trials.exists(), done.stderr
    return done.returncode, json.loads(trials.read_text()), done.stdout


# CI runs `make packages` on the native engine, which is the same.
@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("project", OWN_PACKAGES, ids=lambda path: path.parent.name)
def test_packages_of_each_release_build_step_and_train(tmp_path, project, engine):
    status, trials, table = run_tool(tmp_path, project.parent, "--engines", engine)
    assert [trial["error"] for trial in trials] == [None] * len(trials)
    assert {tuple(trial["passed"]) for trial in trials} == {("import", "build", "step", "train")}
    assert {trial["satisfied"] for trial in trials} == {True}
    assert status == 0
    assert all(trial["task"] in table for trial in trials)


def test_the_page_names_every_package():
    page = (Path(__file__).parents[1] / "docs" / "how-to" / "packages.md").read_text()
    assert [path for path in OWN_PACKAGES if path.parent.name not in page] == []


# Broken packages.


@pytest.fixture
def package(tmp_path):
    """Return a function that writes a task package and returns its folder."""

    def write(name: str, text: str, project: str = "") -> Path:
        folder = tmp_path / name
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(textwrap.dedent(text))
        default = f"""
            [project]
            name = "{name}"
            dependencies = ["mjlab>=1.1"]
            [project.entry-points."mjlab.tasks"]
            tasks = "{name}"
        """
        (folder / "pyproject.toml").write_text(textwrap.dedent(project or default))
        return folder

    return write


MIXED = """
import os
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, register_mjlab_task

def crashes(play=False):
    os._exit(7)

def fails(play=False):
    raise ValueError("their mistake")

def works(play=False):
    return load_env_cfg("Mjlab-Cartpole-Balance", play=play)

for env_cfg in (crashes, fails, works):
    rl_cfg = load_rl_cfg("Mjlab-Cartpole-Balance")
    register_mjlab_task(env_cfg.__name__, env_cfg, rl_cfg=rl_cfg)
"""


def test_failing_imports_do_not_hurt_others(tmp_path, package):
    raises = package("raises", "x = 1\n\nraise RuntimeError('their mistake')\n")
    lacks = package("lacks", "import no_such_module_anywhere\n")
    dropped = package("dropped", "from mjlab.entity import NoSuchThing\n")
    silent = package("silent", "VALUE = 1\n")
    status, trials, table = run_tool(
        tmp_path, raises, lacks, dropped, silent, "--engines", "native"
    )
    assert status == 1
    assert [trial["package"] for trial in trials] == ["raises", "lacks", "dropped", "silent"]
    assert [trial["passed"] for trial in trials] == [[]] * 4
    assert [trial["task"] for trial in trials] == [None] * 4
    first, second, third, fourth = (trial["error"] for trial in trials)
    assert first == "RuntimeError: their mistake (raises/__init__.py:3)"
    assert second == "missing dependency 'no_such_module_anywhere' (lacks/__init__.py:1)"
    assert third.startswith("ImportError")
    assert "NoSuchThing" in third
    assert third.endswith("(dropped/__init__.py:1)")
    assert "registers no task" in fourth
    assert all(error.splitlines()[0] in table for error in (first, second, fourth))


@pytest.mark.slow
def test_a_task_that_fails_or_crashes_leaves_the_others_alone(tmp_path, package):
    status, trials, _ = run_tool(tmp_path, package("mixed", MIXED), "--engines", "native")
    assert status == 1
    crashed, failed, works = trials
    assert (crashed["task"], failed["task"], works["task"]) == ("crashes", "fails", "works")
    assert crashed["error"].startswith("crashed with exit status 7")
    assert failed["error"] == "ValueError: their mistake (mixed/__init__.py:9)"
    assert crashed["passed"] == failed["passed"] == ["import"]
    assert works["error"] is None
    assert works["passed"] == ["import", "build", "step", "train"]


def test_a_package_that_hangs_is_stopped(tmp_path, package):
    folder = package("hangs", "import time\ntime.sleep(100)\n")
    status, trials, _ = run_tool(tmp_path, folder, "--engines", "native", "--timeout", "3")
    assert status == 1
    assert [trial["error"] for trial in trials] == ["timed out after 3 s"]


# Project files.


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("packages_tool", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("dependencies", "requirement", "satisfied"),
    [
        ('["mjlab>=1.1"]', "mjlab>=1.1", True),
        ('["numpy", "mjlab >=1.3, <2"]', "mjlab<2,>=1.3", True),
        ('["mjlab==1.2.0"]', "mjlab==1.2.0", False),
        ('["mjlab @ git+https://example.org/mjlab"]', None, None),
        ('["not a requirement!", "mjlab[cu128]~=1.6"]', "mjlab[cu128]~=1.6", True),
        ("[]", None, None),
    ],
)
def test_the_requirement_on_mjlab_is_compared_with_the_version(
    tool, package, monkeypatch, dependencies, requirement, satisfied
):
    monkeypatch.setattr(tool, "version", lambda name: "1.6.100")
    folder = package("pinned", "", f'[project]\nname = "pinned"\ndependencies = {dependencies}\n')
    read = tool.read_package(folder)
    assert read.requirement == requirement
    assert read.satisfied is satisfied


@pytest.mark.parametrize("where", ["", "src", "source/deeper"])
def test_modules_are_found_where_packages_keep_them(tool, tmp_path, where):
    (tmp_path / where / "their_tasks").mkdir(parents=True)
    (tmp_path / where / "their_tasks" / "__init__.py").touch()
    (tmp_path / "pyproject.toml").write_text(
        '[project]\nname = "x"\n[project.entry-points."mjlab.tasks"]\nx = "their_tasks.sub:go"\n'
    )
    package = tool.read_package(tmp_path)
    assert package.modules == ["their_tasks"]
    assert package.roots == [tmp_path / where]


def test_without_entry_points_top_level_packages_are_imported(tool, tmp_path):
    for name in ("their_tasks", "tests", "docs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    package = tool.read_package(tmp_path)
    assert package.name == tmp_path.name
    assert package.modules == ["their_tasks"]
    assert package.roots == [tmp_path]


def test_a_missing_dependency_of_an_extra_names_the_extra(tool, monkeypatch, tmp_path):
    monkeypatch.setattr(
        tool, "requires", lambda name: ["numpy", 'moviepy>=2; extra == "compat"', "not a thing!"]
    )
    package = tool.Package(tmp_path, "x", None, {"x": "their_tasks"})
    error = ModuleNotFoundError("No module named 'moviepy'", name="moviepy.editor")
    assert tool._describe(error, package) == (
        "missing dependency 'moviepy'; mjlab[compat] brings it"
    )
    # Modules of mjlab and of the package are not dependencies.
    for name in ("mjlab.no_such_module", "their_tasks.sub"):
        error = ModuleNotFoundError(f"No module named {name!r}", name=name)
        assert tool._describe(error, package) == f"ModuleNotFoundError: No module named {name!r}"


def test_a_folder_that_does_not_exist_is_named(tool, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        tool.read_package(tmp_path / "nowhere")
