"""Test task packages: import each, then build, step and train every task it registers.

    python tools/packages.py [--engines native warp] [--json FILE] [FOLDER ...]

Each package runs in a separate process per engine, on the CPU, with a few environments. The result is
a Markdown table with a row per task and engine. The exit status is 1 if a row has an error.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import multiprocessing
import os
import re
import sys
import tempfile
import time
import tomllib
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from importlib.metadata import entry_points, requires, version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, get_args

from packaging.requirements import InvalidRequirement, Requirement

OWN_PACKAGES = Path(__file__).parents[1] / "tests" / "packages"
GROUP = "mjlab.tasks"
STAGES = ("import", "build", "step", "train")
Engine = Literal["native", "warp"]
ENGINES = get_args(Engine)

NUM_ENVS = 4
NUM_STEPS = 8
ITERATIONS = 2

# Folders beside a package's modules that are not part of it.
_NOT_MODULES = {"tests", "test", "docs", "scripts", "examples", "tools", "build", "dist", "logs"}


@dataclass
class Package:
    """Folder of a task package and what its project file declares."""

    folder: Path
    name: str
    requirement: str | None
    """Requirement on mjlab, as declared. None: none declared."""
    entry_points: dict[str, str]
    """Objects by name in the entry point group `mjlab.tasks`. Empty: tasks are registered when the
    top-level modules are imported."""

    @property
    def satisfied(self) -> bool | None:
        """True if this mjlab's version meets the requirement. None: no version is required."""
        if self.requirement is None:
            return None
        return version("mjlab") in Requirement(self.requirement).specifier

    @property
    def modules(self) -> list[str]:
        """Top-level modules that register the tasks."""
        if self.entry_points:
            return sorted({re.split(r"[.:]", value)[0] for value in self.entry_points.values()})
        root = self.folder / "src" if (self.folder / "src").is_dir() else self.folder
        packages = (init.parent for init in sorted(root.glob("*/__init__.py")))
        return [package.name for package in packages if package.name not in _NOT_MODULES]

    @property
    def roots(self) -> list[Path]:
        """Folders to import the modules from: the package's, its `src`, or one nested deeper."""
        roots = {}
        for module in self.modules:
            for pattern in ("", "src/", "*/", "*/*/"):
                found = [
                    *self.folder.glob(f"{pattern}{module}/__init__.py"),
                    *self.folder.glob(f"{pattern}{module}.py"),
                ]
                if found:
                    parent = found[0].parent
                    roots[parent.parent if found[0].name == "__init__.py" else parent] = None
                    break
        return list(roots) or [self.folder]


