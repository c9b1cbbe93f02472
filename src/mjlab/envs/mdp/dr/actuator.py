"""Randomization of actuator gains and effort limits.

MuJoCo's servos store these parameters in the model; actuators computed outside MuJoCo store them in
tensors.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
import torch

from mjlab.actuator import (
    BuiltinDcMotorActuator,
    BuiltinMotorActuator,
    BuiltinMuscleActuator,
    BuiltinPdActuator,
    BuiltinPositionActuator,
    BuiltinVelocityActuator,
    DcMotorInputMode,
    IdealPdActuator,
    XmlActuator,
)
from mjlab.actuator.actuator import TransmissionType
from mjlab.compat import older_names
from mjlab.envs.mdp.dr._core import ROBOT, model_field
from mjlab.envs.mdp.dr._types import (
    Distribution,
    Operation,
    draw,
    read_bounds,
    resolve_distribution,
    resolve_operation,
)
from mjlab.managers.event_manager import requires_model_fields
from mjlab.managers.scene_entity_config import columns_of
from mjlab.utils.errors import WrongTypeError, check_one_of
from mjlab.utils.indexing import as_ids

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mjlab.actuator import Actuator
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.dr._types import Distribution
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = ["effort_limits", "pd_gains"]

__getattr__ = older_names(__name__)


@requires_model_fields("actuator_gainprm", "actuator_biasprm")
def pd_gains(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    kp_range: tuple[float, float],
    kd_range: tuple[float, float],
    asset_cfg: SceneEntityCfg = ROBOT,
    distribution: Distribution | str = "uniform",
    operation: Operation | str = "scale",
) -> None:
    """Randomize stiffness and damping of actuators.

    Velocity servos have only damping; DC motors in velocity mode have only stiffness. Gains are
    sampled independently per environment and actuator: for each actuator config first all
    stiffnesses, then all dampings.

    Args:
        env_ids: Environments to change. None: all.
        kp_range: Stiffness in the units of the actuator's config, or its factor with "scale".
        kd_range: Damping in the units of the actuator's config, or its factor with "scale".
        asset_cfg: Entity and actuators, selected individually by name or index.
        distribution: "uniform", "log_uniform", or a `Distribution`.
        operation: "scale" multiplies the configured gains, "abs" replaces them; or an `Operation`.

    Raises:
        ValueError: unsupported operation, DC motor in voltage mode, or DC motor in velocity mode
            with a slew rate.
        TypeError: a selected actuator has no gains, such as a motor or a muscle.
    """
    dist, op = resolve_distribution(distribution), _operation("pd_gains", operation)
    bounds = _first_two(kp_range, "kp_range"), _first_two(kd_range, "kd_range")
    chosen = list(selected_actuators(env, as_ids(env_ids, env.num_envs, env.device), asset_cfg))
    locations = [_locate_gains(env, selected) for selected in chosen]
    for selected, gains in zip(chosen, locations, strict=True):
        kp, kd = (selected.draw(dist, pair, env.device) for pair in bounds)
        actuator = selected.actuator
        if isinstance(actuator, IdealPdActuator):
            stiffness = _merged(selected, actuator.stiffness, actuator.default_stiffness, op, kp)
            damping = _merged(selected, actuator.damping, actuator.default_damping, op, kd)
            actuator.set_gains(selected.rows, kp=stiffness, kd=damping)
        elif isinstance(actuator, BuiltinDcMotorActuator):
            _set_dc_motor_gains(env, selected, op, kp, kd)
        for samples, targets in ((kp, gains.kp), (kd, gains.kd)):
            for parameter in targets:
                columns = selected.elements[parameter.element]
                _write(env, selected.rows, columns, parameter, op, samples)


@requires_model_fields(
    *("actuator_forcerange", "actuator_ctrlrange", "jnt_actfrcrange", "tendon_actfrcrange"),
    *("actuator_gainprm", "actuator_biasprm"),
)
def effort_limits(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    effort_limit_range: tuple[float, float],
    asset_cfg: SceneEntityCfg = ROBOT,
    distribution: Distribution | str = "uniform",
    operation: Operation | str = "scale",
) -> None:
    """Randomize effort limits of actuators, sampled per environment and actuator.

    MuJoCo's servos apply the limit only if they were configured with one. The limit of a motor
    applies before its gear; that of a muscle is its peak force. XML motors need a `forcerange` or a
    `ctrlrange`; both are written.

    Args:
        env_ids: Environments to change. None: all.
        effort_limit_range: Effort limit (N m or N), or its factor with "scale".
        asset_cfg: Entity and actuators, selected individually by name or index.
        distribution: "uniform", "log_uniform", or a `Distribution`.
        operation: "scale" multiplies the configured limits, "abs" replaces them; or an `Operation`.

    Raises:
        ValueError: unsupported operation.
        TypeError: a selected actuator is of a custom type, or is an XML actuator with effort
            commands but without an effort limit.
    """
    dist, op = resolve_distribution(distribution), _operation("effort_limits", operation)
    bounds = _first_two(effort_limit_range, "effort_limit_range")
    chosen = list(selected_actuators(env, as_ids(env_ids, env.num_envs, env.device), asset_cfg))
    locations = [_locate_limits(env, selected) for selected in chosen]
    for selected, (columns, targets) in zip(chosen, locations, strict=True):
        samples = selected.draw(dist, bounds, env.device)
        actuator = selected.actuator
        if isinstance(actuator, IdealPdActuator):
            default = actuator.default_force_limit
            merged = _merged(selected, actuator.force_limit, default, op, samples)
            actuator.set_effort_limit(selected.rows, merged)
        for parameter in targets:
            at, unit = columns, None
            if parameter.field == "actuator_ctrlrange":
                at = env.sim.get_default_field("actuator_ctrladr")[columns]
                # Effort = control * gain; only XML motors have a gain other than 1.
                unit = _default(env, selected.rows, columns, "actuator_gainprm", 0).abs()
            _write(env, selected.rows, at, parameter, op, samples, unit)


def _first_two(bounds: Any, name: str) -> tuple[float, float]:
    """Return the first two numbers of a range; warn of more."""
    if isinstance(bounds, (tuple, list)) and len(bounds) > 2:
        warnings.warn(
            f"{name}: expected a pair of numbers, got {bounds!r}; using the first two.",
            UserWarning,
            stacklevel=3,
        )
        bounds = bounds[:2]
    return read_bounds(bounds, name)


def _operation(function: str, operation: Operation | str) -> Operation:
    """Return the operation; raise `ValueError` for a name other than "scale" and "abs"."""
    if not isinstance(operation, Operation):
        check_one_of(f"{function} operation", operation, ("scale", "abs"))
    return resolve_operation(operation)


@dataclass(frozen=True)
class SelectedActuator:
    """Selected targets of one actuator object (one per actuator config)."""

    entity: Entity
    actuator: Actuator
    rows: torch.Tensor
    """Environment ids, (R,)."""
    targets: torch.Tensor
    """Indices of the selected targets within the actuator object, (K,)."""
    elements: torch.Tensor
    """Model ids of the MuJoCo actuators of these targets, (E, K); E = 1 for most types."""

    def draw(
        self, distribution: Distribution, bounds: tuple[float, float], device: str
    ) -> torch.Tensor:
        """Sample one number per environment and target, (R, K)."""
        return draw(distribution, bounds, (len(self.rows), len(self.targets)), device)


def selected_actuators(
    env: ManagerBasedRlEnv, rows: torch.Tensor, asset_cfg: SceneEntityCfg
) -> Iterator[SelectedActuator]:
    """Yield the actuator objects of an entity with selected actuators.

    `asset_cfg.actuator_ids` indexes individual actuators, in the order of `actuator_names`.
    """
    entity: Entity = env.scene[asset_cfg.name]
    chosen = entity.data.indexing.actuator_ids[columns_of(asset_cfg, "actuator", env)]
    for actuator in entity.actuators:
        ids, count = actuator.global_element_ids, len(actuator.target_names)
        # Custom actuators may have another layout; functions that need it reject them.
        elements = ids.reshape(-1, count) if len(ids) % count == 0 else ids[None, :]
        is_chosen = torch.isin(elements, chosen.to(elements.dtype)).any(dim=0)
        targets = is_chosen.nonzero().flatten()
        if len(targets):
            yield SelectedActuator(entity, actuator, rows, targets, elements[:, targets].long())


# Gains in the model.


class Parameter(NamedTuple):
    """Location of an actuator parameter in the model."""

    field: str
    axis: int
    sign: float
    element: int = 0
    """Index among the target's MuJoCo actuators."""


