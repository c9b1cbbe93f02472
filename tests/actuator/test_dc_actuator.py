"""PD control through a motor with a torque-speed curve."""

from __future__ import annotations

import warnings

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.actuator import DcMotorActuatorCfg
from mjlab.actuator.dc_actuator import dc_motor_clip

JOINTS = ("hip", "knee", "ankle")


def dc_cfg(**fields) -> DcMotorActuatorCfg:
    values = {
        "target_names_expr": JOINTS, "stiffness": 20.0, "damping": 2.0, "effort_limit": 8.0,
        "saturation_effort": 10.0, "velocity_limit": 20.0, **fields,
    }  # fmt: skip
    return DcMotorActuatorCfg(**values)


def test_torque_speed_curve_at_its_corners(make_world):
    """S = 10, w = 20, F = 8: full torque up to v = 4, none at 20, braking up to v = 36."""
    world = make_world(dc_cfg(), num_envs=6)
    speeds = torch.tensor([0.0, 4.0, 12.0, 20.0, 30.0, 100.0])
    world.sim.data.qvel[:] = speeds[:, None]
    world.entity.set_joint_position_target(torch.full((6, 3), 1e6))
    world.entity.write_data_to_sim()
    expected = torch.tensor([8.0, 8.0, 4.0, 0.0, -5.0, -8.0])
    torch.testing.assert_close(world.ctrl[:, 0], expected)


FLOATS = st.floats(-200, 200, width=32)
POSITIVE = st.floats(0.125, 100, width=32)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(effort=FLOATS, vel=FLOATS, saturation=POSITIVE, limit=POSITIVE, no_load=POSITIVE)
def test_torque_speed_clip_is_bounded_odd_and_idempotent(effort, vel, saturation, limit, no_load):
    def clip(e: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        return dc_motor_clip(e, *(torch.tensor(x) for x in (saturation, no_load, limit)), v)

    e, v = torch.tensor(effort), torch.tensor(vel)
    once = clip(e, v)
    assert once.abs() <= limit
    torch.testing.assert_close(clip(-e, -v), -once)
    torch.testing.assert_close(clip(once, v), once)
    if abs(vel) < no_load * (1 - limit / saturation):
        # Below the knee only the force limit acts.
        torch.testing.assert_close(once, e.clamp(-limit, limit), rtol=0, atol=1e-5 * saturation)


@pytest.mark.parametrize("limit", [float("inf"), 11.0])
def test_effort_limit_above_the_stall_torque_warns(make_world, limit):
    with pytest.warns(UserWarning, match=r"effort_limit=.*saturation_effort=10.0"):
        make_world(dc_cfg(effort_limit=limit))


def test_effort_limit_below_the_stall_torque_does_not_warn(make_world):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_world(dc_cfg(effort_limit=10.0))


def test_effort_limit_must_be_positive():
    with pytest.raises(ValueError, match="effort_limit: .*> 0, got 0.0"):
        dc_cfg(effort_limit=0.0)


@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.parametrize("field", ["saturation_effort", "velocity_limit"])
def test_curve_below_zero_warns_once(make_world, field, value):
    with pytest.warns(UserWarning, match=f"{field}: expected a number > 0, got {value}") as caught:
        world = make_world(dc_cfg(**{field: value}))
    assert len(caught) == 1
    world.entity.write_data_to_sim()
    if field == "saturation_effort" and value == 0.0:
        assert not world.ctrl.any()


def test_parameters_have_the_names_of_other_releases(make_world):
    actuator = make_world(dc_cfg()).entity.actuators[0]
    names = ("stiffness", "damping", "force_limit", "saturation_effort", "velocity_limit_motor")
    assert actuator.param_names == names
    assert (actuator.velocity_limit_motor == 20.0).all()
