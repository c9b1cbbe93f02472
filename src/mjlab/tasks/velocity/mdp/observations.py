"""Observation terms of the velocity task, about feet. They are for critics: robots do not know it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import accepts_older_params, older_names
from mjlab.managers.build_checks import checked_when_built
from mjlab.tasks.velocity.mdp.sensor_checks import (
    check_air_time_sensor,
    check_force_sensor,
    check_found_sensor,
    check_height_sensor,
)

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@accepts_older_params
@checked_when_built(check_height_sensor)
def foot_height(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Height of each foot above the ground (m), (N, feet), from a height sensor."""
    return env.scene[sensor_name].data.heights


@checked_when_built(check_air_time_sensor)
def foot_air_time(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Time that each foot has been in the air (s), (N, feet); 0 on the ground."""
    return env.scene[sensor_name].data.current_air_time


@checked_when_built(check_found_sensor)
def foot_contact(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """1 for each foot that touches the ground, else 0, (N, feet)."""
    return (env.scene[sensor_name].data.found > 0).float()


@checked_when_built(check_force_sensor)
def foot_contact_forces(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Contact forces as `sign(f) ln(1 + |f|)`, (N, 3 feet): x, y, z of the first foot, and so on.

    The logarithm brings standing (some 30 N a foot) and landing (some 1000 N) to one scale.
    """
    force = env.scene[sensor_name].data.force.flatten(start_dim=1)
    return torch.copysign(torch.log1p(force.abs()), force)


__getattr__ = older_names(__name__)
