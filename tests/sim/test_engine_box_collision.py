"""Box-box collisions of bare MuJoCo and Warp, which use different algorithms.

A cube, a finger and a fingertip as in the lifting task. MuJoCo clips box against box in closed form and
keeps up to 8 points; Warp searches the deepest penetration by iteration (GJK and EPA) and keeps up
to 4. Other contact parameters are equal, and these tests bound the difference.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import pytest

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .01" pos="0 0 -.1"/>
    <geom name="finger" type="box" size=".006 .002 .04" friction=".6 .005 .0001"/>
    <geom name="tip" type="sphere" size=".003" pos="0 0 -.055" condim="6" priority="1"
          friction="1 .005 .0005" solref=".01 1"/>
    <body name="cube">
      <freejoint/>
      <geom name="cube" type="box" size=".02 .02 .02" mass=".05"/>
    </body>
  </worldbody>
</mujoco>
""")
FLOOR, FINGER, TIP, CUBE = (MODEL.geom(name).id for name in ("floor", "finger", "tip", "cube"))
NUM_STATES = 60


class Contact(NamedTuple):
    """One contact."""

    other: int
    """Geom that the cube touches."""
    dist: float
    pos: np.ndarray
    normal: np.ndarray
    parameters: np.ndarray
    """Contact dimension, friction, solref and solimp."""


def contacts_of_mujoco(states: np.ndarray) -> list[list[Contact]]:
    """Return the cube's contacts in each pose."""
    data, result = mujoco.MjData(MODEL), []
    for state in states:
        data.qpos[:] = state
        mujoco.mj_fwdPosition(MODEL, data)
        result.append(
            [
                Contact(
                    c.geom1, c.dist, c.pos.copy(), c.frame[:3].copy(),
                    np.hstack((c.dim, c.friction, c.solref, c.solimp)),
                )
                for c in data.contact
            ]
        )  # fmt: skip
    return result


def contacts_of_warp(states: np.ndarray) -> list[list[Contact]]:
    """Return the cube's contacts in each pose."""
    mjw, wp = pytest.importorskip("mujoco_warp"), pytest.importorskip("warp")
    with wp.ScopedDevice("cpu"):
        model = mjw.put_model(MODEL)
        data = mjw.make_data(MODEL, nworld=len(states), nconmax=16, njmax=128)
        data.qpos.assign(states)
        mjw.kinematics(model, data)
        mjw.collision(model, data)
    count, contact = int(data.nacon.numpy()[0]), data.contact
    fields = {
        name: getattr(contact, name).numpy()[:count]
        for name in (
            "worldid",
            "geom",
            "dist",
            "pos",
            "frame",
            "dim",
            "friction",
            "solref",
            "solimp",
        )
    }
    result: list[list[Contact]] = [[] for _ in states]
    for i in range(count):
        parameters = [fields[name][i] for name in ("dim", "friction", "solref", "solimp")]
        result[fields["worldid"][i]].append(
            Contact(
                int(fields["geom"][i][0]), float(fields["dist"][i]), fields["pos"][i],
                fields["frame"][i].reshape(3, 3)[0], np.hstack(parameters),
            )
        )  # fmt: skip
    return result


def compared(states: np.ndarray, other: int) -> list[tuple[list[Contact], list[Contact]]]:
    """Return MuJoCo's and Warp's contacts of the cube with one geom, in each pose."""
    both = contacts_of_mujoco(states), contacts_of_warp(states)
    return [
        tuple([contact for contact in found if contact.other == other] for found in pair)
        for pair in zip(*both, strict=True)
    ]


def deepest(contacts: list[Contact]) -> Contact:
    return min(contacts, key=lambda contact: contact.dist)


