"""`mjlab check`: each fault, planted into three robots, is found with file and line."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import pytest

from mjlab.asset_zoo.robots import get_g1_robot_cfg, get_go1_robot_cfg
from mjlab.own_robot.findings import Finding, find_faults
from mjlab.own_robot.source_lines import SourceLines
from mjlab.own_robot.subject import subject_of

LEG = """
<body name="{side}_hip" pos="{x} {y} 0">
  <joint name="{side}_hip" axis="1 0 0" range="-1 1"/>
  <geom name="{side}_hip_geom" type="sphere" size="0.03" mass="0.5"/>
  <body name="{side}_thigh" pos="0 {out} 0">
    <joint name="{side}_thigh" axis="0 1 0" range="-0.5 3"/>
    <geom name="{side}_thigh_geom" fromto="0 0 -0.04 0 0 -0.17" mass="1"/>
    <body name="{side}_calf" pos="0 0 -0.21">
      <joint name="{side}_calf" axis="0 1 0" range="-2.7 -0.5"/>
      <geom name="{side}_calf_geom" fromto="0 0 -0.04 0 0 -0.18" mass="0.2"/>
      <geom name="{side}_foot" class="foot" pos="0 0 -0.21" mass="0.05"/>
    </body>
  </body>
</body>"""
HOUND = """<mujoco model="hound">
  <compiler angle="radian"/>
  <default>
    <geom type="capsule" size="0.015" group="3"/>
    <joint armature="0.01"/>
    <general biastype="affine" gainprm="50" biasprm="0 -50 -1" forcerange="-30 30"/>
    <default class="foot">
      <geom type="sphere" size="0.02" priority="1" condim="3"/>
    </default>
  </default>
  <worldbody>
    <body name="trunk">
      <freejoint/>
      <geom name="trunk_geom" type="box" size="0.2 0.08 0.05" mass="8"/>
      <include file="front.xml"/>
      <include file="legs/rear.xml"/>
    </body>
  </worldbody>
  <actuator>
    {servos}
  </actuator>
  <keyframe>
    <key name="init_state" qpos="0 0 0.278 1 0 0 0 {legs}" ctrl="{legs}"/>
  </keyframe>