class Gains(NamedTuple):
    """Locations of stiffness and damping in the model."""

    kp: tuple[Parameter, ...]
    kd: tuple[Parameter, ...]


_SERVO_GAINS = Gains(
    kp=(Parameter("actuator_gainprm", 0, 1.0), Parameter("actuator_biasprm", 1, -1.0)),
    kd=(Parameter("actuator_biasprm", 2, -1.0),),
)

# Velocity servos have no stiffness.
_VELOCITY_GAINS = Gains(
    kp=(), kd=(Parameter("actuator_gainprm", 0, 1.0), Parameter("actuator_biasprm", 2, -1.0))
)

# gainprm[0] of a `<pid>` is the integral gain, not the gain of the control.
_PID_GAINS = Gains(
    kp=(Parameter("actuator_biasprm", 1, -1.0),), kd=(Parameter("actuator_biasprm", 2, -1.0),)
)

# Two MuJoCo actuators per target: the first tracks position, the second velocity.
_PD_GAINS = Gains(
    kp=(Parameter("actuator_gainprm", 0, 1.0, 0), Parameter("actuator_biasprm", 1, -1.0, 0)),
    kd=(Parameter("actuator_gainprm", 0, 1.0, 1), Parameter("actuator_biasprm", 2, -1.0, 1)),
)


