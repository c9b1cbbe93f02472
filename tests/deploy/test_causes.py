"""Mistakes planted into copies of bundles, and the causes that the check names."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from bundles import write_demo, write_random

from mjlab.deploy.check import check_bundle

STEPS = 120
"""Control steps of the traces: two episodes, of which the second begins with a yaw of 100 degrees."""


# Bundles.


def odd_task(env: Any, agent: Any) -> None:
    """Change a task so that it has all that mistakes can be made with."""
    from mjlab.actuator import IdealPdActuatorCfg
    from mjlab.entity import EntityArticulationInfoCfg

    terms = env.observations["actor"].terms
    terms["joint_vel"].scale, terms["joint_vel"].clip = 0.5, (-3.0, 2.0)
    terms["base_ang_vel"].history_length = terms["projected_gravity"].history_length = 3
    (action,) = env.actions.values()
    action.clip = {".*_hip_joint": (-0.101, 0.101)}
    parts = (".*_calf_joint", ".*_thigh_joint", ".*_hip_joint")
    env.scene.entities["robot"].articulation = EntityArticulationInfoCfg(
        actuators=tuple(
            IdealPdActuatorCfg(
                target_names_expr=(part,),
                stiffness=20.0 + 5.0 * k,
                damping=0.5 + 0.1 * k,
                effort_limit=8.0,
                armature=0.01,
                frictionloss=0.2,
                viscous_damping=0.1,
            )
            for k, part in enumerate(parts)
        )
    )
    agent.actor.class_name, agent.actor.rnn_type = "RNNModel", "gru"
    agent.actor.rnn_hidden_dim = 8


def geared_task(env: Any, agent: Any) -> None:
    """Let a servo with a gear of 2 in the robot's file move the cart."""
    from mjlab.actuator import XmlActuatorCfg
    from mjlab.entity import EntityArticulationInfoCfg
    from mjlab.envs.mdp import JointPositionActionCfg

    robot = env.scene.entities["cartpole"]
    make = robot.spec_fn

    def geared() -> mujoco.MjSpec:
        spec = make()
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        joint = mujoco.mjtTrn.mjTRN_JOINT
        servo = spec.add_actuator(name="slider", target="slider", trntype=joint)
        servo.set_to_position(kp=20.0, kv=2.0)
        servo.gear[0], servo.forcerange, servo.forcelimited = 2.0, (-30.0, 30.0), True
        return spec

    robot.spec_fn = geared
    servo = XmlActuatorCfg(target_names_expr=("slider",))
    robot.articulation = EntityArticulationInfoCfg(actuators=(servo,))
    cart = {"entity_name": "cartpole", "actuator_names": ("slider",)}
    env.actions = {"position": JointPositionActionCfg(**cart, scale=0.2)}


def write_traced(name: str, folder: Path) -> Path:
    """Write a bundle: `go1`, `g1`, or the untrained `odd` and `geared`."""
    if name == "odd":
        return write_random("Mjlab-Velocity-Flat-Unitree-Go1", folder, odd_task, STEPS)
    if name == "geared":
        return write_random("Mjlab-Cartpole-Swingup", folder, geared_task, STEPS)
    return write_demo(name, folder, STEPS)


@pytest.fixture(scope="session")
def traced(tmp_path_factory) -> Callable[[str], Path]:
    """Return `write_traced` that writes each bundle once."""
    written: dict[str, Path] = {}

    def make(name: str) -> Path:
        if name not in written:
            folder = tmp_path_factory.mktemp("traced") / "bundle"
            written[name] = write_traced(name, folder)
        return written[name]

    return make


def copied(folder: Path, target: Path) -> Path:
    """Return a copy of a bundle; its files are links until they are written."""
    return Path(shutil.copytree(folder, target, copy_function=os.link))


def written(path: Path, text: str) -> None:
    path.unlink()
    path.write_text(text, encoding="utf-8")


# Edits.

Edit = Callable[[Path], None]


