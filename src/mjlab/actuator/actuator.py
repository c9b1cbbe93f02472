"""What all actuators share: config, command, delay, and the life of an actuator.

An `Actuator` object stands for one `ActuatorCfg` of an entity, and so for all joints, tendons or
sites (its *targets*) that the config's patterns match. It adds MuJoCo actuators (*elements*) to the
spec, and in every physics substep turns the entity's commands into their controls.

An environment step runs `decimation` physics substeps. If no actuator and no sensor acts between
them, the engine runs all of them in one dispatch, which makes CPU runs several times as fast.
`constant_within_step` marks methods that allow this.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import mujoco
import torch

from mjlab.utils.buffers import DelayBuffer
from mjlab.utils.errors import (
    UnsupportedError,
    WrongStateError,
    check_in_range,
    check_one_of,
    check_positive,
)
from mjlab.utils.indexing import Columns, EnvIds, read_columns, write_columns
from mjlab.utils.mujoco import CommandField as CommandField
from mjlab.utils.mujoco import control_columns
from mjlab.utils.spec import TransmissionType as TransmissionType
from mjlab.utils.spec import apply_target_overrides
from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.entity.data import EntityData
    from mjlab.entity.entity import Entity


@dataclass(kw_only=True)
class ActuatorCfg(ABC):
    """What every actuator config has. Delays count physics substeps.

    Raises `ValueError`, when it is made and again when the actuator is built, for figures that make
    no sense.
    """

    target_names_expr: tuple[str, ...]
    """Regular expressions for the names of the targets; each must match a whole name."""
    transmission_type: TransmissionType = TransmissionType.JOINT
    """Whether the targets are joints, tendons or sites."""
    armature: float | None = None
    """Reflected rotor inertia written to the targets (kg m^2, or kg); None keeps theirs."""
    frictionloss: float | None = None
    """Dry friction written to the targets (N m, or N); None keeps theirs."""
    viscous_damping: float | None = None
    """Passive linear damping written to the targets (N m s/rad, or N s/m); None keeps theirs."""
    delay_min_lag: int = 0
    """Smallest delay of a command, in physics substeps."""
    delay_max_lag: int = 0
    """Largest delay of a command, in physics substeps; 0 for none."""
    delay_hold_prob: float = 0.0
    """Probability to keep the old lag when a new one would be drawn."""
    delay_update_period: int = 0
    """Substeps between draws of the lag; 0 draws at every substep."""
    delay_per_env_phase: bool = True
    """Whether environments draw their lags at different substeps of the period."""

    # Kinds that read a position or velocity cannot act on a site, which has none.
    _accepts_site: ClassVar[bool] = True
    # Fields that must be above 0 where they are not None.
    _positive: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if isinstance(self.target_names_expr, str):
            raise ValueError(
                f"{type(self).__name__}.target_names_expr is the string "
                f"{self.target_names_expr!r}; give a tuple of patterns, "
                f"({self.target_names_expr!r},)."
            )
        self.validate()

    def validate(self) -> None:
        """Check the figures; see the class. Subclasses extend it."""
        kinds = [kind.value for kind in TransmissionType]
        check_one_of(self._label("transmission_type"), self.transmission_type, kinds)
        # Configs may also say "joint".
        self.transmission_type = TransmissionType(self.transmission_type)
        on_site = self.transmission_type == TransmissionType.SITE
        if on_site and not self._accepts_site:
            raise ValueError(
                f"{self._label('transmission_type')}: a site has no position or velocity to "
                "control; use a joint or a tendon, or BuiltinMotorActuatorCfg or IdealPdActuatorCfg."
            )
        for name, low, high in (
            ("delay_min_lag", 0, math.inf),
            ("delay_max_lag", self.delay_min_lag, math.inf),
            ("delay_hold_prob", 0.0, 1.0),
            ("delay_update_period", 0, math.inf),
        ):
            check_in_range(self._label(name), getattr(self, name), low, high)
        for name in ("armature", "frictionloss", "viscous_damping"):
            value = getattr(self, name) or 0.0
            check_in_range(self._label(name), value, 0.0, math.inf)
            if on_site and value:
                raise ValueError(f"{self._label(name)}: expected None for a site, got {value}.")
        for name in self._positive:
            value = getattr(self, name)
            if value is not None:
                check_positive(self._label(name), value)

    @abstractmethod
    def build(self, entity: Entity, target_ids: list[int], target_names: list[str]) -> Actuator:
        """Return the actuator for these targets (indices and names within the entity)."""

    def _label(self, field: str) -> str:
        """Return how errors name a field."""
        return f"{type(self).__name__} for {self.target_names_expr}: {field}"


ActuatorCfgT = TypeVar("ActuatorCfgT", bound=ActuatorCfg)


@stateful
class Actuator(ABC, Generic[ActuatorCfgT]):
    """Turns commands for its targets into controls of MuJoCo actuators.

    To write your own: in `edit_spec` add one element a target and append it to
    `self._mjs_actuators`, and in `compute` return the controls, (N, number of controls). Keep what
    changes at run time in tensor attributes, so that a resumed run finds it again. A `compute` that
    remembers earlier calls also overrides `compute_after_reset`.
    """

    _transient = {
        "cfg", "entity", "_mjs_actuators", "_target_ids_list", "_target_names", "_target_ids",
        "_ctrl_ids", "_global_ctrl_ids", "_global_element_ids", "_in_group", "_resets_delay",
    }  # fmt: skip

    def __init__(
        self,
        cfg: ActuatorCfgT,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """Store what the actuator is for. `target_ids` and `target_names` are the entity's."""
        # A config may have been changed since it was made.
        cfg.validate()
        self.cfg = cfg
        self.entity = entity
        self._target_ids_list = list(target_ids)
        self._target_names = list(target_names)
        self._mjs_actuators: list[mujoco.MjsActuator] = []
        self._target_ids: torch.Tensor | None = None
        self._ctrl_ids: torch.Tensor | None = None
        self._global_ctrl_ids: torch.Tensor | None = None
        self._global_element_ids: torch.Tensor | None = None
        self._delay_buffer: DelayBuffer | None = None
        self._in_group = False
        self._resets_delay = True

    # What it acts on.

    @property
    def target_names(self) -> list[str]:
        """Names of the targets within the entity."""
        return self._target_names

    @property
    def transmission_type(self) -> TransmissionType:
        """Whether the targets are joints, tendons or sites."""
        return self.cfg.transmission_type

    @property
    def target_ids(self) -> torch.Tensor:
        """(n,) int64 indices of the targets within the entity. Set by `initialize`."""
        return self._initialized(self._target_ids)

    @property
    def ctrl_ids(self) -> torch.Tensor:
        """(number of elements,) int64 ids of the elements in the entity, as `find_actuators` counts.

        `EntityData.write_ctrl` takes them, with the controls of each element in turn. `compute`
        gives controls in the order of `global_ctrl_ids`; both orders agree for elements with one
        control.
        """
        return self._initialized(self._ctrl_ids)

    @property
    def global_ctrl_ids(self) -> torch.Tensor:
        """(number of controls,) int64 columns of `ctrl` in the simulation.

        Most elements have one control. Of those with several, come all first ones, then all second.
        """
        return self._initialized(self._global_ctrl_ids)

    @property
    def global_element_ids(self) -> torch.Tensor:
        """(number of elements,) int64 ids of the elements in the model: rows of `actuator_gainprm`."""
        return self._initialized(self._global_element_ids)

    @property
    def has_delay(self) -> bool:
        """Whether commands are delayed."""
        return self.cfg.delay_max_lag > 0

    @property
    def needs_substep(self) -> bool:
        """Whether it has to act at every physics substep, not just once per environment step."""
        overrides_update = type(self).update is not Actuator.update
        return self.has_delay or overrides_update or not is_constant_within_step(type(self).compute)

    # Building.

    @abstractmethod
    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add the elements for `target_names`, names in `spec`, to it.

        Called once with all targets, or, where the entity sorts its actuators, once for each.
        """

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Find ids in the compiled model and allocate for `data.nworld` environments.

        Args:
            mj_model: The compiled model.
            model: The simulation's model fields.
            data: The simulation's data fields.
            device: Where tensors live.

        Raises:
            RuntimeError: `edit_spec` added no elements.
        """
        elements = self._ordered_elements()
        if not elements:
            raise WrongStateError(
                f"{type(self).__name__} for {self._target_names} has no MuJoCo actuators: its "
                "edit_spec must append what it adds to self._mjs_actuators, and run before the "
                "model is compiled."
            )
        # Actuators without a name can only be found by their place in the spec.
        own = [actuator.id for actuator in self.entity.spec.actuators]
        element_ids = [actuator.id for actuator in elements]
        by_element = [control_columns(mj_model, (i,)) for i in element_ids]
        columns = [
            ctrl[k]
            for k in range(max(map(len, by_element)))
            for ctrl in by_element
            if k < len(ctrl)
        ]
        self._target_ids = _int_tensor(self._target_ids_list, device)
        self._global_element_ids = _int_tensor(element_ids, device)
        self._global_ctrl_ids = _int_tensor(columns, device)
        self._ctrl_ids = _int_tensor([own.index(i) for i in element_ids], device)
        self._in_group, self._resets_delay, self._delay_buffer = False, True, None
        if self.has_delay:
            self._delay_buffer = self.make_delay_buffer(data.nworld, device)

    def make_delay_buffer(self, num_envs: int, device: str) -> DelayBuffer:
        """Return a new delay line with the config's settings."""
        cfg = self.cfg
        return DelayBuffer(
            min_lag=cfg.delay_min_lag,
            max_lag=cfg.delay_max_lag,
            batch_size=num_envs,
            device=device,
            hold_prob=cfg.delay_hold_prob,
            update_period=cfg.delay_update_period,
            per_env_phase=cfg.delay_per_env_phase,
        )

    def join_group(self, delay_buffer: DelayBuffer | None, resets_delay: bool) -> None:
        """Leave writing controls, and the delay, to a group of actuators.

        Exactly one of the actuators that share a line resets it.
        """
        self._in_group = True
        self._resets_delay = resets_delay
        self._delay_buffer = delay_buffer

    def _ordered_elements(self) -> list[mujoco.MjsActuator]:
        """Return the elements in the order of the columns that `compute` returns."""
        return self._mjs_actuators

    # Acting.

    def get_command(self, data: EntityData) -> ActuatorCmd:
        """Return copies of the commands and the feedback of the targets, (N, n) each."""
        return read_command(data, self.transmission_type, self.target_ids)

    def apply_delay(self, cmd: ActuatorCmd) -> ActuatorCmd:
        """Append the command to the delay line and return the delayed one; feedback stays.

        Raises:
            RuntimeError: a group runs this actuator's delay line, which a second call would spoil.
        """
        return self._delayed(cmd, None)

    @abstractmethod
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the controls of the elements, (N, number of controls)."""

    def compute_after_reset(self, cmd: ActuatorCmd, env_ids: torch.Tensor | slice) -> torch.Tensor:
        """As `compute`, but only the rows `env_ids`, which were just reset, are of interest.

        A `compute` that changes state must override this and change only the state of `env_ids`.
        """
        return self.compute(cmd)

    @staticmethod
    def control_law(params: dict[str, torch.Tensor], cmd: ActuatorCmd) -> torch.Tensor:
        """Return the controls as a function of parameters and command alone.

        Only kinds that can be evaluated together have one; see `FusedActuatorGroup`.
        """
        raise UnsupportedError("This kind of actuator has only `compute`, no control law.")

    def apply_controls(self, data: EntityData, env_ids: EnvIds = None) -> None:
        """Compute the controls of this actuator and write them to the simulation.

        With `env_ids`, which must just have been reset, nothing of any other environment changes.
        """
        if env_ids is None:
            ctrl = self.compute(self.apply_delay(self.get_command(data)))
        else:
            ctrl = self.compute_after_reset(self._delayed(self.get_command(data), env_ids), env_ids)
        write_columns(data.data.ctrl, self.global_ctrl_ids, ctrl, env_ids)

    def update(self, dt: float) -> None:
        """Called after every substep of `dt` seconds. Overriding it makes it run in each."""

    def reset(self, env_ids: EnvIds = None) -> None:
        """Forget the past of these environments: the delay line starts anew with a new lag."""
        if self._delay_buffer is not None and self._resets_delay:
            self._delay_buffer.reset(env_ids)

    def set_lags(self, lags: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Set the lags, (k,) integers, of environments until the next draw.

        They are clamped to the configured range. Actuators of one delay line share the lag.
        Without a configured delay the range is 0 to 0, so nothing changes.
        """
        if self._delay_buffer is not None:
            self._delay_buffer.set_lags(lags, env_ids)

    def _delayed(self, cmd: ActuatorCmd, env_ids: EnvIds) -> ActuatorCmd:
        if self._delay_buffer is None:
            return cmd
        if self._in_group:
            raise WrongStateError(
                f"The delay of {type(self).__name__} for {self._target_names} is run by its group, "
                "together with that of like actuators. Write controls through "
                "Entity.write_data_to_sim()."
            )
        targets = (cmd.position_target, cmd.velocity_target, cmd.effort_target)
        return ActuatorCmd(*delay_rows(self._delay_buffer, targets, env_ids), cmd.pos, cmd.vel)

    def _initialized(self, value: torch.Tensor | None) -> torch.Tensor:
        if value is None:
            raise WrongStateError(
                f"{type(self).__name__} for {self._target_names} is not initialized yet. Its ids "
                "are known after Scene.initialize()."
            )
        return value


