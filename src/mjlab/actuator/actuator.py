"""Base classes of actuators: config, command, delay, life cycle.

An `Actuator` implements one `ActuatorCfg` of an entity for all joints, tendons or sites (its
*targets*) matched by the config's patterns. It adds MuJoCo actuators (*elements*) to the spec, and
at every physics substep converts the entity's commands to their controls.

An environment step runs `decimation` physics substeps. If no actuator or sensor acts between
substeps, the engine runs all of them in one dispatch, which makes steps of the native engine 1.10
(Go1, G1 tracking) to 1.15 times (Cartpole) as fast.
`constant_within_step` marks methods that allow this.
"""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import mujoco
import torch

from mjlab.compat import offers_older_attributes
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
    """Base actuator configuration. Delays are in physics substeps.

    Raises `ValueError` for invalid values, at construction and when the actuator is built.
    """

    target_names_expr: tuple[str, ...]
    """Regular expressions for target names; each must match a whole name. May be a single string."""
    transmission_type: TransmissionType = TransmissionType.JOINT
    """Type of the targets: joints, tendons or sites."""
    armature: float | None = None
    """Reflected rotor inertia of the targets (kg m^2 or kg). None: unchanged."""
    frictionloss: float | None = None
    """Dry friction of the targets (N m or N). None: unchanged."""
    viscous_damping: float | None = None
    """Passive linear damping of the targets (N m s/rad or N s/m). None: unchanged."""
    delay_min_lag: int = 0
    """Minimum command delay, in physics substeps."""
    delay_max_lag: int = 0
    """Maximum command delay, in physics substeps. 0: no delay."""
    delay_hold_prob: float = 0.0
    """Probability of keeping the current lag when a lag is due for resampling."""
    delay_update_period: int = 0
    """Substeps between lag samples. 0: resample at every substep."""
    delay_per_env_phase: bool = True
    """Resample lags of different environments at different substeps of the period."""

    # False for actuators that read a position or velocity: sites have neither.
    _accepts_site: ClassVar[bool] = True
    # Fields that must be > 0 unless None.
    _positive: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        self.validate()

    def validate(self) -> None:
        """Check the field values; see the class. Subclasses extend this method."""
        if isinstance(self.target_names_expr, str):
            self.target_names_expr = (self.target_names_expr,)
        kinds = [kind.value for kind in TransmissionType]
        check_one_of(self._label("transmission_type"), self.transmission_type, kinds)
        # Configs may use the string "joint".
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
        """Build the actuator for these targets (ids and names within the entity)."""

    def _label(self, field: str) -> str:
        """Return the label of a field in error messages."""
        return f"{type(self).__name__} for {self.target_names_expr}: {field}"


ActuatorCfgT = TypeVar("ActuatorCfgT", bound=ActuatorCfg)