def distance_to_finger(data: mujoco.MjData, state: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the cube's distance from the finger, and the unit vector towards the cube."""
    data.qpos[:] = state
    mujoco.mj_fwdPosition(MODEL, data)
    ends = np.zeros(6)
    gap = mujoco.mj_geomDistance(MODEL, data, FINGER, CUBE, 1.0, ends)
    towards = ends[3:] - ends[:3]
    return gap, towards / (np.linalg.norm(towards) or 1.0)


def pressed_states(depth: float) -> np.ndarray:
    """Return cube poses with arbitrary contact with the finger at penetration `depth` (m)."""
    rng, data, states = np.random.default_rng(0), mujoco.MjData(MODEL), []
    for _ in range(NUM_STATES):
        quat, direction = (rng.normal(size=n) for n in (4, 3))
        quat, direction = quat / np.linalg.norm(quat), direction / np.linalg.norm(direction)
        # Start separated, then approach until contact.
        far = 0.2
        for _ in range(20):
            gap, towards = distance_to_finger(data, np.hstack((far * direction, quat)))
            if gap < 1e-5:
                break
            far -= 0.9 * gap
        states.append(np.hstack((far * direction - (gap + depth) * towards, quat)))
    return np.array(states, dtype=np.float32)


def flat_states(depth: float) -> np.ndarray:
    """Return poses of the cube with a face flat against the finger, shifted and turned along it."""
    rng = np.random.default_rng(0)
    half = 0.5 * rng.uniform(-np.pi, np.pi, NUM_STATES)
    x, z = (rng.uniform(-size, size, NUM_STATES) for size in (0.02, 0.05))
    zero = np.zeros(NUM_STATES)
    place = (x, np.full(NUM_STATES, 0.022 - depth), z)
    return np.stack((*place, np.cos(half), zero, np.sin(half), zero), axis=1).astype(np.float32)


def test_on_the_floor_and_on_a_round_tip_the_contacts_are_the_same():
    rng = np.random.default_rng(0)
    quat = np.array([1.0, 0.0, 0.0, 0.0]) + 0.1 * rng.normal(size=(NUM_STATES, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    for other, place in ((FLOOR, (0.3, 0.0, -0.082)), (TIP, (0.0, 0.022, -0.05))):
        states = np.hstack((np.tile(place, (NUM_STATES, 1)), quat)).astype(np.float32)
        touching = 0
        for mine, theirs in compared(states, other):
            assert len(mine) == len(theirs)
            touching += len(mine)
            for one, two in zip(
                *(sorted(c, key=lambda c: tuple(c.pos)) for c in (mine, theirs)), strict=True
            ):
                assert one.dist == pytest.approx(two.dist, abs=1e-6)
                np.testing.assert_allclose(one.pos, two.pos, atol=1e-6)
                np.testing.assert_allclose(one.normal, two.normal, atol=1e-5)
                np.testing.assert_allclose(one.parameters, two.parameters, rtol=1e-6)
        assert touching > NUM_STATES // 2


@pytest.mark.parametrize("depth", [1e-4, 1e-3, 4e-3])
def test_flat_boxes_meet_at_the_same_points_of_which_warp_keeps_four(depth):
    fewer = 0
    for mine, theirs in compared(flat_states(depth), FINGER):
        assert 0 < len(theirs) <= min(len(mine), 4)
        assert len(mine) <= 8
        fewer += len(theirs) < len(mine)
        assert deepest(mine).dist == pytest.approx(deepest(theirs).dist, abs=1e-6)
        places = np.array([contact.pos for contact in mine])
        for contact in theirs:
            assert np.linalg.norm(places - contact.pos, axis=1).min() < 1e-5
            np.testing.assert_allclose(contact.normal, mine[0].normal, atol=1e-5)
            np.testing.assert_allclose(contact.parameters, mine[0].parameters, rtol=1e-6)
    # Once this fails, the engines agree, and docs/explanation/engines.md should say so.
    assert fewer > 0


@pytest.mark.parametrize("depth", [1e-4, 1e-3])
def test_boxes_have_the_same_depth_and_normal(depth):
    angles, differs = [], 0
    for mine, theirs in compared(pressed_states(depth), FINGER):
        one, two = deepest(mine), deepest(theirs)
        assert one.dist == pytest.approx(two.dist, abs=0.1 * depth)
        np.testing.assert_allclose(one.parameters, two.parameters, rtol=1e-6)
        angles.append(np.degrees(np.arccos(np.clip(one.normal @ two.normal, -1.0, 1.0))))
        differs += len(mine) != len(theirs)
    # If an edge and a face are almost equally deep, the engines may choose differently.
    assert np.median(angles) < 0.1
    assert np.quantile(angles, 0.9) < 5.0
    assert max(angles) < 30.0
    assert differs > 0