# Work whose effect is the same at every substep of an environment step.

F = TypeVar("F", bound=Callable[..., Any])
_MARK = "_constant_within_step"


def constant_within_step(function: F) -> F:
    """Mark `function` as having the same effect at every substep of an environment step.

    A subclass that overrides the method loses the mark.
    """
    setattr(function, _MARK, True)
    return function


def is_constant_within_step(function: Callable[..., Any]) -> bool:
    """Return whether `function` (plain or bound) carries the mark of `constant_within_step`."""
    return bool(getattr(function, _MARK, False))


class DirectActuator(Actuator[ActuatorCfgT]):
    """An actuator whose controls are the commands in `command_fields`, one block of columns each.

    Many of them are written to the simulation at once, by `BuiltinActuatorGroup`. A subclass
    defines `command_fields`, and what it adds to the spec: `_add_element`, or all of `edit_spec`.
    """

    shares_delay: ClassVar[bool] = False
    """Whether actuators of this class with equal delay settings have one lag per environment."""

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """Which commands the elements read."""
        raise NotImplementedError(f"{type(self).__name__} must define command_fields.")

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add one element for each target, and write the config's properties to the target."""
        for name in target_names:
            self._mjs_actuators.append(self._add_element(spec, name))
            self._override_target(spec, name)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        """Add the element of one target to `spec` and return it."""
        raise NotImplementedError(
            f"{type(self).__name__} must define _add_element(spec, target_name), or edit_spec."
        )

    @constant_within_step
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the commands that the elements read, (N, number of controls)."""
        commands = [getattr(cmd, f"{field}_target") for field in self.command_fields]
        return commands[0] if len(commands) == 1 else torch.cat(commands, dim=1)

    def _override_target(self, spec: mujoco.MjSpec, target_name: str) -> None:
        """Write the config's armature, friction loss and damping to a target in `spec`."""
        apply_target_overrides(
            spec,
            target_name,
            self.transmission_type,
            armature=self.cfg.armature,
            frictionloss=self.cfg.frictionloss,
            viscous_damping=self.cfg.viscous_damping,
        )


