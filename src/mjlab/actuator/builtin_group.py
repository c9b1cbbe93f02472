"""Actuators that pass commands through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mjlab.actuator.actuator import (
    Actuator,
    ActuatorGroup,
    DirectActuator,
    acts_like,
    target_field,
)
from mjlab.actuator.builtin_actuator import (
    BuiltinMotorActuator,
    BuiltinMuscleActuator,
    BuiltinPositionActuator,
    BuiltinVelocityActuator,
)
from mjlab.utils.indexing import Columns, EnvIds, as_columns, read_columns, write_columns

if TYPE_CHECKING:
    from mjlab.entity.data import EntityData

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
        members = [
            actuator
            for actuator in actuators
            if isinstance(actuator, DirectActuator)
            and acts_like(actuator, DirectActuator)
            # Sites have no position or velocity targets; `compute` returns zeros for these.
            and all(target_field(actuator.transmission_type, f) for f in actuator.command_fields)
        ]
        others = tuple(actuator for actuator in actuators if actuator not in members)
        return BuiltinActuatorGroup(members), others

    def _writers_without_delay(self, device: str) -> list[Any]:
        return [
            _Copy(
                str(target_field(actuator.transmission_type, command)),
                as_columns(actuator.target_ids.tolist(), device),
                as_columns(ctrl_ids.tolist(), device),
            )
            for actuator in self._actuators
            if not actuator.has_delay
            for command, ctrl_ids in zip(
                actuator.command_fields,
                actuator.global_ctrl_ids.split(len(actuator.target_ids)),
                strict=True,
            )
        ]

    def _delay_settings(self, actuator: Any) -> tuple[Any, ...]:
        own = None if actuator.shares_delay else id(actuator)
        return (*super()._delay_settings(actuator), own)


@dataclass
class _Copy:
    """Copy of columns `source` of a target field to columns `ctrl` of the controls."""

    field: str
    source: Columns
    ctrl: Columns

    def apply_controls(self, data: EntityData, env_ids: EnvIds = None) -> None:
        values = read_columns(getattr(data, self.field), self.source)
        write_columns(data.data.ctrl, self.ctrl, values, env_ids)
