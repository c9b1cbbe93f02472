"""`deploy.yaml`, read by the rules of Unitree's programs."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import yaml
from bundles import load_program, write_random

from mjlab.deploy.check import check_bundle
from mjlab.deploy.unitree import (
    MOTORS,
    UnknownToUnitreeError,
    _network,
    deploy_settings,
    motor_map,
    phase_note,
)
from mjlab.scripts.demo import DEMOS


class Reader:
    """Unitree's reading: motor states in motor order in, motor targets in motor order out."""

    def __init__(self, folder: Path) -> None:
        text = (folder / "params" / "deploy.yaml").read_text()
        self.cfg = yaml.safe_load(text)
        self.motors = np.array(self.cfg["joint_ids_map"])
        session = onnxruntime.InferenceSession(str(folder / "exported" / "policy.onnx"))
        (self.input,) = session.get_inputs()
        # The programs multiply the dimensions: a dynamic one, -1, would throw.
        self.size = int(np.prod(self.input.shape))
        self.session = session
        self.action = np.zeros(len(self.motors), np.float32)
        self.history: dict[str, list] = {}
        self.phase = 0.0

    def observe(self, state: dict[str, np.ndarray], stick: np.ndarray) -> np.ndarray:
        """Return the network input of low-level states in the order of the motors."""
        parts = []
        for name, term in self.cfg["observations"].items():
            value = getattr(self, name)(state, stick, **term["params"])
            if term["clip"] is not None:
                value = np.clip(value, *term["clip"])
            assert isinstance(term["scale"], list)
            value = value * np.array(term["scale"])
            frames = self.history.setdefault(name, [value] * term["history_length"])
            frames[:] = [*frames[1:], value]
            parts += frames
        return np.concatenate(parts).astype(np.float32)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return motor positions in the order of the motors."""
        first_output = self.session.run(None, {"obs": observation[None]})[0]
        self.action = first_output[0]
        (action,) = self.cfg["actions"].values()
        assert action["clip"] is None
        assert action["joint_ids"] is None
        targets = np.empty(len(self.motors))
        targets[self.motors] = self.action * action["scale"] + action["offset"]
        return targets

    # Registered terms.

    def base_ang_vel(self, state, stick):
        return state["gyroscope"]

    def projected_gravity(self, state, stick):
        w, x, y, z = state["quaternion"]
        return np.array([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1])

    def joint_pos_rel(self, state, stick):
        return state["q"][self.motors] - self.cfg["default_joint_pos"]

    def joint_vel_rel(self, state, stick):
        return state["dq"][self.motors]

    def last_action(self, state, stick):
        return self.action

    def velocity_commands(self, state, stick):
        ranges = self.cfg["commands"]["base_velocity"]["ranges"]
        bounds = [ranges[name] for name in ("lin_vel_x", "lin_vel_y", "ang_vel_z")]
        return np.clip(stick, *np.array(bounds).T)

    def motion_command(self, state, stick):
        return state["motion"]

    def motion_anchor_ori_b(self, state, stick):
        return state["anchor"]

    def gait_phase(self, state, stick, period):
        self.phase = (self.phase + self.cfg["step_dt"] / period) % 1.0
        angle = 2 * np.pi * self.phase
        return np.array([np.sin(angle), np.cos(angle)])


@pytest.mark.parametrize("name", ["go1", "g1"])
def test_the_programs_act_as_in_training(bundle, name):
    folder = bundle(name)
    reader, trace = Reader(folder), dict(np.load(folder / "golden.npz"))
    assert reader.input.name == "obs"
    motors = reader.motors
    if "gait_phase" in reader.cfg["observations"]:
        # Their clock advances before it is read.
        reader.phase = (
            -reader.cfg["step_dt"] / reader.cfg["observations"]["gait_phase"]["params"]["period"]
        )
    for k in range(len(trace["time"])):
        assert bool(trace["first"][k]) == (k == 0)
        q, dq = np.empty(len(motors)), np.empty(len(motors))
        q[motors] = trace["measurement/joint_pos"][k]
        dq[motors] = trace["measurement/joint_vel"][k]
        state = {
            "q": q,
            "dq": dq,
            "gyroscope": trace["measurement/imu_ang_vel"][k],
            "quaternion": trace["measurement/root_quat"][k],
        }
        observation = reader.observe(state, trace["command/twist"][k])
        assert observation.size == reader.size
        np.testing.assert_allclose(observation, trace["input/obs"][k], atol=2e-5)
        targets = reader.act(observation)
        np.testing.assert_allclose(targets[motors], trace["target"][k], atol=2e-5)


def test_the_programs_act_as_in_training_of_motions(tmp_path):
    task = "Mjlab-Tracking-Flat-Unitree-G1-No-State-Estimation"
    folder = write_random(task, tmp_path / "bundle", steps=8)
    # They raise for an input that is no observation, such as a frame.
    reader, trace = Reader(folder), dict(np.load(folder / "golden.npz"))
    assert reader.input.name == "obs"
    assert reader.motors.tolist() == list(range(29))
    for k in range(len(trace["time"])):
        if trace["first"][k]:
            reader.action[:] = 0.0
        state = {
            "q": trace["measurement/joint_pos"][k],
            "dq": trace["measurement/joint_vel"][k],
            "gyroscope": trace["measurement/imu_ang_vel"][k],
            "motion": trace["command/motion"][k],
            "anchor": trace["raw/obs/motion_anchor_ori_b"][k],
        }
        observation = reader.observe(state, np.zeros(3))
        np.testing.assert_allclose(observation, trace["input/obs"][k], atol=2e-5)
        np.testing.assert_allclose(reader.act(observation), trace["target"][k], atol=2e-5)
    assert check_bundle(folder).is_passed


def test_the_network_for_the_programs_needs_no_frame(bundle, tmp_path):
    bundled = DEMOS["g1-tracking"].policy
    folder = Path(shutil.copytree(bundle("Mjlab-Tracking-Flat-Unitree-G1"), tmp_path / "bundle"))
    shutil.copyfile(bundled, folder / "policy.onnx")
    contract = json.loads((folder / "contract.json").read_text())
    network = _network(contract, folder)
    assert [one.name for one in network.graph.input] == ["obs"]
    observations = np.random.default_rng(0).normal(size=(1, 160)).astype(np.float32)
    frame = {"time_step": np.zeros((1, 1), np.float32)}
    programs = [
        onnxruntime.InferenceSession(p) for p in (str(bundled), network.SerializeToString())
    ]
    wanted = programs[0].run(["actions"], {"obs": observations, **frame})[0]
    np.testing.assert_array_equal(programs[1].run(None, {"obs": observations})[0], wanted)


def test_recurrent_policy_is_rejected(bundle):
    entry = {"name": "h_in", "shape": [1, 1, 8], "kind": "memory", "output": "h_out"}
    contract = edited(bundle("go1"), lambda c: c["policy"]["inputs"].append(entry))
    with pytest.raises(UnknownToUnitreeError, match="no input 'h_in'"):
        deploy_settings(contract)


def test_gains_are_in_the_order_of_the_motors(bundle):
    contract = json.loads((bundle("go1") / "contract.json").read_text())
    # As in Unitree's model of the Go2: left legs first.
    order = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    contract["joints"] = [contract["joints"][k] for k in order]
    contract["actions"][0]["joints"] = [joint["name"] for joint in contract["joints"]]
    for k, joint in enumerate(contract["joints"]):
        joint["kp"] = float(k)
    settings = deploy_settings(contract)
    assert settings["joint_ids_map"] == order
    assert settings["stiffness"] == [3.0, 4.0, 5.0, 0.0, 1.0, 2.0, 9.0, 10.0, 11.0, 6.0, 7.0, 8.0]


def test_breadth_first_joints_of_the_g1():
    motors = MOTORS["G1 (29 joints)"]
    order = [0, 6, 12, 1, 7, 13, 2, 8, 14, 3, 9, 15, 22, 4, 10, 16, 23, 5, 11, 17, 24, 18, 25, 19]
    order += [26, 20, 27, 21, 28]
    assert motor_map([f"{motors[k]}_joint" for k in order]) == order


def test_joints_of_the_h1_2_are_in_the_order_of_its_motors():
    # Of its MJCF in unitree_ros, h1_2_description, and in this order.
    names = [
        "left_hip_yaw_joint",
        "left_hip_pitch_joint",
        "left_hip_roll_joint",
        "left_knee_joint",
        "left_ankle_pitch_joint",
        "left_ankle_roll_joint",
        "right_hip_yaw_joint",
        "right_hip_pitch_joint",
        "right_hip_roll_joint",
        "right_knee_joint",
        "right_ankle_pitch_joint",
        "right_ankle_roll_joint",
        "torso_joint",
        "left_shoulder_pitch_joint",
        "left_shoulder_roll_joint",
        "left_shoulder_yaw_joint",
        "left_elbow_joint",
        "left_wrist_roll_joint",
        "left_wrist_pitch_joint",
        "left_wrist_yaw_joint",
        "right_shoulder_pitch_joint",
        "right_shoulder_roll_joint",
        "right_shoulder_yaw_joint",
        "right_elbow_joint",
        "right_wrist_roll_joint",
        "right_wrist_pitch_joint",
        "right_wrist_yaw_joint",
    ]
    assert motor_map(names) == list(range(27))
    assert motor_map(names[::-1]) == list(range(27))[::-1]


def with_term(contract: dict, **changes: Any) -> dict:
    changed = copy.deepcopy(contract)
    changed["observations"][0]["terms"][0].update(changes)
    return changed


def test_unregistered_terms_are_named(bundle):
    contract = json.loads((bundle("go1") / "contract.json").read_text())
    with pytest.raises(UnknownToUnitreeError, match="base_ang_vel"):
        deploy_settings(with_term(contract, kind="custom"))
    with pytest.raises(UnknownToUnitreeError, match="base_ang_vel"):
        deploy_settings(with_term(contract, columns=[0, 1]))


def edited(folder: Path, change: Any) -> dict:
    contract = json.loads((folder / "contract.json").read_text())
    change(contract)
    return contract


@pytest.mark.parametrize(
    ("clip", "written"),
    [((None, 2.0), [-1e9, 2.0]), ((-3.0, None), [-3.0, 1e9]), ((-3.0, 2.0), [-3.0, 2.0])],
)
def test_clip_with_an_open_side(bundle, clip, written):
    contract = edited(bundle("go1"), lambda c: c["observations"][0]["terms"][0].update(clip=clip))
    assert deploy_settings(contract)["observations"]["base_ang_vel"]["clip"] == written


def test_clip_of_actions_is_refused(bundle):
    contract = edited(bundle("go1"), lambda c: c["policy"].update(clip=1.0))
    with pytest.raises(UnknownToUnitreeError, match="actions of the policy"):
        deploy_settings(contract)


@pytest.mark.parametrize("body", ["robot/torso_link", "robot/pelvis"])
def test_anchor_of_a_motion_is_the_torso(bundle, body):
    def change(contract: dict) -> None:
        source = {"kind": "body_quat", "body": body}
        contract["measurements"].append({"name": "anchor_quat", "source": source})
        inputs = ["command/motion/anchor_quat", "anchor_quat"]
        contract["observations"][0]["terms"][0].update(kind="orientation_in_frame", inputs=inputs)

    contract = edited(bundle("g1"), change)
    if body == "robot/torso_link":
        assert "motion_anchor_ori_b" in deploy_settings(contract)["observations"]
    else:
        with pytest.raises(UnknownToUnitreeError, match="base_ang_vel"):
            deploy_settings(contract)


def test_gait_phase_is_two_steps_ahead_of_the_clock(bundle, tmp_path):
    clock = {
        "name": "gait",
        "kind": "gait_clock",
        "frequency": 1.6,
        "fade_s": 0.0,
        "start": 0.0,
        "velocity_command": None,
        "components": [{"name": "sin"}, {"name": "cos"}],
    }

    def change(contract: dict) -> None:
        contract["commands"].append(clock)
        term = contract["observations"][0]["terms"][-1]
        term.update(name="gait", kind="command", size=2, scale=None, inputs=["command/gait"])
        term.update(start=0, stop=2, columns=None, factor=None, offset=None, clip=None)
        contract["observations"][0]["terms"] = [term]

    contract = edited(bundle("go1"), change)
    settings = deploy_settings(contract)
    reader = Reader(bundle("go1"))
    reader.cfg = settings
    params = settings["observations"]["gait_phase"]["params"]
    policy = load_program(bundle("go1"), "runtime").Policy(
        contract, lambda outputs, inputs: [np.zeros((1, 12))], limits=False
    )
    # Their reset reads each term.
    reader.gait_phase({}, np.zeros(3), **params)
    expected, got = [], []
    for k in range(60):
        measured = {"time": 0.02 * k, "joint_pos": np.zeros(12), "joint_vel": np.zeros(12)}
        policy.step(measured, {"twist": np.zeros(3)})
        expected.append(policy.values["obs", "gait"])
        got.append(reader.gait_phase({}, np.zeros(3), **params))
    np.testing.assert_allclose(got[:-2], expected[2:], atol=1e-5)
    assert "two control steps" in str(phase_note(contract))
    assert phase_note(edited(bundle("go1"), lambda content: None)) is None


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda cfg: cfg["stiffness"].reverse(), "deploy.yaml/stiffness"),
        (lambda cfg: cfg["observations"]["joint_pos_rel"].update(clip=[-1.0, 1.0]), "clip"),
        (
            lambda cfg: cfg["observations"].update(base=cfg["observations"].pop("last_action")),
            "base",
        ),
        (lambda cfg: cfg.pop("commands"), "deploy.yaml/commands"),
        (lambda cfg: cfg.clear(), "is of this contract"),
    ],
)
def test_edited_file_is_found(bundle, tmp_path, change, where):
    """A file of another task is reported to have destroyed a robot."""
    folder = Path(shutil.copytree(bundle("go1"), tmp_path / "bundle"))
    path = folder / "params" / "deploy.yaml"
    settings = yaml.safe_load(path.read_text())
    change(settings)
    path.write_text(yaml.safe_dump(settings, sort_keys=False))
    report = check_bundle(folder)
    assert not report.is_passed
    assert where in " ".join(str(one) for one in report.findings)


def test_file_and_network_of_another_task_are_found(bundle, tmp_path):
    folder = Path(shutil.copytree(bundle("go1"), tmp_path / "bundle"))
    for name in ("params/deploy.yaml", "exported/policy.onnx"):
        shutil.copyfile(bundle("g1") / name, folder / name)
    wrong = {one.comparison.name for one in check_bundle(folder).findings}
    assert wrong >= {"deploy.yaml/joint_ids_map", "exported/policy.onnx"}
    other = Path(shutil.copytree(bundle("Mjlab-Cartpole-Swingup"), tmp_path / "other"))
    (other / "params").mkdir()
    shutil.copyfile(folder / "params" / "deploy.yaml", other / "params" / "deploy.yaml")
    assert [one.comparison.name for one in check_bundle(other).findings] == ["deploy.yaml"]


def test_damaged_copy_of_the_network_is_found(bundle, tmp_path):
    folder = Path(shutil.copytree(bundle("go1"), tmp_path / "bundle"))
    (folder / "exported" / "policy.onnx").write_bytes(b"no network")
    assert [one.comparison.name for one in check_bundle(folder).findings] == [
        "exported/policy.onnx"
    ]


def test_reason_for_the_g1_with_23_joints():
    motors = MOTORS["G1 (29 joints)"]
    without = ("waist_roll", "waist_pitch", "wrist_pitch", "wrist_yaw")
    names = [f"{one}_joint" for one in motors if not one.endswith(without)]
    assert len(names) == 23
    with pytest.raises(UnknownToUnitreeError, match="sources disagree"):
        motor_map(names)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("Mjlab-Velocity-Rough-Unitree-Go1", "do not register the term 'base_lin_vel'"),
        ("Mjlab-Reach-Yam", "motors of these joints are not known"),
    ],
)
def test_reason_why_there_is_no_file(bundle, name, why):
    folder = bundle(name)
    assert not (folder / "params").exists()
    assert not (folder / "exported").exists()
    (line,) = [x for x in (folder / "README.md").read_text().splitlines() if "deploy.yaml" in x]
    assert why in line