def source(name: str, old: str, new: str) -> Edit:
    """Return the edit of a program: `old` becomes `new`."""

    def edit(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        written(folder / name, text.replace(old, new))

    return edit


def runtime(old: str, new: str) -> Edit:
    return source("runtime.py", old, new)


def simulate(old: str, new: str) -> Edit:
    return source("simulate.py", old, new)


CHECKED = "values = self._checked(measurements)\n        self.add_commands"


def measured(code: str) -> Edit:
    """Return the edit that runs `code` on the measurements before they are used."""
    return runtime(CHECKED, CHECKED.replace("\n", f"\n        {code}\n", 1))


def contract(change: Callable[[dict[str, Any]], None]) -> Edit:
    """Return an edit of `contract.json`."""

    def edit(folder: Path) -> None:
        path = folder / "contract.json"
        content = json.loads(path.read_text(encoding="utf-8"))
        before = json.dumps(content)
        change(content)
        assert json.dumps(content) != before
        written(path, json.dumps(content))

    return edit


def term(name: str, **fields: Any) -> Edit:
    """Return an edit of a term of the contract."""

    def change(content: dict[str, Any]) -> None:
        terms = content["observations"][0]["terms"]
        next(one for one in terms if one["name"] == name).update(fields)

    return contract(change)


def sensor(name: str, **origin: Any) -> Edit:
    """Return an edit of the source of a measurement."""

    def change(content: dict[str, Any]) -> None:
        entries = content["measurements"]
        next(one for one in entries if one["name"] == name)["source"] = origin

    return contract(change)


def joints(key: str, function: Callable[[list], list]) -> Edit:
    """Return an edit of one key of all joints."""

    def change(content: dict[str, Any]) -> None:
        values = function([joint[key] for joint in content["joints"]])
        for joint, value in zip(content["joints"], values, strict=True):
            joint[key] = value

    return contract(change)


def action(key: str, function: Callable[[np.ndarray], Any]) -> Edit:
    """Return an edit of one key of the action."""

    def change(content: dict[str, Any]) -> None:
        entry = content["actions"][0]
        entry[key] = np.asarray(function(np.array(entry[key]))).tolist()

    return contract(change)


def model(field: str, function: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """Return an edit of a field of the scene's model."""

    def edit(folder: Path) -> None:
        from mjlab.deploy.evidence import FILES, Programs

        exact: Any = dict(np.load(folder / "scene" / "exact.npz"))
        loaded = Programs.load(FILES).simulate.load_model(folder)
        holder, key = (loaded.opt, field[4:]) if field.startswith("opt.") else (loaded, field)
        exact[field] = np.array(function(np.array(getattr(holder, key), float)))
        (folder / "scene" / "exact.npz").unlink()
        np.savez(folder / "scene" / "exact.npz", **exact)

    return edit


def network(change: Callable[[Any], None]) -> Edit:
    """Return an edit of `policy.onnx`."""

    def edit(folder: Path) -> None:
        import onnx

        loaded = onnx.load(str(folder / "policy.onnx"))
        change(loaded)
        (folder / "policy.onnx").unlink()
        onnx.save(loaded, str(folder / "policy.onnx"))

    return edit


def without_normalizer(loaded: Any) -> None:
    """Let the normalizer of a network change nothing."""
    from onnx import numpy_helper

    graph = loaded.graph
    subtract, divide = graph.node[0], graph.node[1]
    assert (subtract.op_type, divide.op_type) == ("Sub", "Div")
    for constant in graph.initializer:
        if constant.name in (subtract.input[1], divide.input[1]):
            shape = numpy_helper.to_array(constant).shape
            value = np.full(shape, float(constant.name == divide.input[1]), np.float32)
            constant.CopyFrom(numpy_helper.from_array(value, constant.name))


def feeding(code: str) -> Edit:
    """Return the edit that feeds the network with `code`, a function of the input x, mean and std."""

    def edit(folder: Path) -> None:
        from mjlab.deploy.evidence import Evidence

        normalizer = Evidence(folder).normalizer
        assert normalizer is not None
        np.savez(folder / "normalizer.npz", mean=normalizer[0], std=normalizer[1])
        old = "return cls(contract, session.run, folder, limits)"
        new = f"""n = np.load(folder / "normalizer.npz")
        mean, std = n["mean"], n["std"]
        def run(outputs, inputs):
            x = inputs["obs"]
            return session.run(outputs, {{**inputs, "obs": ({code}).astype(np.float32)}})
        return cls(contract, run, folder, limits)"""
        runtime(old, new)(folder)

    return edit


def alphabetical(content: dict[str, Any]) -> None:
    """Place the terms in alphabetical order."""
    place = 0
    for one in sorted(content["observations"][0]["terms"], key=lambda one: one["name"]):
        one["stop"] = place + one["stop"] - one["start"]
        one["start"], place = place, one["stop"]


def stiffer_calf(content: dict[str, Any]) -> None:
    """Give a motor another gain, wherever the contract lists it."""
    joint = content["joints"][2]
    joint["kp"] *= 1.2
    for one in content["actuators"]:
        if one["joint"] == joint["scene_name"]:
            one["kp"] = joint["kp"]


def slower(content: dict[str, Any]) -> None:
    """Run at twice the control rate."""
    content["rates"]["step_dt"] /= 2
    content["rates"]["decimation"] //= 2


def fewer_substeps(content: dict[str, Any]) -> None:
    content["rates"]["decimation"] //= 2


BY_COMPONENT = """m = slot.reshape(history, -1)
                if self._is_first:
                    m[:] = value[:, None]
                else:
                    m[:, :-1] = m[:, 1:].copy()
                    m[:, -1] = value
            elif False:
                pass"""

# Histories of whole observations, as in other libraries: the terms of a step side by side.
WHOLE = """

class Policy(Policy):
    def step(self, measurements, command=None):
        if not self._is_first:
            self.inputs["obs"][:] = self.kept
        return super().step(measurements, command)

    def stacked(self, outputs, inputs):
        x = self.kept = inputs["obs"].copy()
        entries = self.contract["observations"][0]["terms"]
        parts = [x[:, t["start"] : t["stop"]] for t in entries]
        deep = [p.reshape(3, -1) for p, t in zip(parts, entries) if t["history"]["length"] > 1]
        rest = [p for p, t in zip(parts, entries) if t["history"]["length"] <= 1]
        stacked = np.concatenate(deep, axis=1).reshape(1, -1)
        inputs["obs"][:] = np.concatenate([stacked, *rest], axis=1)
        return self.unstacked(outputs, inputs)

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.unstacked, self.network = self.network, self.stacked
"""


def appended(code: str) -> Edit:
    def edit(folder: Path) -> None:
        written(folder / "runtime.py", (folder / "runtime.py").read_text() + code)

    return edit


# Expressions are replaced by expressions in parentheses, so that two edits of one compose.
GIVEN = "np.asarray(command[name], float)"
SHIFT = "slot[:-history], slot[-history:] = slot[history:].copy(), value"
LAST = 'values["last_action"] = self.action\n'
SERVO = "self.data.ctrl[k] = control"
STEP = """            self.write_controls(targets)
            mujoco.mj_step(self.model, self.data)
"""
ENTER = 'for _ in range(self.contract["rates"]["decimation"]):\n'
JOINT_TARGETS = "self.target = sent = np.concatenate(parts)"
UNDECIDABLE = ""


@dataclass(frozen=True)
class Plant:
    """Mistake, the bundle it is planted in, and the cause that must be named."""

    mistake: str
    bundle: str
    edit: Edit
    cause: str


PLANTS = (
    # Order.
    Plant("joints in another order", "g1", measured('values["joint_pos"] = values["joint_pos"][::-1]'), "components in another order"),
    Plant("left and right legs swapped", "go1", measured('values["joint_vel"] = values["joint_vel"][[3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]]'), "components in another order"),
    Plant("controls in joint order", "odd", simulate(SERVO, "self.data.ctrl[j] = control"), "controls in joint order"),
    Plant("terms in alphabetical order", "g1", contract(alphabetical), "terms in another order"),
    # Frames.
    Plant("quaternion (x, y, z, w)", "go1", measured('values["root_quat"] = values["root_quat"][[1, 2, 3, 0]]'), "quaternion (x, y, z, w) read as (w, x, y, z)"),
    Plant("quaternion (x, y, z, w) of the sensor", "go1", simulate("body.xquat).copy()", "body.xquat[[1, 2, 3, 0]]).copy()"), "quaternion (x, y, z, w) read as (w, x, y, z)"),
    Plant("gravity upward", "go1", runtime("-rotation(i[0])[2]", "rotation(i[0])[2]"), "opposite sign"),
    Plant("gravity by the inverse rotation", "go1", runtime("-rotation(i[0])[2]", "-rotation(i[0])[:, 2]"), "inverse rotation"),
    Plant("angular velocity in world axes", "go1", measured('values["imu_ang_vel"] = rotation(values["root_quat"]) @ values["imu_ang_vel"]'), "world axes, not those of the body"),
    Plant("linear velocity in world axes", "odd", measured('values["imu_lin_vel"] = rotation(values["root_quat"]) @ values["imu_lin_vel"]'), "world axes, not those of the body"),
    Plant("linear velocity missing", "odd", measured('values["imu_lin_vel"] = np.zeros(3)'), "always zero: missing"),
    Plant("velocity of the root, not of the IMU", "odd", sensor("imu_lin_vel", kind="body_lin_vel_b", body="robot/trunk"), "IMU, or velocity, of another link"),
    Plant("IMU of the torso", "g1", sensor("imu_ang_vel", kind="body_ang_vel_b", body="robot/torso_link"), "IMU, or velocity, of another link"),
    Plant("IMU mounted askew", "go1", measured('values["imu_ang_vel"] = np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]]) @ values["imu_ang_vel"]'), "constant rotation between frames"),
    # Terms.
    Plant("default pose not subtracted", "go1", term("joint_pos", offset=None), "default pose not subtracted"),
    Plant("encoders with an offset", "go1", measured('values["joint_pos"] = values["joint_pos"] + np.linspace(-0.1, 0.1, 12)'), "constant offsets"),
    Plant("joint velocities in degrees", "go1", measured('values["joint_vel"] = np.degrees(values["joint_vel"])'), "degrees for radians"),
    Plant("observation scaled", "go1", term("joint_vel", scale=[0.05]), "another scale"),
    Plant("observation scale left out", "odd", term("joint_vel", scale=None), "scale left out"),
    Plant("command scaled", "go1", runtime(GIVEN, f"({GIVEN} * [2.0, 2.0, 0.25])"), "another scale of some components"),
    Plant("command clipped", "go1", runtime(GIVEN, f"{GIVEN}.clip(-0.3, 0.3)"), "clipped"),
    Plant("yaw command negated", "go1", runtime(GIVEN, f"({GIVEN} * [1, 1, -1])"), "opposite sign of some components"),
    Plant("targets as the last action", "go1", runtime(LAST, 'values["last_action"] = self._sent if self._sent is not None else self.action\n'), "joint targets instead of the raw last action"),
    Plant("last action scaled", "go1", runtime(LAST, 'values["last_action"] = self.action * self.contract["actions"][0]["scale"]\n'), "last action after scale"),
    Plant("last action one step late", "go1", runtime(LAST, 'values["last_action"] = getattr(self, "old", self.action)\n        self.old = self.action.copy()\n'), "one control step late"),
    Plant("noise left on", "go1", measured('values["joint_vel"] = values["joint_vel"] + np.random.uniform(-1.5, 1.5, 12)'), "random numbers: noise left on"),
    # History and clip.
    Plant("history newest first", "g1", runtime(SHIFT, "slot[history:], slot[:history] = slot[:-history].copy(), value"), "history newest first"),
    Plant("history by component", "g1", runtime("elif self._is_first:\n                slot.reshape(-1, history)[:] = value", f"elif history:\n                {BY_COMPONENT}"), "history by component, not by step"),
    Plant("history of whole observations", "odd", appended(WHOLE), "history of whole observations"),
    Plant("history from zeros", "g1", runtime("slot.reshape(-1, history)[:] = value", "slot[:], slot[-history:] = 0, value"), "history starts with zeros"),
    Plant("clip after scale", "odd", runtime('np.clip(value, *term["clip"])', 'np.clip(value * term["scale"], *term["clip"]) / term["scale"]'), "clip after scale"),
    Plant("clip left out", "odd", term("joint_vel", clip=None), "clip left out"),
    # Network.
    Plant("normalizer left out", "go1", feeding("x * std + mean"), "normalizer left out"),
    Plant("normalizer applied twice", "go1", feeding("(x - mean) / std"), "normalizer applied twice"),
    Plant("network without its normalizer", "go1", network(without_normalizer), "policy.onnx is not the network of the trace"),
    Plant("memory not fed back", "odd", runtime("self.inputs[name][:] = value\n        return", "pass\n        return"), "memory not fed back"),
    Plant("memory kept at a start", "odd", runtime("self.inputs[name][:] = 0.0", "pass"), "memory not cleared at the start"),
    # Targets.
    Plant("action scale", "go1", action("scale", lambda scale: 0.5 * scale), "other action scale"),
    Plant("action scale of the waist", "g1", action("scale", lambda scale: np.where(np.arange(29) == 12, 0.6 * scale, scale)), "other action scale of some joints"),
    Plant("default pose not added", "go1", action("offset", lambda offset: 0.0 * offset), "default pose not added"),
    Plant("targets clipped to the joint ranges", "g1", runtime(JOINT_TARGETS, f'parts = [np.clip(parts[0], *np.array([j["range"] for j in self.contract["joints"]]).T)]\n        {JOINT_TARGETS}'), "targets clipped to the joint ranges"),
    Plant("targets clipped near the default pose", "go1", runtime(JOINT_TARGETS, f"parts = [parts[0].clip(self.default - 0.4, self.default + 0.4)]\n        {JOINT_TARGETS}"), "components clipped"),
    Plant("target clip left out", "odd", action("clip", lambda clip: None), "target clip left out"),
    # Time.
    Plant("twice the control rate", "go1", contract(slower), "other control rate"),
    Plant("half the physics steps", "go1", contract(fewer_substeps), "other control rate"),
    Plant("other physics time step", "go1", model("opt.timestep", lambda dt: 0.8 * dt), "other physics time step"),
    Plant("a control step of latency", "go1", simulate(ENTER, f'targets, self.sent = getattr(self, "sent", targets), targets\n        {ENTER}'), "targets one control step late"),
    Plant("a physics step of latency", "go1", simulate(ENTER + STEP, 'held, self.sent = getattr(self, "sent", targets), targets\n        for n in range(self.contract["rates"]["decimation"]):\n            self.write_controls(held if n == 0 else targets)\n            mujoco.mj_step(self.model, self.data)\n'), "targets one physics step late"),
    Plant("sensors without mj_forward", "go1", simulate("before the last physics step.\n        mujoco.mj_forward(self.model, self.data)", "before the last physics step."), "sensors read without mj_forward"),
    # Motors and joints.
    Plant("gains of the contract", "go1", joints("kp", lambda kp: [0.5 * one for one in kp]), "other gains"),
    Plant("gains of the scene", "go1", model("actuator_gainprm", lambda x: 0.8 * x), "other gains"),
    Plant("gains in another order", "odd", joints("kp", lambda kp: kp[::-1]), "gains in another order"),
    Plant("no armature", "go1", model("dof_armature", lambda x: 0.0 * x), "other armature"),
    Plant("no joint damping", "odd", model("dof_damping", lambda x: 0.0 * x), "other joint damping"),
    Plant("no joint friction", "odd", model("dof_frictionloss", lambda x: 0.0 * x), "other joint friction"),
    Plant("no effort limit", "odd", joints("effort", lambda limits: [None] * len(limits)), "other effort limit"),
    Plant("no effort limit of a wrist, never reached", "g1", joints("effort", lambda limits: [*limits[:-1], None]), UNDECIDABLE),
    Plant("gains of the scene, with a gear", "geared", model("actuator_gainprm", lambda x: 0.8 * x), "other gains"),
    Plant("gain of a motor in both lists of the contract", "go1", contract(stiffer_calf), "other gains"),
)  # fmt: skip
"""Numbered list of mistakes of deployments, as users reported them."""

NUMBERS = {f"{number}, {plant.mistake}": plant for number, plant in enumerate(PLANTS, 1)}


@pytest.mark.parametrize("number", NUMBERS)
def test_planted_mistake_is_named(number, traced, tmp_path):
    plant = NUMBERS[number]
    folder = copied(traced(plant.bundle), tmp_path / "copy")
    plant.edit(folder)
    report = check_bundle(folder)
    if plant.cause == UNDECIDABLE:
        assert report.is_passed
        assert "never reached" in " ".join(report.undecided)
        return
    assert not report.is_passed
    assert set(report.causes) == {plant.cause}, str(report)


PAIRS = [(one, other) for one, other in combinations(PLANTS, 2) if one.bundle == other.bundle]
"""Pairs of mistakes in the same bundle, about 670."""


def assert_no_wrong_name(one: Plant, other: Plant, folder: Path) -> None:
    one.edit(folder)
    try:
        other.edit(folder)
    except AssertionError:
        # Both edit the same line.
        return
    report = check_bundle(folder)
    assert not report.is_passed
    assert set(report.causes) <= {one.cause, other.cause}, str(report)


SOME = [
    pytest.param(number, marks=() if number % 180 == 0 else pytest.mark.slow)
    for number in range(0, len(PAIRS), 60)
]


@pytest.mark.parametrize("number", SOME)
def test_two_mistakes_give_no_wrong_name(number, traced, tmp_path):
    one, other = PAIRS[number]
    assert_no_wrong_name(one, other, copied(traced(one.bundle), tmp_path / "copy"))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(7, len(PAIRS), 7))
def test_more_pairs_give_no_wrong_name(number, traced, tmp_path):
    one, other = PAIRS[number]
    assert_no_wrong_name(one, other, copied(traced(one.bundle), tmp_path / "copy"))


@pytest.mark.parametrize("name", ["odd", "geared"])
def test_untrained_bundle_as_written_passes(traced, name):
    report = check_bundle(traced(name))
    assert report.is_passed, str(report)


def test_gains_are_those_at_the_joint(traced):
    """A servo with gear g follows g q, and its force acts on the joint times g."""
    content = json.loads((traced("geared") / "contract.json").read_text())
    (slider,) = (joint for joint in content["joints"] if joint["name"] == "slider")
    assert (slider["kp"], slider["kd"], slider["effort"]) == (80.0, 8.0, 60.0)
    (action,) = content["actions"]
    assert action["scale"] == [0.1]
