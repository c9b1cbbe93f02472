"""Randomization of actuator gains and effort limits.

Where these figures are depends on the kind of actuator: MuJoCo's own servos have them in the
model, actuators computed outside MuJoCo in tensors of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

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
    ABS,
    SCALE,
    Distribution,
    Operation,
    draw,
    read_bounds,
    resolve_distribution,
    resolve_operation,
)
from mjlab.managers.event_manager import requires_model_fields
from mjlab.utils.errors import WrongTypeError
from mjlab.utils.indexing import as_columns, as_ids

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mjlab.actuator import Actuator
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.dr._types import Distribution
    from mjlab.managers.scene_entity_config import SceneEntityCfg
    from mjlab.utils.mujoco import CommandField

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
    """Randomize stiffness and damping of actuators that have them.

    Of velocity servos only the damping changes, of DC motors in velocity mode only the stiffness.
    Gains are drawn independently per environment and actuator: for each actuator config first all
    stiffnesses, then all dampings.

    Args:
        env_ids: Environments to change; None means all.
        kp_range: Stiffness in the units of the actuator's config, or its factor with "scale".
        kd_range: Damping in the units of the actuator's config, or its factor with "scale".
        asset_cfg: Entity and actuators, each selected by its own name or index.
        distribution: "uniform", "log_uniform", or a `Distribution`.
        operation: "scale" multiplies the configured gains, "abs" replaces them.

    Raises:
        ValueError: another operation, or a DC motor that is driven by voltage or, in velocity mode,
            has a slew rate.
        TypeError: a selected actuator has no gains: motors and muscles have none.
    """
    dist, op = resolve_distribution(distribution), _scale_or_abs(operation, "pd_gains")
    bounds = read_bounds(kp_range, "kp_range"), read_bounds(kd_range, "kd_range")
    chosen = list(selected_actuators(env, as_ids(env_ids, env.num_envs, env.device), asset_cfg))
    places = [_gain_places(env, selected) for selected in chosen]
    for selected, gains in zip(chosen, places, strict=True):
        kp, kd = (selected.draw(dist, pair, env.device) for pair in bounds)
        actuator = selected.actuator
        if isinstance(actuator, IdealPdActuator):
            stiffness = _merged(selected, actuator.stiffness, actuator.default_stiffness, op, kp)
            damping = _merged(selected, actuator.damping, actuator.default_damping, op, kd)
            actuator.set_gains(selected.rows, kp=stiffness, kd=damping)
        elif isinstance(actuator, BuiltinDcMotorActuator):
            _set_dc_motor_gains(env, selected, op, kp, kd)
        for samples, targets in ((kp, gains.kp), (kd, gains.kd)):
            for place in targets:
                _write(env, selected.rows, selected.elements[place.element], place, op, samples)


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
    """Randomize the largest effort of actuators, drawn per environment and actuator.

    MuJoCo's own servos obey only if they were configured with an effort limit at all. The limit of
    a motor holds before its gear; that of a muscle is its peak force. Motors of the XML need a
    `forcerange` or a `ctrlrange`; both are written.

    Args:
        env_ids: Environments to change; None means all.
        effort_limit_range: Largest effort (N m or N), or its factor with "scale".
        asset_cfg: Entity and actuators, each selected by its own name or index.
        distribution: "uniform", "log_uniform", or a `Distribution`.
        operation: "scale" multiplies the configured limits, "abs" replaces them.

    Raises:
        ValueError: another operation.
        TypeError: a selected actuator is of a user's own kind, or takes efforts and comes from an
            XML that does not limit them.
    """
    dist, op = resolve_distribution(distribution), _scale_or_abs(operation, "effort_limits")
    bounds = read_bounds(effort_limit_range, "effort_limit_range")
    chosen = list(selected_actuators(env, as_ids(env_ids, env.num_envs, env.device), asset_cfg))
    places = [_limit_places(env, selected) for selected in chosen]
    for selected, (controls, targets) in zip(chosen, places, strict=True):
        samples = selected.draw(dist, bounds, env.device)
        actuator = selected.actuator
        if isinstance(actuator, IdealPdActuator):
            default = actuator.default_force_limit
            merged = _merged(selected, actuator.force_limit, default, op, samples)
            actuator.set_effort_limit(selected.rows, merged)
        for place in targets:
            values, at = samples, controls
            if place.field == "actuator_ctrlrange":
                at = env.sim.get_default_field("actuator_ctrladr")[controls]
                if op is ABS:
                    # Efforts are controls times the gain, which only motors of the XML have.
                    gains = _default(env, selected.rows, controls, "actuator_gainprm", 0)
                    values = samples / gains.abs()
            _write(env, selected.rows, at, place, op, values)


@dataclass(frozen=True)
class SelectedActuator:
    """The selected targets of one actuator object (one per actuator config)."""

    entity: Entity
    actuator: Actuator
    rows: torch.Tensor
    """Environment ids, (R,)."""
    targets: torch.Tensor
    """Positions of the selected targets inside the actuator, (K,)."""
    elements: torch.Tensor
    """Ids in the model of the MuJoCo actuators of these targets, (E, K); most kinds have E = 1."""

    def draw(
        self, distribution: Distribution, bounds: tuple[float, float], device: str
    ) -> torch.Tensor:
        """Draw one number per environment and target, (R, K)."""
        return draw(distribution, bounds, (len(self.rows), len(self.targets)), device)


def selected_actuators(
    env: ManagerBasedRlEnv, rows: torch.Tensor, asset_cfg: SceneEntityCfg
) -> Iterator[SelectedActuator]:
    """Yield the actuator objects of an entity that own selected actuators.

    `asset_cfg.actuator_ids` counts single actuators, as `actuator_names` does.
    """
    entity: Entity = env.scene[asset_cfg.name]
    chosen = entity.data.indexing.actuator_ids[as_columns(asset_cfg.actuator_ids, env.device)]
    for actuator in entity.actuators:
        ids, count = actuator.global_element_ids, len(actuator.target_names)
        # Kinds of a user's own may have another layout; who needs single elements refuses them.
        elements = ids.reshape(-1, count) if len(ids) % count == 0 else ids[None, :]
        is_chosen = torch.isin(elements, chosen.to(elements.dtype)).any(dim=0)
        targets = is_chosen.nonzero().flatten()
        if len(targets):
            yield SelectedActuator(entity, actuator, rows, targets, elements[:, targets].long())


# Gains: their places in the model.


class Place(NamedTuple):
    """Where a figure stands in the model."""

    field: str
    axis: int
    sign: float
    element: int = 0
    """Which of a target's MuJoCo actuators."""


