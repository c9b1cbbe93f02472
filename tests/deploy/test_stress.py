"""Success under stress, the passport, and warnings."""

from __future__ import annotations

import json
import shutil

import mujoco
import numpy as np
import pytest

from mjlab.deploy.check import check_bundle
from mjlab.deploy.evidence import Evidence
from mjlab.deploy.fitness import fitness_warnings
from mjlab.deploy.passport import write_passport
from mjlab.deploy.stress import LEVELS, UNITS, Setting, push, stress, succeeds
from mjlab.utils.errors import UserError


@pytest.fixture
def evidence(bundle):
    return Evidence(bundle("go1"))


def test_nominal_robot_stands_and_a_slow_one_falls(evidence):
    assert succeeds(evidence, Setting(), seed=0, seconds=1.0)
    assert succeeds(evidence, Setting(noise=1.0, latency=0.01), seed=0, seconds=1.0)
    assert not succeeds(evidence, Setting(payload=60.0), seed=0, seconds=1.0)
    assert not succeeds(evidence, Setting(push=12.0), seed=0, seconds=2.5)


def test_each_level_changes_the_episodes(evidence):
    levels = {"gains": (0.05, 1.0), "joint_friction": (0.0, 40.0)}
    curves = stress(evidence, episodes=1, seconds=0.6, levels=levels)
    assert [point.level for point in curves["gains"]] == [0.05, 1.0]
    assert curves["gains"][1].successes == curves["joint_friction"][0].successes == 1
    assert curves["gains"][0].successes == 0
    low, high = curves["gains"][1].interval
    assert low < 1.0
    assert high == 1.0
    assert set(LEVELS) == set(UNITS) == set(vars(Setting()))


def test_commands_are_those_of_the_seed(evidence, monkeypatch):
    """Neither noise nor pushes change the commands of an episode."""
    seen: list[list[np.ndarray]] = []
    policy = evidence.originals.runtime.Policy
    step = policy.step

    def recorded(self, measurements, command=None):
        seen[-1] += command.values()
        return step(self, measurements, command)

    monkeypatch.setattr(policy, "step", recorded)
    for setting in (Setting(), Setting(noise=1.0), Setting(push=0.1)):
        seen.append([])
        assert succeeds(evidence, setting, seed=3, seconds=2.1)
    nominal, noisy, pushed = map(np.array, seen)
    assert np.ptp(nominal, axis=0).max() > 0.0
    assert (noisy == nominal).all()
    assert (pushed == nominal).all()


def test_pushes_are_of_the_robot():
    """The robot is not the first floating body."""
    body = '<body name="{0}"><freejoint/><geom size=".1"/></body>'
    xml = f"<mujoco><worldbody>{body.format('box')}{body.format('robot')}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    push(model, data, model.body("robot").id, speed=2.0, heading=np.pi / 2)
    assert data.qvel == pytest.approx([*[0.0] * 6, 0.0, 2.0, *[0.0] * 4])


def test_latency_is_that_simulated(evidence):
    dt = evidence.contract["rates"]["physics_dt"]
    levels = {"latency": (0.0, 0.9 * dt, 1.1 * dt, 1.6 * dt)}
    curves = stress(evidence, episodes=1, seconds=0.1, levels=levels)
    assert [point.level for point in curves["latency"]] == pytest.approx([0.0, dt, 2 * dt])


def test_noise_of_other_packages_is_named(evidence, tmp_path):
    term = next(t for one in evidence.contract["observations"] for t in one["terms"] if t["noise"])
    term["noise"] = {"type": "MyNoiseCfg", "operation": "add"}
    lines: list[str] = []
    curves = stress(evidence, 1, 0.1, levels={"noise": (1.0,)}, report=lines.append)
    assert "MyNoiseCfg" in lines[0]
    assert term["name"] in lines[0]
    report = check_bundle(evidence.folder)
    write_passport(tmp_path / "p.html", evidence.contract, report, curves, {})
    assert "MyNoiseCfg" in (tmp_path / "p.html").read_text()


def test_passport_has_checks_and_curves(evidence, tmp_path):
    report = check_bundle(evidence.folder)
    curves = stress(evidence, episodes=1, seconds=0.1, levels={"mass": (1.0, 1.2)})
    write_passport(tmp_path / "p.html", evidence.contract, report, curves, {"seconds": 0.1})
    assert "<th>commit</th><td>not recorded</td>" in (tmp_path / "p.html").read_text()
    content = json.loads((tmp_path / "p.json").read_text())
    assert content["source"]["task"] == evidence.contract["source"]["task"]
    assert content["check"]["passed"]
    assert [one["level"] for one in content["stress"]["curves"]["mass"]] == [1.0, 1.2]
    page = (tmp_path / "p.html").read_text()
    assert page.count("<svg") == 1
    assert "Check: passed" in page
    assert "mass" in page


def test_scans_cannot_be_stressed(bundle):
    with pytest.raises(UserError, match="scans"):
        stress(Evidence(bundle("Mjlab-Velocity-Rough-Unitree-Go1")), episodes=1, seconds=0.1)


# Warnings.


def test_warnings_are_of_the_trace(evidence):
    before = fitness_warnings(evidence)
    evidence.trace["measurement/joint_vel"] = evidence.values("joint_vel") + np.eye(12)[3] * 99
    (speed,) = set(fitness_warnings(evidence)) - set(before)
    assert "1 of 12 joints above limits.joint_speed; most FL_hip_joint, in 100.0 %" in speed
    evidence.trace["target"] = evidence.trace["target"] + 9.0 * np.arange(45)[:, None]
    warnings = " ".join(fitness_warnings(evidence))
    assert "target_step" in warnings
    assert "target_high" in warnings


def test_tilt_beyond_the_limit_is_warned_of(evidence):
    before = fitness_warnings(evidence)
    assert "tilt" not in " ".join(before)
    angle = 0.5 * np.linspace(0.0, 1.5, len(evidence.first))
    tilts = np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], axis=1)
    evidence.trace["measurement/root_quat"] = tilts
    (text,) = set(fitness_warnings(evidence)) - set(before)
    assert "golden trace tilts the robot by 1.5 rad" in text


def test_tilt_of_a_motion_is_warned_of(bundle, tmp_path):
    folder = shutil.copytree(bundle("Mjlab-Tracking-Flat-Unitree-G1"), tmp_path / "bundle")
    motion = dict(np.load(folder / "motion.npz"))
    assert "reference motion" not in " ".join(fitness_warnings(Evidence(folder)))
    motion["body_quat_w"][7, 0] = np.cos(0.65), np.sin(0.65), 0.0, 0.0
    np.savez(folder / "motion.npz", **motion)
    assert "reference motion tilts the robot by 1.3 rad" in " ".join(
        fitness_warnings(Evidence(folder))
    )


def test_unmeasured_inputs_are_warned_of(bundle):
    evidence = Evidence(bundle("Mjlab-Velocity-Rough-Unitree-Go1"))
    text = " ".join(fitness_warnings(evidence))
    assert "imu_lin_vel, which base_lin_vel needs" in text
