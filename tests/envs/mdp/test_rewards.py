"""Reward and metric terms against their formulas."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab.actuator import IdealPdActuatorCfg
from mjlab.envs.mdp import metrics, rewards
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg


def resolved(world: Any, **kwargs: Any) -> SceneEntityCfg:
    cfg = SceneEntityCfg("robot", **kwargs)
    cfg.resolve(world.scene)
    return cfg


@pytest.fixture
def moving(make_world: Any) -> Any:
    pd = IdealPdActuatorCfg(target_names_expr=("hip", "knee"), stiffness=10.0, damping=1.0)
    world = make_world(actuators=(pd,))
    world.sim.data.qpos[:, 7:] = torch.tensor([[0.1, 0.2, 0.3], [0.95, -3.0, 0.0]] * 2)
    world.sim.data.qvel[:, 6:] = torch.tensor([[1.0, -2.0, 3.0]] * 4)
    world.robot.set_joint_effort_target(torch.tensor([[0.5, -5.0, 0.0]] * 4))
    world.robot.write_data_to_sim()
    world.sim.forward()
    return world


def test_termination_rewards_do_not_count_time_outs() -> None:
    terminated = torch.tensor([True, False, False])
    manager = SimpleNamespace(terminated=terminated, time_outs=torch.tensor([False, True, False]))
    env: Any = SimpleNamespace(termination_manager=manager)
    assert rewards.is_alive(env).tolist() == [0.0, 1.0, 1.0]
    assert rewards.is_terminated(env).tolist() == [1.0, 0.0, 0.0]


def test_sums_of_squares(moving: Any) -> None:
    data = moving.robot.data
    last = resolved(moving, joint_names=("knee", "ankle"))
    torch.testing.assert_close(rewards.joint_vel_l2(moving), torch.full((4,), 14.0))
    torch.testing.assert_close(rewards.joint_vel_l2(moving, last), torch.full((4,), 13.0))
    expected = (data.joint_acc[:, 1:] ** 2).sum(1)
    torch.testing.assert_close(rewards.joint_acc_l2(moving, last), expected)
    force = data.actuator_force
    assert bool((force[:, 1] != 0.0).all())
    for knee in ({"actuator_names": ["knee"]}, {"joint_names": ("knee", "ankle")}):
        chosen = resolved(moving, **knee)
        torch.testing.assert_close(rewards.joint_torques_l2(moving, chosen), force[:, 1] ** 2)


def test_torques_of_joints_without_actuator(moving: Any) -> None:
    ankle = resolved(moving, joint_names=("ankle",))
    with pytest.warns(UserWarning, match=r"joint_names=\['ankle'\]; the term uses no"):
        value = rewards.joint_torques_l2(moving, ankle)
    assert value.tolist() == [0.0] * 4


def test_torques_of_bodies_are_those_of_all(moving: Any) -> None:
    shin = resolved(moving, body_names=("shin",))
    with pytest.warns(UserWarning, match="body_names=.*every actuator"):
        value = rewards.joint_torques_l2(moving, shin)
    torch.testing.assert_close(value, rewards.joint_torques_l2(moving))


def test_limits_count_what_is_beyond_the_soft_ones(moving: Any) -> None:
    # Soft limits are 0.9 of (-1, 1) and of (-2, 0.5); the ankle has none.
    expected = torch.tensor([0.0, 0.05 + (3.0 - 1.875), 0.0, 0.05 + (3.0 - 1.875)])
    torch.testing.assert_close(rewards.joint_pos_limits(moving), expected)


def test_power_counts_driving_and_not_braking(moving: Any) -> None:
    data = moving.robot.data
    expected = (data.qfrc_actuator * data.joint_vel).clamp(min=0.0).sum(1)
    term = rewards.electrical_power_cost(RewardTermCfg(func=None, weight=1.0), moving)
    cost = term(moving, resolved(moving, joint_names=(".*",)))
    torch.testing.assert_close(cost, expected)
    assert bool((cost > 0.0).any())
    assert bool((data.qfrc_actuator * data.joint_vel < 0.0).any())


def test_action_terms_are_differences_of_raw_actions() -> None:
    manager = SimpleNamespace(
        action=torch.tensor([[3.0, 1.0]]),
        prev_action=torch.tensor([[1.0, 1.0]]),
        prev_prev_action=torch.tensor([[0.0, 2.0]]),
    )
    env: Any = SimpleNamespace(action_manager=manager)
    assert rewards.action_rate_l2(env).tolist() == [4.0]
    assert rewards.action_acc_l2(env).tolist() == [2.0]
    assert metrics.mean_action_acc(env).tolist() == [1.0]


# posture


def posture(world: Any, std: dict[str, float], **kwargs: Any) -> torch.Tensor:
    params = {"std": std, "asset_cfg": resolved(world, **kwargs)}
    term = rewards.posture(RewardTermCfg(func=rewards.posture, weight=1.0, params=params), world)
    return term(world, **params)


@pytest.mark.parametrize("preserve_order", [False, True])
def test_posture_pairs_each_joint_with_its_own_deviation(moving: Any, preserve_order: bool) -> None:
    std = {"hip": 0.5, "knee": 2.0}
    value = posture(moving, std, joint_names=("knee", "hip"), preserve_order=preserve_order)
    expected = math.exp(-0.5 * ((0.1 / 0.5) ** 2 + (0.2 / 2.0) ** 2))
    assert value[0].item() == pytest.approx(expected)


def test_posture_wants_every_joint_covered(moving: Any) -> None:
    with pytest.raises(ValueError, match=r"std: .*\['ankle'\]"):
        posture(moving, {"hip": 0.5, "knee": 2.0}, joint_names=(".*",))
    with pytest.raises(ValueError, match="elbow"):
        posture(moving, {".*": 0.5, "elbow": 1.0}, joint_names=(".*",))
    with pytest.raises(ValueError, match="std: "):
        posture(moving, {".*": 0.5}, joint_names=())


# Orientation


def test_tilt_of_the_root(make_world: Any) -> None:
    world = make_world()
    angle = torch.tensor([0.0, 0.5, 1.0, 3.1])
    world.sim.data.qpos[:, 3] = torch.cos(angle / 2)
    world.sim.data.qpos[:, 4] = torch.sin(angle / 2)
    world.sim.forward()
    torch.testing.assert_close(
        rewards.flat_orientation_l2(world), torch.sin(angle) ** 2, atol=1e-5, rtol=1e-4
    )


# Collisions


def touched(**data: Any) -> Any:
    sensor = SimpleNamespace(data=SimpleNamespace(**{"force_history": None, **data}))
    return SimpleNamespace(scene={"touch": sensor})


def test_collisions_count_substeps_with_a_strong_contact() -> None:
    force = torch.zeros(2, 2, 4, 3)
    force[0, 0, 1] = torch.tensor([6.0, 0.0, 8.1])
    # The same substep in another slot counts once, and 10 N is not above 10 N.
    force[0, 1, 1] = torch.tensor([0.0, 30.0, 0.0])
    force[0, 1, 3] = torch.tensor([-20.0, 0.0, 0.0])
    force[1, 0, 0] = torch.tensor([10.0, 0.0, 0.0])
    env = touched(force_history=force)
    assert rewards.self_collision_cost(env, "touch").tolist() == [2.0, 0.0]
    assert rewards.self_collision_cost(env, "touch", force_threshold=25.0).tolist() == [1.0, 0.0]


def test_without_a_history_collisions_count_contacts() -> None:
    env = touched(found=torch.tensor([[2.0, 1.0], [0.0, 0.0]]))
    assert rewards.self_collision_cost(env, "touch").tolist() == [3.0, 0.0]


def touching(slots: int, **data: Any) -> Any:
    values = {"force_history": None, "force": None, "found": None, **data}
    cfg = SimpleNamespace(num_slots=slots)
    return SimpleNamespace(
        scene={"touch": SimpleNamespace(data=SimpleNamespace(**values), cfg=cfg)}
    )


def test_undesired_contacts_count_primaries() -> None:
    # Two primaries of two slots.
    found = torch.tensor([[1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    assert rewards.undesired_contacts(touching(2, found=found), "touch").tolist() == [1, 2, 0]
    force = found[..., None] * torch.tensor([3.0, 0.0, 4.0])
    env = touching(2, found=found, force=force)
    assert rewards.undesired_contacts(env, "touch").tolist() == [1, 2, 0]
    assert rewards.undesired_contacts(env, "touch", force_threshold=5.0).tolist() == [0, 0, 0]
    # Contact in any substep counts.
    history = torch.zeros(3, 4, 3, 3)
    history[1, 3, 2, 0] = 20.0
    env = touching(2, found=found, force=force, force_history=history)
    assert rewards.undesired_contacts(env, "touch").tolist() == [0, 1, 0]


# Deviations


def test_absolute_sums_and_deviations(moving: Any) -> None:
    data = moving.robot.data
    torch.testing.assert_close(rewards.joint_vel_l1(moving), torch.full((4,), 6.0))
    chosen = resolved(moving, joint_names=("hip", "ankle"))
    expected = (data.joint_pos - data.default_joint_pos)[:, [0, 2]].abs().sum(dim=1)
    torch.testing.assert_close(rewards.joint_deviation_l1(moving, chosen), expected)
    data.default_joint_pos[:] = data.joint_pos
    assert rewards.joint_deviation_l1(moving).tolist() == [0.0] * 4


def test_velocities_of_the_base_by_axis(moving: Any) -> None:
    moving.sim.data.qvel[:, :6] = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    moving.sim.forward()
    data = moving.robot.data
    torch.testing.assert_close(rewards.lin_vel_z_l2(moving), data.root_link_lin_vel_b[:, 2] ** 2)
    torch.testing.assert_close(rewards.ang_vel_xy_l2(moving), torch.full((4,), 0.41))


def test_the_height_of_the_base_above_the_ground(moving: Any) -> None:
    moving.sim.data.qpos[:, 2] = torch.tensor([0.4, 0.5, 0.6, 0.7])
    moving.sim.forward()
    expected = torch.tensor([0.01, 0.0, 0.01, 0.04])
    torch.testing.assert_close(rewards.base_height_l2(moving, 0.5), expected)
    # Rays: a step of 0.1 m, a half of it with one miss, a hole, and a hill of which one ray misses.
    hits = torch.zeros(4, 2, 3)
    hits[..., 2] = torch.tensor([[0.1, 0.1], [0.1, 0.0], [9.0, 9.0], [0.2, 9.0]])
    distances = torch.tensor([[0.3, 0.3], [0.4, 0.5], [-1.0, -1.0], [0.5, -1.0]])
    moving.scene["rays"] = SimpleNamespace(
        data=SimpleNamespace(hit_pos_w=hits, distances=distances)
    )
    above = torch.tensor([0.3, 0.45, 0.6, 0.5])
    torch.testing.assert_close(
        rewards.base_height_l2(moving, 0.5, sensor_name="rays"), (above - 0.5) ** 2
    )


def test_size_of_the_action() -> None:
    env: Any = SimpleNamespace(
        action_manager=SimpleNamespace(action=torch.tensor([[3.0, -4.0], [0.0, 1.0]]))
    )
    assert rewards.action_l2(env).tolist() == [25.0, 1.0]