def read_package(folder: Path) -> Package:
    """Read the project file of a task package.

    Raises:
        FileNotFoundError: the folder does not exist.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"Package {str(folder)!r}: expected a folder, found none.")
    path = folder / "pyproject.toml"
    content = tomllib.loads(path.read_text()) if path.exists() else {}
    project = content.get("project", {})
    return Package(
        folder=folder.resolve(),
        name=project.get("name", folder.resolve().name),
        requirement=_mjlab_requirement(project.get("dependencies", [])),
        entry_points=dict(project.get("entry-points", {}).get(GROUP, {})),
    )


def _mjlab_requirement(dependencies: list[str]) -> str | None:
    for requirement in _parse(dependencies):
        # A requirement on a URL or a path has no version.
        if requirement.name == "mjlab" and requirement.url is None:
            return str(requirement)
    return None


def _parse(dependencies: list[str]) -> Iterator[Requirement]:
    for dependency in dependencies:
        # Project files may be unfilled templates.
        with contextlib.suppress(InvalidRequirement):
            yield Requirement(dependency)


@dataclass
class Trial:
    """Outcome of a task on one engine, or of a package that registers none."""

    package: str
    requirement: str | None
    satisfied: bool | None
    engine: Engine
    task: str | None = None
    passed: list[str] = field(default_factory=list)
    """Stages passed, of `import`, `build`, `step` and `train`."""
    seconds: float = 0.0
    warnings: list[str] = field(default_factory=list)
    error: str | None = None

    @property
    def ok(self) -> bool:
        """True if the task passed all stages."""
        return self.error is None and self.passed == list(STAGES)


# Child process that tests a package. It sends a message per event: ("tasks", names), ("start", task),
# ("passed", stage), ("warned", message), ("failed", error) and ("end", seconds).


class _Worker:
    def __init__(self, connection: Connection, package: Package, engine: Engine) -> None:
        self._connection = connection
        self._package = package
        self._engine = engine
        self._warned: set[str] = set()

    def run(self, done: list[str]) -> None:
        """Import the package and test its tasks except `done`."""
        warnings.simplefilter("always")
        warnings.showwarning = self._report_warning  # ty: ignore[invalid-assignment]
        try:
            tasks = self._import()
        except (Exception, SystemExit) as error:
            self._send("failed", _describe(error, self._package))
            return
        self._send("tasks", tasks)
        for task in tasks:
            if task not in done:
                self._try(task)

    def _send(self, event: str, value: Any) -> None:
        self._connection.send((event, value))

    def _report_warning(self, message: Any, category: type, filename: str, *_: Any) -> None:
        # mjlab warns of older names with FutureWarning, and of replaced values with UserWarning.
        if not issubclass(category, FutureWarning | UserWarning) or str(message) in self._warned:
            return
        if "mjlab" in Path(filename).parts or Path(filename).is_relative_to(self._package.folder):
            self._warned.add(str(message))
            self._send("warned", f"{category.__name__}: {message}")

    def _import(self) -> list[str]:
        from mjlab.tasks import registry

        before = set(registry.list_tasks())
        sys.path[:0] = [str(root) for root in self._package.roots]
        # Metadata as written by an installer, because packages may query their own.
        sys.path.append(str(self._write_metadata()))
        importlib.invalidate_caches()
        for entry_point in entry_points(group=GROUP):
            if self._package.entry_points.get(entry_point.name) == entry_point.value:
                entry_point.load()
        for module in self._package.modules:
            importlib.import_module(module)
        tasks = sorted(set(registry.list_tasks()) - before)
        if not tasks:
            raise LookupError(f"importing {', '.join(self._package.modules)} registers no task")
        return tasks

    def _write_metadata(self) -> Path:
        site = Path(tempfile.mkdtemp(dir=Path.cwd()))
        info = site / f"{re.sub(r'[-_.]+', '_', self._package.name)}-0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {self._package.name}\nVersion: 0\n"
        )
        lines = [f"{name} = {value}" for name, value in self._package.entry_points.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines, ""]))
        return site

    def _try(self, task: str) -> None:
        self._send("start", task)
        self._send("passed", "import")
        started = time.monotonic()
        try:
            for stage in self._stages(task):
                self._send("passed", stage)
        except (Exception, SystemExit) as error:
            self._send("failed", _describe(error, self._package))
        self._send("end", time.monotonic() - started)

    def _stages(self, task: str) -> Iterator[str]:
        """Yield each stage after the import once it is passed."""
        import torch

        from mjlab.envs import ManagerBasedRlEnv
        from mjlab.runs import Run
        from mjlab.scripts.train import TrainConfig, launch_training
        from mjlab.tasks.registry import load_env_cfg

        envs = []
        for play in (False, True):
            cfg = load_env_cfg(task, play=play)
            cfg.scene.num_envs = NUM_ENVS
            cfg.sim.engine = self._engine
            envs.append(ManagerBasedRlEnv(cfg, device="cpu"))
        yield "build"
        for env in envs:
            env.reset()
            for _ in range(NUM_STEPS):
                env.step(2.0 * torch.rand(NUM_ENVS, env.action_manager.total_action_dim) - 1.0)
            env.close()
        yield "step"
        cfg = TrainConfig.from_task(task)
        cfg.num_envs, cfg.engine, cfg.device = NUM_ENVS, self._engine, "cpu"
        cfg.log_root = str(Path.cwd() / "logs")
        cfg.agent.num_steps_per_env = NUM_STEPS
        cfg.agent.max_iterations = ITERATIONS
        cfg.agent.logger = "tensorboard"
        checkpoints = Run(launch_training(task, cfg)).checkpoints
        if not checkpoints:
            raise FileNotFoundError("training left no checkpoint")
        yield "train"


def _describe(error: BaseException, package: Package) -> str:
    """Return the last line of the error, and the file of the package that raised it."""
    missing = _missing_dependency(error, package)
    text = missing or f"{type(error).__name__}: {str(error).strip() or 'no message'}"
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.is_relative_to(package.folder):
            return f"{text} ({path.relative_to(package.folder)}:{frame.lineno})"
    return text


def _missing_dependency(error: BaseException | None, package: Package) -> str | None:
    """Return a message if a third-party module is missing, with the mjlab extra that provides it."""
    while error is not None and not isinstance(error, ModuleNotFoundError):
        error = error.__cause__
    if error is None or error.name is None:
        return None
    module = error.name.partition(".")[0]
    if module == "mjlab" or module in package.modules:
        return None
    extra = _extra_with(module)
    hint = f"; mjlab[{extra}] brings it" if extra else ""
    return f"missing dependency {module!r}{hint}"


def _extra_with(distribution: str) -> str | None:
    for requirement in _parse(requires("mjlab") or []):
        if requirement.name == distribution and requirement.marker:
            match = re.search(r"extra == ['\"]([\w-]+)['\"]", str(requirement.marker))
            if match:
                return match[1]
    return None


def _work(
    connection: Connection, package: Package, engine: Engine, done: list[str], folder: str
) -> None:
    os.chdir(folder)
    # Output of packages must not mix with the table.
    with open("output.txt", "a") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    _Worker(connection, package, engine).run(done)


# Parent process.


def try_package(package: Package, engine: Engine, seconds: float) -> list[Trial]:
    """Test all tasks of a package on an engine, each for at most `seconds`."""
    trials: list[Trial] = []
    with tempfile.TemporaryDirectory() as folder:
        # A crash or timeout ends the process; a new one runs the remaining tasks.
        while not _watch(package, engine, seconds, folder, trials):
            pass
    return trials


def _watch(
    package: Package, engine: Engine, seconds: float, folder: str, trials: list[Trial]
) -> bool:
    """Run one process, adding to `trials`; return True if no task remains."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    done = [trial.task for trial in trials]
    process = context.Process(target=_work, args=(sender, package, engine, done, folder))
    process.start()
    sender.close()
    trial = Trial(package.name, package.requirement, package.satisfied, engine)
    tasks: list[str] | None = None
    end = time.monotonic() + seconds
    try:
        while receiver.poll(max(0.0, end - time.monotonic())):
            event, value = receiver.recv()
            if event == "tasks":
                tasks = value
            elif event == "start":
                trial.task = value
                trials.append(trial)
                end = time.monotonic() + seconds
            elif event == "passed":
                trial.passed.append(value)
            elif event == "warned":
                trial.warnings.append(value)
            elif event == "failed":
                trial.error = value
            elif event == "end":
                trial.seconds = value
                trial = Trial(package.name, package.requirement, package.satisfied, engine)
        trial.error = f"timed out after {seconds:g} s"
        process.kill()
    except EOFError:
        process.join()
        if process.exitcode:
            trial.error = f"crashed with exit status {process.exitcode}: {_last_line(folder)}"
    finally:
        process.kill()
        process.join()
        receiver.close()
    if tasks is None:
        trials.append(trial)
        return True
    return len(trials) >= len(tasks)


