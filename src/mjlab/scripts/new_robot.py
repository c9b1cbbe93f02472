"""Write a package for a robot of one's own: `uv run mjlab new-robot MODEL [flags]`."""

from __future__ import annotations

import importlib.util
import keyword
import os
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Annotated

import mujoco
import tyro

from mjlab.cli.flags import parse_own_flags
from mjlab.cli.help import requested_topic
from mjlab.cli.main import run_alias
from mjlab.own_robot.guess import Question
from mjlab.own_robot.model_source import identifier, load_model, model_file
from mjlab.own_robot.package import Package, questions_table, values_table
from mjlab.own_robot.report import RobotReport, describe_robot
from mjlab.own_robot.rewriting import RECORD, Record, Task, deleted_files, read_record, write_files
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.string import command_line, suggest
from mjlab.utils.tables import WIDTH, tables_text


@dataclass(frozen=True)
class NewRobotConfig:
    """Flags of `new-robot`."""

    name: str | None = None
    """Name of the package, letters, digits and underscores. None: that of the model."""
    task: Task | None = None
    """Task: `velocity` or `tracking` (legs), `reach` (an arm), `bare` (robot only). None: `velocity` or
    `reach`, by the kind of the robot."""
    motion: Path | None = None
    """Motion file (.npz) of the task `tracking`."""
    output: str | None = None
    """Folder of the package. None: the name, in the current folder."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")
    ] = ()
    """Answer to a question, such as `armature=0.01` or `pose.FL_knee=-1.5`."""
    install: bool = False
    """Install the package in this environment, with uv."""


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab new-robot`."""
    source, *flags = argv
    cfg, others = parse_own_flags(NewRobotConfig(), flags, f"{prog} MODEL")
    if requested_topic(others) is not None:
        return
    if others:
        names = [f"--{field.name}" for field in fields(NewRobotConfig)]
        raise BadCallError(f"{prog}: unknown flag {others[0]!r}; {suggest(others[0], names)}")
    run_new_robot(source, cfg)


def run_new_robot(source: str, cfg: NewRobotConfig) -> Path:
    """Write the package of a robot, print its values, and return its folder.

    Raises:
        UserError: no robot at `source`, an unknown setting, or a folder with other files.
    """
    answers = dict(_setting(text) for text in cfg.set)
    if os.getcwd() not in sys.path:
        # As `python -m` does: modules in the working folder can be imported.
        sys.path.append(os.getcwd())
    path = Path(source).expanduser()
    try:
        # An archive is unpacked once.
        model = load_model(str(model_file(path)) if path.exists() else source)
    except ModuleNotFoundError as error:
        raise UserError(str(error)) from error
    name = cfg.name or (identifier(path.stem) if path.suffix == ".zip" else model.name)
    folder = Path(cfg.output or name).expanduser()
    _check_name(name, folder)
    record = read_record(folder)
    _check_model(source, record.model, folder)
    cfg = _with_recorded(cfg, record)
    # A later run keeps the answers of earlier ones.
    settings = record.settings | answers
    report = describe_robot(model, settings)
    if report.questions and not answers and on_terminal():
        settings |= _ask(report.questions)
        report = describe_robot(model, settings)
    package = Package(name, cfg.task or _task(report), report, cfg.motion)
    _check_task(package.task, report)
    if (package.task == "tracking") != (cfg.motion is not None):
        raise BadCallError(
            "new-robot: expected --task tracking with --motion FILE, got one of both."
        )
    if cfg.motion is not None and not cfg.motion.is_file():
        raise UserError(f"--motion {cfg.motion}: no such file.")
    tables = [values_table(report), questions_table(report)]
    print(tables_text([table for table in tables if table.rows], WIDTH))
    _check_bases(report)
    files = package.files(_command_line(source, cfg, settings), folder)
    motion = str(cfg.motion) if cfg.motion else None
    record = replace(record, model=source, task=cfg.task, motion=motion, settings=settings)
    kept = write_files(folder, files, record)
    print(_findings(package, folder))
    print(_summary(package, folder, kept, deleted_files(folder, record)))
    if cfg.install:
        _install(folder)
    return folder


def _with_recorded(cfg: NewRobotConfig, record: Record) -> NewRobotConfig:
    """Return the flags with the task and the motion of an earlier run, where they are not given."""
    task = cfg.task or record.task
    is_tracking = task == "tracking" and record.motion is not None
    motion = cfg.motion or (Path(record.motion) if is_tracking else None)
    return replace(cfg, task=task, motion=motion)


