"""Settings of a config that the contract has, and configs that it cannot describe."""

from __future__ import annotations

import copy
import dataclasses
import json
from typing import Any

import pytest
from bundles import write_random

from mjlab.actuator import DcMotorActuatorCfg
from mjlab.deploy.check import undecided
from mjlab.deploy.evidence import Evidence
from mjlab.entity import EntityArticulationInfoCfg
from mjlab.scripts.demo import DEMOS


def test_speeds_and_delays_of_motors(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        motor = DcMotorActuatorCfg(
            target_names_expr=(".*_calf_joint",),
            stiffness=20.0,
            damping=0.5,
            effort_limit=20.0,
            saturation_effort=30.0,
            velocity_limit=21.0,
            delay_min_lag=1,
            delay_max_lag=3,
        )
        robot = env.scene.entities["robot"]
        others = [
            dataclasses.replace(one, target_names_expr=(".*_hip_joint", ".*_thigh_joint"))
            for one in robot.articulation.actuators[:1]
        ]
        robot.articulation = EntityArticulationInfoCfg(actuators=(*others, motor))

    task = "Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation"
    folder = write_random(task, tmp_path / "bundle", edit, steps=5)
    contract = json.loads((folder / "contract.json").read_text())
    names = [joint["name"] for joint in contract["joints"]]
    calves = ["calf" in name for name in names]
    assert [joint["speed"] for joint in contract["joints"]] == [21.0 if x else None for x in calves]
    assert contract["limits"]["joint_speed"] == [21.0 if x else 30.0 for x in calves]
    delays = [one["delay"] for one in contract["actuators"] if "calf" in one["name"]]
    assert delays == [[1, 3]] * 4
    (text,) = [one for one in undecided(Evidence(folder)) if one.startswith("delays of")]
    assert text.startswith("delays of 4 of 12 actuators, 1 to 3 physics steps")


def test_training_of_a_bundled_policy(bundle):
    source = json.loads((bundle("go1") / "contract.json").read_text())["source"]
    readme = (DEMOS["go1"].policy.parent / "README.md").read_text()
    assert f"in {source['iteration']} iterations" in readme
    assert f"--agent.seed {source['seed']}\n" in readme


def test_joints_that_no_fault_damps_are_named(bundle):
    """A motor driven by effort has no kd."""
    assert (
        "without torque, not damped: slider ("
        in (bundle("Mjlab-Cartpole-Swingup") / "README.md").read_text()
    )
    assert "not damped" not in (bundle("go1") / "README.md").read_text()


def test_terms_of_two_groups_with_one_name(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        env.observations["extra"] = copy.deepcopy(env.observations["actor"])
        agent.obs_groups = {**agent.obs_groups, "actor": ("actor", "extra")}

    with pytest.raises(ValueError, match="groups actor, extra"):
        write_random("Mjlab-Cartpole-Swingup", tmp_path / "bundle", edit)


def test_actions_of_two_entities(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        env.scene.entities["second"] = copy.deepcopy(env.scene.entities["cartpole"])
        env.actions["other"] = copy.deepcopy(env.actions["effort"])
        env.actions["other"].entity_name = "second"

    with pytest.raises(ValueError, match="Action 'other' entity_name"):
        write_random("Mjlab-Cartpole-Swingup", tmp_path / "bundle", edit)
