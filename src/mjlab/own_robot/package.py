"""A small package of the user's own from a model file: robot, task, registration, README and test."""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from mjlab.own_robot.anatomy import SOLE_RULE
from mjlab.own_robot.guess import Guess
from mjlab.own_robot.model_files import copy_model
from mjlab.own_robot.python_text import number
from mjlab.own_robot.report import RobotReport
from mjlab.own_robot.rewriting import Task
from mjlab.own_robot.robot_source import by_pattern, imu_site, robot_source
from mjlab.own_robot.settings import PER_JOINT
from mjlab.own_robot.task_source import reach_source, tracking_source, velocity_source
from mjlab.own_robot.templates import template
from mjlab.utils.tables import Table


@dataclass(frozen=True)
class Package:
    """Package to write."""

    name: str
    """Python module: letters, digits and underscores."""
    task: Task
    """Task of the robot."""
    report: RobotReport
    """Values of the robot."""
    motion: Path | None = None
    """Motion file of the tracking task."""

    @property
    def title(self) -> str:
        """Name of the robot in text and tasks, such as `Mini-Cheetah`."""
        return "-".join(word[:1].upper() + word[1:] for word in self.name.split("_") if word)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the registered tasks."""
        if self.task == "bare":
            return ()
        if self.task == "reach":
            return (f"Reach-{self.title}",)
        if self.task == "tracking":
            return (f"Tracking-Flat-{self.title}",)
        return tuple(f"Velocity-{terrain}-{self.title}" for terrain in ("Flat", "Rough"))

    def files(self, command: str, folder: Path) -> dict[str, bytes]:
        """Return the content of each file by its path in the package.

        Args:
            command: Command line that writes the package, for the README.
            folder: Folder of the package, for the README.
        """
        module, title, report = f"src/{self.name}", self.title, self.report
        names = {"package": self.name, "title": title, "task_name": title}
        kind = "legged" if self.task == "velocity" else self.task
        with tempfile.TemporaryDirectory() as temporary:
            models = Path(temporary) / "model"
            model = copy_model(report.model, models)
            found = {
                f"{module}/model/{path.relative_to(models).as_posix()}": path.read_bytes()
                for path in sorted(models.rglob("*"))
                if path.is_file()
            }
        text = {
            "pyproject.toml": template("pyproject.toml").substitute(
                names, distribution=self.name.strip("_").replace("_", "-")
            ),
            f"{module}/__init__.py": template(f"{kind}_init.py").substitute(names),
            f"{module}/robot.py": robot_source(report, title, model),
            f"tests/test_{self.name}.py": self._test(kind, names),
            "README.md": self._readme(command, folder),
        }
        if self.task == "velocity":
            text[f"{module}/task.py"] = velocity_source(report, self.name, title, title)
        if self.task == "reach":
            text[f"{module}/task.py"] = reach_source(report, self.name, title)
        if self.task == "tracking":
            assert self.motion is not None
            text[f"{module}/task.py"] = tracking_source(report, self.name, title, self.motion.name)
            found[f"{module}/motions/{self.motion.name}"] = self.motion.read_bytes()
        return found | {name: content.encode() for name, content in text.items()}

    @property
    def _has_two_legs(self) -> bool:
        return self.task == "velocity" and len(self.report.anatomy.feet.value) == 2

    @property
    def _standing(self) -> str:
        """Claim of the package's test."""
        return (
            f"falls no sooner than after {_TWO_LEGS_STAND:g} s" if self._has_two_legs else "stands"
        )

    def _test(self, kind: str, names: dict[str, str]) -> str:
        if kind != "legged":
            return template(f"{kind}_test.py").substitute(names)
        has_two = self._has_two_legs
        reason = "Two legs fall soon without a policy." if has_two else "Legs yield a little."
        return template("legged_test.py").substitute(
            names,
            seconds=_TWO_LEGS_STAND if has_two else 2.0,
            test_name="falls_late" if has_two else "stands_for_two_seconds",
            what=self._standing,
            seconds_reason=reason,
        )

    def _readme(self, command: str, folder: Path) -> str:
        module = f"src/{self.name}"
        contents = {
            f"{module}/robot.py": "initial pose, motors, parts: each value with its reason",
            f"{module}/model/": "the model file and its meshes",
            f"{module}/__init__.py": "registration of the tasks",
            f"tests/test_{self.name}.py": f"{self._standing}, and its tasks can be stepped (`uv run pytest`)",
        }
        if self.tasks:
            contents[f"{module}/task.py"] = "commands, rewards, terminations, profile for a CPU"
        questions = questions_table(self.report)
        asked = ["", "## Questions", "", questions.markdown()] if questions.rows else []
        if self._has_two_legs:
            asked += ["", _TWO_LEGS]
        return template("README.md").substitute(
            title=self.title,
            command=command,
            contents="\n".join(f"| `{file}` | {what} |" for file, what in contents.items()),
            folder=shlex.quote(folder.as_posix()),
            run="\n".join(self.commands()),
            values=values_table(self.report).markdown(),
            questions="\n".join(asked),
        )

    def commands(self) -> list[str]:
        """Return the command lines to start with."""
        view = f"uv run mjlab view {self.name}.robot:get_robot_cfg"
        if not self.tasks:
            return [view]
        task = self.tasks[0]
        return [
            view,
            f"uv run mjlab describe {task}",
            f"uv run mjlab play {task} --agent zero",
            f"uv run mjlab train {task} --profile cpu",
            f"uv run mjlab play {task}",
        ]