def _last_line(folder: str) -> str:
    lines = (Path(folder) / "output.txt").read_text(errors="replace").split("\n")
    return next((line for line in reversed(lines) if line.strip()), "no output")


# The table.

_COLUMNS = ("package", "requires", "task", "engine", *STAGES, "warnings", "error")


def show(trials: list[Trial]) -> str:
    """Return the trials as a Markdown table."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|" + " --- |" * len(_COLUMNS)]
    lines += ["| " + " | ".join(_cells(trial)) + " |" for trial in trials]
    return "\n".join(lines)


def _cells(trial: Trial) -> list[str]:
    requirement = {None: "", True: " (met)", False: " (**not met**)"}[trial.satisfied]
    failed = next((stage for stage in STAGES if stage not in trial.passed), None)
    verdicts = ["yes" if s in trial.passed else "**no**" if s == failed else "" for s in STAGES]
    error = (trial.error or "").splitlines()[:1]
    return [
        trial.package,
        f"`{trial.requirement}`{requirement}" if trial.requirement else "",
        trial.task or "",
        trial.engine,
        *verdicts,
        str(len(trial.warnings) or ""),
        "".join(error).replace("|", "\\|"),
    ]


def main() -> None:
    """Test the packages of the command line; print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds for a task")
    parser.add_argument("--json", type=Path, help="file to write the trials to as well")
    args = parser.parse_args()
    folders = args.folders or sorted(path.parent for path in OWN_PACKAGES.glob("*/pyproject.toml"))
    os.environ["WANDB_MODE"] = "disabled"

    trials = []
    for package in [read_package(folder) for folder in folders]:
        for engine in args.engines:
            print(f"{package.name} on {engine} ...", file=sys.stderr, flush=True)
            trials += try_package(package, engine, args.timeout)
            if args.json:
                args.json.write_text(json.dumps([asdict(trial) for trial in trials], indent=2))
    print(show(trials))
    warned = {message: None for trial in trials for message in trial.warnings}
    if warned:
        print("\nWarnings:\n\n" + "\n".join(f"- {message}" for message in warned))
    sys.exit(0 if trials and all(trial.ok for trial in trials) else 1)


if __name__ == "__main__":
    main()
