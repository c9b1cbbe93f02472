"""`params/deploy.yaml`: the file that Unitree's deployment programs read beside the network.

The programs register a fixed set of terms. A policy with another one cannot run there, and the file is then
not written. Gains are in the order of the motors, everything else in that of the policy.

Their gait phase advances before it is read, and their reset reads it as well: since the start it is two
control steps ahead of training's. They read its period and nothing else, so the file cannot correct that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from mjlab.deploy.usual_terms import is_velocity, usual_term

if TYPE_CHECKING:
    from onnx import ModelProto

_LEGS = ("FR", "FL", "RR", "RL")
_SIDES = ("left", "right")
_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_LEG_OF_H1_2 = ("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll")
_ARM = (
    *("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
    *("wrist_roll", "wrist_pitch", "wrist_yaw"),
)
MOTORS: dict[str, tuple[str, ...]] = {
    "Go1, Go2": tuple(f"{leg}_{joint}" for leg in _LEGS for joint in ("hip", "thigh", "calf")),
    "G1 (29 joints)": (
        *(f"{side}_{joint}" for side in _SIDES for joint in _LEG),
        *("waist_yaw", "waist_roll", "waist_pitch"),
        *(f"{side}_{joint}" for side in _SIDES for joint in _ARM),
    ),
    # `H1_2_JointIndex` of unitree_sdk2_python's h1_2_low_level_example.py, as the MJCF of unitree_ros. Lists of
    # others have hip roll before hip pitch.
    "H1-2": (
        *(f"{side}_{joint}" for side in _SIDES for joint in _LEG_OF_H1_2),
        "torso",
        *(f"{side}_{joint}" for side in _SIDES for joint in _ARM),
    ),
}
"""Joint of each motor, without `_joint`, in the order of the motor commands."""
_UNBOUNDED = 1e9
# Body whose orientation the programs compare with the motion's.
_ANCHOR = "torso_link"


class UnknownToUnitreeError(ValueError):
    """Term, action or robot that Unitree's programs do not know."""


def write_unitree(contract: Mapping[str, Any], folder: Path) -> str | None:
    """Write `params/deploy.yaml` and `exported/policy.onnx`; return the reason if they are not."""
    try:
        content, network = deploy_settings(contract), _network(contract, folder)
    except UnknownToUnitreeError as error:
        return f"No params/deploy.yaml for Unitree's programs: {error}"
    for name in ("params", "exported"):
        (folder / name).mkdir(exist_ok=True)
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
    head = f"# {contract['source'].get('task')}, written by training; do not edit.\n"
    (folder / "params" / "deploy.yaml").write_text(head + text, encoding="utf-8")
    (folder / "exported" / "policy.onnx").write_bytes(network.SerializeToString())
    return None


def _network(contract: Mapping[str, Any], folder: Path) -> ModelProto:
    """Return the network as the programs read it: they raise for an input that is no observation.

    Of a motion's policy, the frame and what depends on nothing else are left out.

    Raises:
        UnknownToUnitreeError: the actions depend on another input.
    """
    import onnx

    policy = contract["policy"]
    model = onnx.load(str(folder / policy["file"]))
    others = {one["name"] for one in policy["inputs"] if one["kind"] != "observation"}
    if not others:
        return model
    graph, needed = model.graph, {policy["output"]}
    if any(attribute.HasField("g") for node in graph.node for attribute in node.attribute):
        raise UnknownToUnitreeError(
            f"they have no input {min(others)!r}, and the network branches."
        )
    for k in reversed(range(len(graph.node))):
        if needed.isdisjoint(graph.node[k].output):
            del graph.node[k]
        else:
            # An optional input that is left out has no name.
            needed.update(filter(None, graph.node[k].input))
    if used := others & needed:
        raise UnknownToUnitreeError(f"they have no input {min(used)!r}.")
    for values in (graph.input, graph.output, graph.initializer):
        for k in reversed(range(len(values))):
            if values[k].name not in needed:
                del values[k]
    del graph.value_info[:]
    return model


def file_numbers(
    contract: Mapping[str, Any], folder: Path
) -> dict[str, tuple[dict[str, float], dict[str, float]]]:
    """Return the numbers of `deploy.yaml` by part and key, as the contract gives them and as in `folder`.

    Empty without the file. One that `contract` cannot have, or that is no such file, is not of this contract.
    """
    path = folder / "params" / "deploy.yaml"
    if not path.exists():
        return {}
    try:
        written, found = deploy_settings(contract), yaml.safe_load(path.read_text(encoding="utf-8"))
        network = _network(contract, folder)
        for settings in (written, found):
            names = settings["observations"]
            settings["order of terms"] = {name: place for place, name in enumerate(names)}
        parts = {
            key: (_flat(written.get(key)), _flat(found.get(key))) for key in {**written, **found}
        }
    except (ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError):
        return {"deploy.yaml": ({"is of this contract": 1.0}, {"is of this contract": 0.0})}
    is_same = _holds(folder / "exported" / "policy.onnx", network)
    parts["exported/policy.onnx"] = {"is policy.onnx": 1.0}, {"is policy.onnx": float(is_same)}
    return {name if "/" in name else f"deploy.yaml/{name}": part for name, part in parts.items()}


def _holds(path: Path, network: ModelProto) -> bool:
    """Return True if the file is there, can be read, and is `network`."""
    import onnx
    from google.protobuf.message import DecodeError

    try:
        return onnx.load(str(path)) == network
    except (OSError, DecodeError):
        return False


