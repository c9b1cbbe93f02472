"""Action terms: convert the policy's output to actuator targets of an entity."""

from __future__ import annotations

from mjlab.envs.mdp.actions.actions import (
    BaseActionCfg,
    JointEffortAction,
    JointEffortActionCfg,
    JointPositionAction,
    JointPositionActionCfg,
    JointVelocityAction,
    JointVelocityActionCfg,
    RelativeJointPositionAction,
    RelativeJointPositionActionCfg,
    SiteEffortAction,
    SiteEffortActionCfg,
    TendonEffortAction,
    TendonEffortActionCfg,
    TendonLengthAction,
    TendonLengthActionCfg,
    TendonVelocityAction,
    TendonVelocityActionCfg,
)
from mjlab.envs.mdp.actions.binary import (
    BinaryJointPositionAction,
    BinaryJointPositionActionCfg,
)
from mjlab.envs.mdp.actions.differential_ik import (
    DifferentialIKAction,
    DifferentialIKActionCfg,
)
from mjlab.envs.mdp.actions.operational_space import (
    OperationalSpaceControllerAction,
    OperationalSpaceControllerActionCfg,
)
from mjlab.envs.mdp.actions.pose_target import PoseTargetAction, PoseTargetActionCfg

__all__ = [
    "BaseActionCfg",
    "BinaryJointPositionAction",
    "BinaryJointPositionActionCfg",
    "DifferentialIKAction",
    "DifferentialIKActionCfg",
    "JointEffortAction",
    "JointEffortActionCfg",
    "JointPositionAction",
    "JointPositionActionCfg",
    "JointVelocityAction",
    "JointVelocityActionCfg",
    "OperationalSpaceControllerAction",
    "OperationalSpaceControllerActionCfg",
    "PoseTargetAction",
    "PoseTargetActionCfg",
    "RelativeJointPositionAction",
    "RelativeJointPositionActionCfg",
    "SiteEffortAction",
    "SiteEffortActionCfg",
    "TendonEffortAction",
    "TendonEffortActionCfg",
    "TendonLengthAction",
    "TendonLengthActionCfg",
    "TendonVelocityAction",
    "TendonVelocityActionCfg",
]
