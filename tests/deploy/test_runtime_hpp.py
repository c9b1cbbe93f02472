"""The runtime of a bundle in C++: compiled, and run on tables of measurements."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

DRIVER = Path(__file__).with_name("replay.cpp")
FILES = Path(__file__).parents[2] / "src" / "mjlab" / "deploy" / "files"
TOLERANCE = 1e-5
"""Largest difference, as a fraction of the range of a term."""

Row = dict[str, Any]


@pytest.fixture(scope="module")
def compiler() -> list[str]:
    """Return the command to compile; skip where this machine has no compiler or library, but in CI."""
    library = Path("/usr/include/nlohmann/json.hpp")
    if not os.environ.get("CI") and not (shutil.which("g++") and library.exists()):
        pytest.skip("needs g++ and nlohmann-json3-dev")
    return ["g++", "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", f"-I{FILES}"]


@pytest.fixture(scope="module")
def program(compiler, tmp_path_factory) -> Path:
    """Compile the driver."""
    program = tmp_path_factory.mktemp("replay") / "replay"
    subprocess.run([*compiler, str(DRIVER), "-o", str(program)], check=True)
    return program


def network_of(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the layers of each input, and `actions`, those of all their answers side by side."""
    graph = onnx.load(str(path)).graph
    weights = {one.name: onnx.numpy_helper.to_array(one) for one in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            constant = onnx.helper.get_attribute_value(node.attribute[0])
            weights[node.output[0]] = onnx.numpy_helper.to_array(constant)
    found, joint = {}, ""
    for one in graph.input:
        if one.name != "time_step":
            found[one.name], joint = layers_from(one.name, graph, weights)
    is_over = joint == graph.output[0].name
    return {**found, "actions": [] if is_over else layers_from(joint, graph, weights)[0]}


def layers_from(value: str, graph: Any, weights: Row) -> tuple[list[Row], str]:
    """Return the layers from a value to the actions, or to where answers are joined; and the value there."""
    layers = []
    while value != graph.output[0].name:
        node = next(n for n in graph.node if value in n.input)
        if node.op_type == "Concat":
            return layers, node.output[0]
        arrays, shape = [weights[name] for name in node.input if name in weights], []
        kind = {
            "Sub": "normalize",
            "Gemm": "linear",
            "LayerNormalization": "layer_norm",
            "Elu": "elu",
            "Sigmoid": "silu",
            "Slice": "first",
            "Tanh": "tanh",
            "Conv": "convolution",
            "Shape": "mean_places",
        }[node.op_type]
        if kind == "normalize":
            # The quotient follows the difference.
            node = next(n for n in graph.node if node.output[0] in n.input)
            arrays = [weights[node.input[1]], arrays[0]]
        if kind == "silu":
            # The product with its argument follows the sigmoid.
            node = next(n for n in graph.node if node.output[0] in n.input)
        if kind == "first":
            arrays = [np.zeros(0), np.zeros(arrays[1][0])]
        if kind == "convolution":
            options = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
            shape = [*arrays[0].shape[1:3], options["strides"][0], options["pads"][0]]
        if kind == "mean_places":
            # A softmax of the pixels, and the products with their rows and columns, until all are flat.
            arrays = [weights[name] for name in weights if name.endswith((".rows", ".columns"))]
            node = next(n for n in graph.node if n.op_type == "Flatten")
        weight, bias = (np.ravel(x).tolist() for x in (*arrays, (), ())[:2])
        layers.append({"kind": kind, "weight": weight, "bias": bias, "shape": shape})
        value = node.output[0]
    return layers, value


@pytest.fixture
def replay(program, tmp_path) -> Callable[..., list[Row]]:
    """Return a function that runs the policy of a bundle on a table."""

    def run(folder: Path, table: Path, mode: str = "", layers: Any = None) -> list[Row]:
        network = network_of(folder / "policy.onnx") if layers is None else layers
        (tmp_path / "layers.json").write_text(json.dumps(network))
        command = [program, folder, tmp_path / "layers.json", table, mode]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr)
        return [json.loads(line) for line in done.stdout.splitlines()]

    return run