def _flat(value: Any, key: str = "") -> dict[str, float]:
    """Return the numbers within mappings and lists, by dotted key; 0 for null."""
    if not isinstance(value, Mapping | list):
        return {key: float(value or 0.0)}
    parts = value.items() if isinstance(value, Mapping) else enumerate(value)
    flat = [_flat(part, f"{key}.{name}".lstrip(".")) for name, part in parts]
    return {name: number for one in flat for name, number in one.items()}


def phase_note(contract: Mapping[str, Any]) -> str | None:
    """Return a sentence on the gait phase of Unitree's programs; None for a policy without a clock."""
    clocks = [one for one in contract["commands"] if one["kind"] == "gait_clock"]
    if not clocks:
        return None
    return (
        "Unitree's programs give a gait phase two control steps ahead of training's, and newer versions zeros "
        "for commands shorter than 0.1: `runtime.py` gives that of training."
    )


def deploy_settings(contract: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `deploy.yaml`.

    Raises:
        UnknownToUnitreeError: a term, action, command or robot that the programs do not know.
    """
    joints = contract["joints"]
    motors = motor_map([joint["name"] for joint in joints])
    by_motor = sorted(range(len(joints)), key=lambda k: motors[k])
    (observation, *others) = contract["observations"]
    unknown = [one["input"] for one in others]
    unknown += [one["name"] for one in contract["policy"]["inputs"] if one["kind"] == "memory"]
    if unknown:
        raise UnknownToUnitreeError(f"they have no input {unknown[0]!r}.")
    return {
        "joint_ids_map": motors,
        "step_dt": contract["rates"]["step_dt"],
        "stiffness": [joints[k]["kp"] for k in by_motor],
        "damping": [joints[k]["kd"] for k in by_motor],
        "default_joint_pos": [joint["default_pos"] for joint in joints],
        "commands": _commands(contract),
        "actions": {"JointPositionAction": _action(contract)},
        "observations": dict(_observation(contract, term) for term in observation["terms"]),
    }


def motor_map(names: Sequence[str]) -> list[int]:
    """Return the motor of each joint.

    Raises:
        UnknownToUnitreeError: the joints are not those of a robot in `MOTORS`.
    """
    short = [name.removesuffix("_joint") for name in names]
    for motors in MOTORS.values():
        if sorted(short) == sorted(motors):
            return [motors.index(name) for name in short]
    raise UnknownToUnitreeError(
        f"the motors of these joints are not known; known: {', '.join(MOTORS)}. Public sources disagree on "
        "those of the G1 with 23 joints."
    )


# Terms.


def _observation(contract: Mapping[str, Any], term: Mapping[str, Any]) -> tuple[str, dict]:
    """Return the programs' name of a term, and its settings."""
    name, params = _registered(contract, term)
    low, high = term["clip"] or (None, None)
    clip = [-_UNBOUNDED if low is None else low, _UNBOUNDED if high is None else high]
    return name, {
        "params": params,
        # A pair or nothing: the programs know no open side.
        "clip": None if low is None and high is None else clip,
        "scale": np.broadcast_to(term["scale"] or [1.0], term["size"]).tolist(),
        "history_length": max(1, term["history"]["length"]),
    }


def _registered(contract: Mapping[str, Any], term: Mapping[str, Any]) -> tuple[str, dict]:
    kind, inputs = term["kind"], term["inputs"]
    sources = {one["name"]: one["source"] for one in contract["measurements"]}
    commands = {one["name"]: one for one in contract["commands"]}
    if (usual := usual_term(contract, term)) is not None:
        return usual, {}
    if kind == "command":
        command = commands[inputs[0].removeprefix("command/")]
        if command["kind"] == "motion":
            return "motion_command", {}
        always = command["kind"] == "gait_clock" and command["velocity_command"] is None
        if always and command["fade_s"] == 0.0 and command["start"] == 0.0:
            return "gait_phase", {"period": 1.0 / command["frequency"]}
    if kind == "orientation_in_frame" and _is_of_anchor(inputs, sources):
        return "motion_anchor_ori_b", {}
    raise UnknownToUnitreeError(f"they do not register the term {term['name']!r}.")


def _is_of_anchor(inputs: Sequence[str], sources: Mapping[str, Any]) -> bool:
    """Return True for a motion's orientation in the frame of the torso."""
    body = sources.get(inputs[1], {}).get("body", "")
    return inputs[0].startswith("command/") and body.rsplit("/", 1)[-1] == _ANCHOR


def _commands(contract: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ranges that the programs clamp the stick to."""
    for command in contract["commands"]:
        if is_velocity(command):
            ranges = {one["name"]: one["range"] for one in command["components"]}
            return {"base_velocity": {"ranges": {**ranges, "heading": None}}}
    return {}


def _action(contract: Mapping[str, Any]) -> dict[str, Any]:
    (action, *others), joints = contract["actions"], contract["joints"]
    names = [joint["name"] for joint in joints]
    if others or action["kind"] != "joint_position" or action["joints"] != names:
        raise UnknownToUnitreeError(
            "they expect one joint position action of all joints, in order."
        )
    if contract["policy"]["clip"] is not None:
        raise UnknownToUnitreeError("they do not clip the actions of the policy.")
    if action["clip"] is not None:
        raise UnknownToUnitreeError("they do not clip joint targets.")
    return {
        "clip": None,
        "scale": action["scale"],
        "offset": action["offset"],
        "joint_ids": None,
    }