# Commands.


@dataclass
class ActuatorCmd:
    """Commands and feedback of one actuator's targets, (N, number of targets) each."""

    position_target: torch.Tensor
    """Joint position (rad or m) or tendon length (m) to reach."""
    velocity_target: torch.Tensor
    """Velocity to reach (rad/s or m/s)."""
    effort_target: torch.Tensor
    """Force to add (N m or N), or another input, such as a voltage."""
    pos: torch.Tensor
    """Current position. It is never delayed."""
    vel: torch.Tensor
    """Current velocity. It is never delayed."""


# Fields of EntityData: three targets, position, velocity. None reads as zero.
_FIELDS = {
    TransmissionType.JOINT: (
        "joint_pos_target", "joint_vel_target", "joint_effort_target", "joint_pos", "joint_vel",
    ),
    TransmissionType.TENDON: (
        "tendon_len_target", "tendon_vel_target", "tendon_effort_target", "tendon_len",
        "tendon_vel",
    ),
    TransmissionType.SITE: (None, None, "site_effort_target", None, None),
}  # fmt: skip
_POSITIONS = {"position": 0, "velocity": 1, "effort": 2}


def target_field(transmission: TransmissionType, command: CommandField) -> str | None:
    """Return the field of EntityData that holds one kind of target."""
    return _FIELDS[transmission][_POSITIONS[command]]


