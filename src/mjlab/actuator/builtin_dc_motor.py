"""DC motors simulated by MuJoCo, with their electrical side."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, ClassVar

import mujoco

from mjlab.actuator.actuator import ActuatorCfg
from mjlab.actuator.direct import DirectActuator

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.utils.mujoco import CommandField


class DcMotorInputMode(IntEnum):
    """What the control of a DC motor is."""

    VOLTAGE = 0
    POSITION = 1
    VELOCITY = 2


@dataclass(kw_only=True)
class DcMotorDatasheetParams:
    """A DC motor by the figures of its data sheet."""

    nominal_voltage: float
    """Voltage at which the other figures hold (V)."""
    stall_torque: float
    """Torque at standstill (N m)."""
    no_load_speed: float
    """Speed without load (rad/s)."""


@dataclass(kw_only=True)
class DcMotorPhysicalParams:
    """A DC motor by its physical constants."""

    kt: float
    """Torque constant (N m/A)."""
    ke: float
    """Back-EMF constant (V s/rad)."""
    resistance: float
    """Terminal resistance (Ohm)."""


@dataclass(kw_only=True)
class BuiltinDcMotorActuatorCfg(ActuatorCfg):
    """MuJoCo DC motor, see `BuiltinDcMotorActuator`."""

    motor_params: DcMotorDatasheetParams | DcMotorPhysicalParams
    """The motor itself."""
    mode: DcMotorInputMode = DcMotorInputMode.POSITION
    """Whether the control is a voltage, or a position or velocity for a PID controller."""
    stiffness: float = 0.0
    """Gain kp of the controller (N m/rad)."""
    damping: float = 0.0
    """Gain kd of the controller (N m s/rad)."""
    voltage_limit: float = 0.0
    """Largest voltage that the controller applies (V)."""
    integral_gain: float = 0.0
    """Integral gain of the controller."""
    integral_limit: float = 0.0
    """Largest integral term (V); 0 for no limit."""
    slew_rate: float = 0.0
    """Largest change of the control per second; 0 for no limit."""
    effort_limit: float | None = None
    """Largest electromagnetic torque (N m); cogging and friction act after it."""
    gear: float = 1.0
    """Gear ratio from motor to target."""
    inductance: float = 0.0
    """Winding inductance (H); 0 neglects it."""
    electrical_time_constant: float = 0.0
    """Inductance over resistance (s), in place of the inductance."""
    thermal: tuple[float, float, float, float, float, float] | None = None
    """MuJoCo's six thermal figures; None neglects heating."""
    cogging: tuple[float, float, float] | None = None
    """MuJoCo's three figures of cogging torque; None for none."""
    lugre: tuple[float, float, float, float, float] | None = None
    """MuJoCo's five figures of LuGre friction; None for none."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def validate(self) -> None:
        """See `ActuatorCfg`."""
        super().validate()
        for name, length in (("thermal", 6), ("cogging", 3), ("lugre", 5)):
            value = getattr(self, name)
            if value is not None and len(value) != length:
                self._refuse(name, f"it takes {length} figures")
        if self.mode not in list(DcMotorInputMode):
            self._refuse("mode", f"choose one of {[mode.name for mode in DcMotorInputMode]}")
        if self.mode == DcMotorInputMode.VOLTAGE:
            for name in ("stiffness", "damping", "integral_gain"):
                if getattr(self, name) != 0.0:
                    self._refuse(name, "in mode VOLTAGE there is no controller, so it must be 0")
        else:
            for name in ("stiffness", "voltage_limit"):
                if not getattr(self, name) > 0.0:
                    mode = DcMotorInputMode(self.mode).name
                    self._refuse(name, f"the controller of mode {mode} needs it to be positive")

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinDcMotorActuator:
        """See `ActuatorCfg`."""
        return BuiltinDcMotorActuator(self, entity, target_ids, target_names)


_COMMAND_OF_MODE: dict[DcMotorInputMode, CommandField] = {
    DcMotorInputMode.VOLTAGE: "effort",
    DcMotorInputMode.POSITION: "position",
    DcMotorInputMode.VELOCITY: "velocity",
}
_TRANSMISSIONS = {
    "joint": mujoco.mjtTrn.mjTRN_JOINT,
    "tendon": mujoco.mjtTrn.mjTRN_TENDON,
}


class BuiltinDcMotorActuator(DirectActuator[BuiltinDcMotorActuatorCfg]):
    """MuJoCo DC motor, driven by the position or velocity target, or by the effort target in volts.

    Torque = K (V - K w) / R at speed w, with constant K, resistance R and voltage V. A controller
    asks for the torque kp (u - l) - kd l' in position mode, or kd (u - l') - kp l in velocity mode,
    apart from its integral term, and applies the voltage that gives it, up to the limit.

    From a data sheet with voltage V, stall torque T and no-load speed w MuJoCo takes both constants
    as K = V / w and the resistance as R = K V / T.
    """

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """What the mode reads; a voltage is given as effort target."""
        return (_COMMAND_OF_MODE[DcMotorInputMode(self.cfg.mode)],)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        trntype = _TRANSMISSIONS[self.transmission_type.value]
        element = spec.add_actuator(name=target_name, target=target_name, trntype=trntype)
        self._set_dc_motor(element)
        element.gear[0] = self.cfg.gear
        return element

    def _set_dc_motor(self, element: mujoco.MjsActuator) -> None:
        cfg, motor = self.cfg, self.cfg.motor_params
        if isinstance(motor, DcMotorPhysicalParams):
            constants, resistance, nominal = (motor.kt, motor.ke), motor.resistance, (0.0, 0.0, 0.0)
        else:
            constants, resistance = (0.0, 0.0), 0.0
            nominal = (motor.nominal_voltage, motor.stall_torque, motor.no_load_speed)
        try:
            element.set_to_dcmotor(
                motorconst=constants,
                resistance=resistance,
                nominal=nominal,
                saturation=(cfg.effort_limit or 0.0, 0.0, 0.0),
                inductance=(cfg.inductance, cfg.electrical_time_constant),
                cogging=cfg.cogging or (0.0,) * 3,
                controller=(
                    cfg.stiffness,
                    cfg.integral_gain,
                    cfg.damping,
                    cfg.slew_rate,
                    cfg.integral_limit,
                    cfg.voltage_limit,
                ),
                thermal=cfg.thermal or (0.0,) * 6,
                lugre=cfg.lugre or (0.0,) * 5,
                ctrlspec=int(cfg.mode),
            )
        except ValueError as error:
            raise ValueError(
                f"BuiltinDcMotorActuatorCfg for {cfg.target_names_expr}: MuJoCo refuses the motor "
                f"{motor}: {error}."
            ) from error
