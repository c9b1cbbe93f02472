"""Gait metrics against their definitions."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.tasks.velocity.gait_metrics import GAIT_METRICS

FEET = ("FR", "FL", "RR", "RL")


def test_gait_metrics_agree_with_what_they_are_made_of(make_env):
    env = make_env()
    env.reset()
    torch.manual_seed(0)
    for _ in range(30):
        env.step(0.1 * torch.randn_like(env.action_manager.action))
    robot = env.scene["robot"]
    values = {name: func(env) for name, func in GAIT_METRICS.items()}
    assert all(value.shape == (4,) and value.isfinite().all() for value in values.values())
    torque = robot.data.qfrc_actuator
    torch.testing.assert_close(values["joint_torque"], torque.abs().mean(dim=1))
    power = (torque * robot.data.joint_vel).abs().sum(dim=1)
    torch.testing.assert_close(values["mechanical_power"], power)
    # Of the Go1, all gears are 1, and forces are clipped to the limits.
    limits = torch.tensor(env.sim.mj_model.actuator_forcerange[:, 1], dtype=torch.float32)
    share = (robot.data.actuator_force.abs() / limits).amax(dim=1)
    torch.testing.assert_close(values["torque_share"], share)
    assert 0.0 < values["torque_share"].max() <= 1.0 + 1e-6
    in_contact = env.scene["feet_ground_contact"].data.found > 0
    assert in_contact.any()
    ids = [robot.site_names.index(name) for name in FEET]
    speed = robot.data.site_lin_vel_w[:, ids, :2].norm(dim=-1)
    slowest = torch.where(in_contact, speed, torch.inf).amin(dim=1)
    fastest = torch.where(in_contact, speed, 0.0).amax(dim=1)
    touches = in_contact.any(dim=1)
    slip = values["foot_slip"]
    assert (slip >= torch.where(touches, slowest, 0.0) - 1e-6).all()
    assert (slip <= fastest + 1e-6).all()
    soles = env.scene["foot_height_scan"].data.heights
    assert (values["foot_clearance"][:, None] >= soles).all()
    vertical = robot.data.root_link_vel_w[:, 2].abs()
    torch.testing.assert_close(values["trunk_bobbing"], vertical)


def test_the_action_rate_does_not_depend_on_the_scale_of_actions(make_env):
    rates = []
    for scale in (0.25, 0.5):

        def edit(cfg: Any, scale: float = scale) -> None:
            cfg.actions["joint_pos"].scale = scale

        env = make_env(edit=edit)
        env.reset()
        for target in (0.1, -0.2):
            env.step(torch.full_like(env.action_manager.action, target / scale))
        rates.append(GAIT_METRICS["action_rate"](env).tolist())
    assert rates[0] == pytest.approx(rates[1])
    assert rates[0] == pytest.approx([0.3] * 4)
