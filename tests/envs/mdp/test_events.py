"""Resets, pushes and forces."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjlab.entity import EntityCfg
from mjlab.envs.mdp import events
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.utils.lab_api.math import quat_apply, quat_from_euler_xyz, quat_mul

ROBOT = SceneEntityCfg("robot")
INITIAL = EntityCfg.InitialStateCfg(
    pos=(1.0, 2.0, 3.0),
    rot=(0.8, 0.0, 0.6, 0.0),
    lin_vel=(0.1, 0.2, 0.3),
    ang_vel=(0.4, 0.5, 0.6),
    joint_pos={"hip": 0.3, "knee": -0.5},
    joint_vel={"hip": 1.0},
)
LAWS = settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def world(make_world: Any) -> Any:
    world = make_world(init_state=INITIAL)
    world.scene.env_origins[:] = torch.arange(12.0).reshape(4, 3)
    return world


def root_velocity(world: Any, ids: Any = slice(None)) -> torch.Tensor:
    """World velocity of the root from qvel: linear, angular."""
    qpos, qvel = world.sim.data.qpos[ids], world.sim.data.qvel[ids]
    return torch.cat((qvel[:, :3], quat_apply(qpos[:, 3:7], qvel[:, 3:6])), dim=1)


def test_resolve_env_ids_takes_all_forms(world: Any) -> None:
    assert events.resolve_env_ids(world, None).tolist() == [0, 1, 2, 3]
    assert events.resolve_env_ids(world, slice(1, 3)).tolist() == [1, 2]
    mask = torch.tensor([True, False, False, True])
    assert events.resolve_env_ids(world, mask).tolist() == [0, 3]
    assert events.resolve_env_ids(world, torch.tensor([2])).tolist() == [2]


# Joints


def test_joint_offsets_start_from_the_defaults(world: Any) -> None:
    before = world.sim.data.qpos.clone()
    events.reset_joints_by_offset(world, torch.tensor([0, 2]), (0.1, 0.1), (0.2, 0.2), ROBOT)
    data = world.robot.data
    expected = data.default_joint_pos[0] + 0.1
    torch.testing.assert_close(data.joint_pos[[0, 2]], expected.expand(2, 3))
    torch.testing.assert_close(data.joint_vel[[0, 2]], torch.tensor([[1.2, 0.2, 0.2]] * 2))
    assert torch.equal(world.sim.data.qpos[[1, 3]], before[[1, 3]])
    assert torch.equal(world.sim.data.qpos[:, :7], before[:, :7])


@LAWS
@given(low=st.floats(-5.0, 5.0), width=st.floats(0.0, 5.0), speed=st.floats(0.0, 50.0))
def test_joint_positions_are_clamped_to_soft_limits_and_velocities_are_not(
    world: Any, low: float, width: float, speed: float
) -> None:
    events.reset_joints_by_offset(world, None, (low, low + width), (speed, speed), ROBOT)
    data = world.robot.data
    limits = data.soft_joint_pos_limits
    assert bool((data.joint_pos >= limits[..., 0]).all())
    assert bool((data.joint_pos <= limits[..., 1]).all())
    # The ankle has no limits, so it is never clamped.
    assert torch.isinf(limits[:, 2]).all()
    offset = data.joint_pos[:, 2]
    assert bool(((offset >= low - 1e-5) & (offset <= low + width + 1e-5)).all())
    torch.testing.assert_close(data.joint_vel - data.default_joint_vel, torch.full((4, 3), speed))


def test_joints_are_scaled_within_their_soft_limits(world: Any) -> None:
    data = world.robot.data
    before = data.joint_pos.clone()
    ids = torch.tensor([0, 2])
    events.reset_joints_by_scale(world, ids, (0.5, 0.5), (2.0, 2.0), ROBOT)
    torch.testing.assert_close(data.joint_pos[ids], 0.5 * data.default_joint_pos[ids])
    torch.testing.assert_close(data.joint_vel[ids], 2.0 * data.default_joint_vel[ids])
    assert torch.equal(data.joint_pos[[1, 3]], before[[1, 3]])
    events.reset_joints_by_scale(world, None, (50.0, 100.0), (0.0, 1.0), ROBOT)
    limits = data.soft_joint_pos_limits
    assert (data.joint_pos >= limits[..., 0]).all()
    assert (data.joint_pos <= limits[..., 1]).all()
    # A default of 0 is a factor of nothing.
    assert torch.equal(data.joint_pos[:, 2], torch.zeros(4))


def test_only_the_selected_joints_move(world: Any) -> None:
    chosen = SceneEntityCfg("robot", joint_names=("ankle", "hip"))
    chosen.resolve(world.scene)
    before = world.robot.data.joint_pos.clone()
    events.reset_joints_by_offset(world, None, (-0.2, 0.2), (0.0, 0.0), chosen)
    after = world.robot.data.joint_pos
    assert torch.equal(after[:, 1], before[:, 1])
    assert bool((after[:, [0, 2]] != before[:, [0, 2]]).all())
    assert len(after[:, [0, 2]].unique()) == 8


# Root


def test_the_default_state_includes_the_origin(world: Any) -> None:
    world.sim.data.qpos[:] = 0.5
    events.reset_scene_to_default(world, torch.tensor([1, 2]))
    qpos = world.sim.data.qpos
    torch.testing.assert_close(qpos[1:3, :3], torch.tensor([[4.0, 6.0, 8.0], [7.0, 9.0, 11.0]]))
    torch.testing.assert_close(qpos[1:3, 3:7], torch.tensor([[0.8, 0.0, 0.6, 0.0]] * 2))
    torch.testing.assert_close(qpos[1:3, 7:], torch.tensor([[0.3, -0.5, 0.0]] * 2))
    assert bool((qpos[[0, 3]] == 0.5).all())
    expected = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]).expand(2, 6)
    torch.testing.assert_close(root_velocity(world, slice(1, 3)), expected)


def test_ranges_may_change_between_resets(world: Any) -> None:
    ids = torch.tensor([1])
    ranges: dict[str, tuple[float, float]] = {}
    events.reset_root_state_uniform(world, ids, ranges)
    start = world.sim.data.qpos[1, :3].clone()
    for x in (0.25, 0.5):
        ranges["x"] = (x, x)
        events.reset_root_state_uniform(world, ids, ranges)
        moved = world.sim.data.qpos[1, :3] - start
        torch.testing.assert_close(moved, torch.tensor([x, 0.0, 0.0]))


def test_uniform_root_state_turns_about_the_bodys_axes(world: Any) -> None:
    pose: Any = {"x": (0.5, 0.5), "roll": (0.3, 0.3), "yaw": [0.7, 0.7]}
    velocity = {"z": (1.0, 1.0), "yaw": (2.0, 2.0)}
    events.reset_root_state_uniform(world, torch.tensor([3]), pose, velocity, ROBOT)
    qpos = world.sim.data.qpos[3]
    torch.testing.assert_close(qpos[:3], torch.tensor([9.0 + 1.5, 10.0 + 2.0, 11.0 + 3.0]))
    delta = quat_from_euler_xyz(*torch.tensor([0.3, 0.0, 0.7]).unbind())
    expected = quat_mul(torch.tensor([[0.8, 0.0, 0.6, 0.0]]), delta[None])[0]
    torch.testing.assert_close(qpos[3:7], expected)
    expected = torch.tensor([[0.1, 0.2, 1.3, 0.4, 0.5, 2.6]])
    torch.testing.assert_close(root_velocity(world, torch.tensor([3])), expected)
    assert bool((world.sim.data.qvel[:3] == 0.0).all())


@pytest.mark.parametrize(
    "func", [events.reset_root_state_uniform, events.reset_root_state_from_flat_patches]
)
def test_unknown_range_keys_warn(world: Any, func: Any) -> None:
    params = {"pose_range": {"rol": (0.0, 1.0), "x": (2.0, 2.0)}}
    manager = world.events(place=EventTermCfg(func=func, mode="startup", params=params))
    with pytest.warns(UserWarning, match="pose_range.*'roll'.*'rol'"):
        manager.apply("startup")
    assert bool((world.sim.data.qpos[:, 0] - world.scene.env_origins[:, 0] == 3.0).all())


def test_all_six_numbers_are_drawn_whatever_is_given(world: Any) -> None:
    results = []
    for pose in ({"yaw": (0.0, 1.0)}, {"x": (5.0, 5.0), "yaw": (0.0, 1.0)}):
        torch.manual_seed(3)
        events.reset_root_state_uniform(world, None, pose)
        results.append(world.sim.data.qpos[:, 3:7].clone())
    assert torch.equal(*results)


def test_a_mocap_base_takes_the_pose(make_cart: Any) -> None:
    world = make_cart(init_state=EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 1.0)))
    world.scene.env_origins[1] = torch.tensor([5.0, 0.0, 0.0])
    events.reset_root_state_uniform(world, torch.tensor([1]), {"y": (2.0, 2.0)}, {"x": (1, 1)})
    assert world.sim.data.mocap_pos[1, 0].tolist() == [5.0, 2.0, 1.0]
    assert world.sim.data.mocap_pos[0, 0].tolist() == [0.0, 0.0, 1.0]
    events.reset_scene_to_default(world, None)
    assert world.sim.data.mocap_pos[1, 0].tolist() == [5.0, 0.0, 1.0]


def test_a_fixed_base_without_mocap_is_refused(world: Any, monkeypatch: Any) -> None:
    entity = type(world.robot)
    monkeypatch.setattr(entity, "is_fixed_base", property(lambda self: True))
    with pytest.raises(ValueError, match="mocap base, got 'robot' with a fixed base"):
        events.reset_root_state_uniform(world, None, {})
    with pytest.raises(ValueError, match="'robot' with a fixed base"):
        events.push_by_setting_velocity(world, None, {})
    before = world.sim.data.qpos[:, :7].clone()
    events.reset_scene_to_default(world, None)
    assert torch.equal(world.sim.data.qpos[:, :7], before)


def test_flat_patches_set_the_position(world: Any) -> None:
    patches = torch.zeros(2, 1, 3, 3)
    patches[1, 0] = torch.tensor([[10.0, 0.0, 0.5], [20.0, 0.0, 0.5], [30.0, 0.0, 0.5]])
    world.scene.terrain = SimpleNamespace(
        flat_patches={"spawn": patches},
        terrain_levels=torch.tensor([1, 0, 1, 1]),
        terrain_types=torch.zeros(4, dtype=torch.long),
    )
    pose = {"y": (1.0, 1.0), "z": (0.1, 0.1)}
    events.reset_root_state_from_flat_patches(world, None, "spawn", pose)
    position = world.sim.data.qpos[:, :3]
    # Neither the default x and y nor the environment's origin count; the default height does.
    torch.testing.assert_close(position[1], torch.tensor([0.0, 1.0, 3.1]))
    for env in (0, 2, 3):
        assert position[env, 0].item() in (10.0, 20.0, 30.0)
        torch.testing.assert_close(position[env, 1:], torch.tensor([1.0, 3.6]))


@pytest.mark.parametrize("has_terrain", [False, True])
def test_without_patches_of_that_name_it_is_the_uniform_reset(
    world: Any, has_terrain: bool
) -> None:
    world.scene.terrain = (
        SimpleNamespace(flat_patches={}, terrain_levels=None, terrain_types=None)
        if has_terrain
        else None
    )
    pose, velocity = {"x": (-1.0, 1.0), "yaw": (-3.0, 3.0)}, {"y": (-1.0, 1.0)}
    results = []
    for term in (events.reset_root_state_from_flat_patches, events.reset_root_state_uniform):
        torch.manual_seed(5)
        term(world, None, pose_range=pose, velocity_range=velocity)
        results.append(torch.cat((world.sim.data.qpos[:, :7], world.sim.data.qvel[:, :6]), 1))
    assert torch.equal(*results)


def test_randomize_terrain_passes_the_ids_on(world: Any) -> None:
    events.randomize_terrain(world, None)
    asked: list[Any] = []
    world.scene.terrain = SimpleNamespace(randomize_env_origins=asked.append)
    events.randomize_terrain(world, torch.tensor([1]))
    events.randomize_terrain(world, None)
    assert [ids.tolist() for ids in asked] == [[1], [0, 1, 2, 3]]


# Pushes and forces


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_a_push_adds_to_the_velocity_and_undoes_nothing(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine, init_state=INITIAL)
    events.reset_root_state_uniform(world, None, {"yaw": (-3.0, 3.0)}, {"roll": (1.0, 2.0)})
    # Derived velocities are one substep old: they do not know what gravity did to qvel since.
    assert world.robot.data.root_link_vel_w.shape == (4, 6)
    world.sim.data.qvel[:, 2] -= 0.05
    before = root_velocity(world)
    others = world.sim.data.qvel[:, 6:].clone()
    push = {"x": (0.5, 0.5), "roll": (0.25, 0.25)}
    events.push_by_setting_velocity(world, torch.tensor([0, 3]), push)
    change = root_velocity(world) - before
    expected = torch.zeros(4, 6)
    expected[[0, 3]] = torch.tensor([0.5, 0.0, 0.0, 0.25, 0.0, 0.0])
    torch.testing.assert_close(change, expected, atol=1e-5, rtol=0)
    assert torch.equal(world.sim.data.qvel[:, 6:], others)


def test_external_wrenches_act_on_the_selected_bodies(world: Any) -> None:
    chosen = SceneEntityCfg("robot", body_names=("shin", "torso"))
    chosen.resolve(world.scene)
    events.apply_external_force_torque(world, torch.tensor([2]), (1.0, 2.0), (3.0, 4.0), chosen)
    wrench = world.sim.data.xfrc_applied
    assert bool(((wrench[2, [1, 3], :3] >= 1.0) & (wrench[2, [1, 3], :3] <= 2.0)).all())
    assert bool(((wrench[2, [1, 3], 3:] >= 3.0) & (wrench[2, [1, 3], 3:] <= 4.0)).all())
    assert len(wrench[2, [1, 3]].unique()) == 12
    wrench[2, [1, 3]] = 0.0
    assert bool((wrench == 0.0).all())
