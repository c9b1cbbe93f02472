"""Action terms in actuator space: one action component per target."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.actuator.actuator import TransmissionType, constant_within_step
from mjlab.compat import suggests_fields
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.managers.manager_base import label_errors
from mjlab.utils.indexing import as_columns
from mjlab.utils.lab_api.string import resolve_matching_names, resolve_matching_names_values

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass(kw_only=True)
class BaseActionCfg(ActionTermCfg):
    """Base configuration of actuator-space actions: target = clip(action * scale + offset)."""

    transmission_type: TransmissionType = TransmissionType.JOINT
    """Transmission of the actuators: joint, tendon or site. Fixed by subclasses."""

    actuator_names: tuple[str, ...] | list[str]
    """Patterns of the actuated joints (tendons, sites), matched in full."""

    scale: float | dict[str, float] = 1.0
    """Factor of the action: one number, or target name pattern to number (others 1)."""

    offset: float | dict[str, float] = 0.0
    """Offset added after scaling: one number, or target name pattern to number (others 0)."""

    preserve_order: bool = False
    """Order the action components by pattern instead of the entity's order."""


class BaseAction(ActionTerm):
    """Base class of action terms with one component per target.

    Raises `ValueError` if a pattern (of targets, scale, offset or clip) matches nothing, if two
    patterns match one name, and `TypeError` if scale or offset are neither a number nor a dict.
    """

    cfg: BaseActionCfg

    # Derived from the config; not checkpointed, because a resumed run may change the config. The
    # entity saves its state itself.
    _transient = {
        "_entity",
        "_target_ids",
        "_target_names",
        "_columns",
        "_scale",
        "_own_offset",
        "_default_field",
        "_default",
        "_clip",
    }
    # Field of the entity's default values that are the offset; None: a fixed offset.
    _default_field: str | None = None
    _own_offset: Any

    def __init__(self, cfg: BaseActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        ids, self._target_names = self._find_targets()
        self._target_ids = torch.tensor(ids, dtype=torch.long, device=self.device)
        # Slice if the targets are contiguous: reads without a copy.
        self._columns = as_columns(ids, self.device)
        self._raw_actions = torch.zeros(
            self.num_envs, len(ids), dtype=torch.float32, device=self.device
        )
        self._processed_actions = torch.zeros_like(self._raw_actions)
        self._scale = self._by_target("scale", cfg.scale, 1.0)
        self._offset = self._by_target("offset", cfg.offset, 0.0)
        # Bounds of all targets, (N, action_dim, 2), infinite for unclipped targets.
        self._clip: torch.Tensor | None = None
        if cfg.clip is not None:
            bounds = torch.tensor([-torch.inf, torch.inf], dtype=torch.float32, device=self.device)
            bounds = bounds.repeat(self.action_dim, 1)
            with label_errors(f"{type(cfg).__name__}.clip"):
                found = resolve_matching_names_values(cfg.clip, self._target_names)
            for i, name, pair in zip(*found, strict=True):
                if not (isinstance(pair, (tuple, list)) and pair[0] <= pair[-1]):
                    warnings.warn(
                        f"{type(cfg).__name__}.clip of target {name!r}: expected (low, high) with low "
                        f"<= high, got {pair!r}; the target is constant.",
                        UserWarning,
                        stacklevel=2,
                    )
                bounds[i] = torch.tensor(pair, dtype=torch.float32, device=self.device)
            self._clip = bounds.repeat(self.num_envs, 1, 1)

    @property
    def action_dim(self) -> int:
        """Number of targets."""
        return len(self._target_names)

    @property
    def raw_action(self) -> torch.Tensor:
        """Last unprocessed action, (N, action_dim). Zero after a reset."""
        return self._raw_actions

    @property
    def scale(self) -> torch.Tensor | float:
        """Factor of the action, a number or (N, action_dim)."""
        return self._scale

    @property
    def offset(self) -> torch.Tensor | float:
        """Offset added after scaling, a number or (N, action_dim)."""
        return self._offset

    @property
    def _offset(self) -> torch.Tensor | float:
        if self._default_field is not None:
            # Only changed default values, because package terms may write to the offset.
            current = getattr(self._entity.data, self._default_field)[:, self._columns]
            own = self._own_offset
            torch.where(current != self._default, current, own, out=own)
            self._default.copy_(current)
        return self._own_offset

    @_offset.setter
    def _offset(self, value: torch.Tensor | float) -> None:
        self._default_field, self._own_offset = None, value

    @property
    def target_ids(self) -> torch.Tensor:
        """Ids of the targets within the entity, in the order of the action components."""
        return self._target_ids

    @property
    def target_names(self) -> list[str]:
        """Names of the targets, in the order of the action components."""
        return self._target_names

    def process_actions(self, actions: torch.Tensor) -> None:
        """Scale, offset and clip `actions` (N, action_dim)."""
        self._raw_actions.copy_(actions)
        processed = self._processed_actions
        torch.mul(self._raw_actions, self._scale, out=processed)
        processed += self._offset
        if self._clip is not None:
            torch.clamp(processed, min=self._clip[..., 0], max=self._clip[..., 1], out=processed)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Zero the raw action of `env_ids` (None: all)."""
        self._raw_actions[slice(None) if env_ids is None else env_ids] = 0.0

    def _use_default_offset(self, field: str) -> None:
        self._default = getattr(self._entity.data, field)[:, self._columns].clone()
        self._offset = self._default.clone()
        self._default_field = field

    def _find_targets(self) -> tuple[list[int], list[str]]:
        names, ordered = self.cfg.actuator_names, self.cfg.preserve_order
        if self.cfg.transmission_type == TransmissionType.TENDON:
            return self._entity.find_tendons(names, preserve_order=ordered)
        if self.cfg.transmission_type == TransmissionType.SITE:
            return self._entity.find_sites(names, preserve_order=ordered)
        ids, joints = self._entity.find_joints_by_actuator_names(names)
        if not ordered:
            return ids, joints
        positions, joints = resolve_matching_names(names, joints, preserve_order=True)
        return [ids[position] for position in positions], joints

    def _by_target(
        self, name: str, value: float | dict[str, float], default: float
    ) -> torch.Tensor | float:
        if isinstance(value, (int, float)):
            return float(value)
        per_target = torch.full(
            (self.action_dim,), default, dtype=torch.float32, device=self.device
        )
        with label_errors(f"{type(self.cfg).__name__}.{name}"):
            ids, _, values = resolve_matching_names_values(value, self._target_names)
        per_target[ids] = torch.tensor(values, dtype=torch.float, device=self.device)
        return per_target.repeat(self.num_envs, 1)


@suggests_fields
@dataclass(kw_only=True)
class JointPositionActionCfg(BaseActionCfg):
    """Joint position target configuration."""

    use_default_offset: bool = True
    """Use the entity's default joint positions as offset, also after an event changed them; `offset`
    is then ignored."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT

    def build(self, env: ManagerBasedRlEnv) -> JointPositionAction:
        return JointPositionAction(self, env)


class JointPositionAction(BaseAction):
    """Commands joint positions (rad or m) as measured by the encoders.

    The encoder bias is subtracted from the target, so that a robot commanded to its observed
    positions (`joint_pos_rel` with `biased=True`) does not move.
    """

    def __init__(self, cfg: JointPositionActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._use_default_offset("default_joint_pos")

    @constant_within_step
    def apply_actions(self) -> None:
        bias = self._entity.data.encoder_bias[:, self._columns]
        self._entity.set_joint_position_target(
            self._processed_actions - bias, joint_ids=self._columns
        )


@suggests_fields
@dataclass(kw_only=True)
class RelativeJointPositionActionCfg(BaseActionCfg):
    """Relative joint position target configuration. `offset` must be 0."""

    read_every_substep: bool = True
    """Read the current positions at every physics substep. False: once per step, as a robot's program, so that
    policies can be deployed."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT
        if self.offset != 0.0:
            raise ValueError(
                f"RelativeJointPositionActionCfg.offset: expected 0, got {self.offset!r}; the target "
                "is the current position plus the scaled action."
            )

    def build(self, env: ManagerBasedRlEnv) -> RelativeJointPositionAction:
        return RelativeJointPositionAction(self, env)


class RelativeJointPositionAction(BaseAction):
    """Commands joint position increments (rad or m); `clip` bounds the increment.

    The current position is read at every physics substep, or once per step: `read_every_substep`.
    """

    _transient = BaseAction._transient | {"_measured", "_reads_every_substep"}

    def __init__(self, cfg: RelativeJointPositionActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self._reads_every_substep = cfg.read_every_substep
        self._measured = torch.zeros_like(self._processed_actions)

    @property
    def measured(self) -> torch.Tensor:
        """Positions that the targets are relative to, (N, action_dim), as last read."""
        return self._measured

    @property
    def needs_substep(self) -> bool:
        """True if the position is read at every substep."""
        return self._reads_every_substep

    def process_actions(self, actions: torch.Tensor) -> None:
        """Scale and clip `actions` (N, action_dim), and read the positions."""
        super().process_actions(actions)
        self._measured.copy_(self._entity.data.joint_pos[:, self._columns])

    def apply_actions(self) -> None:
        if self._reads_every_substep:
            self._measured.copy_(self._entity.data.joint_pos[:, self._columns])
        target = self._measured + self._processed_actions
        self._entity.set_joint_position_target(target, joint_ids=self._columns)


@suggests_fields
@dataclass(kw_only=True)
class JointVelocityActionCfg(BaseActionCfg):
    """Joint velocity target configuration."""

    use_default_offset: bool = True
    """Use the entity's default joint velocities as offset, also after an event changed them; `offset`
    is then ignored."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT

    def build(self, env: ManagerBasedRlEnv) -> JointVelocityAction:
        return JointVelocityAction(self, env)


class JointVelocityAction(BaseAction):
    """Commands joint velocities (rad/s or m/s)."""

    def __init__(self, cfg: JointVelocityActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._use_default_offset("default_joint_vel")

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_joint_velocity_target(self._processed_actions, joint_ids=self._columns)


@suggests_fields
@dataclass(kw_only=True)
class JointEffortActionCfg(BaseActionCfg):
    """Joint effort target configuration."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT

    def build(self, env: ManagerBasedRlEnv) -> JointEffortAction:
        return JointEffortAction(self, env)


class JointEffortAction(BaseAction):
    """Commands joint efforts in units of the actuator's control (N m or N, before its gear)."""

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_joint_effort_target(self._processed_actions, joint_ids=self._columns)


@dataclass(kw_only=True)
class TendonLengthActionCfg(BaseActionCfg):
    """Tendon length target configuration."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.TENDON

    def build(self, env: ManagerBasedRlEnv) -> TendonLengthAction:
        return TendonLengthAction(self, env)


class TendonLengthAction(BaseAction):
    """Commands tendon lengths (m)."""

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_tendon_len_target(self._processed_actions, tendon_ids=self._columns)


@dataclass(kw_only=True)
class TendonVelocityActionCfg(BaseActionCfg):
    """Tendon velocity target configuration."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.TENDON

    def build(self, env: ManagerBasedRlEnv) -> TendonVelocityAction:
        return TendonVelocityAction(self, env)


class TendonVelocityAction(BaseAction):
    """Commands tendon velocities (m/s)."""

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_tendon_vel_target(self._processed_actions, tendon_ids=self._columns)


@dataclass(kw_only=True)
class TendonEffortActionCfg(BaseActionCfg):
    """Tendon effort target configuration."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.TENDON

    def build(self, env: ManagerBasedRlEnv) -> TendonEffortAction:
        return TendonEffortAction(self, env)


class TendonEffortAction(BaseAction):
    """Commands tendon forces (N)."""

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_tendon_effort_target(self._processed_actions, tendon_ids=self._columns)


@dataclass(kw_only=True)
class SiteEffortActionCfg(BaseActionCfg):
    """Site effort target configuration."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.SITE

    def build(self, env: ManagerBasedRlEnv) -> SiteEffortAction:
        return SiteEffortAction(self, env)


class SiteEffortAction(BaseAction):
    """Commands efforts at sites (N or N m), along the first axis of the actuator's gear."""

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_site_effort_target(self._processed_actions, site_ids=self._columns)
