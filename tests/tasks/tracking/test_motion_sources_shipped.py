"""Bundled motions: small, complete and feasible for the robot."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.tasks.tracking.motion_file import check_rate, read_motion
from mjlab.tasks.tracking.motion_sources import SHIPPED, shipped_motions

TOOL = Path(__file__).parents[3] / "tools" / "make_motions.py"
NAMES = ("side_step", "slow_walk", "squat", "turn_in_place", "wave")
GRAVITY = 9.81
# Height of the sole below which a foot is in stance (m).
STANDS = 0.002


@cache
def robot():
    entity = get_g1_robot_cfg().build()
    return entity, entity.compile()


class Played:
    """Soles and center of mass of a motion in every frame."""

    def __init__(self, name: str) -> None:
        self.motion = read_motion(shipped_motions()[name])
        entity, model = robot()
        data = mujoco.MjData(model)
        soles = {
            side: [i for i in range(model.ngeom) if f"{side}_foot" in model.geom(i).name]
            for side in ("left", "right")
        }
        self.com, self.height, self.points = [], {}, []
        heights = {side: [] for side in soles}
        self.self_contacts = 0
        for frame in range(self.motion.num_frames):
            data.qpos[:3] = self.motion.body_pos_w[frame, 0]
            data.qpos[3:7] = self.motion.body_quat_w[frame, 0]
            data.qpos[7:] = self.motion.joint_pos[frame]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            self.self_contacts += data.ncon
            self.com.append(data.subtree_com[0].copy())
            standing = []
            for side, geoms in soles.items():
                ends = np.concatenate([_ends(model, data, geom) for geom in geoms])
                heights[side].append(ends[:, 2].min() - model.geom_size[geoms[0], 0])
                if heights[side][-1] < STANDS:
                    standing.append(ends[:, :2])
            self.points.append(np.concatenate(standing))
        self.com = np.stack(self.com)
        self.height = {side: np.array(values) for side, values in heights.items()}
        self.feet = {
            side: self.motion.body_pos_w[:, entity.body_names.index(f"{side}_ankle_roll_link")]
            for side in soles
        }

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of points (T, 2) outside of the support polygon."""
        hulls = [ConvexHull(area).equations for area in self.points]
        return np.array(
            [(h[:, :2] @ p + h[:, 2]).max() for h, p in zip(hulls, points, strict=True)]
        )

    def center_of_pressure(self) -> np.ndarray:
        """Return the center of pressure, from the motion of the center of mass, (T, 2)."""
        dt = 1.0 / self.motion.fps
        acceleration = np.zeros_like(self.com)
        acceleration[1:-1] = np.diff(self.com, 2, axis=0) / dt**2
        lever = self.com[:, 2:] / (GRAVITY + acceleration[:, 2:])
        return self.com[:, :2] - lever * acceleration[:, :2]


def _ends(model, data, geom) -> np.ndarray:
    axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
    return np.stack((data.geom_xpos[geom] + axis, data.geom_xpos[geom] - axis))


@pytest.fixture(scope="module", params=NAMES)
def played(request):
    return Played(request.param)


def test_there_are_these_and_each_is_small():
    assert tuple(shipped_motions()) == NAMES
    for path in shipped_motions().values():
        assert path.stat().st_size < 300_000
    text = (SHIPPED / "README.md").read_text()
    for name in NAMES:
        assert f"`{name}`" in text
        seconds = read_motion(shipped_motions()[name]).num_frames / 50.0
        assert f"| `{name}` | {seconds:.1f} |" in text


def test_it_is_of_the_robot_and_names_its_joints_and_bodies(played):
    entity, _ = robot()
    motion = played.motion
    check_rate("", motion, 0.02)
    assert (motion.joint_names, motion.body_names) == (entity.joint_names, entity.body_names)
    assert motion.joint_names == entity.joint_names
    assert motion.body_names == entity.body_names
    assert 100 < motion.num_frames < 500


