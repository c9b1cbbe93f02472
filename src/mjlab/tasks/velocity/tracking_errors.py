"""What evaluations of the velocity task measure: how far the robot is from its command."""

from __future__ import annotations

from typing import Any

import torch

_ROBOT = "robot"
_COMMAND = "twist"


def lin_vel_error(env: Any) -> torch.Tensor:
    """Return |c_xy - v_xy|, (num_envs,), in m/s: linear velocity of the root link, in its frame."""
    return (_command(env)[:, :2] - _robot(env).root_link_lin_vel_b[:, :2]).norm(dim=-1)


def ang_vel_error(env: Any) -> torch.Tensor:
    """Return |c_z - w_z|, (num_envs,), in rad/s: turning rate of the root link, in its frame."""
    return (_command(env)[:, 2] - _robot(env).root_link_ang_vel_b[:, 2]).abs()


def _command(env: Any) -> torch.Tensor:
    return env.command_manager.get_command(_COMMAND)


def _robot(env: Any) -> Any:
    return env.scene[_ROBOT].data


TRACKING_ERRORS = {"lin_vel_error": lin_vel_error, "ang_vel_error": ang_vel_error}
"""The errors by the name under which evaluations report them."""
