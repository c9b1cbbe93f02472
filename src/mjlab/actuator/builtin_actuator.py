"""MuJoCo built-in actuators: position and velocity servos, motors, PD, muscles, DC motors."""

from __future__ import annotations

import warnings
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
from mjlab.compat import suggests_fields
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


@suggests_fields
@dataclass(kw_only=True)
class BuiltinPositionActuatorCfg(ActuatorCfg):
    """Position servo, see `BuiltinPositionActuator`."""

    stiffness: float
    """Gain kp on the position error (N m/rad or N/m)."""
    damping: float
    """Gain kd on the velocity (N m s/rad or N s/m)."""
    effort_limit: float | None = None
    """Maximum force E (N m or N). None: no limit."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinPositionActuator:
        """See `ActuatorCfg`."""
        return BuiltinPositionActuator(self, entity, target_ids, target_names)


class BuiltinPositionActuator(DirectActuator[BuiltinPositionActuatorCfg]):
    """MuJoCo position servo: force = clamp(kp (u - l) - kd l', -E, E), position target u."""

    shares_delay: ClassVar[bool] = True
    _create = staticmethod(create_position_actuator)
    _create_fields: ClassVar[tuple[str, ...]] = ("stiffness", "damping", "effort_limit")

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The position target."""
        return ("position",)


@dataclass(kw_only=True)
class BuiltinVelocityActuatorCfg(ActuatorCfg):
    """Velocity servo, see `BuiltinVelocityActuator`."""

    damping: float
    """Gain kd on the velocity error (N m s/rad or N s/m)."""
    effort_limit: float | None = None
    """Maximum force E (N m or N). None: no limit."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinVelocityActuator:
        """See `ActuatorCfg`."""
        return BuiltinVelocityActuator(self, entity, target_ids, target_names)


class BuiltinVelocityActuator(DirectActuator[BuiltinVelocityActuatorCfg]):
    """MuJoCo velocity servo: force = clamp(kd (u - l'), -E, E), velocity target u."""

    shares_delay: ClassVar[bool] = True
    _create = staticmethod(create_velocity_actuator)
    _create_fields: ClassVar[tuple[str, ...]] = ("damping", "effort_limit")

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The velocity target."""
        return ("velocity",)


@dataclass(kw_only=True)
class BuiltinMotorActuatorCfg(ActuatorCfg):
    """Motor, see `BuiltinMotorActuator`."""

    effort_limit: float
    """Maximum control E (N m or N, before the gear). May be infinite."""
    gear: float = 1.0
    """Force on the target per unit of control g."""

    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinMotorActuator:
        """See `ActuatorCfg`."""
        return BuiltinMotorActuator(self, entity, target_ids, target_names)


class BuiltinMotorActuator(DirectActuator[BuiltinMotorActuatorCfg]):
    """MuJoCo motor: force on the target = g clamp(u, -E, E), effort target u.

    On a site, the force acts along the first axis of the gear, the site's x axis.
    """

    shares_delay: ClassVar[bool] = True
    _create = staticmethod(create_motor_actuator)
    _create_fields: ClassVar[tuple[str, ...]] = ("effort_limit", "gear")

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The effort target."""
        return ("effort",)


@dataclass(kw_only=True)
class BuiltinPdActuatorCfg(ActuatorCfg):
    """PD control by MuJoCo servos, see `BuiltinPdActuator`."""

    stiffness: float
    """Gain kp on the position error (N m/rad or N/m)."""
    damping: float
    """Gain kd on the velocity error (N m s/rad or N s/m)."""
    effort_limit: float | None = None
    """Maximum sum E of the forces of all actuators on a target (N m or N). None: no limit."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinPdActuator:
        """See `ActuatorCfg`."""
        return BuiltinPdActuator(self, entity, target_ids, target_names)


class BuiltinPdActuator(DirectActuator[BuiltinPdActuatorCfg]):
    """PD control with two servos per target: force = clamp(kp (p* - l) + kd (v* - l'), -E, E).

    Controls and `ctrl_ids` are ordered as all position targets p*, then all velocity targets v*,
    independent of the order of elements. E is a limit of the joint or tendon, so it applies to the
    sum of all actuators on the target.
    """

    # Same elements as in _mjs_actuators.
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
        """Number of joints or tendons: half the number of controls."""
        return len(self._target_ids_list)

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The position targets, then the velocity targets."""
        return ("position", "velocity")

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add `<target>_pd_pos` for each target, then `<target>_pd_vel` for each target."""
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
        self._mjs_actuators = [*self._position_elements, *self._velocity_elements]


@dataclass(kw_only=True)
class BuiltinMuscleActuatorCfg(ActuatorCfg):
    """MuJoCo muscle with the parameters of MJCF `<muscle>`, see `BuiltinMuscleActuator`."""

    length_range: tuple[float, float] = (0.0, 0.0)
    """Minimum and maximum actuator length (m or rad). (0, 0): computed by MuJoCo."""
    gear: float = 1.0
    """Scale of the force and the length on the target."""
    timeconst: tuple[float, float] = (0.01, 0.04)
    """Time constants of activation and deactivation (s)."""
    tausmooth: float = 0.0
    """Width of the smooth transition between the two time constants."""
    range: tuple[float, float] = (0.75, 1.05)
    """Operating range of lengths, in units of the optimal fiber length."""
    force: float = -1.0
    """Peak force at rest (N). Negative: `scale` divided by the actuator's acceleration."""
    scale: float = 200.0
    """Numerator of the peak force if `force` is negative."""
    lmin: float = 0.5
    """Lower end of the force-length curve."""
    lmax: float = 1.6
    """Upper end of the force-length curve."""
    vmax: float = 1.5
    """Shortening velocity at zero force, in optimal lengths per second."""
    fpmax: float = 1.3
    """Passive force at `lmax`, relative to the peak force."""
    fvmax: float = 1.2
    """Active force at saturating lengthening velocity, relative to the peak force."""

    _accepts_site: ClassVar[bool] = False

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinMuscleActuator:
        """See `ActuatorCfg`."""
        return BuiltinMuscleActuator(self, entity, target_ids, target_names)


class BuiltinMuscleActuator(DirectActuator[BuiltinMuscleActuatorCfg]):
    """MuJoCo muscle. The effort target is its excitation, in [0, 1]."""

    shares_delay: ClassVar[bool] = True
    _create = staticmethod(create_muscle_actuator)
    _create_fields: ClassVar[tuple[str, ...]] = (
        *("length_range", "gear", "timeconst", "tausmooth", "range", "force", "scale"),
        *("lmin", "lmax", "vmax", "fpmax", "fvmax"),
    )

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The effort target, as excitation."""
        return ("effort",)


class DcMotorInputMode(IntEnum):
    """Command of a DC motor."""

    VOLTAGE = 0
    POSITION = 1
    VELOCITY = 2


@dataclass
class DcMotorDatasheetParams:
    """Datasheet parameters of a DC motor."""

    nominal_voltage: float
    """Voltage of the other parameters (V)."""
    stall_torque: float
    """Stall torque (N m)."""
    no_load_speed: float
    """No-load speed (rad/s)."""


@dataclass
class DcMotorPhysicalParams:
    """Physical constants of a DC motor."""

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
    """Motor parameters."""
    mode: DcMotorInputMode = DcMotorInputMode.POSITION
    """Command type: voltage, or position or velocity tracked by a controller."""
    stiffness: float = 0.0
    """Gain kp of the controller (V/rad; V s/rad in mode VELOCITY)."""
    damping: float = 0.0
    """Gain kd of the controller (V s/rad). Mode POSITION only; no effect in mode VELOCITY."""
    voltage_limit: float = 0.0
    """Maximum terminal voltage (V). 0 in mode VOLTAGE: no limit."""
    integral_gain: float = 0.0
    """Gain ki of the controller (V/(rad s)). Mode POSITION only; no effect in mode
    VELOCITY."""
    integral_limit: float = 0.0
    """Maximum time integral of the position error (rad s). 0: no limit."""
    slew_rate: float = 0.0
    """Maximum change of the command per second, starting at 0 after a reset. 0: no limit."""
    effort_limit: float | None = None
    """Maximum electromagnetic torque (N m), before cogging and friction. None, or <= 0: no limit."""
    gear: float = 1.0
    """Gear ratio from motor to target."""
    inductance: float = 0.0
    """Winding inductance (H). 0: neglected."""
    electrical_time_constant: float = 0.0
    """Inductance divided by resistance (s), instead of the inductance."""
    thermal: tuple[float, float, float, float, float, float] | None = None
    """MuJoCo's six thermal parameters. None: no heating."""
    cogging: tuple[float, float, float] | None = None
    """MuJoCo's three cogging torque parameters. None: no cogging."""
    lugre: tuple[float, float, float, float, float] | None = None
    """MuJoCo's five LuGre friction parameters. None: no LuGre friction."""

    _accepts_site: ClassVar[bool] = False

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
        unused = ("stiffness", "damping", "integral_gain")
        for name in unused if mode == DcMotorInputMode.VOLTAGE else ():
            if getattr(self, name) != 0.0:
                raise ValueError(
                    f"{self._label(name)}: expected 0 in mode {mode.name}, got "
                    f"{getattr(self, name)}; use mode POSITION."
                )

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinDcMotorActuator:
        """See `ActuatorCfg`."""
        return BuiltinDcMotorActuator(self, entity, target_ids, target_names)


class BuiltinDcMotorActuator(DirectActuator[BuiltinDcMotorActuatorCfg]):
    """MuJoCo DC motor, driven by a position target, a velocity target, or an effort target (V).

    Torque = K (V - K w) / R at speed w, with motor constant K, resistance R and terminal voltage V,
    before cogging and friction. For a target u the controller applies, up to the voltage limit,

        V = kp (u - l) + ki x - kd w    in mode POSITION, with x the time integral of u - l,
        V = kp (u - w)                  in mode VELOCITY,
        V = u                           in mode VOLTAGE.

    Without load, mode VELOCITY settles at u kp / (kp + K).

    From datasheet voltage V, stall torque T and no-load speed w, MuJoCo computes K = V / w (both
    constants) and R = K V / T.

    MuJoCo's controller computes, from gains (p, i, d) in torque space and controls c,

        V = R/K (p (c_pos - l) + i x + d (c_vel - w)) + K w.

    Mode POSITION is p = kp K/R, i = ki K/R, d = (kd + K) K/R with control u. With d = (s + K) K/R
    and control g u / (s + K), the velocity input alone gives V = g u - s w: this is mode VELOCITY
    with s = g = kp, and mode VOLTAGE with a voltage limit or slew rate with s = 0, g = 1. MuJoCo's
    voltage input has no limits; it is used for mode VOLTAGE without limits.
    """

    _transient = {"_model"}

    def __init__(
        self,
        cfg: BuiltinDcMotorActuatorCfg,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """See `Actuator`. Warns of an integral gain in mode VELOCITY."""
        super().__init__(cfg, entity, target_ids, target_names)
        self._model: Any = None
        if cfg.mode == DcMotorInputMode.VELOCITY and cfg.integral_gain != 0.0:
            warnings.warn(
                f"{type(cfg).__name__} for {cfg.target_names_expr} integral_gain: expected 0 in mode "
                f"VELOCITY, got {cfg.integral_gain} without effect; use mode POSITION.",
                UserWarning,
                stacklevel=2,
            )

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """See `Actuator`."""
        super().initialize(mj_model, model, data, device)
        self._model = model

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """Command of the mode; a voltage is an effort target."""
        return (_COMMAND_OF_MODE[DcMotorInputMode(self.cfg.mode)],)

    @constant_within_step
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the controls, (N, n): the command in the units of MuJoCo's input."""
        command = super().compute(cmd)
        if self._input() != _INPUT_VELOCITY:
            return command
        # Read at each call, because gains may be randomized.
        gainprm = self._model.actuator_gainprm[:, self.global_element_ids]
        resistance, constant, damping = gainprm[..., 0], gainprm[..., 1], gainprm[..., 6]
        total = damping * resistance / constant  # s + K
        gain = 1.0 if self.cfg.mode == DcMotorInputMode.VOLTAGE else total - constant
        return command * (gain / total)

    def _input(self) -> int:
        """Return the MuJoCo motor input that receives the command."""
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
        """Return MuJoCo's (kp, ki, kd, slew rate, integral limit, voltage limit)."""
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
                f"BuiltinDcMotorActuatorCfg for {cfg.target_names_expr}: MuJoCo rejects motor_params "
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