class Gains(NamedTuple):
    """Places of the two gains."""

    kp: tuple[Place, ...]
    kd: tuple[Place, ...]


_SERVO_GAINS = Gains(
    kp=(Place("actuator_gainprm", 0, 1.0), Place("actuator_biasprm", 1, -1.0)),
    kd=(Place("actuator_biasprm", 2, -1.0),),
)

# A velocity servo has no stiffness.
_VELOCITY_GAINS = Gains(
    kp=(), kd=(Place("actuator_gainprm", 0, 1.0), Place("actuator_biasprm", 2, -1.0))
)

# A `<pid>` has its integral gain where a servo has the gain of its control.
_PID_GAINS = Gains(
    kp=(Place("actuator_biasprm", 1, -1.0),), kd=(Place("actuator_biasprm", 2, -1.0),)
)

# Two MuJoCo actuators a target: the first follows the position, the second the velocity.
_PD_GAINS = Gains(
    kp=(Place("actuator_gainprm", 0, 1.0, 0), Place("actuator_biasprm", 1, -1.0, 0)),
    kd=(Place("actuator_gainprm", 0, 1.0, 1), Place("actuator_biasprm", 2, -1.0, 1)),
)


def _gain_places(env: ManagerBasedRlEnv, selected: SelectedActuator) -> Gains:
    """Return where an actuator's gains are in the model; nowhere if they are not there as such."""
    actuator = selected.actuator
    if isinstance(actuator, IdealPdActuator):
        return Gains((), ())
    if isinstance(actuator, BuiltinPdActuator):
        return _PD_GAINS
    if isinstance(actuator, BuiltinDcMotorActuator):
        if actuator.cfg.mode == DcMotorInputMode.VOLTAGE:
            raise ValueError(
                f"pd_gains: the DC motors {list(actuator.target_names)} are driven by voltage and "
                "have no gains. Select other actuators, or use position or velocity mode."
            )
        if actuator.cfg.mode == DcMotorInputMode.VELOCITY and actuator.cfg.slew_rate > 0.0:
            raise ValueError(
                f"pd_gains: the DC motors {list(actuator.target_names)} have a slew_rate in "
                "velocity mode, which MuJoCo scales with their gain. Select other actuators, or "
                "set slew_rate to 0."
            )
        return Gains((), ())
    if isinstance(actuator, XmlActuator):
        kinds = env.sim.mj_model.actuator_gaintype[selected.elements[0].tolist()]
        if (kinds == mujoco.mjtGain.mjGAIN_PID).all():
            return _PID_GAINS
        if (kinds != mujoco.mjtGain.mjGAIN_FIXED).any():
            raise WrongTypeError(_refusal("pd_gains", actuator, _WITH_GAINS))
    if _reads(actuator, "position", BuiltinPositionActuator):
        return _SERVO_GAINS
    if _reads(actuator, "velocity", BuiltinVelocityActuator):
        return _VELOCITY_GAINS
    raise WrongTypeError(_refusal("pd_gains", actuator, _WITH_GAINS))


