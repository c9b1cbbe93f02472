"""Actuators with a PD-like control law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mjlab.actuator.actuator import Actuator, ActuatorGroup, acts_like
from mjlab.actuator.pd_actuator import IdealPdActuator


@dataclass
class FusedActuatorGroup(ActuatorGroup):
    """Actuators of an entity with the control law of `IdealPdActuator`, or another `control_law`.

    Actuators whose class overrides `compute` are not in the group.
    """

    @staticmethod
    def process(
        actuators: Sequence[Actuator],
    ) -> tuple[FusedActuatorGroup, tuple[Actuator, ...]]:
        """Return a group of the PD-like actuators, and all other actuators in order."""
        members = [actuator for actuator in actuators if acts_like(actuator, IdealPdActuator)]
        others = tuple(actuator for actuator in actuators if actuator not in members)
        return FusedActuatorGroup(members), others
