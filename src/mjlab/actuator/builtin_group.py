"""Writing the controls of all actuators that only pass commands through, as few as possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeGuard

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
"""Actuators whose control is one target."""


@dataclass
class BuiltinActuatorGroup:
    """All actuators of an entity whose control is a command, passed through.

    Those without delay make one copy for each target field they read. Those with a delay that may
    share one (`DirectActuator.shares_delay`) have one delay line, and one lag in each environment,
    for all with the same class, transmission and delay settings; others have one each.

    An actuator whose class has a `compute` of its own is left to it.
    """

    _actuators: list[DirectActuator] = field(default_factory=list)
    _routes: list[_Route] = field(default_factory=list)
    _delayed_groups: list[_DelayedRoutes] = field(default_factory=list)

    @staticmethod
    def process(
        actuators: Sequence[Actuator],
    ) -> tuple[BuiltinActuatorGroup, tuple[Actuator, ...]]:
        """Return a group of the actuators that need nothing computed, and all others in order."""
        members = [actuator for actuator in actuators if _passes_commands(actuator)]
        others = tuple(actuator for actuator in actuators if not _passes_commands(actuator))
        return BuiltinActuatorGroup(_actuators=members), others

    def initialize(self, num_envs: int, device: str) -> None:
        """Plan the copies and make the delay lines. The actuators must be initialized already."""
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
        """Write the controls of all actuators of the group.

        With `env_ids`, which must just have been reset, nothing of any other environment changes.
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
    """Targets that go to controls: columns `source` of a target field to columns `ctrl`."""

    field: str
    source: Columns
    ctrl: Columns


@dataclass
class _DelayedRoutes:
    """Routes whose commands are delayed together."""

    routes: list[_Route]
    line: DelayBuffer


def _passes_commands(actuator: Actuator) -> TypeGuard[DirectActuator]:
    # A site has no position or velocity target; where one is asked for, `compute` gives zeros.
    return (
        isinstance(actuator, DirectActuator)
        and acts_like(actuator, DirectActuator)
        and all(target_field(actuator.transmission_type, name) for name in actuator.command_fields)
    )


def _plan(actuators: Sequence[DirectActuator], device: str) -> list[_Route]:
    """Merge what the actuators read into one route for each target field."""
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
        # In the order of controls, these are usually neighbours, and often the targets too.
        both.sort()
        ctrl_ids, sources = [ctrl for ctrl, _ in both], [source for _, source in both]
        routes.append(_Route(name, as_columns(sources, device), as_columns(ctrl_ids, device)))
    return routes
