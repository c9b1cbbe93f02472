"""Legs of any joint order reach their places, with level soles."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.entity import Entity
from mjlab.utils.leg_kinematics import Leg, LegTable, find_legs

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
LINK = 0.3
"""Length of thigh and shank (m)."""
# Axes of hip, knee and ankle.
ORDERS = ("yxz y yx", "zxy y yx", "zxy y y", "xy y ")


def biped_model(order: str, bend: float = 0.3) -> tuple[mujoco.MjModel, mujoco.MjData, list[int]]:
    """Return a biped whose legs are in line with their hips, its pose with bent knees, and its soles."""
    hip, knee, ankle = order.split(" ")
    spec = mujoco.MjSpec()
    trunk = spec.worldbody.add_body(name="trunk", pos=(0, 0, 1))
    trunk.add_freejoint()
    trunk.add_geom(size=(0.1, 0.1, 0.1), type=mujoco.mjtGeom.mjGEOM_BOX)
    for name, side in (("right", -1), ("left", 1)):
        body, below = trunk, (0.0, 0.1 * side, 0.0)
        for part, axes, length in (("hip", hip, 0), ("knee", knee, LINK), ("ankle", ankle, LINK)):
            for index, axis in enumerate(axes):
                offset = below if part == "hip" and index == 0 else (0, 0, -length * (index == 0))
                body = body.add_body(name=f"{name}_{part}_{axis}", pos=offset)
                body.add_joint(name=f"{name}_{part}_{axis}", axis=AXES[axis])
                body.add_geom(size=(0.02, 0, 0))
        end = (0.05, 0.0, -0.05) if ankle else (0.0, 0.0, -LINK)
        body.add_site(name=f"{name}_sole", pos=end)
    model = spec.compile()
    data = mujoco.MjData(model)
    for name in ("left", "right"):
        for part, axes, angle in (
            ("hip", hip, -bend),
            ("knee", knee, 2.0 * bend),
            ("ankle", ankle, -bend),
        ):
            if "y" in axes:
                data.joint(f"{name}_{part}_y").qpos = angle
    mujoco.mj_kinematics(model, data)
    return model, data, [model.site(f"{name}_sole").id for name in ("left", "right")]


def g1_model() -> tuple[mujoco.MjModel, mujoco.MjData, list[int]]:
    entity = Entity(get_g1_robot_cfg())
    model = entity.spec.compile()
    data = mujoco.MjData(model)
    for name, pose in (("hip_pitch", -0.312), ("knee", 0.669), ("ankle_pitch", -0.363)):
        for side in ("left", "right"):
            data.joint(f"{side}_{name}_joint").qpos = pose
    mujoco.mj_kinematics(model, data)
    return model, data, [model.site(f"{side}_foot").id for side in ("left", "right")]


def legs_of(model: mujoco.MjModel, data: mujoco.MjData, soles: list[int]) -> tuple[Leg, Leg]:
    return find_legs(model, data, int(model.body_rootid[model.site_bodyid[soles[0]]]), soles)


def places(num: int = 300) -> np.ndarray:
    """Return alpha, beta and bend of the workspace of a walk, (P, 3)."""
    rng = np.random.default_rng(0)
    return rng.uniform((-0.5, -0.3, 0.15), (0.5, 0.3, 0.8), (num, 3))


@pytest.mark.parametrize("order", [*ORDERS, "G1"])
def test_table_reaches_within_a_centimeter(order: str) -> None:
    model, data, soles = g1_model() if order == "G1" else biped_model(order)
    where = places()
    for leg in legs_of(model, data, soles):
        positions = LegTable(leg, "cpu")(torch.tensor(where, dtype=torch.float32)).numpy()
        wanted = leg.place(*where.T)
        for row, ankle in zip(positions, wanted, strict=True):
            # In the model, not in the leg's own kinematics.
            data.qpos[model.jnt_qposadr[leg.joints]] = row
            mujoco.mj_kinematics(model, data)
            turn = data.xmat[leg.foot].reshape(3, 3)
            root = data.xpos[int(model.body_rootid[leg.foot])]
            assert np.linalg.norm(data.xpos[leg.foot] + turn @ leg.ankle - root - ankle) < 0.01
            if order.endswith("yx"):
                assert turn[2, 2] > np.cos(0.03)


@pytest.mark.parametrize("order", ORDERS)
def test_equal_links_bend_as_an_isosceles_triangle(order: str) -> None:
    left, right = legs_of(*biped_model(order))
    assert left.length == pytest.approx(2.0 * LINK, abs=1e-3)
    assert left.hip == pytest.approx([0.0, 0.1, 0.0], abs=1e-3)
    alpha, bend = 0.2, 0.4
    found = left.reach(left.place(np.array([alpha]), np.zeros(1), np.array([bend])))[0]
    names = "".join(order.split(" "))
    wanted = np.zeros(len(names))
    wanted[[i for i, axis in enumerate(names) if axis == "y"]] = (
        -alpha - bend, 2.0 * bend, alpha - bend
    )[: names.count("y")]  # fmt: skip
    assert found == pytest.approx(wanted, abs=0.01)
    assert right.sole[1] < 0.0 < left.sole[1]


def test_default_pose_is_its_own_place() -> None:
    for leg in legs_of(*g1_model()):
        pose = leg.reach(leg.place(np.zeros(1), np.zeros(1), np.array([leg.bend])))[0]
        # Hip pitch, knee and ankle pitch; the default pose has its ankle 1.5 degrees behind the hip.
        assert pose[[0, 3, 4]] == pytest.approx([-0.34, 0.67, -0.33], abs=0.02)


def test_joint_that_turns_the_leg_stays() -> None:
    left, _ = legs_of(*biped_model("zxy y yx"))
    assert left.yaw == 0
    assert (left.reach(left.place(*places(20).T))[:, 0] == 0.0).all()
    assert legs_of(*biped_model("xy y "))[0].yaw is None


def test_leg_without_a_knee() -> None:
    model, data, soles = biped_model("yxz  yx")
    with pytest.raises(ValueError, match="knee"):
        legs_of(model, data, soles)


def test_number_of_feet() -> None:
    model, data, soles = biped_model("xy y ")
    with pytest.raises(ValueError, match="two feet"):
        find_legs(model, data, 1, soles[:1])