def with_images(folder: Path, trace: dict[str, np.ndarray], table: Path) -> Path:
    """Write the golden table with the images of the trace, which are too wide for it."""
    with (folder / "golden.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name in (key for key in trace if key.startswith("measurement/") and trace[key].ndim > 2):
        for row, image in zip(rows, trace[name], strict=True):
            place = name.replace("/", ".")
            row.update({f"{place}.{k}": str(pixel) for k, pixel in enumerate(image.ravel())})
    with table.open("w") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return table


@pytest.mark.parametrize(
    "name",
    [
        "go1",
        "g1",
        "Mjlab-Cartpole-Swingup",
        "Mjlab-Lift-Cube-Yam",
        "Mjlab-Reach-Yam",
        "Mjlab-Tracking-Flat-Unitree-G1",
        "Mjlab-Velocity-Rough-Unitree-Go1",
        "Mjlab-Lift-Cube-Yam-Depth",
    ],
)
def test_answers_are_those_of_training(bundle, replay, tmp_path, name):
    folder = bundle(name)
    trace = dict(np.load(folder / "golden.npz"))
    rows = replay(folder, with_images(folder, trace, tmp_path / "table.csv"))
    assert len(rows) == len(trace["time"])
    keys = {key for key in trace if key.startswith(("raw/", "input/"))} | {"action", "target"}
    assert len(keys) > 3
    for key in keys:
        kind, _, term = key.partition("/")
        group = {"raw": "values", "input": "inputs"}.get(kind)
        got = [row[kind] if group is None else row[group][term] for row in rows]
        expected = trace[key].reshape(len(rows), -1)
        scale = max(np.ptp(expected), 1e-3)
        assert np.abs(got - expected).max(initial=0.0) / scale < TOLERANCE, key


def test_motion_is_turned_to_the_robot(bundle, replay, tmp_path):
    folder = bundle("Mjlab-Tracking-Flat-Unitree-G1")
    measurements = json.loads((folder / "contract.json").read_text())["measurements"]
    with (folder / "golden.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        for name in (one["name"] for one in measurements if one["is_quaternion"]):
            keys = [f"measurement.{name}.{k}" for k in range(4)]
            w, x, y, z = (float(row[key]) for key in keys)
            # By 90 degrees to the left.
            turned = np.sqrt(0.5) * np.array((w - z, x - y, y + x, z + w))
            row.update(zip(keys, turned, strict=True))
        for name in (one["name"] for one in measurements if one["source"]["kind"] == "body_pos"):
            keys = [f"measurement.{name}.{k}" for k in (0, 1)]
            x, y = (float(row[key]) for key in keys)
            row.update(zip(keys, (2.0 - y, 1.0 + x), strict=True))
    table = tmp_path / "turned.csv"
    with table.open("w") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    runs = [replay(folder, path, "aligned") for path in (folder / "golden.csv", table)]
    before, after = (np.array([row["inputs"]["obs"] for row in run]) for run in runs)
    np.testing.assert_allclose(after, before, atol=1e-5)
    assert np.abs(replay(folder, table)[0]["inputs"]["obs"] - before[0]).max() > 0.5


def test_motor_commands_are_those_of_the_contract(bundle, replay):
    folder = bundle("go1")
    joints = json.loads((folder / "contract.json").read_text())["joints"]
    row = replay(folder, folder / "golden.csv", "limits")[0]
    assert row["names"] == [joint["name"] for joint in joints]
    assert row["kp"] == [joint["kp"] for joint in joints]
    assert row["kd"] == [joint["kd"] for joint in joints]
    assert row["position"] == row["target"]
    assert not row["is_damping"]


# Limits.


class Robot:
    """Policy with limits whose network answers a constant, and measurements of a robot at rest."""

    def __init__(self, folder: Path, copy: Path, replay: Callable[..., list[Row]]) -> None:
        self.folder, self._replay = copy, replay
        shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("scene", "robot"))
        self.contract = json.loads((copy / "contract.json").read_text())
        with (copy / "golden.csv").open() as table:
            self.first = next(csv.DictReader(table))

    def run(self, rows: list[Row], mode: str = "limits", action: float = 0.0) -> list[Row]:
        """Return the answers to measurements that differ from those of the first row."""
        (self.folder / "contract.json").write_text(json.dumps(self.contract))
        with (self.folder / "table.csv").open("w") as table:
            writer = csv.DictWriter(table, self.first)
            writer.writeheader()
            for k, row in enumerate(rows):
                writer.writerow({**self.first, "time": 0.02 * k, "first": int(k == 0), **row})
        size = len(self.contract["joints"])
        inputs = self.contract["observations"][0]["shape"][0]
        weight, bias = [0.0] * size * inputs, [action] * size
        layer = {"kind": "linear", "weight": weight, "bias": bias, "shape": []}
        layers = {"obs": [], "actions": [layer]}
        return self._replay(self.folder, self.folder / "table.csv", mode, layers)


@pytest.fixture
def robot(bundle, replay, tmp_path) -> Robot:
    return Robot(bundle("go1"), tmp_path / "bundle", replay)


@pytest.mark.parametrize(("action", "end"), [(1000.0, "high"), (-1000.0, "low")])
def test_targets_keep_within_limits(robot, action, end):
    (row,) = robot.run([{}], action=action)
    np.testing.assert_allclose(row["position"], robot.contract["limits"][f"target_{end}"])
    assert np.abs(row["target"]).min() > 100.0


def test_target_jumps_are_limited(robot):
    robot.contract["limits"]["target_step"] = [0.1] * 12
    # Memory of one number that counts the steps, and is added to the actions.
    robot.contract["policy"]["inputs"].append(
        {"name": "h", "shape": [1, 1], "kind": "memory", "output": "h_out"}
    )
    before, after, restarted = robot.run([{}, {}, {"first": 1}])
    scale = np.array(robot.contract["actions"][0]["scale"])
    np.testing.assert_allclose(after["target"] - np.array(before["target"]), scale)
    assert np.abs(np.subtract(after["position"], before["position"])).max() == pytest.approx(0.1)
    assert restarted["position"] == before["position"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"measurement.joint_vel.FR_calf_joint": "40"}, "faster"),
        ({f"measurement.root_quat.{k}": q for k, q in enumerate((0.76, 0.64, 0, 0))}, "tilted"),
        ({f"measurement.root_quat.{k}": 0 for k in range(4)}, "quaternion"),
        ({"measurement.imu_ang_vel.1": "nan"}, "finite"),
        ({"measurement.joint_pos.FR_calf_joint": "inf"}, "finite"),
        ({"command.twist.0": "nan"}, "finite"),
        ({"time": "0.5"}, "no new measurement"),
        ({"time": "nan"}, "no new measurement"),
    ],
)
def test_odd_measurements_damp_until_reset(robot, change, reason):
    good, odd, later, restarted = robot.run([{}, change, {}, {"first": 1}])
    assert [row["is_damping"] for row in (good, odd, later, restarted)] == [
        False,
        True,
        True,
        False,
    ]
    assert reason in odd["reason"]
    assert later["reason"] == odd["reason"]
    assert not any(odd["kp"])
    assert all(np.array(odd["kd"]) > 0.0)
    assert np.isfinite(np.array(odd["position"], float)).all()


