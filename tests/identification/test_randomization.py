"""Printed actuators and events run, and cover the intervals."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from mjlab.actuator import BuiltinMotorActuatorCfg, IdealPdActuatorCfg, TransmissionType
from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.envs import ManagerBasedRlEnv
from mjlab.identification.estimate import DriveEstimate, Estimate, LimbEstimate
from mjlab.identification.randomization import actuators_source, events_source
from mjlab.tasks.registry import load_env_cfg

TIMESTEP = 0.005
VALUES = {"armature": 0.006, "damping": 0.2, "friction": 0.5, "kp": 30.0, "kd": 1.0}


def leg(name: str, share: float) -> LimbEstimate:
    parameters = {kind: Estimate(value, share * value) for kind, value in VALUES.items()}
    drives = [
        DriveEstimate((f"{name}_{part}_joint",), parameters, ())
        for part in ("hip", "thigh", "calf")
    ]
    return LimbEstimate(tuple(drives), Estimate(0.011, 0.002), {"position": np.zeros(3)})


LIMBS = [leg("FR", 0.12), leg("FL", 0.12), leg("RR", 0.5), leg("RL", 0.01)]


@pytest.fixture(scope="module")
def written() -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(actuators_source(LIMBS, {"FR_hip_joint": 23.7}, TIMESTEP), names)
    exec(events_source(LIMBS), names)
    return names


def test_actuators_have_the_values(written: dict[str, Any]) -> None:
    first = written["ACTUATORS"][0]
    assert len(written["ACTUATORS"]) == 12
    assert (first.stiffness, first.damping, first.armature) == (30.0, 1.0, 0.006)
    assert (first.effort_limit, written["ACTUATORS"][1].effort_limit) == (23.7, None)
    # 9 to 13 ms, in steps of 5 ms.
    assert (first.delay_min_lag, first.delay_max_lag) == (1, 3)


def test_joints_of_a_group_keep_their_effort_limits() -> None:
    (drive,) = leg("FR", 0.1).drives[:1]
    shared = dataclasses.replace(drive, joints=("left", "right", "middle"))
    limb = dataclasses.replace(leg("FR", 0.1), drives=(shared,))
    names: dict[str, Any] = {}
    exec(actuators_source([limb], {"left": 20.0, "right": 5.0, "middle": 20.0}, TIMESTEP), names)
    limits = {tuple(cfg.target_names_expr): cfg.effort_limit for cfg in names["ACTUATORS"]}
    assert limits == {("left", "middle"): 20.0, ("right",): 5.0}
    assert {cfg.stiffness for cfg in names["ACTUATORS"]} == {30.0}


def test_untold_values_are_marked() -> None:
    told, untold = (actuators_source([leg("FR", share)], {}, TIMESTEP) for share in (0.1, 0.5))
    assert "not told" not in told
    marked = {line.split("=")[0].strip() for line in untold.splitlines() if "not told" in line}
    assert marked == {"armature", "viscous_damping", "frictionloss", "stiffness", "damping"}


def test_other_actuators_stay_as_they_are() -> None:
    others = [
        IdealPdActuatorCfg(
            target_names_expr=("waist", "neck"),
            stiffness=40.179238,
            damping=2.0,
            effort_limit=float("inf"),
            delay_max_lag=2,
        ),
        BuiltinMotorActuatorCfg(
            target_names_expr=("tail",), transmission_type=TransmissionType.TENDON, effort_limit=3.0
        ),
    ]
    names: dict[str, Any] = {}
    exec(actuators_source(LIMBS, {}, TIMESTEP, others), names)
    assert list(names["ACTUATORS"][12:]) == others


def test_ranges_are_intervals_of_known_values(written: dict[str, Any]) -> None:
    ranges = written["EVENTS"]["joint_friction"].params["ranges"]
    assert ranges["FR_hip_joint"] == pytest.approx((0.44, 0.56))
    # At least 5 % to each side.
    assert ranges["RL_hip_joint"] == pytest.approx((0.475, 0.525))
    # An interval of half the value is no knowledge.
    assert "RR_hip_joint" not in ranges
    lines = [line for line in events_source(LIMBS).splitlines() if "RR_hip_joint" in line]
    assert [line.split(":")[0].strip() for line in lines if "not told" in line] == [
        "# armature",
        "# joint_friction",
        "# joint_damping",
        "# gains",
        "# gains",
    ]
    assert written["EVENTS"]["gains"].params["kp_range"] == (0.88, 1.12)


def test_task_with_the_events(written: dict[str, Any]) -> None:
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    cfg.scene.num_envs = 4
    robot = get_go1_robot_cfg()
    assert robot.articulation is not None
    robot.articulation = dataclasses.replace(robot.articulation, actuators=written["ACTUATORS"])
    cfg.scene.entities["robot"] = robot
    cfg.events |= written["EVENTS"]
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    friction = env.sim.model.dof_frictionloss[:, env.scene["robot"].data.indexing.joint_v_adr]
    hip = env.scene["robot"].joint_names.index("FR_hip_joint")
    assert friction[:, hip].min() >= 0.44
    assert friction[:, hip].max() <= 0.56
    env.close()
