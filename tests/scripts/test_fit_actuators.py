"""`fit-actuators`: a log of a hinge to tables and Python."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from swing import TRUE, link_spec, make_log

from mjlab.actuator import BuiltinMotorActuatorCfg, IdealPdActuatorCfg, XmlActuatorCfg
from mjlab.cli.main import main
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.identification.estimate import DriveEstimate, Estimate, LimbEstimate
from mjlab.identification.log import COLUMNS, JointLog
from mjlab.identification.robot import Drives
from mjlab.tasks.registry import load_env_cfg


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


# Robots, with estimates that are given.

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
VALUES = {"armature": 0.006, "damping": 0.2, "friction": 0.5, "kp": 30.0, "kd": 1.0}
ROBOT = """
from mjlab.actuator import BuiltinMotorActuatorCfg, IdealPdActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from swing import link_spec

def make():
    servos = IdealPdActuatorCfg(
        target_names_expr=("hinge[01]",), stiffness=25.0, damping=1.0, effort_limit=8.0
    )
    motor = BuiltinMotorActuatorCfg(target_names_expr=("hinge2",), effort_limit=2.0, gear=3.0)
    articulation = EntityArticulationInfoCfg(actuators=(servos, motor))
    return EntityCfg(spec_fn=lambda: link_spec(joints=3), articulation=articulation)
"""


@pytest.fixture
def printed(run_main, folder: Path, monkeypatch):
    """Return a function of the robot: first guesses, ACTUATORS, the whole output."""
    monkeypatch.chdir(folder)
    (folder / "hinged.py").write_text(ROBOT)
    given: list[Drives] = []

    def estimates(spec, drives: Drives, *args, **kwargs) -> list[LimbEstimate]:
        given.append(drives)
        parameters = {kind: Estimate(value, 0.1 * value) for kind, value in VALUES.items()}
        drive = DriveEstimate(("hinge0",), parameters, ())
        return [LimbEstimate((drive,), Estimate(0.011, 0.0015), {})]

    monkeypatch.setattr("mjlab.scripts.fit_actuators.fit_robot", estimates)

    def run(*more: str) -> tuple[Drives, tuple, str]:
        outcome = run_main(main, "mjlab", "fit-actuators", "log.csv", "--robot", *more)
        assert outcome.status == 0, outcome.err
        names: dict = {}
        source = outcome.out[outcome.out.index("from mjlab.actuator") :]
        exec(source[: source.index("Events (")], names)
        return given[-1], names["ACTUATORS"], outcome.out

    return run


def test_effort_limits_are_those_of_the_configs(printed) -> None:
    drives, actuators, _ = printed("hinged:make")
    assert drives.effort_limit == {"hinge0": 8.0, "hinge1": 8.0, "hinge2": 6.0}
    assert actuators[0].effort_limit == 8.0


def test_joints_that_the_log_leaves_out_keep_their_actuators(printed) -> None:
    _, (fitted, servo, motor), _ = printed("hinged:make")
    assert fitted.target_names_expr == ("hinge0",)
    assert type(servo) is IdealPdActuatorCfg
    assert (servo.target_names_expr, servo.stiffness, servo.effort_limit) == (("hinge1",), 25, 8)
    assert (type(motor), motor.target_names_expr) == (BuiltinMotorActuatorCfg, ("hinge2",))
    assert motor.gear == 3.0


def write_driven_arm(folder: Path) -> None:
    """Write `driven.xml`, whose two hinges have actuators."""
    spec = link_spec(joints=2)
    for name in ("hinge0", "hinge1"):
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    spec.compile()
    (folder / "driven.xml").write_text(spec.to_xml())


def test_file_keeps_its_other_actuators(printed, folder: Path) -> None:
    write_driven_arm(folder)
    _, (_, other), _ = printed("driven.xml", "--stiffness", "25", "--damping", "1")
    assert (type(other), other.target_names_expr) == (XmlActuatorCfg, ("hinge1",))


def test_fitted_joints_have_one_actuator(printed, folder: Path) -> None:
    write_driven_arm(folder)
    _, actuators, out = printed("driven.xml", "--stiffness", "25", "--damping", "1")
    names: dict = {}
    source = out[out.index("from mjlab.actuator") :]
    exec(source[: source.index("Events (")], names)

    def make() -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_file(str(folder / "driven.xml"))
        names["remove_file_actuators"](spec)
        return spec

    articulation = EntityArticulationInfoCfg(actuators=actuators)
    model = EntityCfg(spec_fn=make, articulation=articulation).build().spec.compile()
    driven = [model.joint(int(joint)).name for joint in model.actuator_trnid[:, 0]]
    assert sorted(driven) == ["hinge0", "hinge1"]


def test_configs_replace_themselves(printed) -> None:
    """Actuators that configs add need not be removed."""
    assert "remove_file_actuators" not in printed("hinged:make")[2]


def test_delays_are_in_timesteps_of_the_task(printed, monkeypatch) -> None:
    """9.5 to 12.5 ms."""
    cfg = load_env_cfg(TASK)
    cfg.sim.mujoco.timestep = 0.002
    monkeypatch.setattr("mjlab.tasks.registry.load_env_cfg", lambda task: cfg)

    def lags(*flags: str) -> tuple[int, int]:
        actuator = printed(*flags)[1][0]
        return actuator.delay_min_lag, actuator.delay_max_lag

    assert lags("hinged:make") == (1, 3)
    assert lags(TASK) == (4, 7)
    assert lags(TASK, "--timestep", "0.001") == (9, 13)


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