def test_feet_do_not_sink(played):
    for side, height in played.height.items():
        assert height.min() > -5e-4, side


def test_feet_that_stand_do_not_slide(played):
    for side, height in played.height.items():
        both = (height[1:] < STANDS) & (height[:-1] < STANDS)
        assert both.any()
        moved = np.linalg.norm(np.diff(played.feet[side][:, :2], axis=0), axis=1)[both]
        # 0.1 mm from one frame to the next.
        assert moved.max() < 1e-4, side


def test_joints_keep_their_soft_limits(played):
    _, model = robot()
    low, high = model.jnt_range[1:].T
    margin = 0.05 * (high - low)
    assert (played.motion.joint_pos >= low + margin - 1e-3).all()
    assert (played.motion.joint_pos <= high - margin + 1e-3).all()


def test_joints_are_no_faster_than_motors_easily_are(played):
    assert np.abs(played.motion.joint_vel).max() < 5.0


def test_the_robot_does_not_touch_itself(played):
    assert played.self_contacts == 0


def test_the_center_of_mass_stays_above_the_soles(played):
    assert played.outside(played.com[:, :2]).max() < 0.0


def test_the_force_of_the_ground_stays_within_the_soles(played):
    outside = played.outside(played.center_of_pressure())
    # Margin of at least 1 cm for unmodeled effects.
    assert outside.max() < -0.01


def test_velocities_are_those_of_the_positions(played):
    motion, dt = played.motion, 1.0 / played.motion.fps
    for position, velocity in (
        (motion.body_pos_w, motion.body_lin_vel_w),
        (motion.joint_pos, motion.joint_vel),
    ):
        expected = np.gradient(position.astype(np.float64), dt, axis=0)
        error = np.sqrt(np.mean((expected - velocity) ** 2))
        assert error < 0.02 * np.ptp(velocity)


def test_the_robot_is_at_rest_at_both_ends(played):
    for frame in (0, -1):
        assert np.abs(played.motion.joint_vel[frame]).max() < 0.05
        assert np.abs(played.motion.body_lin_vel_w[frame]).max() < 0.05


def test_each_does_what_it_is_called_after():
    def way(name):
        motion = read_motion(shipped_motions()[name])
        turn = motion.body_quat_w[-1, 0]
        yaw = 2.0 * np.degrees(np.arctan2(turn[3], turn[0]))
        return motion.body_pos_w[-1, 0] - motion.body_pos_w[0, 0], yaw, motion

    assert way("slow_walk")[0][0] > 0.4
    assert way("side_step")[0][1] > 0.11
    assert way("turn_in_place")[1] == pytest.approx(60.0, abs=2.0)
    pelvis = way("squat")[2].body_pos_w[:, 0, 2]
    assert pelvis[0] - pelvis.min() == pytest.approx(0.22, abs=0.01)
    motion = way("wave")[2]
    hand = motion.body_pos_w[:, motion.body_names.index("right_wrist_yaw_link")]
    assert hand[:, 2].max() > motion.body_pos_w[0, 0, 2] + 0.35
    # To and fro, three times.
    sideways = np.diff(hand[65:190, 1])
    assert np.count_nonzero(np.diff(np.sign(sideways[np.abs(sideways) > 1e-4]))) >= 5


def test_the_script_makes_the_motion_that_is_there():
    pytest.importorskip("mink")
    spec = importlib.util.spec_from_file_location("make_motions", TOOL)
    assert spec is not None
    assert spec.loader is not None
    tool: Any = importlib.util.module_from_spec(spec)
    sys.modules["make_motions"] = tool
    spec.loader.exec_module(tool)
    description = next(d for d in tool.DESCRIPTIONS if d.name == "wave")
    made, there = tool.make(description), read_motion(shipped_motions()["wave"])
    np.testing.assert_allclose(made.joint_pos, there.joint_pos, atol=1e-3)
    np.testing.assert_allclose(made.body_pos_w, there.body_pos_w, atol=1e-3)
