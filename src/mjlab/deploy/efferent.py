"""`manifest.yaml`: the file from which `efferent` makes the package of a policy that it checks and runs.

`efferent` knows the usual terms; others are named `custom.<name>`, and its user registers their formulas.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mjlab.deploy.usual_terms import usual_term

_NAMES = {"joint_vel_rel": "joint_vel", "velocity_commands": "command"}


def write_manifest(contract: Mapping[str, Any], folder: Path) -> None:
    """Write `manifest.yaml` for a policy that it can state."""
    if (content := manifest(contract)) is not None:
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
        (folder / "manifest.yaml").write_text(text, encoding="utf-8")


def manifest(contract: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the content of `manifest.yaml`; None for a policy that it cannot state.

    It states a flat input, of terms without clips, and actions that move all joints from their defaults.
    """
    joints, policy = contract["joints"], contract["policy"]
    (observation, *groups), (action, *others) = contract["observations"], contract["actions"]
    kinds = [entry["kind"] for entry in policy["inputs"]]
    is_flat = not groups and len(observation["shape"]) == 1 and "frame" not in kinds
    is_clipped = action.get("clip") or any(term["clip"] for term in observation["terms"])
    is_of_all = not others and action["joints"] == [joint["name"] for joint in joints]
    if not is_flat or is_clipped or not is_of_all or action["kind"] != "joint_position":
        return None
    defaults = [joint["default_pos"] for joint in joints]
    if not np.allclose(action["offset"], defaults, atol=1e-6):
        return None
    clip, source = policy["clip"], contract["source"]
    return {
        "efferent": 1,
        "name": str(source.get("task", "policy")),
        "policy": _network(policy, observation["input"]),
        "control": {
            "rate_hz": 1.0 / contract["rates"]["step_dt"],
            "action_type": "joint_position_delta",
            "action_scale": np.broadcast_to(action["scale"], len(joints)).tolist(),
            "clip_actions": None if clip is None else [-clip, clip],
            "gains": {key: [joint[key] for joint in joints] for key in ("kp", "kd")},
        },
        "joints": [{"name": one["name"], "default": one["default_pos"]} for one in joints],
        "observation": [_term(contract, term) for term in observation["terms"]],
        "provenance": {"trained_in": source.get("package"), "commit": source.get("commit")},
    }


def _network(policy: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the inputs and outputs of the network, with its memory."""
    found = {"file": policy["file"], "input": name, "output": policy["output"]}
    memory = [entry for entry in policy["inputs"] if entry["kind"] == "memory"]
    if memory:
        found["state_input"] = [entry["name"] for entry in memory]
        found["state_output"] = [entry["output"] for entry in memory]
        found["state_init"] = [entry["shape"] for entry in memory]
    return found


def _term(contract: Mapping[str, Any], term: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of an observation term."""
    usual = usual_term(contract, term)
    entry: dict[str, Any] = {
        "term": f"custom.{term['name']}" if usual is None else _NAMES.get(usual, usual),
        "scale": np.broadcast_to(term["scale"] or [1.0], term["size"]).tolist(),
        "history": max(1, term["history"]["length"]),
    }
    if usual is None:
        entry["dim"] = term["size"]
    if usual == "velocity_commands":
        entry["names"] = ["lin_vel_x", "lin_vel_y", "ang_vel_z"]
    return entry