def _locate_gains(env: ManagerBasedRlEnv, selected: SelectedActuator) -> Gains:
    """Return the model locations of an actuator's gains; empty if the model does not hold them."""
    actuator = selected.actuator
    if isinstance(actuator, IdealPdActuator):
        return Gains((), ())
    if isinstance(actuator, BuiltinPdActuator):
        return _PD_GAINS
    if isinstance(actuator, BuiltinDcMotorActuator):
        if actuator.cfg.mode == DcMotorInputMode.VOLTAGE:
            raise ValueError(
                f"pd_gains: DC motors {list(actuator.target_names)} in voltage mode have no gains; "
                "select other actuators, or use position or velocity mode."
            )
        if actuator.cfg.mode == DcMotorInputMode.VELOCITY and actuator.cfg.slew_rate > 0.0:
            raise ValueError(
                f"pd_gains: DC motors {list(actuator.target_names)} in velocity mode have a "
                "slew_rate, and MuJoCo scales it with the gain; select other actuators, or set "
                "slew_rate to 0."
            )
        return Gains((), ())
    if isinstance(actuator, XmlActuator):
        kinds = env.sim.mj_model.actuator_gaintype[selected.elements[0].tolist()]
        if (kinds == mujoco.mjtGain.mjGAIN_PID).all():
            return _PID_GAINS
        if (kinds != mujoco.mjtGain.mjGAIN_FIXED).any():
            raise WrongTypeError(_unsupported("pd_gains", actuator, _TYPES_WITH_GAINS))
    if isinstance(actuator, (XmlActuator, BuiltinPositionActuator, BuiltinVelocityActuator)):
        servos: dict[tuple[str, ...], Gains] = {
            ("position",): _SERVO_GAINS,
            ("velocity",): _VELOCITY_GAINS,
        }
        if actuator.command_fields in servos:
            return servos[actuator.command_fields]
    raise WrongTypeError(_unsupported("pd_gains", actuator, _TYPES_WITH_GAINS))


