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

    Many of them are written to the simulation at once, by `BuiltinActuatorGroup`. A subclass
    defines `command_fields`, and what it adds to the spec: `_add_element`, or all of `edit_spec`.
    """

    shares_delay: ClassVar[bool] = False
    """Whether actuators of this class with equal delay settings have one lag per environment."""

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """Which commands the elements read."""
        raise NotImplementedError(f"{type(self).__name__} must define command_fields.")

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add one element for each target, and write the config's properties to the target."""
        for name in target_names:
            self._mjs_actuators.append(self._add_element(spec, name))
            self._override_target(spec, name)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        """Add the element of one target to `spec` and return it."""
        raise NotImplementedError(
            f"{type(self).__name__} must define _add_element(spec, target_name), or edit_spec."
        )

    @constant_within_step
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the commands that the elements read, (N, number of controls)."""
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
