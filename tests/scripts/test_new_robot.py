"""`new-robot` writes a package that the other commands see, and asks on a terminal only."""

from __future__ import annotations

import builtins
import json
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest
from small_robots import write_archive, write_quadruped, write_still_motion

from mjlab.scripts import new_robot


@pytest.fixture
def model(tmp_path: Path) -> str:
    return str(write_quadruped(tmp_path / "model"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "package"


def test_values_and_next_commands_are_printed(run, model: str, folder: Path) -> None:
    outcome = run("new_robot", model, "--output", str(folder))
    assert outcome.status == 0, outcome.err
    for text in (
        "guessed",
        "found",
        "FL_calf",
        f"uv pip install -e {folder}",
        "train Velocity-Flat-Dog",
    ):
        assert text in outcome.out
    assert (folder / "src" / "dog" / "task.py").is_file()


def test_front_is_said_not_to_turn_commands(run, model: str, folder: Path) -> None:
    assert "lin_vel_x" not in run("new_robot", model, "--output", str(folder)).out.split("Wrote")[1]
    outcome = run("new_robot", model, "--output", str(folder), "--set", "front=-x")
    assert "lin_vel_x" in outcome.out.split("Wrote")[1]


def test_archive_is_named_by_its_file(run, tmp_path: Path, folder: Path) -> None:
    outcome = run("new_robot", str(write_archive(tmp_path / "model")), "--output", str(folder))
    assert outcome.status == 0, outcome.err
    assert (folder / "src" / "dog" / "model" / "dog.xml").is_file()


def test_folder_of_the_model_may_have_its_name(
    run, tmp_path: Path, folder: Path, monkeypatch
) -> None:
    write_quadruped(tmp_path / "dog")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    outcome = run("new_robot", "dog/dog.xml", "--output", str(folder))
    assert outcome.status == 0, outcome.err


def test_function_of_a_module(run, folder: Path) -> None:
    outcome = run(
        "new_robot", "small_robots:arm_spec", "--output", str(folder), "--name", "crane_arm"
    )
    assert outcome.status == 0, outcome.err
    assert "train Reach-Crane-Arm" in outcome.out
    assert "mjlab check Reach-Crane-Arm" in outcome.out


def test_task_needs_its_parts(run, model: str, folder: Path) -> None:
    assert "kind=arm" in run("new_robot", model, "--task", "reach", "--output", str(folder)).message


def test_answers_add_up(run, model: str, folder: Path) -> None:
    for setting in ("stiffness=33", "damping=2"):
        assert run("new_robot", model, "--output", str(folder), "--set", setting).status == 0
    robot = (folder / "src" / "dog" / "robot.py").read_text()
    assert "stiffness=33.0" in robot
    assert "damping=2.0" in robot
    record = json.loads((folder / "new_robot.json").read_text())
    assert record["settings"] == {"stiffness": "33", "damping": "2"}


def test_edits_survive_a_second_run(run, model: str, folder: Path) -> None:
    run("new_robot", model, "--output", str(folder))
    robot = folder / "src" / "dog" / "robot.py"
    mine = robot.read_text() + "\n# mine\n"
    robot.write_text(mine)
    outcome = run("new_robot", model, "--output", str(folder), "--set", "stiffness=33")
    assert outcome.status == 0, outcome.err
    assert robot.read_text() == mine
    assert "stiffness=33.0" in robot.with_name("robot.py.new").read_text()
    assert "src/dog/robot.py" in outcome.out
    # The task and the README fit the robot that is kept.
    paths = (robot.with_name("task.py"), folder / "README.md")
    texts = [path.read_text() for path in paths]
    outcome = run("new_robot", model, "--output", str(folder), "--set", "root_height=0.4")
    assert [path.read_text() for path in paths] == texts
    assert "Not in force" in outcome.out


def test_questions_on_a_terminal(run, model: str, folder: Path, monkeypatch) -> None:
    path = Path(model)
    path.write_text(path.read_text().replace(' armature="0.005"', ""))

    def forbidden(prompt: str) -> str:
        raise AssertionError(prompt)

    monkeypatch.setattr(builtins, "input", forbidden)
    assert run("new_robot", model, "--output", str(folder)).status == 0
    asked = []

    def answer(prompt: str) -> str:
        asked.append(prompt)
        return "0.02" if "armature" in prompt else ""

    monkeypatch.setattr(builtins, "input", answer)
    monkeypatch.setattr(new_robot, "on_terminal", lambda: True)
    assert run("new_robot", model, "--output", str(folder)).status == 0
    assert len(asked) == 1
    assert "armature=0.02" in (folder / "src" / "dog" / "robot.py").read_text()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--set", "stiffness"], "KEY=VALUE"),
        (["--set", "stifness=3"], "stiffness"),
        (["--name", "torch"], "exists"),
        (["--name", "my robot"], "my_robot"),
        (["--nme", "x"], "--name"),
        (["--task", "tracking"], "--motion"),
        (["--task", "tracking", "--motion", "none.npz"], "no such file"),
    ],
)
def test_mistakes(run, model: str, tmp_path: Path, flags: list[str], message: str) -> None:
    outcome = run("new_robot", model, "--output", str(tmp_path / "out"), *flags)
    assert outcome.status != 0
    assert message in outcome.message
    assert not (tmp_path / "out").exists()