_TYPES_WITH_GAINS = (
    "position and velocity servos (builtin or XML), XML <pid>, BuiltinPdActuator, "
    "BuiltinDcMotorActuator, IdealPdActuator and its subclasses"
)


# Effort limits in the model.


def _range_of(field: str) -> tuple[Parameter, ...]:
    return Parameter(field, 0, -1.0), Parameter(field, 1, 1.0)


_FORCE_RANGE = _range_of("actuator_forcerange")
_MOTOR_RANGES = (*_FORCE_RANGE, *_range_of("actuator_ctrlrange"))

# Peak force of a muscle, and the scale MuJoCo computes it from if it is negative. Both are stored
# twice, for the active (gainprm) and the passive (biasprm) force.
_MUSCLE_FORCE = tuple(
    Parameter(field, axis, 1.0)
    for field in ("actuator_gainprm", "actuator_biasprm")
    for axis in (2, 3)
)


def _locate_limits(
    env: ManagerBasedRlEnv, selected: SelectedActuator
) -> tuple[torch.Tensor, tuple[Parameter, ...]]:
    """Return model ids and locations of the effort limits of the selected targets."""
    actuator, elements = selected.actuator, selected.elements[0]
    if isinstance(actuator, IdealPdActuator):
        # `set_effort_limit` also sets the ranges of the underlying MuJoCo motor.
        return elements, ()
    if isinstance(actuator, BuiltinPdActuator):
        indexing, targets = selected.entity.data.indexing, actuator.target_ids[selected.targets]
        if actuator.transmission_type == TransmissionType.JOINT:
            return indexing.joint_ids[targets].long(), _range_of("jnt_actfrcrange")
        return indexing.tendon_ids[targets].long(), _range_of("tendon_actfrcrange")
    if isinstance(actuator, XmlActuator) and actuator.command_fields == ("effort",):
        return elements, _locate_xml_limits(env, selected)
    if isinstance(actuator, _FORCE_LIMITED):
        return elements, _FORCE_RANGE
    if isinstance(actuator, BuiltinMotorActuator):
        return elements, _MOTOR_RANGES
    if isinstance(actuator, BuiltinMuscleActuator):
        return elements, _MUSCLE_FORCE
    raise WrongTypeError(_unsupported("effort_limits", actuator, "all types of mjlab.actuator"))


_FORCE_LIMITED = (
    BuiltinDcMotorActuator,
    BuiltinPositionActuator,
    BuiltinVelocityActuator,
    XmlActuator,
)

# Activation dynamics that follow the control, so that `ctrlrange` limits the effort too.
_CTRL_DYNAMICS = (
    int(mujoco.mjtDyn.mjDYN_NONE),
    int(mujoco.mjtDyn.mjDYN_FILTER),
    int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
)


def _locate_xml_limits(env: ManagerBasedRlEnv, selected: SelectedActuator) -> tuple[Parameter, ...]:
    """Return the effort limits of XML actuators with effort commands; raise if one has no limit."""
    model, ids = env.sim.mj_model, selected.elements[0].tolist()
    if (model.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_MUSCLE).all():
        return _MUSCLE_FORCE
    # The force of a motor is control * gain.
    motors = (
        (model.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_FIXED)
        & (model.actuator_biastype[ids] == mujoco.mjtBias.mjBIAS_NONE)
        & np.isin(model.actuator_dyntype[ids], _CTRL_DYNAMICS)
        & (model.actuator_gainprm[ids, 0] != 0.0)
    )
    by_control = bool(motors.all())
    unlimited = [
        selected.actuator.target_names[target]
        for i, target in zip(ids, selected.targets.tolist(), strict=True)
        if not (
            model.actuator_forcelimited[i]
            or (by_control and model.actuator_ctrllimited[model.actuator_ctrladr[i]])
        )
    ]
    if unlimited:
        raise WrongTypeError(
            f"effort_limits: XML actuators on {unlimited} have no effort limit; set "
            f"forcerange{' or ctrlrange' if by_control else ''} in the XML, or select other "
            "actuators by name. Motors and muscles need separate events."
        )
    return _MOTOR_RANGES if by_control else _FORCE_RANGE