_WITH_GAINS = (
    "position and velocity servos (builtin or XML), <pid> of the XML, BuiltinPdActuator, "
    "BuiltinDcMotorActuator, IdealPdActuator and its subclasses"
)


# Effort limits: their places in the model.


def _range_of(field: str) -> tuple[Place, ...]:
    return Place(field, 0, -1.0), Place(field, 1, 1.0)


_FORCE_RANGE = _range_of("actuator_forcerange")
_MOTOR_RANGES = (*_FORCE_RANGE, *_range_of("actuator_ctrlrange"))

# The peak force of a muscle, and the figure from which MuJoCo takes it where it is negative. Both
# stand twice, for the active and the passive force.
_MUSCLE_FORCE = tuple(
    Place(field, axis, 1.0) for field in ("actuator_gainprm", "actuator_biasprm") for axis in (2, 3)
)


def _limit_places(
    env: ManagerBasedRlEnv, selected: SelectedActuator
) -> tuple[torch.Tensor, tuple[Place, ...]]:
    """Return model ids and places of the effort limits of the selected targets."""
    actuator, elements = selected.actuator, selected.elements[0]
    if isinstance(actuator, IdealPdActuator):
        # `set_effort_limit` carries the limit over to the ranges of the MuJoCo motor behind it.
        return elements, ()
    if isinstance(actuator, BuiltinPdActuator):
        indexing, targets = selected.entity.data.indexing, actuator.target_ids[selected.targets]
        if actuator.transmission_type == TransmissionType.JOINT:
            return indexing.joint_ids[targets].long(), _range_of("jnt_actfrcrange")
        return indexing.tendon_ids[targets].long(), _range_of("tendon_actfrcrange")
    if isinstance(actuator, XmlActuator) and actuator.command_fields == ("effort",):
        return elements, _xml_effort_places(env, selected)
    if isinstance(actuator, _FORCE_LIMITED):
        return elements, _FORCE_RANGE
    if isinstance(actuator, BuiltinMotorActuator):
        return elements, _MOTOR_RANGES
    if isinstance(actuator, BuiltinMuscleActuator):
        return elements, _MUSCLE_FORCE
    raise WrongTypeError(_refusal("effort_limits", actuator, "every kind that mjlab.actuator has"))


_FORCE_LIMITED = (
    BuiltinDcMotorActuator,
    BuiltinPositionActuator,
    BuiltinVelocityActuator,
    XmlActuator,
)

# Kinds of activation that follow the control, so that its range limits the effort too.
_FOLLOWING = (
    int(mujoco.mjtDyn.mjDYN_NONE),
    int(mujoco.mjtDyn.mjDYN_FILTER),
    int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
)