def test_missing_model_and_menagerie(run) -> None:
    assert "no such file" in run("new_robot", "nothing.xml").message
    outcome = run("new_robot", "menagerie:unknown_robot")
    assert outcome.status == 1
    assert "menagerie" in outcome.message


def test_install_calls_uv(run, model: str, folder: Path, monkeypatch) -> None:
    called = []

    def record(words, **kwargs) -> subprocess.CompletedProcess:
        called.append(words)
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(new_robot.subprocess, "run", record)
    outcome = run("new_robot", model, "--output", str(folder), "--install")
    assert outcome.status == 0, outcome.err
    ((*_, flag, target),) = called
    assert (flag, target) == ("-e", str(folder))
    assert sys.executable in called[0]


def test_module_of_the_working_folder(run, tmp_path: Path, monkeypatch) -> None:
    spec = 'import mujoco\ndef spec():\n    return mujoco.MjSpec.from_file("model/dog.xml")\n'
    (tmp_path / "dogs_here.py").write_text(spec)
    write_quadruped(tmp_path / "model")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    outcome = run("new_robot", "dogs_here:spec", "--name", "hound", "--output", "a folder")
    assert outcome.status == 0, outcome.err
    assert "pip install -e 'a folder'" in outcome.out
    assert "module" in run("new_robot", "no_such_module:spec", "--name", "hound").message


def test_several_floating_bases(run, model: str, folder: Path) -> None:
    path = Path(model)
    other = '<body name="other"><freejoint/><geom size="0.1"/></body></worldbody>'
    path.write_text(path.read_text().replace("</worldbody>", other))
    outcome = run("new_robot", model, "--output", str(folder))
    assert "several floating bases" in outcome.message
    assert "FL_calf" in outcome.out
    assert not folder.exists()


def test_task_is_remembered(run, model: str, tmp_path: Path, folder: Path) -> None:
    run("new_robot", model, "--output", str(folder), "--task", "bare")
    assert run("new_robot", model, "--output", str(folder)).status == 0
    assert not (folder / "src" / "dog" / "task.py").exists()
    other = str(write_quadruped(tmp_path / "other"))
    assert "--output" in run("new_robot", other, "--output", str(folder)).message


def test_motion_is_remembered(run, model: str, tmp_path: Path, folder: Path) -> None:
    compiled = mujoco.MjModel.from_xml_path(model)
    motion = write_still_motion(compiled, tmp_path / "still.npz")
    flags = ("--task", "tracking", "--motion", str(motion))
    assert run("new_robot", model, "--output", str(folder), *flags).status == 0
    outcome = run("new_robot", model, "--output", str(folder), "--set", "damping=2")
    assert outcome.status == 0, outcome.err
    assert (folder / "src" / "dog" / "motions" / motion.name).is_file()
    assert "damping=2.0" in (folder / "src" / "dog" / "robot.py").read_text()


def test_deleted_test_is_named(run, model: str, folder: Path) -> None:
    run("new_robot", model, "--output", str(folder))
    (folder / "tests" / "test_dog.py").unlink()
    outcome = run("new_robot", model, "--output", str(folder))
    assert "tests/test_dog.py" in outcome.out.split("Wrote")[1]
    assert not (folder / "tests" / "test_dog.py").exists()