def _unsupported(function: str, actuator: Actuator, supported: str) -> str:
    kind = type(actuator).__name__
    if isinstance(actuator, XmlActuator):
        kind += f" with command field {', '.join(actuator.command_fields)!r}"
    return (
        f"{function}: actuators {list(actuator.target_names)} of type {kind} are not supported; "
        f"select other actuators by name. Supported: {supported}."
    )


# Write.


def _default(
    env: ManagerBasedRlEnv, rows: torch.Tensor, columns: torch.Tensor, field: str, axis: int
) -> torch.Tensor:
    """Return compile-time values, (C,), or (R, C) if variants differ in them."""
    default = env.sim.get_default_field(field)
    if field in env.sim.per_world_default_fields:
        return default[rows[:, None], columns[None, :], axis]
    return default[columns, axis]


def _write(
    env: ManagerBasedRlEnv,
    rows: torch.Tensor,
    columns: torch.Tensor,
    parameter: Parameter,
    op: Operation,
    samples: torch.Tensor,
    unit: torch.Tensor | None = None,
) -> None:
    """Write a parameter in the samples' units: the field times `sign` and, if given, `unit`."""
    field, index = parameter.field, (rows[:, None], columns[None, :], parameter.axis)
    base = parameter.sign * _base(env, rows, columns, field, parameter.axis, op)
    new = op.combine(base, samples) if unit is None else op.combine(base * unit, samples) / unit
    model_field(env, field)[index] = parameter.sign * new


def _base(
    env: ManagerBasedRlEnv,
    rows: torch.Tensor,
    columns: torch.Tensor,
    field: str,
    axis: int,
    op: Operation,
) -> torch.Tensor:
    """Return the values that the operation starts from, (R, C)."""
    if op.uses_defaults:
        return _default(env, rows, columns, field, axis).expand(len(rows), len(columns))
    return model_field(env, field)[rows[:, None], columns[None, :], axis]


def _set_dc_motor_gains(
    env: ManagerBasedRlEnv,
    selected: SelectedActuator,
    op: Operation,
    kp: torch.Tensor,
    kd: torch.Tensor,
) -> None:
    """Convert voltage gains to MuJoCo's torque gains and write them; see `BuiltinDcMotorActuator`.

    A velocity gain g is stored as (g + K) K/R, a position gain g as g K/R.
    """
    columns = selected.elements[0]

    def default(axis: int) -> torch.Tensor:
        return _default(env, selected.rows, columns, "actuator_gainprm", axis)

    resistance, constant = default(0), default(1)
    torque_per_volt, back_emf = constant / resistance, constant**2 / resistance
    if selected.actuator.cfg.mode == DcMotorInputMode.VELOCITY:
        written = ((6, back_emf, kp),)
    else:
        written = ((4, torch.zeros_like(back_emf), kp), (6, back_emf, kd))
    for axis, offset, samples in written:
        stored = _base(env, selected.rows, columns, "actuator_gainprm", axis, op)
        new = op.combine((stored - offset) / torque_per_volt, samples)
        model_field(env, "actuator_gainprm")[selected.rows[:, None], columns[None, :], axis] = (
            offset + torque_per_volt * new
        )


def _merged(
    selected: SelectedActuator,
    current: torch.Tensor | None,
    default: torch.Tensor | None,
    op: Operation,
    samples: torch.Tensor,
) -> torch.Tensor:
    """Return the rows of a parameter, (R, n), with new values for the selected targets."""
    assert current is not None
    assert default is not None
    merged = current[selected.rows].clone()
    base = (default if op.uses_defaults else current)[selected.rows][:, selected.targets]
    merged[:, selected.targets] = op.combine(base, samples)
    return merged
