"""Actuators whose control law MuJoCo evaluates: the control is a command, passed through."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import torch

from mjlab.actuator.actuator import Actuator, ActuatorCfgT, ActuatorCmd
from mjlab.utils.spec import apply_target_overrides
from mjlab.utils.substep import constant_within_step

if TYPE_CHECKING:
    import mujoco

    from mjlab.utils.mujoco import CommandField


class DirectActuator(Actuator[ActuatorCfgT]):
    """An actuator whose controls are the commands in `command_fields`, one block of columns each.

    Many of them are written to the simulation at once, by `BuiltinActuatorGroup`.
    """

    shares_delay: ClassVar[bool] = False
    """Whether actuators of this class with equal delay settings have one lag per environment."""

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """Which commands the elements read."""
        raise NotImplementedError(f"{type(self).__name__} must define command_fields.")

    @constant_within_step
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the commands that the elements read, (N, number of elements)."""
        commands = [getattr(cmd, f"{field}_target") for field in self.command_fields]
        return commands[0] if len(commands) == 1 else torch.cat(commands, dim=1)

    def _override_target(self, spec: mujoco.MjSpec, target_name: str) -> None:
        """Write the config's armature, friction loss and damping to a target in `spec`."""
        apply_target_overrides(
            spec,
            target_name,
            self.transmission_type,
            armature=self.cfg.armature,
            frictionloss=self.cfg.frictionloss,
            viscous_damping=self.cfg.viscous_damping,
        )