def read_command(data: EntityData, transmission: TransmissionType, columns: Columns) -> ActuatorCmd:
    """Return the command and feedback in some columns; views of live data if they are a slice."""
    names = _FIELDS[transmission]
    values = [
        None if name is None else read_columns(getattr(data, name), columns) for name in names
    ]
    present = [value for value in values if value is not None]
    zeros = torch.zeros_like(present[0]) if len(present) < len(names) else present[0]
    return ActuatorCmd(*(zeros if value is None else value for value in values))


# Delays.


def delay_command(
    buffer: DelayBuffer,
    position_target: torch.Tensor,
    velocity_target: torch.Tensor,
    effort_target: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Append a command, (N, n) three times, to a delay line, and return the delayed command.

    One line for all three keeps them together: they are always of the same age.
    """
    position, velocity, effort = delay_rows(
        buffer, (position_target, velocity_target, effort_target), None
    )
    return position, velocity, effort


def delay_rows(
    buffer: DelayBuffer, values: tuple[torch.Tensor, ...], env_ids: EnvIds
) -> tuple[torch.Tensor, ...]:
    """Return `values`, each (N, n_i), delayed together by one line.

    With `env_ids` these environments have just been reset: their lines start anew, filled with
    what they are given, and all other lines stay as they are. Only the rows `env_ids` of the
    result mean something then.
    """
    widths = [value.shape[1] for value in values]
    together = torch.cat(values, dim=1) if len(values) > 1 else values[0]
    if env_ids is None:
        buffer.append(together)
        return buffer.compute().split(widths, dim=1)
    if not buffer.is_initialized:
        # A line takes its shape from what is appended first; then all environments are new to it.
        buffer.append(torch.zeros_like(together))
        buffer.reset()
    buffer.backfill(together, env_ids)
    return buffer.peek().split(widths, dim=1)


# Groups of actuators, written to the simulation together.

_METHODS = ("compute", "compute_after_reset", "get_command", "apply_delay", "apply_controls")


def acts_like(actuator: Actuator, base: type[Actuator]) -> bool:
    """Return whether the actuator's class left alone what a group does in place of a `base`."""
    return all(getattr(type(actuator), name) is getattr(base, name) for name in _METHODS)


def delay_settings(actuator: Actuator) -> tuple[Any, ...]:
    """Return what has to agree for actuators to share a delay line."""
    cfg = actuator.cfg
    return (
        type(actuator),
        actuator.transmission_type,
        cfg.delay_min_lag,
        cfg.delay_max_lag,
        cfg.delay_hold_prob,
        cfg.delay_update_period,
        cfg.delay_per_env_phase,
    )


def share_line(members: Sequence[Actuator], num_envs: int, device: str) -> DelayBuffer:
    """Make one delay line for actuators with equal settings, and have the first one reset it."""
    line = members[0].make_delay_buffer(num_envs, device)
    for k, actuator in enumerate(members):
        actuator.join_group(line, resets_delay=k == 0)
    return line


def _int_tensor(values: list[int], device: str) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.int64, device=device)