def _xml_effort_places(env: ManagerBasedRlEnv, selected: SelectedActuator) -> tuple[Place, ...]:
    """Return the places for XML actuators driven by effort; refuse where no place has an effect."""
    model, ids = env.sim.mj_model, selected.elements[0].tolist()
    if (model.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_MUSCLE).all():
        return _MUSCLE_FORCE
    # The force of a motor is its control times a gain.
    motors = (
        (model.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_FIXED)
        & (model.actuator_biastype[ids] == mujoco.mjtBias.mjBIAS_NONE)
        & np.isin(model.actuator_dyntype[ids], _FOLLOWING)
        & (model.actuator_gainprm[ids, 0] != 0.0)
    )
    by_control = bool(motors.all())
    idle = [
        selected.actuator.target_names[target]
        for i, target in zip(ids, selected.targets.tolist(), strict=True)
        if not (
            model.actuator_forcelimited[i]
            or (by_control and model.actuator_ctrllimited[model.actuator_ctrladr[i]])
        )
    ]
    if idle:
        raise WrongTypeError(
            f"effort_limits: the XML actuators on {idle} have no effort limit that could be "
            f"written. Give them a forcerange{' or a ctrlrange' if by_control else ''} in the XML, "
            "or select others by name; motors and muscles have to be selected by one event each."
        )
    return _MOTOR_RANGES if by_control else _FORCE_RANGE


def _reads(actuator: Actuator, command: CommandField, builtin: type[Actuator]) -> bool:
    """Return whether it is a MuJoCo servo for this command, builtin or of the XML."""
    if isinstance(actuator, XmlActuator):
        return actuator.command_fields == (command,)
    return isinstance(actuator, builtin)


def _refusal(function: str, actuator: Actuator, supported: str) -> str:
    kind = type(actuator).__name__
    if isinstance(actuator, XmlActuator):
        kind += f" with command field {', '.join(actuator.command_fields)!r}"
    return (
        f"{function}: the actuators {list(actuator.target_names)} are of kind {kind}, which it "
        f"cannot randomize. Supported: {supported}. Select others by name."
    )


# Writing.


def _scale_or_abs(operation: Operation | str, function: str) -> Operation:
    op = resolve_operation(operation)
    if op not in (SCALE, ABS):
        raise ValueError(f"{function} knows the operations 'scale' and 'abs', got {op.name!r}.")
    return op


def _default(
    env: ManagerBasedRlEnv, rows: torch.Tensor, columns: torch.Tensor, field: str, axis: int
) -> torch.Tensor:
    """Return compile-time values, (C,) or, where variants differ in them, (R, C)."""
    default = env.sim.get_default_field(field)
    if field in env.sim.per_world_default_fields:
        return default[rows[:, None], columns[None, :], axis]
    return default[columns, axis]


def _write(
    env: ManagerBasedRlEnv,
    rows: torch.Tensor,
    columns: torch.Tensor,
    place: Place,
    op: Operation,
    samples: torch.Tensor,
) -> None:
    if op is SCALE:
        samples = _default(env, rows, columns, place.field, place.axis) * samples
    else:
        samples = place.sign * samples
    model_field(env, place.field)[rows[:, None], columns[None, :], place.axis] = samples


def _set_dc_motor_gains(
    env: ManagerBasedRlEnv,
    selected: SelectedActuator,
    op: Operation,
    kp: torch.Tensor,
    kd: torch.Tensor,
) -> None:
    """Write gains in volts to MuJoCo's gains in torque; see `BuiltinDcMotorActuator`.

    A gain g on the speed is stored as (g + K) K/R, one on the position as g K/R.
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
        unit = default(axis) - offset if op is SCALE else torque_per_volt
        values = offset + unit * samples
        model_field(env, "actuator_gainprm")[selected.rows[:, None], columns[None, :], axis] = (
            values
        )


def _merged(
    selected: SelectedActuator,
    current: torch.Tensor | None,
    default: torch.Tensor | None,
    op: Operation,
    samples: torch.Tensor,
) -> torch.Tensor:
    """Return the rows of a parameter (R, n) with new values for the selected targets."""
    assert current is not None
    assert default is not None
    merged = current[selected.rows].clone()
    base = default[selected.rows][:, selected.targets]
    merged[:, selected.targets] = base * samples if op is SCALE else samples
    return merged