def _setting(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise BadCallError(f"--set {text!r}: expected KEY=VALUE, such as armature=0.01.")
    return key, value


def _check_model(source: str, recorded: str, folder: Path) -> None:
    """Raise `UserError` for a folder with the package of another model."""
    if recorded and Path(source).resolve() != Path(recorded).resolve():
        raise UserError(
            f"--output {folder}: expected the package of {source}, got that of {recorded}; use another "
            f'folder, or if the model has moved, change "model" in {folder / RECORD}.'
        )


def _check_name(name: str, folder: Path) -> None:
    """Raise `UserError` for a name that is none, or that of another module."""
    if not name.isidentifier() or keyword.iskeyword(name):
        raise UserError(
            f"--name {name!r}: expected a Python name; use e.g. --name {identifier(name)}."
        )
    found = importlib.util.find_spec(name)
    # A folder without `__init__.py`, such as that of the model, has no origin; the package hides it.
    origin = found.origin if found is not None else None
    if origin is not None and folder.resolve() not in Path(origin).resolve().parents:
        raise UserError(f"--name {name!r}: a module of this name exists; use another.")


def _task(report: RobotReport) -> Task:
    kind = report.anatomy.kind.value
    return "velocity" if kind == "legged" else "reach" if kind == "arm" else "bare"


def _check_task(task: Task, report: RobotReport) -> None:
    """Raise `UserError` for a task that needs parts that were not found."""
    for needed, parts, kind in (
        ("velocity", report.anatomy.feet.value, "legged"),
        ("tracking", report.anatomy.feet.value, "legged"),
        ("reach", report.anatomy.hands.value, "arm"),
    ):
        if task == needed and not (parts and report.anatomy.kind.value == kind):
            raise UserError(
                f"--task {task}: expected a robot of kind {kind}, found {report.anatomy.kind.value} "
                f"({report.anatomy.kind.rule}); use --set kind={kind} or --task bare."
            )


def _check_bases(report: RobotReport) -> None:
    """Raise `UserError` for a file with several floating bases: a package is of one robot."""
    free = [joint for joint in report.spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if len(free) > 1:
        names = ", ".join(repr(joint.parent.name) for joint in free)
        raise UserError(
            f"several floating bases: expected one robot, got bodies {names} with free joints; delete "
            "the others from the file. Nothing was written."
        )


def on_terminal() -> bool:
    """Return True if a person can answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _ask(questions: tuple[Question, ...]) -> dict[str, str]:
    """Return the user's answers on the terminal, by setting."""
    print("The model does not tell (Enter: the value in brackets):")
    answers = {}
    for question in questions:
        answer = input(f"  {question.key}: {question.text} [{question.used}]: ").strip()
        if answer:
            answers[question.key] = answer
    return answers


def _command_line(source: str, cfg: NewRobotConfig, settings: dict[str, str]) -> str:
    words = ["uv", "run", "mjlab", "new-robot", source]
    for flag in ("name", "task", "motion", "output"):
        if value := getattr(cfg, flag):
            words += [f"--{flag}", str(value)]
    for key, value in settings.items():
        words += ["--set", f"{key}={value}"]
    return command_line(words)


def _findings(package: Package, folder: Path) -> str:
    """Return what `mjlab check` finds in the robot as written, or as edited by the user."""
    from mjlab.scripts.check import check_entity, check_task, report

    # Without `__init__.py`, which would register the tasks in this process.
    written = ModuleType(package.name)
    written.__path__ = [str(folder.resolve() / "src" / package.name)]
    sys.modules[package.name] = written
    importlib.invalidate_caches()
    try:
        robot = importlib.import_module(f"{package.name}.robot")
        if package.task == "bare":
            findings = check_entity("robot", robot.get_robot_cfg())
        else:
            task = importlib.import_module(f"{package.name}.task")
            findings = check_task(
                task.flat_env_cfg() if package.task == "velocity" else task.env_cfg()
            )
    finally:
        # A later run in this process reads the files again.
        for module in [m for m in sys.modules if m.partition(".")[0] == package.name]:
            del sys.modules[module]
    return report(f"\nmjlab check {package.tasks[0] if package.tasks else package.name}", findings)


def _summary(package: Package, folder: Path, kept: list[str], deleted: list[str]) -> str:
    lines = ["", f"Wrote {folder}. Read {folder}/src/{package.name}/robot.py."]
    if kept:
        lines.append(
            f"Edited by you, and kept: {', '.join(kept)}. The new ones: FILE.new beside them."
        )
    if deleted:
        lines.append(f"Deleted by you, and left out: {', '.join(deleted)}.")
    if any(name.endswith("/robot.py") for name in kept):
        lines.append(
            "Not in force: values above that differ from robot.py, which is yours. Merge robot.py.new."
        )
    if package.report.anatomy.front.value < 0.0:
        lines.append(
            "Front -x sets the direction of the knees only: commands of lin_vel_x > 0 are along the trunk's x. "
            "Turn the trunk in the model file by pi about z to walk with the front ahead."
        )
    if package.report.questions:
        lines.append("Answer questions with --set KEY=VALUE, or edit the values.")
    lines += ["Next:", f"    uv pip install -e {shlex.quote(str(folder))}"]
    return "\n".join([*lines, *(f"    {line}" for line in package.commands())])


def _install(folder: Path) -> None:
    """Install the package into the environment of this process."""
    uv = shutil.which("uv")
    pip = (
        [uv, "pip", "install", "--python", sys.executable]
        if uv
        else [sys.executable, "-m", "pip", "install"]
    )
    # Its only requirement, mjlab, is running.
    words = [*pip, "--no-deps", "-e", str(folder)]
    outcome = subprocess.run(words, capture_output=True, text=True, check=False)
    if outcome.returncode:
        raise UserError(f"--install: {shlex.join(words)} failed:\n{outcome.stderr.strip()}")
    print(f"Installed {folder}.")


def main() -> None:
    """Entry point of `python -m mjlab.scripts.new_robot`."""
    run_alias("new-robot")


if __name__ == "__main__":
    main()
