"""The wheel: its version satisfies task packages, and it carries types. Everything offline."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import textwrap
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
VERSION = PROJECT["project"]["version"]
# Tags of wheels for every Python and machine.
_ANY = "py3-none-any"


@pytest.fixture(scope="module")
def uv() -> str:
    """Return the path of uv. `uv run` sets the variable UV, so `make test` always has it."""
    found = (
        os.environ.get("UV")
        or shutil.which("uv")
        or shutil.which("uv", path=Path.home() / ".local" / "bin")
    )
    if found is None:
        pytest.fail("uv is neither in the variable UV, on PATH nor in ~/.local/bin; use make test.")
    return found


def run(*command: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
    )


def build_wheel(project: Path, folder: Path) -> Path:
    before = set(folder.glob("*.whl"))
    hatch = (sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder))
    built = run(*hatch, cwd=project)
    assert built.returncode == 0, built.stderr
    (wheel,) = set(folder.glob("*.whl")) - before
    return wheel


def build_package(project: Path, folder: Path, requirement: str) -> Path:
    """Build a package with one task, which requires `requirement`."""
    (project / "walker_tasks").mkdir(parents=True)
    (project / "pyproject.toml").write_text(
        textwrap.dedent(
            f"""
            [build-system]
            requires = ["hatchling"]
            build-backend = "hatchling.build"

            [project]
            name = "walker-tasks"
            version = "0.3"
            dependencies = ["{requirement}"]

            [project.entry-points."mjlab.tasks"]
            walker = "walker_tasks"
            """
        )
    )
    (project / "walker_tasks" / "__init__.py").write_text(
        textwrap.dedent(
            """
            from prettytable import PrettyTable

            from mjlab.tasks.registry import register_mjlab_task

            register_mjlab_task("Walker", "walker_tasks.cfg:env", rl_cfg="walker_tasks.cfg:rl")
            """
        )
    )
    return build_wheel(project, folder)


def stand_in(name: str, folder: Path, version: str | None = None, tags: str = _ANY) -> None:
    """Write a wheel without files, by default with the version of the distribution installed here."""
    version = version or importlib.metadata.version(name)
    stem = f"{name.replace('-', '_')}-{version}"
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    tag = f"Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: {tags}\n"
    with zipfile.ZipFile(folder / f"{stem}-{tags}.whl", "w") as wheel:
        wheel.writestr(f"{stem}.dist-info/METADATA", metadata)
        wheel.writestr(f"{stem}.dist-info/WHEEL", tag)
        wheel.writestr(f"{stem}.dist-info/RECORD", "")


@pytest.fixture(scope="module")
def wheels(tmp_path_factory) -> Path:
    """Return a folder with the wheel of this checkout, and stand-ins for its dependencies."""
    folder = tmp_path_factory.mktemp("wheels")
    wheel = build_wheel(ROOT, folder)
    with zipfile.ZipFile(wheel) as files:
        (metadata,) = (name for name in files.namelist() if name.endswith("/METADATA"))
        text = files.read(metadata).decode()
    for requirement in re.findall(r"^Requires-Dist: (.*)$", text, re.MULTILINE):
        if "extra ==" not in requirement:
            stand_in(re.split(r"[^\w-]", requirement)[0], folder)
    return folder


@pytest.fixture(scope="module")
def site(wheels, tmp_path_factory) -> Path:
    """Return a folder with this checkout's wheel unpacked as an installer would."""
    folder = tmp_path_factory.mktemp("site")
    (wheel,) = wheels.glob("mjlab-*.whl")
    with zipfile.ZipFile(wheel) as files:
        files.extractall(folder)
    return folder


