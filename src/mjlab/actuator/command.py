"""What an actuator is told, and where in an entity's data that stands."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import torch

from mjlab.actuator._columns import Columns, read_columns

if TYPE_CHECKING:
    from mjlab.entity import EntityData
    from mjlab.utils.mujoco import CommandField


class TransmissionType(str, Enum):  # noqa: UP042 (part of the interface)
    """What an actuator acts on."""

    JOINT = "joint"
    TENDON = "tendon"
    SITE = "site"


@dataclass
class ActuatorCmd:
    """Commands and feedback of one actuator's targets, (N, number of targets) each."""

    position_target: torch.Tensor
    """Joint position (rad or m) or tendon length (m) to reach."""
    velocity_target: torch.Tensor
    """Velocity to reach (rad/s or m/s)."""
    effort_target: torch.Tensor
    """Force to add (N m or N), or another input, such as a voltage."""
    pos: torch.Tensor
    """Current position. It is never delayed."""
    vel: torch.Tensor
    """Current velocity. It is never delayed."""


# Fields of EntityData: three targets, position, velocity. None reads as zero.
_FIELDS = {
    TransmissionType.JOINT: (
        "joint_pos_target", "joint_vel_target", "joint_effort_target", "joint_pos", "joint_vel",
    ),
    TransmissionType.TENDON: (
        "tendon_len_target", "tendon_vel_target", "tendon_effort_target", "tendon_len",
        "tendon_vel",
    ),
    TransmissionType.SITE: (None, None, "site_effort_target", None, None),
}  # fmt: skip
_POSITIONS = {"position": 0, "velocity": 1, "effort": 2}


def target_field(transmission: TransmissionType, command: CommandField) -> str | None:
    """Return the field of EntityData that holds one kind of target."""
    return _FIELDS[transmission][_POSITIONS[command]]


def read_command(data: EntityData, transmission: TransmissionType, columns: Columns) -> ActuatorCmd:
    """Return the command and feedback in some columns; views of live data if they are a slice."""
    names = _FIELDS[transmission]
    values = [
        None if name is None else read_columns(getattr(data, name), columns) for name in names
    ]
    present = [value for value in values if value is not None]
    zeros = torch.zeros_like(present[0]) if len(present) < len(names) else present[0]
    return ActuatorCmd(*(zeros if value is None else value for value in values))