@stateful
@offers_older_attributes
class Actuator(ABC, Generic[ActuatorCfgT]):
    """Converts commands for its targets to controls of MuJoCo actuators.

    Custom actuators: in `edit_spec`, add one element per target and append it to
    `self._mjs_actuators`, in the order of controls; in `compute`, return the controls, (N, number of controls). Keep run-time
    state in tensor attributes, so that checkpoints contain it. If `compute` keeps state between
    calls, also override `compute_after_reset`.
    """

    _transient = {
        "cfg", "entity", "_mjs_actuators", "_target_ids_list", "_target_names", "_target_ids",
        "_ctrl_ids", "_global_ctrl_ids", "_global_element_ids", "_resets_delay",
    }  # fmt: skip

    param_names: ClassVar[tuple[str, ...]] = ()
    """Attributes that `control_law` reads."""

    def __init__(
        self,
        cfg: ActuatorCfgT,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """Store config, entity and targets. Target ids and names count within the entity."""
        # The config may have changed since construction.
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
        self._resets_delay = True

    # Targets and ids.

    @property
    def target_names(self) -> list[str]:
        """Target names within the entity."""
        return self._target_names

    @property
    def transmission_type(self) -> TransmissionType:
        """Type of the targets: joints, tendons or sites."""
        return self.cfg.transmission_type

    @property
    def target_ids(self) -> torch.Tensor:
        """(n,) int64 target indices within the entity. Set by `initialize`."""
        return self._initialized(self._target_ids)

    @property
    def ctrl_ids(self) -> torch.Tensor:
        """(number of elements,) int64 element ids within the entity, as in `find_actuators`.

        `EntityData.write_ctrl` takes these ids, with controls grouped by element. `compute` returns
        controls in the order of `global_ctrl_ids`; both orders agree for elements with one control.
        """
        return self._initialized(self._ctrl_ids)

    @property
    def global_ctrl_ids(self) -> torch.Tensor:
        """(number of controls,) int64 columns of `ctrl` in the simulation.

        Most elements have one control. For elements with several: all first controls, then all second
        controls, and so on.
        """
        return self._initialized(self._global_ctrl_ids)

    @property
    def global_element_ids(self) -> torch.Tensor:
        """(number of elements,) int64 element ids in the model: rows of `actuator_gainprm`."""
        return self._initialized(self._global_element_ids)

    @property
    def has_delay(self) -> bool:
        """True if commands are delayed."""
        return self.cfg.delay_max_lag > 0

    @property
    def needs_substep(self) -> bool:
        """True if the actuator must act at every physics substep, not once per environment step."""
        overrides_update = type(self).update is not Actuator.update
        return self.has_delay or overrides_update or not is_constant_within_step(type(self).compute)

    # Construction.

    @abstractmethod
    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add the elements for `target_names` (names in `spec`) to `spec`.

        Called once with all targets, or once per target if the entity sorts its actuators.
        """

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Resolve ids in the compiled model and allocate buffers for `data.nworld` environments.

        Args:
            mj_model: Compiled model.
            model: Model fields of the simulation.
            data: Data fields of the simulation.
            device: Torch device.
        """
        if not self._mjs_actuators:
            warnings.warn(
                f"{type(self).__name__} for {self._target_names}: edit_spec added no MuJoCo actuators "
                "to self._mjs_actuators, so its controls are not used.",
                UserWarning,
                stacklevel=2,
            )
        # Unnamed actuators can only be identified by their position in the spec.
        own = [actuator.id for actuator in self.entity.spec.actuators]
        element_ids = [actuator.id for actuator in self._mjs_actuators]
        own_ids = [own.index(i) for i in element_ids]
        by_element = [control_columns(mj_model, (i,)) for i in element_ids]
        # All first controls, then all second controls, and so on.
        columns = [c for row in zip_longest(*by_element) for c in row if c is not None]
        self._target_ids = torch.tensor(self._target_ids_list, dtype=torch.int64, device=device)
        self._global_element_ids = torch.tensor(element_ids, dtype=torch.int64, device=device)
        self._global_ctrl_ids = torch.tensor(columns, dtype=torch.int64, device=device)
        self._ctrl_ids = torch.tensor(own_ids, dtype=torch.int64, device=device)
        self._resets_delay, self._delay_buffer = True, None
        if self.has_delay:
            # An `ActuatorGroup` replaces it. Created here all the same, because creation draws lags,
            # and all later random numbers of a seed follow.
            self._delay_buffer = self.make_delay_buffer(data.nworld, device)

    def make_delay_buffer(self, num_envs: int, device: str) -> DelayBuffer:
        """Return a new delay buffer with the config's settings."""
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

    def share_delay(self, line: DelayBuffer, resets: bool) -> None:
        """Use the delay line of a group, which advances it. Exactly one actuator `resets` a line."""
        self._delay_buffer, self._resets_delay = line, resets

    # Control.

    def get_command(self, data: EntityData) -> ActuatorCmd:
        """Return copies of commands and feedback of the targets, each (N, n)."""
        return read_command(data, self.transmission_type, self.target_ids)

    def apply_delay(self, cmd: ActuatorCmd) -> ActuatorCmd:
        """Append the command to the delay buffer and return the delayed command. Feedback is unchanged.

        Only for actuators outside an `ActuatorGroup`: a group advances the delays of its actuators.
        """
        return self._delayed(cmd, None)

    @abstractmethod
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the controls of the elements, (N, number of controls)."""

    def compute_after_reset(self, cmd: ActuatorCmd, env_ids: torch.Tensor | slice) -> torch.Tensor:
        """Compute controls after a reset of `env_ids`. Only the rows `env_ids` of the result are used.

        Actuators whose `compute` changes state must override this and change only the state of
        `env_ids`.
        """
        return self.compute(cmd)

    @staticmethod
    def control_law(params: dict[str, torch.Tensor], cmd: ActuatorCmd) -> torch.Tensor:
        """Return the controls as a function of only parameters and command."""
        raise UnsupportedError("control_law is not defined for this actuator; use compute.")

    def apply_controls(self, data: EntityData, env_ids: EnvIds = None) -> None:
        """Compute the controls of this actuator and write them to the simulation.

        With `env_ids` (environments just reset), other environments are unchanged.
        """
        cmd = self.get_command(data)
        cmd = self.apply_delay(cmd) if env_ids is None else self._delayed(cmd, env_ids)
        self.write_controls(data, cmd, env_ids)

    def write_controls(self, data: EntityData, cmd: ActuatorCmd, env_ids: EnvIds = None) -> None:
        """Compute the controls of a delayed command and write them; see `apply_controls`."""
        ctrl = self.compute(cmd) if env_ids is None else self.compute_after_reset(cmd, env_ids)
        if self._mjs_actuators:
            write_columns(data.data.ctrl, self.global_ctrl_ids, ctrl, env_ids)

    def update(self, dt: float) -> None:
        """Hook called after every substep of `dt` seconds. An override sets `needs_substep`."""

    def reset(self, env_ids: EnvIds = None) -> None:
        """Reset the delay buffer of `env_ids` and resample their lags."""
        if self._delay_buffer is not None and self._resets_delay:
            self._delay_buffer.reset(env_ids)

    def set_lags(self, lags: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Set the lags of `env_ids`, (k,) integers, until the next resampling.

        Lags are clamped to the configured range. Actuators that share a delay buffer share the lag.
        Without a configured delay the range is [0, 0], so the call has no effect.
        """
        if self._delay_buffer is not None:
            self._delay_buffer.set_lags(lags, env_ids)

    def _delayed(self, cmd: ActuatorCmd, env_ids: EnvIds) -> ActuatorCmd:
        if self._delay_buffer is None:
            return cmd
        return delay_together(self._delay_buffer, [cmd], env_ids)[0]

    def _initialized(self, value: torch.Tensor | None) -> torch.Tensor:
        if value is None:
            raise WrongStateError(
                f"{type(self).__name__} for {self._target_names} is not initialized; its ids are "
                "available after Scene.initialize()."
            )
        return value


# Functions with the same effect at every substep of an environment step.

F = TypeVar("F", bound=Callable[..., Any])
_MARK = "_constant_within_step"


def constant_within_step(function: F) -> F:
    """Mark `function` as having the same effect at every substep of an environment step.

    A subclass that overrides the method loses the mark.
    """
    setattr(function, _MARK, True)
    return function


def is_constant_within_step(function: Callable[..., Any]) -> bool:
    """Return True if `function` (plain or bound) is marked by `constant_within_step`."""
    return bool(getattr(function, _MARK, False))


class DirectActuator(Actuator[ActuatorCfgT]):
    """Actuator whose controls are the commands `command_fields`, one block of columns each.

    Subclasses define `command_fields`, and `_add_element` or `edit_spec`.
    """

    # Function that adds an element, and the config fields that are its keyword arguments.
    _create: ClassVar[Callable[..., mujoco.MjsActuator] | None] = None
    _create_fields: ClassVar[tuple[str, ...]] = ()

    shares_delay: ClassVar[bool] = False
    """Share one lag per environment among actuators of this class with equal delay settings."""

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """Commands that the elements read."""
        raise NotImplementedError(f"{type(self).__name__} must define command_fields.")

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add one element per target, and write the config's passive properties to the target."""
        for name in target_names:
            self._mjs_actuators.append(self._add_element(spec, name))
            self._override_target(spec, name)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        """Add an element for one target to `spec` and return it."""
        if self._create is None:
            raise NotImplementedError(
                f"{type(self).__name__} must define _add_element(spec, target_name), or edit_spec."
            )
        values = {name: getattr(self.cfg, name) for name in self._create_fields}
        return self._create(spec, target_name, transmission_type=self.transmission_type, **values)

    @constant_within_step
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the commands that the elements read, (N, number of controls)."""
        commands = [getattr(cmd, f"{field}_target") for field in self.command_fields]
        return commands[0] if len(commands) == 1 else torch.cat(commands, dim=1)

    def _override_target(self, spec: mujoco.MjSpec, target_name: str) -> None:
        """Write the config's armature, frictionloss and damping to a target in `spec`."""
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
    """Commands and feedback of an actuator's targets, each (N, number of targets)."""

    position_target: torch.Tensor
    """Desired joint position (rad or m) or tendon length (m)."""
    velocity_target: torch.Tensor
    """Desired velocity (rad/s or m/s)."""
    effort_target: torch.Tensor
    """Feedforward force (N m or N), or another input such as a voltage."""
    pos: torch.Tensor
    """Current position, never delayed."""
    vel: torch.Tensor
    """Current velocity, never delayed."""


# Fields of EntityData: position, velocity and effort targets, position, velocity. None reads as zero.
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


_TARGETS = {"position": 0, "velocity": 1, "effort": 2}


def target_field(transmission: TransmissionType, command: CommandField) -> str | None:
    """Return the EntityData field of a kind of target, or None."""
    return _FIELDS[transmission][_TARGETS[command]]


def read_command(data: EntityData, transmission: TransmissionType, columns: Columns) -> ActuatorCmd:
    """Return command and feedback of `columns`; views of live data if `columns` is a slice."""
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
    """Append three targets, each (N, n), to a delay buffer, and return the delayed targets.

    One buffer for all three targets gives all of them the same lag.
    """
    position, velocity, effort = delay_rows(
        buffer, (position_target, velocity_target, effort_target), None
    )
    return position, velocity, effort


def delay_rows(
    buffer: DelayBuffer, values: tuple[torch.Tensor, ...], env_ids: EnvIds
) -> tuple[torch.Tensor, ...]:
    """Return `values`, each (N, n_i), delayed together by one buffer.

    With `env_ids` (environments just reset), the rows `env_ids` of the buffer are filled with `values`,
    and other rows are unchanged. Only the rows `env_ids` of the result are valid then.
    """
    widths = [value.shape[1] for value in values]
    together = torch.cat(values, dim=1) if len(values) > 1 else values[0]
    if env_ids is None:
        buffer.append(together)
        return buffer.compute().split(widths, dim=1)
    if not buffer.is_initialized:
        # The first append allocates the buffer; the reset marks all rows as empty.
        buffer.append(torch.zeros_like(together))
        buffer.reset()
    buffer.backfill(together, env_ids)
    return buffer.peek().split(widths, dim=1)


def delay_together(
    buffer: DelayBuffer, commands: Sequence[ActuatorCmd], env_ids: EnvIds
) -> list[ActuatorCmd]:
    """Return commands delayed by one buffer, with feedback unchanged; `env_ids` as in `delay_rows`."""
    targets = [t for c in commands for t in (c.position_target, c.velocity_target, c.effort_target)]
    late = delay_rows(buffer, tuple(targets), env_ids)
    return [
        ActuatorCmd(*late[3 * k : 3 * k + 3], cmd.pos, cmd.vel) for k, cmd in enumerate(commands)
    ]


# Groups of actuators.


@dataclass
class DelayedWriter:
    """Writer of the controls of actuators with one delay line, hence one lag per environment."""

    actuators: list[Actuator]
    line: DelayBuffer

    def apply_controls(self, data: EntityData, env_ids: EnvIds = None) -> None:
        """Advance the line and write the controls; see `Actuator.apply_controls`."""
        commands = [actuator.get_command(data) for actuator in self.actuators]
        delayed = delay_together(self.line, commands, env_ids)
        for actuator, cmd in zip(self.actuators, delayed, strict=True):
            actuator.write_controls(data, cmd, env_ids)


@dataclass
class ActuatorGroup:
    """Actuators of an entity, of which those with equal delays share a line.

    Delays are equal for actuators of the same class, transmission and delay settings.
    """

    _actuators: list[Any] = field(default_factory=list)
    writers: list[Any] = field(default_factory=list)
    """Objects that write controls by `apply_controls`, in order. Empty before `initialize`."""

    def initialize(self, num_envs: int, device: str) -> None:
        """Create the writers and delay lines. The actuators must be initialized."""
        self.writers = self._writers_without_delay(device)
        members: dict[Any, list[Actuator]] = {}
        for actuator in self._actuators:
            if actuator.has_delay:
                members.setdefault(self._delay_settings(actuator), []).append(actuator)
        for sharing in members.values():
            line = sharing[0].make_delay_buffer(num_envs, device)
            for k, actuator in enumerate(sharing):
                actuator.share_delay(line, resets=k == 0)
            self.writers.append(DelayedWriter(sharing, line))

    def apply_controls(self, data: EntityData, env_ids: EnvIds = None) -> None:
        """Write the controls of all actuators in the group.

        With `env_ids` (environments just reset), other environments are unchanged.
        """
        for writer in self.writers:
            writer.apply_controls(data, env_ids)

    def _writers_without_delay(self, device: str) -> list[Any]:
        """Return the writers of the actuators without delay."""
        return [actuator for actuator in self._actuators if not actuator.has_delay]

    def _delay_settings(self, actuator: Actuator) -> tuple[Any, ...]:
        """Return the settings that must agree for actuators to share a delay line."""
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


_METHODS = ("compute", "compute_after_reset", "get_command", "apply_delay", "apply_controls")


def acts_like(actuator: Actuator, base: type[Actuator]) -> bool:
    """Return True if the class of an actuator is a `base` that changes at most its control law."""
    return isinstance(actuator, base) and all(
        getattr(type(actuator), name) is getattr(base, name) for name in _METHODS
    )
