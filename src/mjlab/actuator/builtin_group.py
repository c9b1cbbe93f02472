"""Actuators that pass commands through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mjlab.actuator.actuator import Actuator, ActuatorGroup, DirectActuator, acts_like
from mjlab.actuator.builtin_actuator import (
    BuiltinMotorActuator,
    BuiltinMuscleActuator,
    BuiltinPositionActuator,
    BuiltinVelocityActuator,
)

BuiltinActuatorType = (
    BuiltinMotorActuator | BuiltinMuscleActuator | BuiltinPositionActuator | BuiltinVelocityActuator
)
"""Actuators with one target as control."""


@dataclass
class BuiltinActuatorGroup(ActuatorGroup):
    """Actuators of an entity whose controls are commands, passed through unchanged.

    Those with `DirectActuator.shares_delay` share delay lines. Actuators whose class overrides
    `compute` are not in the group.
    """

    @staticmethod
    def process(
        actuators: Sequence[Actuator],
    ) -> tuple[BuiltinActuatorGroup, tuple[Actuator, ...]]:
        """Return a group of the actuators without computation, and all other actuators in order."""
        members = [actuator for actuator in actuators if acts_like(actuator, DirectActuator)]
        others = tuple(actuator for actuator in actuators if actuator not in members)
        return BuiltinActuatorGroup(members), others

    def _delay_settings(self, actuator: Any) -> tuple[Any, ...]:
        own = None if actuator.shares_delay else id(actuator)
        return (*super()._delay_settings(actuator), own)
