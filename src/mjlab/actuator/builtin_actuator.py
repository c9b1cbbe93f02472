"""Actuators that MuJoCo itself simulates: position and velocity servos, and motors.

Native PD, muscles and DC motors are at this import path too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from mjlab.actuator.actuator import ActuatorCfg
from mjlab.actuator.builtin_dc_motor import BuiltinDcMotorActuator as BuiltinDcMotorActuator
from mjlab.actuator.builtin_dc_motor import BuiltinDcMotorActuatorCfg as BuiltinDcMotorActuatorCfg
from mjlab.actuator.builtin_dc_motor import DcMotorDatasheetParams as DcMotorDatasheetParams
from mjlab.actuator.builtin_dc_motor import DcMotorInputMode as DcMotorInputMode
from mjlab.actuator.builtin_dc_motor import DcMotorPhysicalParams as DcMotorPhysicalParams
from mjlab.actuator.builtin_muscle import BuiltinMuscleActuator as BuiltinMuscleActuator
from mjlab.actuator.builtin_muscle import BuiltinMuscleActuatorCfg as BuiltinMuscleActuatorCfg
from mjlab.actuator.builtin_pd import BuiltinPdActuator as BuiltinPdActuator
from mjlab.actuator.builtin_pd import BuiltinPdActuatorCfg as BuiltinPdActuatorCfg
from mjlab.actuator.direct import DirectActuator
from mjlab.utils.spec import (
    create_motor_actuator,
    create_position_actuator,
    create_velocity_actuator,
)

if TYPE_CHECKING:
    import mujoco

    from mjlab.entity import Entity
    from mjlab.utils.mujoco import CommandField


@dataclass(kw_only=True)
class BuiltinPositionActuatorCfg(ActuatorCfg):
    """Position servo, see `BuiltinPositionActuator`."""

    stiffness: float
    """Gain kp on the position error (N m/rad or N/m)."""
    damping: float
    """Gain kd on the velocity (N m s/rad or N s/m)."""
    effort_limit: float | None = None
    """Largest force E (N m or N); None for no limit."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinPositionActuator:
        """See `ActuatorCfg`."""
        return BuiltinPositionActuator(self, entity, target_ids, target_names)


class BuiltinPositionActuator(DirectActuator[BuiltinPositionActuatorCfg]):
    """MuJoCo position servo: force = clamp(kp (u - l) - kd l', -E, E), u the position target."""

    shares_delay: ClassVar[bool] = True

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The position target."""
        return ("position",)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        return create_position_actuator(
            spec,
            target_name,
            stiffness=self.cfg.stiffness,
            damping=self.cfg.damping,
            effort_limit=self.cfg.effort_limit,
            transmission_type=self.transmission_type,
        )


@dataclass(kw_only=True)
class BuiltinVelocityActuatorCfg(ActuatorCfg):
    """Velocity servo, see `BuiltinVelocityActuator`."""

    damping: float
    """Gain kd on the velocity error (N m s/rad or N s/m)."""
    effort_limit: float | None = None
    """Largest force E (N m or N); None for no limit."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinVelocityActuator:
        """See `ActuatorCfg`."""
        return BuiltinVelocityActuator(self, entity, target_ids, target_names)


class BuiltinVelocityActuator(DirectActuator[BuiltinVelocityActuatorCfg]):
    """MuJoCo velocity servo: force = clamp(kd (u - l'), -E, E), u the velocity target."""

    shares_delay: ClassVar[bool] = True

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The velocity target."""
        return ("velocity",)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        return create_velocity_actuator(
            spec,
            target_name,
            damping=self.cfg.damping,
            effort_limit=self.cfg.effort_limit,
            transmission_type=self.transmission_type,
        )


@dataclass(kw_only=True)
class BuiltinMotorActuatorCfg(ActuatorCfg):
    """Motor, see `BuiltinMotorActuator`."""

    effort_limit: float
    """Largest control E (N m or N, before the gear); may be infinite."""
    gear: float = 1.0
    """Force on the target per unit of control, g."""

    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinMotorActuator:
        """See `ActuatorCfg`."""
        return BuiltinMotorActuator(self, entity, target_ids, target_names)


class BuiltinMotorActuator(DirectActuator[BuiltinMotorActuatorCfg]):
    """MuJoCo motor: force on the target = g clamp(u, -E, E), u the effort target.

    On a site it acts along the first axis of the gear, the site's x axis.
    """

    shares_delay: ClassVar[bool] = True

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The effort target."""
        return ("effort",)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        return create_motor_actuator(
            spec,
            target_name,
            effort_limit=self.cfg.effort_limit,
            gear=self.cfg.gear,
            transmission_type=self.transmission_type,
        )
