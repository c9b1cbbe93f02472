"""`manifest.yaml`, read by the rules of `efferent`."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
import pytest
import yaml

from mjlab.deploy.efferent import manifest
from mjlab.deploy.evidence import rotations


@pytest.mark.parametrize("name", ["go1", "g1"])
def test_manifest_gives_inputs_and_targets(bundle, name):
    content = yaml.safe_load((bundle(name) / "manifest.yaml").read_text())
    trace = np.load(bundle(name) / "golden.npz")
    starts = [*np.flatnonzero(trace["first"]), len(trace["first"])]
    rows = np.arange(starts[1])
    default = np.array([joint["default"] for joint in content["joints"]])
    action = trace["action"][rows]
    values = {
        "base_ang_vel": trace["measurement/imu_ang_vel"],
        "projected_gravity": -rotations(trace["measurement/root_quat"])[:, 2],
        "joint_pos_rel": trace["measurement/joint_pos"] - default,
        "joint_vel": trace["measurement/joint_vel"],
        "last_action": np.concatenate((0 * action[:1], action[:-1])),
        "command": trace["command/twist"],
    }
    parts = []
    for term in content["observation"]:
        kind, _, custom = term["term"].partition(".")
        value = trace[f"raw/obs/{custom}"] if kind == "custom" else values[kind]
        # Oldest first; the first value fills the history.
        for age in reversed(range(term["history"])):
            parts.append(value[np.maximum(rows - age, 0)] * term["scale"])
    np.testing.assert_allclose(np.concatenate(parts, axis=1), trace["input/obs"][rows], atol=1e-5)
    target = default + content["control"]["action_scale"] * action
    np.testing.assert_allclose(target, trace["target"][rows], atol=1e-5)


@pytest.fixture
def contract(bundle) -> dict[str, Any]:
    return json.loads((bundle("go1") / "contract.json").read_text())


def test_memory_is_state(contract):
    entry = {"name": "h_in", "shape": [1, 1, 8], "kind": "memory", "output": "h_out"}
    contract["policy"]["inputs"].append(entry)
    content = manifest(contract)
    assert content is not None
    policy = content["policy"]
    states = policy["state_input"], policy["state_output"], policy["state_init"]
    assert states == (["h_in"], ["h_out"], [[1, 1, 8]])


@pytest.mark.parametrize("change", ["clip", "target clip", "velocity", "joints", "offset", "group"])
def test_policy_that_a_manifest_cannot_state(contract, change):
    assert manifest(copy.deepcopy(contract)) is not None
    (observation,), (action,) = contract["observations"], contract["actions"]
    if change == "clip":
        observation["terms"][0]["clip"] = [None, 1.0]
    elif change == "target clip":
        action["clip"] = [[-1.0, 1.0]] * 12
    elif change == "velocity":
        action["kind"] = "joint_velocity"
    elif change == "joints":
        action["joints"] = action["joints"][::-1]
    elif change == "offset":
        action["offset"] = [0.0] * 12
    else:
        contract["observations"].append(observation)
    assert manifest(contract) is None
