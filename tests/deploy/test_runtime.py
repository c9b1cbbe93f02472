"""The runtime of a bundle: answers of the training environment, and limits."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import (
    BUNDLES,
    TOLERANCE,
    arrays_of,
    load_program,
    row_of,
    worst_differences,
    write_random,
)

from mjlab.envs.mdp import last_action
from mjlab.managers import ObservationTermCfg
from mjlab.utils.noise import UniformNoiseCfg


@pytest.mark.parametrize("name", BUNDLES)
def test_answers_are_those_of_training(bundle, name):
    worst = worst_differences(bundle(name))
    assert worst.keys() >= {"action", "target"}
    assert max(worst.values()) < TOLERANCE, worst


def kinetic_energy(env: Any) -> Any:
    """Observation term that the runtime does not know, (N, 1)."""
    return 0.5 * env.scene["cartpole"].data.joint_vel.square().sum(dim=1, keepdim=True)


def test_pipeline_of_terms_memory_and_clips(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        terms = env.observations["actor"].terms
        terms["cart_pos"].scale, terms["cart_pos"].history_length = 3.0, 4
        terms["cart_vel"].clip, terms["cart_vel"].scale = (-0.2, 0.1), 0.5
        terms["pole_angle"].history_length = 2
        terms["pole_vel"].noise, terms["pole_vel"].delay_max_lag = UniformNoiseCfg(-1.0, 1.0), 2
        terms["last"] = ObservationTermCfg(func=last_action, params={"action_name": "effort"})
        terms["energy"] = ObservationTermCfg(func=kinetic_energy)
        action = env.actions["effort"]
        action.scale, action.offset, action.clip = 2.0, 0.1, {"slider": (-0.02, 0.15)}
        agent.clip_actions = 0.03
        agent.actor.class_name, agent.actor.rnn_type = "RNNModel", "lstm"
        agent.actor.rnn_hidden_dim = 8
        env.episode_length_s = 1.0

    folder = write_random("Mjlab-Cartpole-Swingup", tmp_path / "bundle", edit)
    with pytest.raises(ValueError, match="kinetic_energy"):
        load_program(folder, "runtime").Policy.load(folder)
    # The value of an unknown term is a measurement.
    worst = worst_differences(
        folder, {f"{__name__}:kinetic_energy": lambda inputs, term: inputs[0]}
    )
    assert max(worst.values()) < TOLERANCE, worst
    trace = arrays_of(folder)
    assert np.abs(trace["action"]).max() == pytest.approx(0.03)
    # Episodes of 20 steps: memory and histories restart.
    assert trace["first"].nonzero()[0].tolist() == [0, 20, 40]
    contract = json.loads((folder / "contract.json").read_text())
    # The network clips.
    assert contract["policy"]["clip"] is None
    by_name = {term["name"]: term for term in contract["observations"][0]["terms"]}
    assert by_name["pole_vel"]["noise"]["n_max"] == 1.0
    assert by_name["pole_vel"]["delay"] == [0, 2]
    assert by_name["cart_vel"]["clip"] == [-0.2, 0.1]


@pytest.mark.parametrize("name", ["go1", "g1", "Mjlab-Lift-Cube-Yam", "Mjlab-Reach-Yam"])
def test_plain_mujoco_follows_training(bundle, name):
    folder = bundle(name)
    load_program(folder, "runtime")
    simulate = load_program(folder, "simulate")
    policy = simulate.Policy.load(folder, limits=False)
    simulation = simulate.Simulation(policy.contract, simulate.load_model(folder))
    trace = arrays_of(folder)
    fields = [key.removeprefix("state/") for key in trace if key.startswith("state/")]
    for k in range(0, len(trace["time"]), 3):
        policy.reset()
        simulation.set_state(**{field: trace[f"state/{field}"][k] for field in fields})
        measured = simulation.measure()
        for measurement, value in measured.items():
            if measurement != "time":
                np.testing.assert_allclose(value, trace[f"measurement/{measurement}"][k], atol=2e-6)
        policy.action[:] = trace["action"][k]
        simulation.apply(policy.targets(measured["joint_pos"]))
        np.testing.assert_allclose(simulation.data.qpos, trace["after/qpos"][k], atol=1e-6)
        np.testing.assert_allclose(simulation.data.qvel, trace["after/qvel"][k], atol=1e-4)


def test_one_step_is_fast(bundle):
    folder = bundle("go1")
    policy = load_program(folder, "runtime").Policy.load(folder, limits=False)
    trace = arrays_of(folder)
    rows = [row_of(policy, trace, k) for k in range(len(trace["time"]))]
    durations = []
    for _ in range(10):
        for measured, command in rows:
            start = time.perf_counter()
            policy.step(measured, command)
            durations.append(time.perf_counter() - start)
    # The target is 0.1 ms on an idle core; tests run on busy ones.
    assert np.median(durations) < 1e-3


@pytest.mark.parametrize(
    ("name", "command"), [("go1", ["0.8", "0", "0"]), ("Mjlab-Lift-Cube-Yam", [])]
)
def test_programs_need_neither_mjlab_nor_torch(bundle, name, command):
    folder = bundle(name)
    program = (
        "import sys, runpy\n"
        "sys.modules['mjlab'] = sys.modules['torch'] = None\n"
        f"sys.path.insert(0, {str(folder)!r})\n"
        f"sys.argv = ['simulate.py', '--seconds', '1', '--command', *{command}]\n"
        f"runpy.run_path({str(folder / 'simulate.py')!r}, run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Damping" not in done.stdout
    forward = float(done.stdout.partition("[")[2].strip().split()[0])
    assert (forward > 0.2) == (name == "go1")


# Limits.


@pytest.fixture
def robot(bundle):
    """Return a policy with limits, and the first measurements and command of its trace."""
    folder = bundle("go1")
    policy = load_program(folder, "runtime").Policy.load(folder)
    measured, command = row_of(policy, arrays_of(folder), 0)
    return policy, measured, command


def test_targets_keep_within_limits(robot):
    policy, measured, command = robot
    low, high = (np.array(policy.contract["limits"][f"target_{end}"]) for end in ("low", "high"))
    policy.network = lambda outputs, inputs: [np.full((1, 12), 1000.0, np.float32)]
    np.testing.assert_allclose(policy.step(measured, command).position, high)
    assert (policy.target > high).all()
    policy.reset()
    policy.network = lambda outputs, inputs: [np.full((1, 12), -1000.0, np.float32)]
    np.testing.assert_allclose(policy.step(measured, command).position, low)


def test_target_jumps_are_limited(robot):
    policy, measured, command = robot
    largest = policy.contract["limits"]["target_step"] = [0.1] * 12
    policy.limits["target_step"] = np.array(largest)
    before = policy.step(measured, command).position
    policy.network = lambda outputs, inputs: [np.ones((1, 12), np.float32)]
    after = policy.step({**measured, "time": 0.02}, command).position
    assert np.abs(after - before).max() == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"joint_vel": np.full(12, 40.0)}, "faster"),
        ({"root_quat": np.array([np.cos(0.7), np.sin(0.7), 0.0, 0.0])}, "tilted"),
        ({"imu_ang_vel": np.array([0.0, np.nan, 0.0])}, "finite"),
        ({"joint_pos": np.full(12, np.inf)}, "finite"),
        ({"root_quat": np.zeros(4)}, "quaternion"),
        ({"root_quat": np.array([0.94, 0.0, 0.0, 0.0])}, "quaternion"),
        ({"time": 0.5}, "no new measurement"),
        ({"time": np.nan}, "no new measurement"),
    ],
)
def test_odd_measurements_damp_until_reset(robot, change, reason):
    policy, measured, command = robot
    assert not policy.step(measured, command).is_damping
    damped = policy.step({**measured, "time": 0.02, **change}, command)
    assert damped.is_damping
    assert reason in damped.reason
    assert not damped.kp.any()
    assert (damped.kd > 0.0).all()
    assert np.isfinite(damped.position).all()
    # Good measurements do not revive the policy.
    assert policy.step({**measured, "time": 0.04}, command).is_damping
    policy.reset()
    assert not policy.step(measured, command).is_damping


def test_repeated_measurements_damp(robot):
    policy, measured, command = robot
    steps = round(policy.contract["limits"]["max_age"] / policy.period) + 2
    damping = [policy.step(measured, command).is_damping for _ in range(steps)]
    assert damping[-1]
    assert not damping[-3]


def test_rounded_quaternions_are_accepted(robot):
    policy, measured, command = robot
    assert not policy.step({**measured, "root_quat": [0.96, 0, 0, 0]}, command).is_damping


@pytest.mark.parametrize(
    "change", [{"joint_pos": [0.5]}, {"imu_ang_vel": 0.0}, {"root_quat": [1.0, 0.0, 0.0]}]
)
def test_measurements_of_wrong_size_are_errors(robot, change):
    policy, measured, command = robot
    with pytest.raises(ValueError, match=next(iter(change))):
        policy.step({**measured, **change}, command)


@pytest.mark.parametrize("given", [[0.5], 0.5, None])
def test_commands_of_wrong_size_are_errors(robot, given):
    policy, measured, _ = robot
    with pytest.raises(ValueError, match="command/twist: expected 3"):
        policy.step(measured, given)


def test_one_array_is_not_for_two_commands(robot):
    policy, measured, _ = robot
    contract = json.loads(json.dumps(policy.contract))
    contract["commands"].append({**contract["commands"][0], "name": "other"})
    other = type(policy)(contract, policy.network)
    twist = np.zeros(3)
    with pytest.raises(KeyError, match="twist"):
        other.step(measured, twist)
    other.step(measured, {"twist": twist, "other": twist})


def test_command_that_is_not_finite_damps(robot):
    policy, measured, _ = robot
    assert policy.step(measured, [np.nan, 0.0, 0.0]).is_damping


def test_answer_that_is_not_finite_damps(robot):
    policy, measured, command = robot
    policy.network = lambda outputs, inputs: [np.full((1, 12), np.nan, np.float32)]
    damped = policy.step(measured, command)
    assert damped.is_damping
    assert np.isfinite(damped.position).all()


# Hand-over.


def test_hand_over_from_a_standing_pose(robot):
    policy, measured, _ = robot
    pose = policy.default + np.linspace(-0.4, 0.4, 12)
    moving = {**measured, "joint_pos": pose, "joint_vel": np.zeros(12)}
    first = policy.hand_over({**moving, "time": 0.0})
    np.testing.assert_allclose(first.position, pose)
    half = policy.hand_over({**moving, "time": 0.05}, seconds=0.1)
    np.testing.assert_allclose(half.position, (pose + policy.default) / 2)
    # The joints did not follow: not ready.
    policy.hand_over({**moving, "time": 0.1}, seconds=0.1)
    assert not policy.is_ready
    last = policy.hand_over({**moving, "joint_pos": policy.default, "time": 0.12}, seconds=0.1)
    np.testing.assert_allclose(last.position, policy.default)
    assert policy.is_ready


def test_first_target_after_the_hand_over_is_near_its_last(robot):
    policy, measured, command = robot
    policy.limits["target_step"] = np.full(12, 0.1)
    policy.network = lambda outputs, inputs: [np.ones((1, 12), np.float32)]
    there = {**measured, "joint_pos": policy.default}
    policy.hand_over({**there, "time": 0.0}, seconds=0.1)
    last = policy.hand_over({**there, "time": 0.1}, seconds=0.1).position
    policy.reset()
    first = policy.step({**there, "time": 0.12}, command).position
    np.testing.assert_allclose(np.abs(first - last), 0.1)
    # A new episode without a hand-over has no last target.
    policy.reset()
    assert np.abs(policy.step(there, command).position - last).max() > 0.1


def test_hand_over_is_to_the_first_pose_of_the_motion(bundle):
    folder = bundle("Mjlab-Tracking-Flat-Unitree-G1")
    policy = load_program(folder, "runtime").Policy.load(folder)
    (command,) = policy.contract["commands"]
    command["motions"].append({"name": "late", "start": 30, "length": 20})
    policy.reset(motion=len(command["motions"]) - 1)
    measured, _ = row_of(policy, arrays_of(folder), 0)
    policy.hand_over({**measured, "time": 0.0}, seconds=0.01)
    last = policy.hand_over({**measured, "time": 0.02}, seconds=0.01)
    assert not last.is_damping, last.reason
    np.testing.assert_allclose(last.position, policy.motion["joint_pos"][30])


def test_motion_is_a_motion_file(bundle):
    """In the fields that other controllers of motions read, of the joints of the contract."""
    folder = bundle("Mjlab-Tracking-Flat-Unitree-G1")
    contract = json.loads((folder / "contract.json").read_text())
    motion = np.load(folder / "motion.npz")
    joints, bodies = len(contract["joints"]), len(contract["commands"][0]["bodies"])
    count = contract["commands"][0]["num_frames"]
    shapes = {name: motion[name].shape for name in motion if not name.endswith("names")}
    assert shapes == {
        "fps": (1,),
        **dict.fromkeys(("joint_pos", "joint_vel"), (count, joints)),
        **dict.fromkeys(("body_pos_w", "body_lin_vel_w", "body_ang_vel_w"), (count, bodies, 3)),
        "body_quat_w": (count, bodies, 4),
    }
    assert motion["fps"][0] == pytest.approx(1.0 / contract["rates"]["step_dt"])
    assert motion["joint_names"].tolist() == [joint["name"] for joint in contract["joints"]]


def turned(quat: np.ndarray) -> np.ndarray:
    """Return an orientation turned by 90 degrees to the left."""
    w, x, y, z = quat
    return np.sqrt(0.5) * np.array((w - z, x - y, y + x, z + w))


def observed(folder: Path, turn: Any, move: Any, is_aligned: bool = True) -> np.ndarray:
    """Return the observations of a robot whose orientations and places are changed, (K, n)."""
    policy = load_program(folder, "runtime").Policy.load(folder, limits=False)
    changes = {one["name"]: one["source"]["kind"] for one in policy.contract["measurements"]}
    changes = {name: {"body_quat": turn, "body_pos": move}.get(k) for name, k in changes.items()}
    trace, rows = arrays_of(folder), []
    for k in range(20):
        measured, command = row_of(policy, trace, k)
        measured |= {name: change(measured[name]) for name, change in changes.items() if change}
        if k == 0:
            policy.reset(measurements=measured if is_aligned else None)
        policy.step(measured, command)
        rows.append(policy.inputs["obs"][0].copy())
    return np.array(rows)


def test_motion_is_turned_and_moved_to_the_robot(bundle):
    folder = bundle("Mjlab-Tracking-Flat-Unitree-G1")

    def move(place: np.ndarray) -> np.ndarray:
        return np.array((2.0 - place[1], 1.0 + place[0], place[2]))

    before = observed(folder, np.array, np.array)
    np.testing.assert_allclose(observed(folder, turned, move), before, atol=1e-5)
    # Else the motion has another heading than the robot.
    assert np.abs(observed(folder, turned, move, is_aligned=False) - before).max() > 0.5


def test_hand_over_after_a_fault_begins_at_the_measured_pose(robot):
    policy, measured, _ = robot
    policy.hand_over({**measured, "time": 0.0}, seconds=0.1)
    policy.hand_over({**measured, "joint_pos": policy.default, "time": 0.12}, seconds=0.1)
    policy.reset()
    assert not policy.is_ready
    pose = policy.default + 0.4
    np.testing.assert_allclose(policy.hand_over({**measured, "joint_pos": pose}).position, pose)


def test_hand_over_of_a_fallen_robot_damps(robot):
    policy, measured, _ = robot
    targets = policy.hand_over({**measured, "root_quat": [0.0, 1.0, 0.0, 0.0]})
    assert targets.is_damping
    assert not policy.is_ready


def test_hand_over_without_a_time_damps(robot):
    policy, measured, _ = robot
    assert policy.hand_over({**measured, "time": np.nan}).is_damping


# Terms of packages.


class Filter:
    """Moving average of the joint velocities, which advances with each call."""

    def __init__(self, cfg: Any, env: Any) -> None:
        self.mean = None

    def reset(self, env_ids: Any = None) -> None:
        """Forget the past."""
        self.mean = None

    def __call__(self, env: Any) -> Any:
        """Return the average, (N, J)."""
        now = env.scene["robot"].data.joint_vel
        self.mean = now.clone() if self.mean is None else 0.5 * (self.mean + now)
        return self.mean


def test_custom_terms_and_second_scans_have_measurements_of_their_own(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        terms = env.observations["actor"].terms
        terms["joint_pos"] = ObservationTermCfg(func=Filter)
        scan = terms["height_scan"]
        terms["low_scan"] = dataclasses.replace(scan, params={**scan.params, "offset": 0.2})
        del terms["projected_gravity"]

    folder = write_random("Mjlab-Velocity-Rough-Unitree-Go1", tmp_path / "bundle", edit, 8)
    contract = json.loads((folder / "contract.json").read_text())
    kinds = {one["name"]: one["source"]["kind"] for one in contract["measurements"]}
    assert kinds["joint_pos"] == "joint_pos"
    assert kinds["term/joint_pos"] == kinds["term/low_scan"] == "trace"
    # The tilt is limited though no term observes it.
    assert kinds["root_quat"] == "body_quat"
    assert contract["limits"]["tilt_from"] == "root_quat"
    trace = arrays_of(folder)
    # A filter advances once a step.
    mean = trace["measurement/joint_vel"][0]
    pairs = zip(trace["measurement/term/joint_pos"], trace["measurement/joint_vel"], strict=True)
    for measured, now in pairs:
        mean = 0.5 * (mean + now)
        np.testing.assert_allclose(measured, mean, atol=1e-6)
    ordinary, low = trace["raw/obs/height_scan"], trace["raw/obs/low_scan"]
    assert not np.allclose(ordinary, low)
    np.testing.assert_array_equal(trace["measurement/term/low_scan"], low)
    worst = worst_differences(folder, {f"{__name__}:Filter": lambda inputs, term: inputs[0]})
    assert max(worst.values()) < TOLERANCE, worst


def test_robot_without_tilt_is_not_limited(robot):
    policy, measured, command = robot
    policy.limits["tilt_from"] = None
    fallen = {**measured, "root_quat": [0.0, 1.0, 0.0, 0.0]}
    assert not policy.step(fallen, command).is_damping


def test_unknown_term_is_named_and_can_be_added(bundle):
    folder = bundle("go1")
    runtime = load_program(folder, "runtime")
    contract = json.loads((folder / "contract.json").read_text())
    term = contract["observations"][0]["terms"][0]
    term["kind"], term["function"] = "custom", "my_package.mdp:half"
    with pytest.raises(ValueError, match="my_package.mdp:half"):
        runtime.Policy(contract, None, folder)
    runtime.TERMS["my_package.mdp:half"] = lambda inputs, term: 0.5 * inputs[0]
    policy = runtime.Policy(contract, lambda *_: [np.zeros((1, 12), np.float32)], folder)
    measured, command = row_of(policy, arrays_of(folder), 0)
    policy.step(measured, command)
    np.testing.assert_allclose(policy.values["obs", term["name"]], 0.5 * measured["imu_ang_vel"])


def test_runtime_is_short():
    from mjlab.deploy.evidence import FILES

    assert len((FILES / "runtime.py").read_text().splitlines()) < 300
