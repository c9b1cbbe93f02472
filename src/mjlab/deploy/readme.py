"""README of a bundle: what to measure, what to command, and how to connect a robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from mjlab.deploy.unitree import UnknownToUnitreeError, motor_map
from mjlab.deploy.usual_terms import imu_field, is_velocity

_TEMPLATE = Path(__file__).parent / "files" / "README.md.txt"


_HEADING = """

The reference motion has a heading in the world, and an IMU starts with any: `reset` with the measurements
after the hand-over turns the motion about the vertical to the robot (and moves it over the ground, if the
place of the robot is measured). Without them the robot would turn to the motion at once."""


def readme(contract: Mapping[str, Any], notes: Sequence[str]) -> str:
    """Return the README, in Markdown.

    Args:
        contract: Content of `contract.json`.
        notes: What the user should know, one sentence each.
    """
    rates, task = contract["rates"], contract["source"]["task"]
    given = [command for command in contract["commands"] if command["kind"] == "given"]
    example = [f"{_middle(one):g}" for one in _components(given)] or ["0"]
    listed = "".join(f"- {note}\n" for note in notes)
    return Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=f"{task}, deployed",
        task=task,
        rate=f"{1.0 / rates['step_dt']:g} Hz",
        mujoco=contract["source"].get("mujoco", ""),
        example=" ".join(example),
        measurements=_table(
            ("name", "size", "unit", "frame", "origin"),
            [
                (
                    f"`{one['name']}`",
                    " x ".join(map(str, one["shape"])),
                    one["unit"] or "-",
                    one["frame"] or "-",
                    one["why"],
                )
                for one in contract["measurements"]
            ],
        ),
        joints=", ".join(joint["name"] for joint in contract["joints"]),
        heading=_HEADING if any(c["kind"] == "motion" for c in contract["commands"]) else "",
        commands=_commands(contract["commands"]),
        **_loops(contract),
        **_unitree([joint["name"] for joint in contract["joints"]]),
        notes=f"\n## Notes\n\n{listed}\n" if listed else "\n",
    )


def _origin(contract: Mapping[str, Any], one: Mapping[str, Any]) -> str:
    """Return the origin of a measurement in the loops: a field of the robot's state, "kinematics" or ""."""
    if one["name"] in ("joint_pos", "joint_vel"):
        return one["name"]
    if (field := imu_field(contract, one)) is not None:
        return field
    return "kinematics" if one["availability"] == "computed" else ""


_PYTHON = {
    "joint_pos": "[m.q for m in motors]",
    "joint_vel": "[m.dq for m in motors]",
    "quaternion": "imu.quaternion",
    "gyroscope": "imu.gyroscope",
}
_CPP = {
    "quaternion": "{turn[3], turn[0], turn[1], turn[2]}",
    "gyroscope": "{rate[0], rate[1], rate[2]}",
}
_IMU_CPP = {
    "turn[": "  const auto turn = imu_->get_orientation();  // x, y, z, w\n",
    "rate[": "  const auto rate = imu_->get_angular_velocity();\n",
}
_TWIST_CPP = (
    "  const auto twist = *twist_.readFromRT();  // geometry_msgs/Twist of a subscription\n"
)
_GO2_MOTORS = 12
_NAN_NOTE = " Replace each NaN by the measurement of the line: until then, the robot is damped."


def _loops(contract: Mapping[str, Any]) -> dict[str, str]:
    """Return the parts of the loops that depend on measurements and commands."""
    python, cpp, computes = "", "", False
    for one in contract["measurements"]:
        name, size, origin = one["name"], one["size"], _origin(contract, one)
        if origin == "kinematics":
            computes = True
        else:
            value = _PYTHON.get(origin, f"np.full({size}, np.nan)")
            python += f',\n                "{name}": {value}'
        if origin not in ("joint_pos", "joint_vel"):
            value = _CPP.get(origin, f"mjlab::Vector({size}, NAN)")
            note = "  // As Simulation.compute in simulate.py." if origin == "kinematics" else ""
            cpp += f'  measured["{name}"] = {value};{note}\n'
    cpp = "".join(line for name, line in _IMU_CPP.items() if name in cpp) + cpp
    given = [one for one in contract["commands"] if one["kind"] == "given"]
    zeros = ", ".join(f'"{one["name"]}": np.zeros({one["size"]})' for one in given)
    sizes = [one["size"] for one in given]
    is_twist = len(given) == 1 and is_velocity(given[0])
    return {
        "measured_py": python,
        "measured_cpp": cpp,
        "return_py": "measured | robot.compute(measured)" if computes else "measured",
        "import_py": "\nimport mujoco\nfrom simulate import Simulation" if computes else "",
        "robot_py": _ROBOT if computes else "",
        "nan_note_py": _NAN_NOTE if "np.nan" in python else "",
        "nan_note_cpp": _NAN_NOTE if "NAN" in cpp else "",
        "command_py": f"np.zeros({sizes[0]})" if len(sizes) == 1 else f"{{{zeros}}}",
        "command_cpp": "{twist.linear.x, twist.linear.y, twist.angular.z}"
        if is_twist
        else "command_",
        "twist_cpp": _TWIST_CPP if is_twist else "",
    }


_ROBOT = """# Kinematics of the robot, for measurements that follow from joints and root.
robot = Simulation(policy.contract, mujoco.MjModel.from_xml_path("robot/robot.xml"))
"""


def _unitree(names: Sequence[str]) -> dict[str, str]:
    """Return the parts of the loop for Unitree's SDK that depend on the robot."""
    parts = {
        "motors": "range(len(policy.names))",
        "motors_note": "in the order of Unitree's messages",
        "message": "unitree_hg",
        "message_note": "  # Go2: unitree_go.",
        "head_py": 'cmd.mode_pr, cmd.mode_machine = 0, received["state"].mode_machine',
    }
    try:
        motors = motor_map(names)
    except UnknownToUnitreeError:
        note = "here joint k drives motor k: replace it by that of your robot"
        return parts | {"motors_note": note}
    if motors != list(range(len(names))):
        parts["motors"] = str(motors)
    parts["message_note"] = ""
    if len(motors) == _GO2_MOTORS:
        parts["message"] = "unitree_go"
        parts["head_py"] = "cmd.head, cmd.level_flag = [0xFE, 0xEF], 0xFF"
    return parts


def _components(commands: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [one for command in commands[:1] for one in command["components"]]


def _middle(component: Mapping[str, Any]) -> float:
    """Return half of the upper bound, within the range; 0 without one."""
    low, high = component["range"] or (0.0, 0.0)
    return max(low, 0.5 * high)


def _commands(commands: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for command in commands:
        if command["kind"] != "given":
            rows.append((f"`{command['name']}`", f"computed: {command['kind']}", "-", "-"))
            continue
        for one in command["components"]:
            bounds = one["range"]
            text = "-" if bounds is None else f"{bounds[0]:.3g} to {bounds[1]:.3g}"
            rows.append((f"`{command['name']}`", one["name"], one["unit"] or "-", text))
    return _table(("command", "component", "unit", "range of training"), rows) if rows else "None."


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
