"""PD control in torch: its law, its gains and limits."""

from __future__ import annotations

import pytest
import torch

from mjlab.actuator import (
    IdealPdActuator,
    IdealPdActuatorCfg,
    TransmissionType,
)

JOINTS = ("hip", "knee", "ankle")
POS = torch.tensor([[0.1, -0.2, 0.3], [0.4, 0.5, -0.6], [0.0, 0.0, 0.0]])
VEL = torch.tensor([[1.0, 2.0, -1.0], [0.0, -2.0, 3.0], [0.5, 0.5, 0.5]])
TARGET = torch.tensor([[0.5, -0.5, 1.0], [-1.0, 1.0, 0.2], [9.0, -9.0, 9.0]])


def pd_cfg(**fields) -> IdealPdActuatorCfg:
    values = {"target_names_expr": JOINTS, "stiffness": 20.0, "damping": 2.0, **fields}
    return IdealPdActuatorCfg(**values)


def test_force_is_the_clamped_sum_of_position_velocity_and_effort_terms(make_world):
    world = make_world(pd_cfg(effort_limit=15.0))
    world.set_state(POS, VEL)
    world.entity.set_joint_position_target(TARGET)
    world.entity.set_joint_velocity_target(0.5 * TARGET)
    world.entity.set_joint_effort_target(0.25 * TARGET)
    wanted = 20.0 * (TARGET - POS) + 2.0 * (0.5 * TARGET - VEL) + 0.25 * TARGET
    torch.testing.assert_close(world.force(), wanted.clamp(-15.0, 15.0))


def test_on_a_site_only_the_effort_target_acts(make_world):
    cfg = pd_cfg(
        target_names_expr=("toe",), transmission_type=TransmissionType.SITE, effort_limit=3.0
    )
    world = make_world(cfg)
    world.entity.set_site_effort_target(torch.tensor([[1.0], [-9.0], [2.0]]))
    assert world.force().tolist() == [[1.0], [-3.0], [2.0]]


def test_on_a_tendon_feedback_is_length_and_speed_of_the_tendon(make_world):
    cfg = pd_cfg(target_names_expr=("cord",), transmission_type=TransmissionType.TENDON)
    world = make_world(cfg)
    world.set_state(POS, VEL)
    world.entity.set_tendon_len_target(torch.full((3, 1), 0.3))
    length, speed = POS[:, 0] - 0.5 * POS[:, 1], VEL[:, 0] - 0.5 * VEL[:, 1]
    torch.testing.assert_close(world.force()[:, 0], 20.0 * (0.3 - length) - 2.0 * speed)


def test_gains_of_chosen_environments_change_and_defaults_stay(make_world):
    world = make_world(pd_cfg())
    actuator = world.entity.actuators[0]
    actuator.set_gains(torch.tensor([1]), kp=torch.tensor([5.0]))
    actuator.set_gains(torch.tensor([0, 2]), kd=torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    assert actuator.stiffness.tolist() == [[20.0] * 3, [5.0] * 3, [20.0] * 3]
    assert actuator.damping.tolist() == [[1.0, 2.0, 3.0], [2.0] * 3, [4.0, 5.0, 6.0]]
    assert (actuator.default_stiffness == 20.0).all()
    assert (actuator.default_damping == 2.0).all()
    world.set_state(POS, VEL)
    torch.testing.assert_close(world.force(), -actuator.stiffness * POS - actuator.damping * VEL)


@pytest.mark.parametrize("env_ids", [None, slice(0, 2), torch.tensor([True, False, True])])
def test_environments_can_be_chosen_in_any_form(make_world, env_ids):
    actuator = make_world(pd_cfg()).entity.actuators[0]
    count = 3 if env_ids is None else 2
    actuator.set_gains(env_ids, kp=torch.full((count,), 7.0))
    changed = (actuator.stiffness == 7.0).all(dim=1)
    expected = torch.ones(3, dtype=torch.bool)
    if env_ids is not None:
        expected = torch.zeros(3, dtype=torch.bool)
        expected[env_ids] = True
    assert changed.tolist() == expected.tolist()


def test_gains_of_a_wrong_shape_are_refused_with_both_shapes(make_world):
    actuator = make_world(pd_cfg()).entity.actuators[0]
    with pytest.raises(ValueError, match=r"kp: .*\(3,\) or \(3, 3\).*got \(2,\)"):
        actuator.set_gains(None, kp=torch.ones(2))


@pytest.mark.parametrize("expand", [False, True])
def test_effort_limit_can_be_raised_above_the_configured_one(make_world, expand):
    """The element behind it must not go on clamping at what it was compiled with."""
    world = make_world(pd_cfg(effort_limit=1.0))
    if expand:
        world.sim.expand_model_fields(("actuator_forcerange", "actuator_ctrlrange"))
    actuator = world.entity.actuators[0]
    actuator.set_effort_limit(torch.tensor([0, 2]), torch.tensor([5.0, 0.5]))
    world.entity.set_joint_position_target(torch.full((3, 3), 100.0))
    assert world.force().tolist() == [[5.0] * 3, [1.0] * 3, [0.5] * 3]
    if expand:
        for ranges in (world.sim.model.actuator_forcerange, world.sim.model.actuator_ctrlrange):
            assert ranges[:, 0].tolist() == [[-5.0, 5.0], [-1.0, 1.0], [-0.5, 0.5]]


def test_element_still_tells_the_configured_limit(make_world):
    model = make_world(pd_cfg(effort_limit=4.0)).sim.mj_model
    assert model.actuator_forcerange.tolist() == [[-4.0, 4.0]] * 3
    assert model.actuator_ctrlrange.tolist() == [[-4.0, 4.0]] * 3


def test_assigning_a_parameter_acts_like_changing_it_in_place(make_world):
    world = make_world(pd_cfg(target_names_expr=("hip",)), pd_cfg(target_names_expr=("knee",)))
    world.set_state(POS, torch.zeros(3, 3))
    knee = world.entity.actuators[1]
    assert isinstance(knee, IdealPdActuator)
    knee.stiffness = torch.full((3, 1), 1.0)
    expected = torch.stack((-20.0 * POS[:, 0], -1.0 * POS[:, 1]), dim=1)
    torch.testing.assert_close(world.force(), expected)
