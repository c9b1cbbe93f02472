"""`fit-actuators`: a log of a hinge to tables and Python."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from swing import TRUE, link_spec, make_log

from mjlab.cli.main import main
from mjlab.identification.log import COLUMNS, JointLog


def write_log(path: Path, log: JointLog) -> Path:
    columns = {"time": log.period * np.arange(len(log.target))}
    for signal, beginning in COLUMNS.items():
        values = getattr(log, signal)
        if values is not None:
            columns[f"{beginning}.hinge0"] = values[:, 0]
    table, header = np.stack(list(columns.values()), axis=1), ",".join(columns)
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.6g")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Folder with the model and a log of it."""
    folder, spec = tmp_path_factory.mktemp("swing"), link_spec(0.4)
    write_log(folder / "log.csv", make_log(spec, with_torque=True))
    spec.compile()
    (folder / "robot.xml").write_text(spec.to_xml())
    return folder


def flags(folder: Path, *more: str) -> tuple[str, ...]:
    robot = ("--robot", str(folder / "robot.xml"), "--stiffness", "25", "--damping", "1.2")
    return ("mjlab", "fit-actuators", str(folder / "log.csv"), *robot, *more)


def test_json_has_the_true_values(run_main, folder: Path) -> None:
    outcome = run_main(main, *flags(folder, "--json"))
    limb = json.loads(outcome.out)[0]
    found = limb["drives"][0]["parameters"]
    assert found["kp"]["value"] == pytest.approx(TRUE[3], rel=0.02)
    assert limb["delay"]["value"] == pytest.approx(TRUE[-1], abs=0.002)


def test_report_ends_with_python(run_main, folder: Path) -> None:
    outcome = run_main(main, *flags(folder))
    assert outcome.status == 0, outcome.err
    assert max(map(len, outcome.out.splitlines())) <= 100
    source = outcome.out[outcome.out.index("from mjlab.envs") :]
    names: dict = {}
    exec(source, names)
    assert set(names["EVENTS"]) == {"armature", "joint_friction", "joint_damping", "gains"}


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (("log.csv",), "--robot"),
        (("none.csv", "--robot", "robot.xml"), "none.csv"),
        (("log.csv", "--robot", "robot.xml"), "--stiffness"),
        (("log.csv", "--robot", "go1"), "hinge0"),
    ],
)
def test_mistakes(run_main, folder: Path, monkeypatch, argv: tuple[str, ...], named: str) -> None:
    monkeypatch.chdir(folder)
    outcome = run_main(main, "mjlab", "fit-actuators", *argv)
    assert outcome.status != 0
    assert named in outcome.err
