"""The README of a bundle: its loop for Unitree's SDK2 drives a simulated robot."""

from __future__ import annotations

import contextlib
import re
import sys
import time
from types import ModuleType, SimpleNamespace
from typing import Any

from bundles import load_program

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
    count = len(simulation.contract["joints"])

    def state() -> SimpleNamespace:
        measured = simulation.measure()
        positions, velocities = measured["joint_pos"], measured["joint_vel"]
        return SimpleNamespace(
            motor_state=[motor(q=q, dq=dq) for q, dq in zip(positions, velocities, strict=True)],
            imu_state=SimpleNamespace(
                quaternion=measured["root_quat"], gyroscope=measured["imu_ang_vel"]
            ),
            mode_machine=5,
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
            assert (cmd.crc, cmd.mode_machine) == (7, 5)
            motors = cmd.motor_cmd[:count]
            assert all(m.mode == 1 for m in motors)
            fields = {"position": "q", "velocity": "dq", "effort": "tau", "kp": "kp", "kd": "kd"}
            values = {key: [getattr(m, name) for m in motors] for key, name in fields.items()}
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
            "unitree_hg_msg_dds__LowCmd_": lambda: SimpleNamespace(
                motor_cmd=[motor() for _ in range(35)]
            )
        },
        "idl.unitree_hg.msg.dds_": {"LowCmd_": object, "LowState_": object},
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
    assert len(cpp.splitlines()) <= 40
