"""Fused evaluation of PD-like actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from mjlab.actuator.actuator import (
    Actuator,
    ActuatorCmd,
    TransmissionType,
    acts_like,
    delay_rows,
    delay_settings,
    read_command,
    share_line,
)
from mjlab.actuator.pd_actuator import IdealPdActuator
from mjlab.utils.buffers import DelayBuffer
from mjlab.utils.indexing import Columns, EnvIds, as_columns, write_columns

if TYPE_CHECKING:
    from mjlab.entity.data import EntityData


@dataclass
class FusedActuatorGroup:
    """Actuators with the control law of `IdealPdActuator`, or a `control_law` override.

    Actuators with the same class, transmission and delay settings are evaluated at once, and share
    one delay buffer, hence one lag per environment. Their parameters become parts of one tensor:
    change them in place (assignment copies in place too). Actuators whose class overrides `compute`
    are not fused.
    """

    _groups: list[_FusedGroup] = field(default_factory=list)

    @staticmethod
    def process(
        actuators: Sequence[Actuator],
    ) -> tuple[FusedActuatorGroup, tuple[Actuator, ...]]:
        """Return groups of the actuators that can be fused, and all other actuators in order."""
        groups: dict[Any, _FusedGroup] = {}
        others = []
        for actuator in actuators:
            if (
                isinstance(actuator, IdealPdActuator)
                and acts_like(actuator, IdealPdActuator)
                and actuator.transmission_type != TransmissionType.SITE
            ):
                group = groups.setdefault(delay_settings(actuator), _FusedGroup([]))
                group.actuators.append(actuator)
            else:
                others.append(actuator)
        return FusedActuatorGroup(list(groups.values())), tuple(others)

    def initialize(self, num_envs: int, device: str) -> None:
        """Concatenate parameters and create delay buffers. The actuators must be initialized."""
        for group in self._groups:
            group.initialize(num_envs, device)

    def apply_controls(self, data: EntityData, env_ids: EnvIds = None) -> None:
        """Compute and write the controls of all actuators in the groups.

        With `env_ids` (environments just reset), other environments are unchanged.
        """
        for group in self._groups:
            group.apply_controls(data, env_ids)


@dataclass
class _FusedGroup:
    """Actuators with the same class, transmission and delay, with concatenated columns."""

    actuators: list[IdealPdActuator]
    source: Columns = field(default_factory=lambda: slice(0))
    ctrl: Columns = field(default_factory=lambda: slice(0))
    params: dict[str, torch.Tensor] = field(default_factory=dict)
    line: DelayBuffer | None = None

    def initialize(self, num_envs: int, device: str) -> None:
        # In control order, so that columns are contiguous if possible.
        self.actuators.sort(key=lambda actuator: int(actuator.global_ctrl_ids.min()))
        sources = torch.cat([actuator.target_ids for actuator in self.actuators])
        ctrl_ids = torch.cat([actuator.global_ctrl_ids for actuator in self.actuators])
        self.source = as_columns(sources.tolist(), device)
        self.ctrl = as_columns(ctrl_ids.tolist(), device)
        self.params = {
            name: torch.cat([_parameter(actuator, name) for actuator in self.actuators], dim=1)
            for name in self.actuators[0].param_names
        }
        widths = [len(actuator.target_ids) for actuator in self.actuators]
        parts = {name: value.split(widths, dim=1) for name, value in self.params.items()}
        for k, actuator in enumerate(self.actuators):
            actuator.share_parameters({name: part[k] for name, part in parts.items()})
        if self.actuators[0].has_delay:
            self.line = share_line(self.actuators, num_envs, device)
        else:
            for actuator in self.actuators:
                actuator.join_group(None, resets_delay=False)

    def apply_controls(self, data: EntityData, env_ids: EnvIds) -> None:
        first = self.actuators[0]
        cmd = read_command(data, first.transmission_type, self.source)
        if self.line is not None:
            targets = (cmd.position_target, cmd.velocity_target, cmd.effort_target)
            cmd = ActuatorCmd(*delay_rows(self.line, targets, env_ids), cmd.pos, cmd.vel)
        ctrl = first.control_law(self.params, cmd)
        write_columns(data.data.ctrl, self.ctrl, ctrl, env_ids)


def _parameter(actuator: IdealPdActuator, name: str) -> torch.Tensor:
    """Return a parameter, (N, n); raises `ValueError` unless it is a tensor that broadcasts to it."""
    value, expected = getattr(actuator, name, None), tuple(actuator.stiffness.shape)
    try:
        return torch.broadcast_to(value, expected)  # ty: ignore
    except (RuntimeError, TypeError):
        found = tuple(value.shape) if isinstance(value, torch.Tensor) else repr(value)
        raise ValueError(
            f"{type(actuator).__name__} of {actuator.target_names} {name} (in param_names): expected a "
            f"tensor of shape {expected} after initialize, got {found}."
        ) from None
