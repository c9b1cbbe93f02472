"""DC motors simulated by MuJoCo, with their electrical side."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import torch

from mjlab.actuator.actuator import ActuatorCfg, ActuatorCmd
from mjlab.actuator.direct import DirectActuator
from mjlab.utils.substep import constant_within_step

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.utils.mujoco import CommandField


class DcMotorInputMode(IntEnum):
    """What the control of a DC motor is."""

    VOLTAGE = 0
    POSITION = 1
    VELOCITY = 2


@dataclass
class DcMotorDatasheetParams:
    """A DC motor by the figures of its data sheet."""

    nominal_voltage: float
    """Voltage at which the other figures hold (V)."""
    stall_torque: float
    """Torque at standstill (N m)."""
    no_load_speed: float
    """Speed without load (rad/s)."""


@dataclass
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
    """Command that the motor follows: a voltage, or a position or velocity by a controller."""
    stiffness: float = 0.0
    """Gain kp of the controller (V/rad; V s/rad in mode VELOCITY)."""
    damping: float = 0.0
    """Gain kd of the controller (V s/rad). Mode POSITION only; without effect in mode VELOCITY."""
    voltage_limit: float = 0.0
    """Largest voltage at the terminals (V); 0 in mode VOLTAGE for no limit."""
    integral_gain: float = 0.0
    """Gain ki of the controller (V/(rad s)). Mode POSITION only."""
    integral_limit: float = 0.0
    """Largest time integral of the position error (rad s); 0 for no limit."""
    slew_rate: float = 0.0
    """Largest change of the command per second, from 0 after a reset; 0 for no limit."""
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
        if self.mode == DcMotorInputMode.VELOCITY and self.integral_gain != 0.0:
            self._refuse(
                "integral_gain", "MuJoCo's velocity controller has no integral, so it must be 0; "
                "use mode POSITION and integrate the velocity into its target"
            )  # fmt: skip

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
_INPUT_POSITION = int(mujoco.mjtCtrlInput.mjINPUT_POS)
_INPUT_VELOCITY = int(mujoco.mjtCtrlInput.mjINPUT_VEL)
_INPUT_VOLTAGE = int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)


class BuiltinDcMotorActuator(DirectActuator[BuiltinDcMotorActuatorCfg]):
    """MuJoCo DC motor, driven by the position or velocity target, or by the effort target in volts.

    Torque = K (V - K w) / R at speed w, with constant K, resistance R and terminal voltage V, before
    cogging and friction. For a target u the controller applies, up to the limit,

        V = kp (u - l) + ki x - kd w    in mode POSITION, with x the time integral of u - l,
        V = kp (u - w)                  in mode VELOCITY,
        V = u                           in mode VOLTAGE.

    Without a load, mode VELOCITY settles at u kp / (kp + K).

    From a data sheet with voltage V, stall torque T and no-load speed w MuJoCo takes both constants
    as K = V / w and the resistance as R = K V / T.

    MuJoCo's own controller turns gains (p, i, d) in torque space and controls c into

        V = R/K (p (c_pos - l) + i x + d (c_vel - w)) + K w.

    Mode POSITION is p = kp K/R, i = ki K/R, d = (kd + K) K/R with control u. With d = (s + K) K/R
    and control g u / (s + K), the velocity input alone gives V = g u - s w: this is mode VELOCITY
    with s = g = kp, and a voltage limited in size or slew with s = 0, g = 1. MuJoCo limits neither
    on its plain voltage input, which serves the rest.
    """

    _transient = {"_model"}

    def __init__(
        self,
        cfg: BuiltinDcMotorActuatorCfg,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """See `Actuator`."""
        super().__init__(cfg, entity, target_ids, target_names)
        self._model: Any = None

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """See `Actuator`."""
        super().initialize(mj_model, model, data, device)
        self._model = model

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """What the mode reads; a voltage is given as effort target."""
        return (_COMMAND_OF_MODE[DcMotorInputMode(self.cfg.mode)],)

    @constant_within_step
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the controls: the command in the units of MuJoCo's input, (N, n)."""
        command = super().compute(cmd)
        if self._input() != _INPUT_VELOCITY:
            return command
        # Read at each call, because the gain may be randomized.
        gainprm = self._model.actuator_gainprm[:, self.global_element_ids]
        resistance, constant, damping = gainprm[..., 0], gainprm[..., 1], gainprm[..., 6]
        total = damping * resistance / constant  # s + K
        gain = 1.0 if self.cfg.mode == DcMotorInputMode.VOLTAGE else total - constant
        return command * (gain / total)

    def _input(self) -> int:
        """Return which input of MuJoCo's motor carries the command."""
        if self.cfg.mode == DcMotorInputMode.POSITION:
            return _INPUT_POSITION
        limited = self.cfg.voltage_limit > 0.0 or self.cfg.slew_rate > 0.0
        if self.cfg.mode == DcMotorInputMode.VELOCITY or limited:
            return _INPUT_VELOCITY
        return _INPUT_VOLTAGE

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        trntype = _TRANSMISSIONS[self.transmission_type.value]
        element = spec.add_actuator(name=target_name, target=target_name, trntype=trntype)
        # The gains depend on the constants that MuJoCo derives from a data sheet.
        self._set_dc_motor(element, (0.0,) * 6)
        self._set_dc_motor(element, self._controller(element.gainprm[1], element.gainprm[0]))
        element.gear[0] = self.cfg.gear
        return element

    def _controller(self, constant: float, resistance: float) -> tuple[float, ...]:
        """Return MuJoCo's kp, ki, kd, slew rate, integral limit and voltage limit."""
        cfg, torque_per_volt = self.cfg, constant / resistance
        kp = ki = kd = 0.0
        slew_rate = cfg.slew_rate
        if cfg.mode == DcMotorInputMode.POSITION:
            kp, ki = cfg.stiffness * torque_per_volt, cfg.integral_gain * torque_per_volt
            kd = (cfg.damping + constant) * torque_per_volt
        elif self._input() == _INPUT_VELOCITY:
            total = cfg.stiffness + constant
            kd = total * torque_per_volt
            slew_rate *= (1.0 if cfg.mode == DcMotorInputMode.VOLTAGE else cfg.stiffness) / total
        return kp, ki, kd, slew_rate, cfg.integral_limit, cfg.voltage_limit

    def _set_dc_motor(self, element: mujoco.MjsActuator, controller: tuple[float, ...]) -> None:
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
                controller=controller,
                thermal=cfg.thermal or (0.0,) * 6,
                lugre=cfg.lugre or (0.0,) * 5,
                ctrlspec=self._input(),
            )
        except ValueError as error:
            raise ValueError(
                f"BuiltinDcMotorActuatorCfg for {cfg.target_names_expr}: MuJoCo refuses the motor "
                f"{motor}: {error}."
            ) from error
