"""Action terms in actuator space: one component of the action for each target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from mjlab.actuator.actuator import TransmissionType
from mjlab.envs.mdp.actions.base import BaseAction as BaseAction
from mjlab.envs.mdp.actions.base import BaseActionCfg as BaseActionCfg
from mjlab.utils.substep import constant_within_step

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass(kw_only=True)
class JointPositionActionCfg(BaseActionCfg):
    """Joint position targets."""

    use_default_offset: bool = True
    """Take the default joint positions as offset; `offset` is then ignored."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT

    def build(self, env: ManagerBasedRlEnv) -> JointPositionAction:
        return JointPositionAction(self, env)


class JointPositionAction(BaseAction):
    """Commands joint positions (rad or m), as the joints' encoders report them.

    The target is lowered by the encoder bias, so that a robot commanded to the positions it
    observes (`joint_pos_rel` with `biased=True`) stays where it is.
    """

    def __init__(self, cfg: JointPositionActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._offset = self._entity.data.default_joint_pos[:, self._columns].clone()

    @constant_within_step
    def apply_actions(self) -> None:
        bias = self._entity.data.encoder_bias[:, self._columns]
        self._entity.set_joint_position_target(
            self._processed_actions - bias, joint_ids=self._columns
        )


@dataclass(kw_only=True)
class RelativeJointPositionActionCfg(BaseActionCfg):
    """Joint position targets relative to the current positions; `offset` must stay 0."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT
        if self.offset != 0.0:
            raise ValueError(
                f"RelativeJointPositionActionCfg takes no offset, got {self.offset!r}: the target "
                "is the current position plus the scaled action."
            )

    def build(self, env: ManagerBasedRlEnv) -> RelativeJointPositionAction:
        return RelativeJointPositionAction(self, env)


class RelativeJointPositionAction(BaseAction):
    """Commands joint position increments (rad or m); `clip` bounds the increment.

    The current position is read again at every physics substep.
    """

    def apply_actions(self) -> None:
        target = self._entity.data.joint_pos[:, self._columns] + self._processed_actions
        self._entity.set_joint_position_target(target, joint_ids=self._columns)


@dataclass(kw_only=True)
class JointVelocityActionCfg(BaseActionCfg):
    """Joint velocity targets."""

    use_default_offset: bool = True
    """Take the default joint velocities as offset; `offset` is then ignored."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT

    def build(self, env: ManagerBasedRlEnv) -> JointVelocityAction:
        return JointVelocityAction(self, env)


class JointVelocityAction(BaseAction):
    """Commands joint velocities (rad/s or m/s)."""

    def __init__(self, cfg: JointVelocityActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._offset = self._entity.data.default_joint_vel[:, self._columns].clone()

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_joint_velocity_target(self._processed_actions, joint_ids=self._columns)


@dataclass(kw_only=True)
class JointEffortActionCfg(BaseActionCfg):
    """Joint effort targets."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.JOINT

    def build(self, env: ManagerBasedRlEnv) -> JointEffortAction:
        return JointEffortAction(self, env)


class JointEffortAction(BaseAction):
    """Commands joint efforts (what the actuator's control means: N m or N before its gear)."""

    def __init__(self, cfg: JointEffortActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_joint_effort_target(self._processed_actions, joint_ids=self._columns)


@dataclass(kw_only=True)
class TendonLengthActionCfg(BaseActionCfg):
    """Tendon length targets."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.TENDON

    def build(self, env: ManagerBasedRlEnv) -> TendonLengthAction:
        return TendonLengthAction(self, env)


class TendonLengthAction(BaseAction):
    """Commands tendon lengths (m)."""

    def __init__(self, cfg: TendonLengthActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_tendon_len_target(self._processed_actions, tendon_ids=self._columns)


@dataclass(kw_only=True)
class TendonVelocityActionCfg(BaseActionCfg):
    """Tendon velocity targets."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.TENDON

    def build(self, env: ManagerBasedRlEnv) -> TendonVelocityAction:
        return TendonVelocityAction(self, env)


class TendonVelocityAction(BaseAction):
    """Commands tendon velocities (m/s)."""

    def __init__(self, cfg: TendonVelocityActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_tendon_vel_target(self._processed_actions, tendon_ids=self._columns)


@dataclass(kw_only=True)
class TendonEffortActionCfg(BaseActionCfg):
    """Tendon effort targets."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.TENDON

    def build(self, env: ManagerBasedRlEnv) -> TendonEffortAction:
        return TendonEffortAction(self, env)


class TendonEffortAction(BaseAction):
    """Commands tendon forces (N)."""

    def __init__(self, cfg: TendonEffortActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_tendon_effort_target(self._processed_actions, tendon_ids=self._columns)


@dataclass(kw_only=True)
class SiteEffortActionCfg(BaseActionCfg):
    """Site effort targets."""

    def __post_init__(self) -> None:
        self.transmission_type = TransmissionType.SITE

    def build(self, env: ManagerBasedRlEnv) -> SiteEffortAction:
        return SiteEffortAction(self, env)


class SiteEffortAction(BaseAction):
    """Commands efforts at sites, along the first axis of the actuator's gear (N or N m)."""

    def __init__(self, cfg: SiteEffortActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)

    @constant_within_step
    def apply_actions(self) -> None:
        self._entity.set_site_effort_target(self._processed_actions, site_ids=self._columns)