</mujoco>
"""


def hound() -> dict[str, str]:
    """Return the files of a small quadruped: front and rear legs are included."""
    sides = {"FL": (0.2, 1), "FR": (0.2, -1), "RL": (-0.2, 1), "RR": (-0.2, -1)}
    legs = {s: LEG.format(side=s, x=x, y=0.05 * y, out=0.08 * y) for s, (x, y) in sides.items()}
    servos = [
        f'<general name="{s}_{j}" joint="{s}_{j}"/>'
        for s in sides
        for j in ("hip", "thigh", "calf")
    ]
    main = HOUND.format(servos="\n    ".join(servos), legs=" ".join(["0 0.9 -1.8"] * 4))
    pair = "<mujoco>{}{}\n</mujoco>"
    return {
        "hound.xml": main,
        "front.xml": pair.format(legs["FL"], legs["FR"]),
        "legs/rear.xml": pair.format(legs["RL"], legs["RR"]),
    }


def exported(make: Callable) -> dict[str, str]:
    """Return a stock robot with its actuators, collisions and initial state as one file."""
    spec = make().build().spec
    spec.compile()
    return {f"{spec.modelname}.xml": spec.to_xml()}


@dataclass
class Robot:
    """Files of a robot without faults, and the starts of some of its elements."""

    files: dict[str, str]
    trunk: str
    thigh: str
    knee: str
    foot: str
    servo: str
    line: str = field(default="", init=False)
    """Place of the last edit."""

    def set(self, start: str, **attributes: str | None) -> None:
        """Set attributes of the element that starts with `start` (None: delete), and keep its place."""
        name = next(name for name, text in self.files.items() if start in text)
        before, _, rest = self.files[name].partition(start)
        own, end, after = rest.partition(">")
        slash = "/" if own.endswith("/") else ""
        own = own.removesuffix("/")
        for key, value in attributes.items():
            own = re.sub(rf' {key.rstrip("_")}="[^"]*"', "", own)
            own += "" if value is None else f' {key.rstrip("_")}="{value}"'
        self.files[name] = f"{before}{start}{own}{slash}{end}{after}"
        self.line = f"{name}:{1 + before.count(chr(10))}"

    def add(self, start: str, element: str) -> None:
        """Add an element in a new line below the one that starts with `start`, and keep its place."""
        self.set(start)
        name, _, number = self.line.partition(":")
        lines = self.files[name].split("\n")
        place = next(i for i in range(int(number) - 1, len(lines)) if ">" in lines[i]) + 1
        self.files[name] = "\n".join([*lines[:place], element, *lines[place:]])
        self.line = f"{name}:{place + 1}"

    def value(self, start: str, attribute: str) -> list[float]:
        """Return the numbers of an attribute."""
        text = next(text for text in self.files.values() if start in text).partition(start)[2]
        found = re.search(rf' {attribute}="([^"]*)"', text)
        assert found is not None
        return [float(number) for number in found[1].split()]

    def findings(self, folder: Path) -> list[Finding]:
        """Write the files and return their findings."""
        for name, text in self.files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
        path = folder / next(iter(self.files))
        return find_faults(subject_of(mujoco.MjSpec.from_file(str(path)), SourceLines(path)))


def parts(trunk: str, thigh: str, knee: str, foot: str) -> tuple[str, ...]:
    """Return the starts of elements: trunk, thigh, joint of the knee, sole, servo of the knee."""
    return (
        f'<body name="{trunk}"',
        f'<body name="{thigh}"',
        f'<joint name="{knee}"',
        f'<geom name="{foot}"',
        f'<general name="{knee}"',
    )


ROBOTS = {
    "go1": (
        lambda: exported(get_go1_robot_cfg),
        *parts("trunk", "FL_thigh", "FL_calf_joint", "FL_foot_collision"),
    ),
    "g1": (
        lambda: exported(get_g1_robot_cfg),
        *parts("pelvis", "left_hip_yaw_link", "left_knee_joint", "left_foot2_collision"),
    ),
    # Knee and foot are in an included file.
    "hound": (hound, *parts("trunk", "RR_thigh", "RR_calf", "RR_foot")),
}


@pytest.fixture(scope="module")
def sound() -> dict[str, dict[str, str]]:
    return {name: files() for name, (files, *_) in ROBOTS.items()}


@pytest.fixture(params=ROBOTS)
def robot(request, sound) -> Robot:
    return Robot(dict(sound[request.param]), *ROBOTS[request.param][1:])


def test_sound_robots_have_no_findings(robot: Robot, tmp_path: Path) -> None:
    assert robot.findings(tmp_path) == []


# Faults.


def gravity(robot: Robot) -> None:
    robot.add("<compiler", '<option gravity="0 0 0"/>')


def stiff(robot: Robot) -> None:
    robot.set(robot.servo, gainprm="9e4", biasprm="0 -9e4 -1")


def soft(robot: Robot) -> None:
    robot.set(robot.servo, gainprm="10", biasprm="0 -10 -1")


def weak(robot: Robot) -> None:
    robot.set(robot.servo, forcerange="-0.5 0.5")


def unarmed(robot: Robot) -> None:
    robot.set(robot.knee, armature="0")


def undriven(robot: Robot) -> None:
    name = next(name for name, text in robot.files.items() if robot.servo in text)
    robot.files[name] = re.sub(f"{robot.servo}[^>]*>", "", robot.files[name])
    robot.set("<key name", ctrl=None)
    robot.set(robot.knee)


def heavy(robot: Robot) -> None:
    inertial = '<inertial mass="900" pos="0 0 -0.1" diaginertia="9 9 2"/>'
    replace_inertial(robot, inertial)


def spread(robot: Robot) -> None:
    """Kilograms times square millimeters."""
    replace_inertial(robot, '<inertial mass="1" pos="0 0 -0.1" diaginertia="3000 3000 500"/>')


def replace_inertial(robot: Robot, inertial: str) -> None:
    robot.set(robot.thigh)
    name = robot.line.partition(":")[0]
    head, start, rest = robot.files[name].partition(robot.thigh)
    joint = rest.index("<joint")
    own = re.sub(r"<inertial[^>]*>", "", rest[:joint])
    robot.files[name] = head + start + own.rstrip() + inertial + rest[joint:]


def uneven(robot: Robot) -> None:
    robot.set(robot.knee, armature="0.004")


def degrees(robot: Robot) -> None:
    robot.set("<compiler", angle=None)


def narrow(robot: Robot) -> None:
    robot.set(robot.knee, range="-0.3 0.3")


def lifted(by: float) -> Callable[[Robot], None]:
    def edit(robot: Robot) -> None:
        x, y, z, *rest = robot.value("<key name", "qpos")
        robot.set("<key name", qpos=" ".join(map(str, (x, y, z + by, *rest))))

    return edit


def leaning(robot: Robot) -> None:
    # A weight in front of the trunk.
    robot.add(
        robot.trunk, '<body pos="1 0 0"><geom type="box" size="0.1 0.1 0.1" mass="20"/></body>'
    )
    robot.set("<key name")


def tangled(robot: Robot) -> None:
    lump = '<geom name="lump" type="sphere" size="0.2" contype="1" conaffinity="1" mass="0"/>'
    robot.add(robot.thigh, lump)


def immaterial(robot: Robot) -> None:
    for name, text in robot.files.items():
        text = re.sub(r' (contype|conaffinity)="[^"]*"', "", text)
        robot.files[name] = re.sub(r"<geom ", '<geom contype="0" conaffinity="0" ', text)
    robot.set(robot.trunk)


def slippery(robot: Robot) -> None:
    robot.set(robot.foot, priority="0")


def frictionless(robot: Robot) -> None:
    robot.set(robot.foot, condim="1")


def sliding(robot: Robot) -> None:
    robot.set(robot.foot, solimp="0.015 1 0.036")


def unnamed(robot: Robot) -> None:
    start = robot.foot
    name = next(name for name, text in robot.files.items() if start in text)
    robot.set(start)
    robot.files[name] = robot.files[name].replace(start, "<geom", 1)


def visible(robot: Robot) -> None:
    robot.set(robot.foot, group="0")


def table(robot: Robot) -> None:
    robot.add(
        "<worldbody", '<body name="table" pos="3 0 0"><geom type="sphere" size="0.1"/></body>'
    )


FAULTS = {
    "zero gravity": gravity,
    "gains too stiff for the time step": stiff,
    "gains too soft for the weight": soft,
    "effort that cannot hold the weight": weak,
    "zero armature": unarmed,
    "joints without an actuator": undriven,
    "absurd mass": heavy,
    "absurd inertia": spread,
    "asymmetric left and right": uneven,
    "ranges in radians, read in degrees": degrees,
    "initial pose outside the limits": narrow,
    "initial pose in the ground": lifted(-0.1),
    "initial pose above the ground": lifted(0.2),
    "initial pose falls": leaning,
    "self-penetration in the initial pose": tangled,
    "nothing collides": immaterial,
    "soles whose friction cannot be randomized": slippery,
    "frictionless soles": frictionless,
    "soles that slide": sliding,
    "unnamed feet": unnamed,
    "geoms that terrain rays see": visible,
    "static bodies beside a floating base": table,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_found_with_its_line(robot: Robot, fault: str, tmp_path: Path) -> None:
    FAULTS[fault](robot)
    name = "soles whose friction cannot be randomized" if "frictionless" in fault else fault
    found = [finding for finding in robot.findings(tmp_path) if finding.fault == name]
    places = {str(Path(place).relative_to(tmp_path)) for one in found for place in one.where}
    assert robot.line in places


def test_a_loose_object_is_not_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "table.xml"
    path.write_text(
        """<mujoco><worldbody>
        <body name="table"><geom type="box" size="1 1 0.1"/></body>
        <body name="goal" pos="0 0 2"><freejoint/>
          <geom type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"/></body>
        </worldbody></mujoco>""",
        encoding="utf-8",
    )
    assert find_faults(subject_of(mujoco.MjSpec.from_file(str(path)), SourceLines(path))) == []