def test_repeated_measurements_damp(robot):
    steps = round(robot.contract["limits"]["max_age"] / robot.contract["rates"]["step_dt"]) + 2
    damping = [row["is_damping"] for row in robot.run([{"time": 0.0}] * steps)]
    assert damping[-1]
    assert not damping[-3]


def test_answer_that_is_not_finite_damps(robot):
    (row,) = robot.run([{}], action=1e39)
    assert row["is_damping"]


def test_without_limits_nothing_damps(robot):
    (row,) = robot.run([{"measurement.joint_vel.FR_calf_joint": "40"}], mode="", action=1000.0)
    assert not row["is_damping"]
    assert row["position"] == row["target"]


# Hand-over.


def test_hand_over_from_a_standing_pose(robot):
    default = {joint["name"]: joint["default_pos"] for joint in robot.contract["joints"]}
    pose = {f"measurement.joint_pos.{name}": x + 0.3 for name, x in default.items()}
    there = {f"measurement.joint_pos.{name}": x for name, x in default.items()}
    rest = {f"measurement.joint_vel.{name}": 0.0 for name in default}
    times = (0.0, 0.05, 0.1, 0.12)
    rows = [{**rest, **(there if time > 0.1 else pose), "time": time} for time in times]
    first, half, late, last = robot.run(rows, mode="hand-over")
    q = np.array(list(default.values()))
    np.testing.assert_allclose(first["position"], q + 0.3)
    np.testing.assert_allclose(half["position"], q + 0.15)
    # The joints did not follow: not ready.
    assert [row["is_ready"] for row in (first, half, late, last)] == [False, False, False, True]
    np.testing.assert_allclose(last["position"], q)
    # Again after a fault: from the measured pose.
    (*_, last) = robot.run([*rows, {**rest, **pose, "time": 0.2, "first": 1}], mode="hand-over")
    np.testing.assert_allclose(last["position"], q + 0.3)


