"""The README of a bundle: its loop for Unitree's SDK2 drives a simulated robot."""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from bundles import load_program

from mjlab.deploy.readme import readme

STEPS = 180
"""Control steps: two seconds of hand-over, and the policy."""


class Done(Exception):
    """End of the loop, which has none."""


def motor(**values: float) -> SimpleNamespace:
    """Return a motor of a message."""
    return SimpleNamespace(**values)


def modules(simulation: Any, clock: list[float]) -> dict[str, ModuleType]:
    """Return stand-ins for the SDK: states of the simulation out, commands in."""
    handlers, sent = [], []
    names = [joint["name"] for joint in simulation.contract["joints"]]
    # Order of a Go2's messages.
    legs, parts = ("FR", "FL", "RR", "RL"), ("hip", "thigh", "calf")
    motors = [names.index(f"{leg}_{part}_joint") for leg in legs for part in parts]
    joints = [motors.index(k) for k in range(len(names))]

    def state() -> SimpleNamespace:
        measured = simulation.measure()
        positions, velocities = measured["joint_pos"], measured["joint_vel"]
        return SimpleNamespace(
            motor_state=[motor(q=positions[k], dq=velocities[k]) for k in motors],
            imu_state=SimpleNamespace(
                quaternion=measured["root_quat"], gyroscope=measured["imu_ang_vel"]
            ),
        )

    class Subscriber:
        def __init__(self, topic: str, kind: object) -> None:
            assert topic == "rt/lowstate"

        def Init(self, handler: Any, depth: int) -> None:
            handlers.append(handler)
            handler(state())

    class Publisher:
        def __init__(self, topic: str, kind: object) -> None:
            assert topic == "rt/lowcmd"

        def Init(self) -> None:
            pass

        def Write(self, cmd: Any) -> None:
            sent.append(cmd)
            assert (cmd.crc, cmd.head, cmd.level_flag) == (7, [0xFE, 0xEF], 0xFF)
            ordered = [cmd.motor_cmd[k] for k in joints]
            assert all(m.mode == 1 for m in ordered)
            fields = {"position": "q", "velocity": "dq", "effort": "tau", "kp": "kp", "kd": "kd"}
            values = {key: [getattr(m, name) for m in ordered] for key, name in fields.items()}
            simulation.apply(SimpleNamespace(**values, is_damping=not any(values["kp"])))
            clock[0] += 0.02
            handlers[0](state())
            if len(sent) == STEPS:
                raise Done
            assert len(sent) < STEPS or not any(values["kp"])

    contents = {
        "core.channel": {
            "ChannelFactoryInitialize": lambda *_: None,
            "ChannelPublisher": Publisher,
            "ChannelSubscriber": Subscriber,
        },
        "idl.default": {
            "unitree_go_msg_dds__LowCmd_": lambda: SimpleNamespace(
                motor_cmd=[motor() for _ in range(20)]
            )
        },
        "idl.unitree_go.msg.dds_": {"LowCmd_": object, "LowState_": object},
        "utils.crc": {"CRC": lambda: SimpleNamespace(Crc=lambda cmd: 7)},
    }
    made = {"unitree_sdk2py": ModuleType("unitree_sdk2py")}
    vars(made["unitree_sdk2py"])["sent"] = sent
    for path, names in contents.items():
        parts = path.split(".")
        for end in range(1, len(parts) + 1):
            name = ".".join(("unitree_sdk2py", *parts[:end]))
            made.setdefault(name, ModuleType(name))
        vars(made[f"unitree_sdk2py.{path}"]).update(names)
    return made


def test_loop_for_unitree_drives_the_robot(bundle, monkeypatch):
    folder = bundle("go1")
    parts = re.findall(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL)
    assert len(parts[1].splitlines()) <= 40
    program = "".join(parts)
    load_program(folder, "runtime")
    simulate = load_program(folder, "simulate")
    policy = simulate.Policy.load(folder)
    simulation = simulate.Simulation(policy.contract, simulate.load_model(folder))
    clock = [100.0]
    made = modules(simulation, clock)
    for name, module in made.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    monkeypatch.chdir(folder)
    scope: dict[str, Any] = {}
    with contextlib.suppress(Done):
        exec(program.replace("np.zeros(3)", "np.array([0.8, 0.0, 0.0])"), scope)
    # The end of the loop damps.
    assert len(vars(made["unitree_sdk2py"])["sent"]) == STEPS + 1
    assert scope["has_begun"]
    assert not scope["policy"].reason
    assert simulation.data.body("robot/trunk").xpos[0] > 0.3


def test_loops_have_the_measurements_of_the_contract(bundle):
    folder = bundle("Mjlab-Tracking-Flat-Unitree-G1")
    text = (folder / "README.md").read_text()
    measured = load_program(folder, "runtime").Policy.load(folder).contract["measurements"]
    python = "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    cpp = re.findall(r"```cpp\n(.*?)```", text, re.DOTALL)[-1]
    compile(python, "README.md", "exec")
    assert "robot.compute(measured)" in python
    for one in measured:
        if one["name"] not in ("joint_pos", "joint_vel"):
            assert f'measured["{one["name"]}"] = ' in cpp
        assert (f'"{one["name"]}": ' in python) == (one["availability"] != "computed")
    assert "np.full(3, np.nan)" in python
    loop = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[1]
    assert max(len(cpp.splitlines()), len(loop.splitlines())) <= 40
    assert all(part in python for part in ("unitree_hg", "mode_pr", "MOTORS = range"))


@pytest.mark.parametrize("name", ["go1", "Mjlab-Reach-Yam", "Mjlab-Tracking-Flat-Unitree-G1"])
def test_missing_measurements_are_asked_for_where_they_are(bundle, name):
    python, cpp = (bundle(name) / "README.md").read_text().split("## In C++")
    assert ("Replace each NaN" in python) == ("np.nan" in python)
    assert ("Replace each NaN" in cpp) == ("NAN)" in cpp)


def test_gyroscope_of_another_link_or_askew_is_missing(bundle):
    contract = json.loads((bundle("go1") / "contract.json").read_text())
    assert '"imu_ang_vel": imu.gyroscope' in readme(contract, [])
    (gyro,) = [one for one in contract["measurements"] if one["name"] == "imu_ang_vel"]
    source = dict(gyro["source"])
    for change in ({"body": "robot/FR_hip"}, {"site_quat": [0.8, 0.6, 0.0, 0.0]}):
        gyro["source"] = source | change
        assert '"imu_ang_vel": np.full(3, np.nan)' in readme(contract, [])


def test_orientation_of_an_askew_sensor_is_missing(bundle):
    """The robot reports that of its root."""
    contract = json.loads((bundle("go1") / "contract.json").read_text())
    (quat,) = [one for one in contract["measurements"] if one["name"] == "root_quat"]
    quat["source"] = {"kind": "sensor", "type": "framequat", "body": "robot/trunk"}
    quat["source"]["site_quat"] = [1.0, 0.0, 0.0, 0.0]
    assert '"root_quat": imu.quaternion' in readme(contract, [])
    quat["source"]["site_quat"] = [0.8, 0.6, 0.0, 0.0]
    assert '"root_quat": np.full(4, np.nan)' in readme(contract, [])


def test_motors_of_an_unknown_robot_are_asked_for(bundle):
    contract = json.loads((bundle("Mjlab-Cartpole-Swingup") / "contract.json").read_text())
    assert "replace it by that of your robot" in readme(contract, [])