def install(uv: str, wheels: Path, target: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    return run(
        uv, "pip", "install", "--python", sys.executable, "--offline", "--no-index", "--no-config",
        "--find-links", wheels, "--target", target, *flags, "walker-tasks", cwd=target.parent,
    )  # fmt: skip


def test_the_version_says_which_interface_it_speaks():
    assert re.fullmatch(r"1\.6\.1\d\d", VERSION)


def test_a_package_of_the_releases_resolves_and_its_task_is_found(uv, wheels, tmp_path):
    folder = shutil.copytree(wheels, tmp_path / "wheels")
    build_package(tmp_path / "package", folder, "mjlab>=1.4,<2")
    done = install(uv, folder, tmp_path / "site")
    assert done.returncode == 0, done.stderr
    installed = {path.name for path in (tmp_path / "site").glob("*.dist-info")}
    assert {f"mjlab-{VERSION}.dist-info", "walker_tasks-0.3.dist-info"} <= installed
    listed = run(
        sys.executable, "-c",
        "import mjlab; from mjlab.tasks.registry import list_tasks; "
        "print(mjlab.__file__, 'Walker' in list_tasks())",
        cwd=tmp_path, PYTHONPATH=str(tmp_path / "site"),
    )  # fmt: skip
    assert listed.stdout.split() == [str(tmp_path / "site" / "mjlab" / "__init__.py"), "True"], (
        listed.stderr
    )


def test_a_package_pinned_below_is_refused_unless_the_pin_is_overridden(uv, wheels, tmp_path):
    folder = shutil.copytree(wheels, tmp_path / "wheels")
    build_package(tmp_path / "package", folder, "mjlab==1.2.0")
    refused = install(uv, folder, tmp_path / "site")
    assert refused.returncode != 0
    assert "mjlab==1.2.0" in refused.stderr
    (tmp_path / "overrides.txt").write_text("mjlab\n")
    done = install(uv, folder, tmp_path / "site", "--overrides", "overrides.txt")
    assert done.returncode == 0, done.stderr


def test_a_project_takes_this_mjlab_for_all_its_packages(uv, wheels, tmp_path):
    """As docs/how-to/other_packages.md says: a source, and an override for pins below 1.6."""
    folder = shutil.copytree(wheels, tmp_path / "wheels")
    build_package(tmp_path / "package", folder, "mjlab==1.2.0")
    (wheel,) = folder.glob("mjlab-*.whl")
    # Out of the index, so that only the source can bring it.
    wheel.rename(tmp_path / wheel.name)
    project = tmp_path / "project"
    project.mkdir()
    (project / "pyproject.toml").write_text(
        textwrap.dedent(
            f"""
            [project]
            name = "mine"
            version = "0"
            requires-python = "=={sys.version_info.major}.{sys.version_info.minor}.*"
            dependencies = ["mjlab", "walker-tasks"]

            [tool.uv]
            no-index = true
            find-links = ["../wheels"]
            override-dependencies = ["mjlab"]

            [tool.uv.sources]
            mjlab = {{ path = "../{wheel.name}" }}
            """
        )
    )
    locked = run(uv, "lock", "--offline", "--python", sys.executable, cwd=project)
    assert locked.returncode == 0, locked.stderr
    text = (project / "uv.lock").read_text()
    assert f'source = {{ path = "../{wheel.name}" }}' in text
    assert f'version = "{VERSION}"' in text


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere, torch has no CUDA by default")
def test_a_fetched_build_of_torch_is_kept(uv, tmp_path):
    checkout, index, others = (tmp_path / name for name in ("checkout", "index", "others"))
    for folder in (index, others, checkout / "wheels"):
        folder.mkdir(parents=True)
    settings = PROJECT["tool"]["uv"]
    (pinned,) = (text for text in settings["constraint-dependencies"] if text.startswith("torch=="))
    version = pinned.removeprefix("torch==")
    stand_in("torch", index, version)
    tag = "cp{}{}".format(*sys.version_info)
    stand_in("torch", others, f"{version}+cpu", f"{tag}-{tag}-linux_{platform.machine()}")
    (checkout / "pyproject.toml").write_text(
        f"""[project]
name = "project"
version = "1"
requires-python = "==3.{sys.version_info.minor}.*"
dependencies = ["torch"]

[tool.uv]
find-links = {settings["find-links"]}
constraint-dependencies = ["{pinned}"]
"""
    )
    (checkout / "tools").mkdir()
    shutil.copy(ROOT / "tools" / "torch_wheel.py", checkout / "tools")
    offline = {"UV_OFFLINE": "1", "UV_NO_INDEX": "1", "UV_PYTHON": sys.executable, "UV": uv}
    show = "import importlib.metadata as m; print(m.version('torch'))"

    def installed() -> str:
        """Return the torch of `uv run`, which finds the default build in the index only."""
        command = (uv, "run", "python", "-c", show)
        done = run(*command, cwd=checkout, **offline, UV_FIND_LINKS=str(index))
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert installed() == version
    folders = f"{index},{others}"
    for _ in range(2):
        fetch = (sys.executable, "tools/torch_wheel.py", "cpu")
        fetched = run(*fetch, cwd=checkout, **offline, UV_FIND_LINKS=folders)
        assert fetched.returncode == 0, fetched.stderr
        assert installed() == f"{version}+cpu"
    missing = run(*fetch[:-1], "cu1", cwd=checkout, **offline, UV_FIND_LINKS=folders)
    assert missing.returncode == 1
    assert "UV_FIND_LINKS" in missing.stderr


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize(("words", "fetches"), [(("TORCH=cpu",), True), ((), False)])
def test_make_fetches_the_build_that_is_named(words, fetches):
    done = run("make", "-n", "train", *words, cwd=ROOT)
    shell = run("sh", "-n", "-c", done.stdout, cwd=ROOT)
    assert (done.returncode, shell.returncode) == (0, 0), done.stderr + shell.stderr
    assert ("tools/torch_wheel.py cpu" in done.stdout) == fetches


def test_the_wheel_carries_its_types(site):
    assert (site / "mjlab" / "py.typed").is_file()


def test_the_wheel_carries_the_references_that_verify_reads(site):
    names = {path.name for path in (ROOT / "src" / "mjlab" / "reference").iterdir()}
    assert {path.name for path in (site / "mjlab" / "reference").iterdir()} == names


def test_a_package_is_type_checked_against_the_wheel(site, tmp_path):
    right = textwrap.dedent(
        """
        from typing import assert_type

        import torch

        from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
        from mjlab.managers import RewardTermCfg
        from mjlab.tasks.registry import load_env_cfg


        def height(env: ManagerBasedRlEnv) -> torch.Tensor:
            return env.sim.data.qpos[:, 2]


        cfg = load_env_cfg("Mjlab-Cartpole-Balance")
        assert_type(cfg, ManagerBasedRlEnvCfg)
        assert_type(cfg.decimation, int)
        cfg.rewards["height"] = RewardTermCfg(func=height, weight=1.0)
        """
    )
    (tmp_path / "right.py").write_text(right)
    (tmp_path / "wrong.py").write_text(right.replace("weight=1.0", "weight='much'"))

    def check(file: str) -> subprocess.CompletedProcess[str]:
        ty = Path(sys.executable).with_name("ty")
        search = ("--python", sys.prefix, "--extra-search-path", str(site))
        return run(ty, "check", *search, "--output-format", "concise", file, cwd=tmp_path)

    passed, failed = check("right.py"), check("wrong.py")
    assert passed.returncode == 0, passed.stdout
    assert "Expected `float`" in failed.stdout
    assert "Found 1 diagnostic" in failed.stdout
