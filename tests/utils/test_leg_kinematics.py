"""Legs of any joint order reach their places, with level soles."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.entity import Entity
from mjlab.utils.leg_kinematics import Leg, LegTable, find_legs, turning_joint

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
LINK = 0.3
"""Length of thigh and shank (m)."""
# Axes of hip, knee and ankle.
ORDERS = ("yxz y yx", "zxy y yx", "zxy y y", "xy y ")


def biped_model(
    order: str,
    bend: float = 0.3,
    knee_range: tuple[float, float] | None = None,
    hip_roll: float = 0.0,
) -> tuple[mujoco.MjModel, mujoco.MjData, list[int]]:
    """Return a biped whose legs are in line with their hips, its pose, and its soles.

    Args:
        order: Axes of hip, knee and ankle.
        bend: Half of the knee's angle (rad).
        knee_range: Range of the knees (rad).
        hip_roll: Angle of both legs outward (rad).
    """
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
                joint = body.add_joint(name=f"{name}_{part}_{axis}", axis=AXES[axis])
                if part == "knee" and knee_range is not None:
                    joint.limited, joint.range = True, np.rad2deg(knee_range)
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
        if hip_roll:
            data.joint(f"{name}_hip_x").qpos = hip_roll if name == "left" else -hip_roll
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


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("low", "high", "side"), [(-0.2, 2.2, 1), (0.0, 2.2, 1), (-2.2, 0.2, -1)])
def test_straight_default_leg_bends_as_its_knee_can(order, low, high, side) -> None:
    """No node bends the knee to the other side, and all are in the knee's range."""
    model, data, soles = biped_model(order, 0.0, (low, high))
    for leg in legs_of(model, data, soles):
        where = places()
        knee = LegTable(leg, "cpu")(torch.tensor(where, dtype=torch.float32))[:, leg.knee].numpy()
        assert leg.bend == pytest.approx(0.0, abs=0.01)
        assert (side * knee >= 0.0).all()
        assert (np.abs(knee) <= max(-low, high)).all()
        # An isosceles triangle.
        assert np.cos(0.5 * knee) == pytest.approx(np.cos(where[:, 2]), abs=0.02)


def test_knee_stops_at_its_range() -> None:
    left, _ = legs_of(*biped_model("zxy y yx", 0.3, (0.2, 1.0)))
    assert left.largest_bend == pytest.approx(np.arccos(np.cos(0.5) / np.cos(0.1)), abs=0.01)
    knee = left.reach(left.place(*places().T))[:, left.knee]
    assert 0.2 <= knee.min() < knee.max() <= 1.0


def test_crouched_leg_lifts_its_foot() -> None:
    """A table ends `lift` beyond the default bend, or close to the end of the knee's range."""
    where = torch.tensor([[0.0, 0.0, 1.2], [0.0, 0.0, 1.5]])
    free, _ = legs_of(*biped_model("zxy y yx", 0.9))
    assert LegTable(free, "cpu", 0.4)(where)[:, free.knee].tolist() == pytest.approx(
        [2.4, 2.6], abs=0.02
    )
    held, _ = legs_of(*biped_model("zxy y yx", 0.9, (0.0, 2.2)))
    assert 2.0 < LegTable(held, "cpu", 0.4)(where)[:, held.knee].max() < 2.2


@pytest.mark.parametrize("outward", [-0.1, 0.0, 0.15])
def test_lateral_angle_of_the_default_pose(outward: float) -> None:
    left, right = legs_of(*biped_model("zxy y y", hip_roll=outward))
    assert (left.beta, right.beta) == pytest.approx((outward, -outward), abs=1e-3)


def test_leg_that_cannot_move_sideways() -> None:
    left, _ = legs_of(*biped_model("y y y"))
    with pytest.raises(ValueError, match=r"left_sole.*cm at alpha, beta and bend"):
        LegTable(left, "cpu")


@pytest.mark.parametrize(
    ("axes", "wanted"),
    [
        ([(1, 0, 0), (0, 1, 0)], None),
        ([(0.8, 0, -0.6), (0, 1, 0)], None),
        ([(0, 1, 0), (0.3, 0, -0.95), (1, 0, 0)], 1),
        (np.zeros((0, 3)), None),
    ],
)
def test_joint_closest_to_the_vertical(axes, wanted) -> None:
    assert turning_joint(np.array(axes, dtype=float)) == wanted


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