FALLEN = {f"measurement.root_quat.{k}": q for k, q in enumerate((0, 1, 0, 0))}


@pytest.mark.parametrize("change", [FALLEN, {"time": "nan"}])
def test_hand_over_of_a_fallen_robot_or_without_a_time_damps(robot, change):
    (row,) = robot.run([change], mode="hand-over")
    assert row["is_damping"]
    assert not row["is_ready"]


def test_first_target_after_the_hand_over_is_near_its_last(robot):
    robot.contract["limits"]["target_step"] = [0.1] * 12
    default = {joint["name"]: joint["default_pos"] for joint in robot.contract["joints"]}
    rest = {f"measurement.joint_pos.{name}": x for name, x in default.items()}
    rest |= {f"measurement.joint_vel.{name}": 0.0 for name in default}
    rows = [{**rest, "time": time} for time in (0.0, 0.1)]
    *_, last, first = robot.run([*rows, {**rest, "time": 0.12}], mode="hand-over-reset", action=5.0)
    assert last["is_ready"]
    np.testing.assert_allclose(np.subtract(first["position"], last["position"]), 0.1)


def test_robot_without_tilt_is_not_limited(robot):
    robot.contract["limits"]["tilt_from"] = None
    (row,) = robot.run([FALLEN])
    assert not row["is_damping"]


def test_one_array_is_not_for_two_commands(robot):
    robot.contract["commands"].append({**robot.contract["commands"][0], "name": "other"})
    with pytest.raises(RuntimeError, match="command/other"):
        robot.run([{}])


# Terms of packages, and errors.


def test_unknown_term_is_named_and_can_be_added(robot):
    term = robot.contract["observations"][0]["terms"][0]
    term["kind"], term["function"] = "custom", "my_package.mdp:half"
    (row,) = robot.run([{}])
    measured = [float(robot.first[f"measurement.imu_ang_vel.{k}"]) for k in range(3)]
    np.testing.assert_allclose(row["values"][f"obs/{term['name']}"], np.multiply(measured, 0.5))
    term["function"] = "my_package.mdp:third"
    with pytest.raises(RuntimeError, match="my_package.mdp:third"):
        robot.run([{}])


def test_measurements_of_wrong_size_are_named(robot):
    robot.contract["measurements"][0]["size"] = 17
    name = robot.contract["measurements"][0]["name"]
    with pytest.raises(RuntimeError, match=f"'{name}': expected 17"):
        robot.run([{}])


# README.

CONTROLLER = """
struct Controller : controller_interface::ControllerInterface {{
  {update}
  std::unique_ptr<mjlab::Policy> policy_;
  std::unique_ptr<Imu> imu_;
  TwistBuffer twist_;
  mjlab::Values last_;
  mjlab::Vector command_;
  double due_, stamp_;
  bool has_begun_;
}};
"""


@pytest.mark.parametrize("name", ["go1", "Mjlab-Tracking-Flat-Unitree-G1", "Mjlab-Reach-Yam"])
def test_readme_compiles(bundle, compiler, tmp_path, name):
    text = (bundle(name) / "README.md").read_text()
    adapter, update = re.findall(r"```cpp\n(.*?)```", text, re.DOTALL)
    shutil.copyfile(DRIVER.with_name("stand_ins.hpp"), tmp_path / "onnxruntime_cxx_api.h")
    (tmp_path / "readme.cpp").write_text(adapter + CONTROLLER.format(update=update))
    flags = ["-fsyntax-only", f"-I{tmp_path}"]
    subprocess.run([*compiler, *flags, str(tmp_path / "readme.cpp")], check=True)
