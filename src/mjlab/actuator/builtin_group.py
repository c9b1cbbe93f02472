"""Batched control writes of actuators that pass commands through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mjlab.actuator.actuator import (
    Actuator,
    DirectActuator,
    acts_like,
    delay_rows,
    delay_settings,
    share_line,
    target_field,
)
from mjlab.actuator.builtin_actuator import (
    BuiltinMotorActuator,
    BuiltinMuscleActuator,
    BuiltinPositionActuator,
    BuiltinVelocityActuator,
)
from mjlab.utils.buffers import DelayBuffer
from mjlab.utils.indexing import Columns, EnvIds, as_columns, read_columns, write_columns

if TYPE_CHECKING:
    from mjlab.entity.data import EntityData

BuiltinActuatorType = (
    BuiltinMotorActuator | BuiltinMuscleActuator | BuiltinPositionActuator | BuiltinVelocityActuator
)
"""Actuators with one target as control."""


@dataclass
class BuiltinActuatorGroup:
    """Actuators of an entity whose controls are commands, passed through unchanged.

    Actuators without delay are written with one copy per target field. Delayed actuators with
    `DirectActuator.shares_delay` share one delay buffer, hence one lag per environment, among
    actuators with the same class, transmission and delay settings; others have separate buffers.

    Actuators whose class overrides `compute` are not grouped.
    """

    _actuators: list[DirectActuator] = field(default_factory=list)
    _routes: list[_Route] = field(default_factory=list)
    _delayed_groups: list[_DelayedRoutes] = field(default_factory=list)

    @staticmethod
    def process(
        actuators: Sequence[Actuator],
    ) -> tuple[BuiltinActuatorGroup, tuple[Actuator, ...]]:
        """Return a group of the actuators without computation, and all other actuators in order."""
        members, others = [], []
        for actuator in actuators:
            # Sites have no position or velocity targets; `compute` returns zeros for these.
            if (
                isinstance(actuator, DirectActuator)
                and acts_like(actuator, DirectActuator)
                and all(
                    target_field(actuator.transmission_type, f) for f in actuator.command_fields
                )
            ):
                members.append(actuator)
            else:
                others.append(actuator)
        return BuiltinActuatorGroup(_actuators=members), tuple(others)

    def initialize(self, num_envs: int, device: str) -> None:
        """Plan the copies and create delay buffers. The actuators must be initialized."""
        direct = [actuator for actuator in self._actuators if not actuator.has_delay]
        for actuator in direct:
            actuator.join_group(None, resets_delay=False)
        self._routes = _plan(direct, device)
        lines: dict[Any, list[DirectActuator]] = {}
        for actuator in self._actuators:
            if actuator.has_delay:
                own = None if actuator.shares_delay else id(actuator)
                lines.setdefault((delay_settings(actuator), own), []).append(actuator)
        self._delayed_groups = [
            _DelayedRoutes(_plan(members, device), share_line(members, num_envs, device))
            for members in lines.values()
        ]

    def apply_controls(self, data: EntityData, env_ids: EnvIds = None) -> None:
        """Write the controls of all actuators in the group.

        With `env_ids` (environments just reset), other environments are unchanged.
        """
        if not self._actuators:
            return
        ctrl = data.data.ctrl
        for route in self._routes:
            write_columns(
                ctrl, route.ctrl, read_columns(getattr(data, route.field), route.source), env_ids
            )
        for group in self._delayed_groups:
            commands = tuple(
                read_columns(getattr(data, route.field), route.source) for route in group.routes
            )
            delayed = delay_rows(group.line, commands, env_ids)
            for route, command in zip(group.routes, delayed, strict=True):
                write_columns(ctrl, route.ctrl, command, env_ids)


@dataclass
class _Route:
    """Copy of columns `source` of a target field to columns `ctrl` of the controls."""

    field: str
    source: Columns
    ctrl: Columns


@dataclass
class _DelayedRoutes:
    """Routes that share a delay buffer."""

    routes: list[_Route]
    line: DelayBuffer


def _plan(actuators: Sequence[DirectActuator], device: str) -> list[_Route]:
    """Merge the commands of the actuators into one route per target field."""
    pairs: dict[str, list[tuple[int, int]]] = {}
    for actuator in actuators:
        sources = actuator.target_ids.tolist()
        ctrl_blocks = actuator.global_ctrl_ids.reshape(-1, len(sources)).tolist()
        for command, ctrl_ids in zip(actuator.command_fields, ctrl_blocks, strict=True):
            name = target_field(actuator.transmission_type, command)
            assert name is not None
            pairs.setdefault(name, []).extend(zip(ctrl_ids, sources, strict=True))
    routes = []
    for name, both in pairs.items():
        # In control order, columns of controls are usually contiguous, and often those of targets too.
        both.sort()
        ctrl_ids, sources = [ctrl for ctrl, _ in both], [source for _, source in both]
        routes.append(_Route(name, as_columns(sources, device), as_columns(ctrl_ids, device)))
    return routes
