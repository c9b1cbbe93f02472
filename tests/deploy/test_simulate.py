"""The simulation of a bundle: keys, damping, and a policy that ends in it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from bundles import load_program

UP, LEFT, BACKSPACE = 265, 263, 259


@pytest.fixture
def simulate(bundle):
    """Return the program of the Go1's bundle, its policy and a simulation."""
    folder = bundle("go1")
    load_program(folder, "runtime")
    program = load_program(folder, "simulate")
    policy = program.Policy.load(folder)
    return program, policy, program.Simulation(policy.contract, program.load_model(folder))


def test_keys_command_within_the_ranges_of_training(simulate):
    program, policy, _ = simulate
    (command,) = policy.contract["commands"]
    keys = program.Keys(command)
    assert not keys.value.any()
    for _ in range(30):
        keys.press(UP)
    assert keys.value.tolist() == [command["components"][0]["range"][1], 0.0, 0.0]
    keys.press(LEFT)
    assert keys.value[1] > 0.0
    keys.press(BACKSPACE)
    assert not keys.value.any()


def test_keys_return_a_pose_to_one_without_turn(simulate):
    keys = simulate[0].Keys({"components": None, "size": 7})
    keys.press(UP)
    keys.press(BACKSPACE)
    assert keys.value.tolist() == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def test_command_of_another_size_is_refused(simulate, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["simulate.py", "--seconds", "0.1", "--command", "0.5"])
    with pytest.raises(SystemExit) as stopped:
        simulate[0].main()
    assert stopped.value.code == 2
    assert "expected 3 numbers, got 1" in capsys.readouterr().err


def test_all_given_commands_are_sent(simulate, monkeypatch):
    program, policy, _ = simulate
    second = {**policy.contract["commands"][0], "name": "second"}
    policy.contract["commands"].append(second)
    sent = []
    monkeypatch.setattr(program.Policy, "load", lambda folder: policy)
    monkeypatch.setattr(program, "play", lambda *args: sent.append(args[2]()) or True)
    arguments = ["--seconds", "0.1", "--command", "0.5", "0", "0"]
    monkeypatch.setattr(sys, "argv", ["simulate.py", *arguments])
    with pytest.raises(SystemExit):
        program.main()
    assert [(key, value.tolist()) for key, value in sent[0].items()] == [
        ("twist", [0.5, 0.0, 0.0]),
        ("second", [0.0, 0.0, 0.0]),
    ]


def test_a_robot_hands_over_walks_and_is_damped(simulate):
    program, policy, simulation = simulate
    simulation.reset()
    for _ in range(100):
        targets = policy.hand_over(simulation.measure(), seconds=1.0)
        simulation.apply(targets)
        if policy.is_ready:
            break
    assert policy.is_ready
    policy.reset()
    for _ in range(50):
        simulation.apply(policy.step(simulation.measure(), [0.8, 0.0, 0.0]))
    assert simulation.data.body("robot/trunk").xpos[0] > 0.2
    # On its back, it is damped: the motors only brake.
    upside_down = np.array([0.0, 1.0, 0.0, 0.0])
    simulation.set_state(
        qpos=np.r_[simulation.data.qpos[:3], upside_down, simulation.data.qpos[7:]]
    )
    assert not program.play(policy, simulation, lambda: [0.8, 0.0, 0.0], 1.0)
    assert "tilted" in policy.reason
    speeds = []
    for _ in range(50):
        targets = policy.step(simulation.measure(), [0.8, 0.0, 0.0])
        assert targets.is_damping
        simulation.apply(targets)
        speeds.append(np.abs(simulation.data.qvel[6:]).max())
    assert speeds[-1] < 1.0


def test_fall_is_an_exit_status(bundle, tmp_path):
    folder = tmp_path / "bundle"
    shutil.copytree(bundle("go1"), folder)
    contract = json.loads((folder / "contract.json").read_text())
    contract["limits"]["tilt"] = 1e-4
    (folder / "contract.json").write_text(json.dumps(contract))
    command = [sys.executable, str(folder / "simulate.py"), "--seconds", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert "tilted" in done.stdout


def test_kinematics_of_the_robot_give_computed_measurements(bundle):
    folder = bundle("Mjlab-Tracking-Flat-Unitree-G1")
    load_program(folder, "runtime")
    simulate = load_program(folder, "simulate")
    contract = json.loads((folder / "contract.json").read_text())
    robot = mujoco.MjModel.from_xml_path(str(folder / "robot" / "robot.xml"))
    trace = np.load(folder / "golden.npz")
    names = ("joint_pos", "joint_vel", "root_quat")
    measured = {name: trace[f"measurement/{name}"][20] for name in names}
    computed = simulate.Simulation(contract, robot).compute(measured)
    assert computed.keys() == {"torso_link_quat"}
    quat = trace["measurement/torso_link_quat"][20]
    assert abs(computed["torso_link_quat"] @ quat) == pytest.approx(1.0, abs=1e-6)
    assert abs(measured["root_quat"] @ quat) < 0.9999


def test_loop_of_the_documentation_walks(bundle, tmp_path, monkeypatch):
    page = Path(__file__).parents[2] / "docs" / "how-to" / "deploy.md"
    program = re.findall(r"```python\n(import sys.*?)```", page.read_text(), re.DOTALL)[0]
    (tmp_path / "go1_bundle").symlink_to(bundle("go1"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "runtime", raising=False)
    scope: dict = {}
    exec(program, scope)
    assert not scope["targets"].is_damping
    assert scope["data"].body("robot/trunk").xpos[0] > 3.0