_TWO_LEGS_STAND = 0.4
"""Time that two legs stand without a policy (s)."""
_TWO_LEGS = """\
## Two legs

The profile `cpu` is that of the G1. An H1, a T1 and a Berkeley Humanoid walk with it as written; others
may need other gains.

A controller that steps in place teaches the policy of the profile `cpu` at first (`stepping_action`).
The observation group `teacher` has its action, and `mdp.SteppingGains` its gains, which follow from
height and mass. To set them, add `gains=mdp.SteppingGains(...)` to `BIPED` in `task.py`. If robots drift,
change `lead`; if they fall sideways, `step_sideways`."""


def values_table(report: RobotReport) -> Table:
    """Return the table of all values: found in the file, guessed and by which rule, set, or asked.

    Values of joints have one row per reason.
    """
    anatomy = report.anatomy
    parts: dict[str, tuple[str, Guess]] = {
        "kind": (anatomy.kind.value, anatomy.kind),
        "trunk": (anatomy.trunk.value, anatomy.trunk),
    }
    if anatomy.feet.value:
        imu, reason = imu_site(report)
        soles = [name for foot in anatomy.feet.value for name in foot.sole]
        parts |= {
            "feet": (", ".join(foot.link for foot in anatomy.feet.value), anatomy.feet),
            "soles": (", ".join(soles), Guess(soles, SOLE_RULE)),
            "front": ("x" if anatomy.front.value > 0 else "-x", anatomy.front),
            "kept upright": (anatomy.upright.value, anatomy.upright),
            "IMU": (imu, replace(anatomy.imu_site, rule=reason)),
        }
    if anatomy.hands.value:
        parts["hands"] = (", ".join(hand.link for hand in anatomy.hands.value), anatomy.hands)
    pairs = [name for name, (partner, _) in anatomy.mirror.value.items() if partner != name]
    parts["mirror pairs"] = (str(len(pairs) // 2), anatomy.mirror)
    parts["height"] = (number(report.root_height.value), report.root_height)
    rows = [
        (name, value, _FROM[guess.source], guess.rule) for name, (value, guess) in parts.items()
    ]
    joints = {name: getattr(report, "joint_pos" if name == "pose" else name) for name in PER_JOINT}
    if anatomy.kind.value == "legged":
        joints["pose_tolerance"] = report.pose_tolerance
    rows += [
        (name, _listed(by_pattern(values, report)), _FROM[reason.source], reason.rule)
        for name, guess in joints.items()
        for reason, values in guess.by_reason().items()
    ]
    if anatomy.kind.value == "legged":
        speeds = _listed({name: high for name, (_, high) in report.commands.value.items()})
        rows.append(("commands", speeds, _FROM[report.commands.source], report.commands.rule))
    return Table("values", ("value", "is", "from", "reason"), rows)


_FROM = {"file": "found", "rule": "guessed", "set": "set", "asked": "asked"}


def _listed(values: Mapping[str, float]) -> str:
    """Return values by name, zeros at the end as `others 0`."""
    shown = {name: float(number(value)) for name, value in values.items()}
    items = [f"{name} {value:g}" for name, value in shown.items() if value]
    return ", ".join([*items, *(["others 0" if items else "0"] * (len(items) < len(shown)))])


def questions_table(report: RobotReport) -> Table:
    """Return the table of the questions that the model leaves open."""
    rows = [(q.key, q.text, q.used) for q in report.questions]
    return Table("questions", ("setting", "question", "used until set"), rows)
