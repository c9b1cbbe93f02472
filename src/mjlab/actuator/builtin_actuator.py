"""Actuators that MuJoCo itself simulates: position and velocity servos, motors, PD, muscles, DC motors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import torch

from mjlab.actuator.actuator import (
    ActuatorCfg,
    ActuatorCmd,
    DirectActuator,
    TransmissionType,
    constant_within_step,
)
from mjlab.utils.errors import check_one_of, check_positive
from mjlab.utils.mujoco import CommandField
from mjlab.utils.spec import (
    create_motor_actuator,
    create_muscle_actuator,
    create_position_actuator,
    create_velocity_actuator,
)

if TYPE_CHECKING:
    from mjlab.entity.entity import Entity


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


@dataclass(kw_only=True)
class BuiltinPdActuatorCfg(ActuatorCfg):
    """PD control inside MuJoCo, see `BuiltinPdActuator`."""

    stiffness: float
    """Gain kp on the position error (N m/rad or N/m)."""
    damping: float
    """Gain kd on the velocity error (N m s/rad or N s/m)."""
    effort_limit: float | None = None
    """Largest sum of forces of all actuators on a target (N m or N); None for no limit."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinPdActuator:
        """See `ActuatorCfg`."""
        return BuiltinPdActuator(self, entity, target_ids, target_names)


class BuiltinPdActuator(DirectActuator[BuiltinPdActuatorCfg]):
    """Two servos a target: force = clamp(kp (p* - l) + kd (v* - l'), -E, E).

    Controls, and `ctrl_ids`, are all position targets p*, then all velocity targets v*, in whatever
    order the elements were added. E is a limit of the joint or tendon, so it holds for the sum of
    all actuators there.
    """

    # Kept in step with _mjs_actuators, which has them in the order of adding.
    _transient = {"_position_elements", "_velocity_elements"}

    def __init__(
        self,
        cfg: BuiltinPdActuatorCfg,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """See `Actuator`."""
        super().__init__(cfg, entity, target_ids, target_names)
        self._position_elements: list[mujoco.MjsActuator] = []
        self._velocity_elements: list[mujoco.MjsActuator] = []

    @property
    def num_targets(self) -> int:
        """Number of joints or tendons, half the number of controls."""
        return len(self._target_ids_list)

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The position targets, then the velocity targets."""
        return ("position", "velocity")

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add `<target>_pd_pos` for each target, then `<target>_pd_vel` for each."""
        limit, on_joint = self.cfg.effort_limit, self.transmission_type == TransmissionType.JOINT
        for name in target_names:
            element = create_position_actuator(
                spec,
                name,
                stiffness=self.cfg.stiffness,
                damping=0.0,
                transmission_type=self.transmission_type,
                actuator_name=f"{name}_pd_pos",
            )
            self._position_elements.append(element)
            if limit is not None:
                target: Any = spec.joint(name) if on_joint else spec.tendon(name)
                target.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
                target.actfrcrange[:] = (-limit, limit)
            self._override_target(spec, name)
        for name in target_names:
            element = create_velocity_actuator(
                spec,
                name,
                damping=self.cfg.damping,
                transmission_type=self.transmission_type,
                actuator_name=f"{name}_pd_vel",
            )
            self._velocity_elements.append(element)
        self._mjs_actuators += self._position_elements[-len(target_names) :]
        self._mjs_actuators += self._velocity_elements[-len(target_names) :]

    def _ordered_elements(self) -> list[mujoco.MjsActuator]:
        return [*self._position_elements, *self._velocity_elements]


@dataclass(kw_only=True)
class BuiltinMuscleActuatorCfg(ActuatorCfg):
    """MuJoCo muscle; the figures are those of MJCF's `<muscle>`, see `BuiltinMuscleActuator`."""

    length_range: tuple[float, float] = (0.0, 0.0)
    """Shortest and longest length of the actuator (m or rad); (0, 0) lets MuJoCo find them."""
    gear: float = 1.0
    """Scale of the force, and of the length, on the target."""
    timeconst: tuple[float, float] = (0.01, 0.04)
    """Time constants of activation and deactivation (s)."""
    tausmooth: float = 0.0
    """Width of the smooth change between the two time constants."""
    range: tuple[float, float] = (0.75, 1.05)
    """Operating range of lengths, in units of the optimal fibre length."""
    force: float = -1.0
    """Peak force at rest (N); negative takes `scale` over the actuator's acceleration."""
    scale: float = 200.0
    """Numerator of the peak force if `force` is negative."""
    lmin: float = 0.5
    """Lower end of the force-length curve."""
    lmax: float = 1.6
    """Upper end of the force-length curve."""
    vmax: float = 1.5
    """Shortening velocity at which the force is zero, in optimal lengths a second."""
    fpmax: float = 1.3
    """Passive force at `lmax`, relative to the peak force."""
    fvmax: float = 1.2
    """Active force at the fastest lengthening, relative to the peak force."""

    _accepts_site: ClassVar[bool] = False

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinMuscleActuator:
        """See `ActuatorCfg`."""
        return BuiltinMuscleActuator(self, entity, target_ids, target_names)


class BuiltinMuscleActuator(DirectActuator[BuiltinMuscleActuatorCfg]):
    """MuJoCo muscle. The effort target is its excitation, from 0 to 1."""

    shares_delay: ClassVar[bool] = True

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The effort target, as excitation."""
        return ("effort",)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        cfg = self.cfg
        return create_muscle_actuator(
            spec,
            target_name,
            length_range=cfg.length_range,
            gear=cfg.gear,
            timeconst=cfg.timeconst,
            tausmooth=cfg.tausmooth,
            range=cfg.range,
            force=cfg.force,
            scale=cfg.scale,
            lmin=cfg.lmin,
            lmax=cfg.lmax,
            vmax=cfg.vmax,
            fpmax=cfg.fpmax,
            fvmax=cfg.fvmax,
            transmission_type=self.transmission_type,
        )


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
                raise ValueError(f"{self._label(name)}: expected {length} numbers, got {value}.")
        check_one_of(self._label("mode"), self.mode, DcMotorInputMode)
        mode = DcMotorInputMode(self.mode)
        has_controller = mode != DcMotorInputMode.VOLTAGE
        for name in ("stiffness", "voltage_limit") if has_controller else ():
            check_positive(f"{self._label(name)} in mode {mode.name}", getattr(self, name))
        unused = {
            DcMotorInputMode.VOLTAGE: ("stiffness", "damping", "integral_gain"),
            DcMotorInputMode.VELOCITY: ("integral_gain",),
            DcMotorInputMode.POSITION: (),
        }
        for name in unused[mode]:
            if getattr(self, name) != 0.0:
                raise ValueError(
                    f"{self._label(name)}: mode {mode.name} does not use it; expected 0, got "
                    f"{getattr(self, name)}; use mode POSITION."
                )

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinDcMotorActuator:
        """See `ActuatorCfg`."""
        return BuiltinDcMotorActuator(self, entity, target_ids, target_names)


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
