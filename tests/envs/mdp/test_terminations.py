"""Termination terms: tilt, height, time and values that are not finite."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab.envs.mdp import terminations
from mjlab.managers.scene_entity_config import SceneEntityCfg


def test_tilt_and_height_of_the_root(make_world: Any) -> None:
    world = make_world()
    angle = torch.tensor([0.0, 0.5, 1.0, 3.1])
    world.sim.data.qpos[:, 3] = torch.cos(angle / 2)
    world.sim.data.qpos[:, 4] = torch.sin(angle / 2)
    world.sim.data.qpos[:, 2] = torch.tensor([0.1, 0.2, 0.3, 0.4])
    world.sim.forward()
    fallen = terminations.bad_orientation(world, limit_angle=0.7)
    assert fallen.tolist() == [False, False, True, True]
    low = terminations.root_height_below_minimum(world, minimum_height=0.25)
    assert low.tolist() == [True, True, False, False]


def test_a_tilt_beyond_what_acos_takes_is_no_nan() -> None:
    """Due to rounding, the cosine of an upright or overturned root slightly exceeds 1."""
    down = torch.tensor([[0.0, 0.0, -1.0000002], [0.0, 0.0, 1.0000002], [0.0, 0.6, -0.8]])
    assert torch.acos(-down[:2, 2]).isnan().all()
    data = SimpleNamespace(projected_gravity_b=down.clone())
    env: Any = SimpleNamespace(scene={"robot": SimpleNamespace(data=data)})
    overturned = terminations.bad_orientation(env, limit_angle=3.0)
    assert overturned.tolist() == [False, True, False]
    assert terminations.bad_orientation(env, limit_angle=0.5).tolist() == [False, True, True]
    # The observation is not clamped on the way.
    assert torch.equal(data.projected_gravity_b, down)


def test_joints_beyond_their_soft_limits(make_world: Any) -> None:
    world = make_world()
    # Soft limits: hip +-0.9, knee -1.875 to 0.375; the ankle has none.
    world.sim.data.qpos[:, 7:] = torch.tensor(
        [[0.8, 0.3, 9.0], [0.95, 0.0, 0.0], [0.0, -1.9, 0.0], [-0.8, -1.8, -9.0]]
    )
    beyond = terminations.joint_pos_out_of_limit(world)
    assert beyond.tolist() == [False, True, True, False]
    hip = SceneEntityCfg("robot", joint_names=("hip",))
    hip.resolve(world.scene)
    assert terminations.joint_pos_out_of_limit(world, hip).tolist() == [False, True, False, False]


def test_time_out_is_reached_at_the_maximum_length(make_world: Any) -> None:
    world = make_world()
    world.episode_length_buf[:] = torch.tensor([0, 9, 10, 11])
    assert terminations.time_out(world).tolist() == [False, False, True, True]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nan_detection_sees_positions_and_velocities(make_world: Any, bad: float) -> None:
    world = make_world()
    assert not terminations.nan_detection(world).any()
    world.sim.data.qpos[1, 8] = bad
    world.sim.data.qvel[2, 0] = bad
    assert terminations.nan_detection(world).tolist() == [False, True, True, False]
