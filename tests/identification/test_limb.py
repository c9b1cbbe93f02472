"""Limbs of a hanging robot are those that move each other."""

from __future__ import annotations

import mujoco
import pytest
from swing import link_spec

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.identification.limb import build_limb, hang, split_into_limbs
from mjlab.utils.errors import UserError

LEGS = ("FR", "FL", "RR", "RL")
JOINTS = tuple(f"{leg}_{part}_joint" for part in ("hip", "thigh", "calf") for leg in LEGS)


@pytest.fixture(scope="module")
def go1() -> mujoco.MjSpec:
    return hang(get_go1_robot_cfg().spec_fn())


def test_legs_are_apart(go1: mujoco.MjSpec) -> None:
    limbs = split_into_limbs(go1, JOINTS, [])
    assert {frozenset(limb) for limb in limbs} == {
        frozenset(joint for joint in JOINTS if joint.startswith(leg)) for leg in LEGS
    }


def test_shared_parameters_join_limbs(go1: mujoco.MjSpec) -> None:
    limbs = split_into_limbs(go1, JOINTS, [("FR_hip_joint", "RL_hip_joint")])
    assert sorted(map(len, limbs)) == [3, 3, 6]


def test_masses_stay(go1: mujoco.MjSpec) -> None:
    own = get_go1_robot_cfg().spec_fn().compile()
    hung = go1.compile()
    assert hung.nv == own.nv - 6
    for body in range(1, own.nbody):
        name = own.body(body).name
        assert hung.body(name).mass == pytest.approx(own.body(name).mass)
        assert hung.body(name).inertia == pytest.approx(own.body(name).inertia, rel=1e-5)


def test_mass_matrix_of_a_leg_is_that_of_the_robot(go1: mujoco.MjSpec) -> None:
    joints = [joint for joint in JOINTS if joint.startswith("RL")]
    leg, whole = build_limb(go1, joints, 0.002), go1.compile()
    assert leg.nv == leg.nu == 3
    for joint in joints:
        own = leg.dof_M0[leg.joint(joint).dofadr[0]]
        assert own == pytest.approx(whole.dof_M0[whole.joint(joint).dofadr[0]], rel=1e-6)


def test_joints_out_of_the_log_are_held() -> None:
    model = build_limb(hang(link_spec(joints=3)), ["hinge0", "hinge2"], 0.002)
    assert [model.joint(j).name for j in range(model.njnt)] == ["hinge0", "hinge2"]
    assert model.nbody == 4


@pytest.mark.parametrize("period", [0.001, 0.002, 0.005, 0.02])
def test_timestep_divides_the_period(period: float) -> None:
    timestep = build_limb(hang(link_spec()), ["hinge0"], period).opt.timestep
    assert timestep <= 0.002 + 1e-9
    assert period / timestep == pytest.approx(round(period / timestep))


def test_unknown_joint(go1: mujoco.MjSpec) -> None:
    with pytest.raises(UserError, match="tail"):
        split_into_limbs(go1, ("FR_hip_joint", "tail"), [])
