"""Task-space action: operational-space control converts frame poses to joint efforts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.actuator.actuator import DirectActuator
from mjlab.compat import suggests_fields
from mjlab.envs.mdp.actions.pose_target import PoseTargetAction, PoseTargetActionCfg
from mjlab.envs.mdp.frames import Frame
from mjlab.utils.errors import check_fields_positive
from mjlab.utils.indexing import as_columns
from mjlab.utils.lab_api.math import compute_pose_error

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

# Part of the mean inverse inertia that is added in all directions. Bounds the inertia of directions
# in which a singular arm cannot move; changes that of others by less than 0.1 %.
_RIDGE = 1.0e-3


@suggests_fields
@dataclass(kw_only=True)
class OperationalSpaceControllerActionCfg(PoseTargetActionCfg):
    """Pose target of one frame, tracked by joint efforts. `clip` has no effect.

    Action dimension: 3 without orientation; else 6 in relative mode (translation, rotation vector)
    or 7 in absolute mode (position, quaternion w x y z). World axes.

    The joints need actuators that take efforts: `BuiltinMotorActuatorCfg`, or `IdealPdActuatorCfg`,
    whose own gains then have no effect.
    """

    controls_orientation: bool = True
    """Control the orientation too. False leaves it to the posture."""

    stiffness: float = 150.0
    """Acceleration of the frame per unit of pose error (1/s^2): the square of the natural frequency."""

    damping_ratio: float = 1.0
    """Damping ratio of the frame's motion; 1 is critical."""

    posture_stiffness: float = 10.0
    """Acceleration of joints toward their default positions (1/s^2), in motions that do not
    accelerate the frame."""

    gravity_compensation: bool = True
    """Add the efforts that hold the arm against gravity, centrifugal and Coriolis forces."""

    def build(self, env: ManagerBasedRlEnv) -> OperationalSpaceControllerAction:
        return OperationalSpaceControllerAction(self, env)


class OperationalSpaceControllerAction(PoseTargetAction):
    """Commands the pose of a frame; joint efforts are updated every physics substep.

    See `compute_efforts` for the formula. Actuators limit the efforts. Poses are in the world frame:
    tasks with separate environment origins add them to absolute positions.

    Raises `ValueError` if a joint pattern or the frame pattern matches nothing, for gains that are
    not positive, and for actuators that take no effort or have a gear.
    """

    cfg: OperationalSpaceControllerActionCfg

    # Derived from the config; not checkpointed.
    _transient = {"_columns", "_dofs", "_frame", "_body_ids"}

    def __init__(self, cfg: OperationalSpaceControllerActionCfg, env: ManagerBasedRlEnv) -> None:
        check_fields_positive(cfg, "stiffness", "damping_ratio")
        super().__init__(cfg, env)
        ids, names = self._entity.find_joints_by_actuator_names(cfg.actuator_names)
        _check_actuators(self._entity, names, env)
        self._columns = as_columns(ids, self.device)
        joints = self._entity.indexing.joint_ids[ids].tolist()
        self._dofs = torch.as_tensor(env.sim.mj_model.jnt_dofadr[joints], device=self.device).long()
        self._frame = Frame(env.sim, self._entity, cfg.entity_name, cfg.frame_type, cfg.frame_name)
        self._body_ids = torch.full(
            (self.num_envs,), self._frame.body, dtype=torch.int32, device=self.device
        )
        # Fields that are read are computed from their first use on.
        for field in ("M", "cdof", "cvel", "qfrc_bias", "qfrc_gravcomp"):
            getattr(env.sim.data, field)

    @property
    def controls_orientation(self) -> bool:
        """As the config says."""
        return self.cfg.controls_orientation

    def _get_frame_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self._frame.pos, self._frame.quat

    def apply_actions(self) -> None:
        """Write joint effort targets."""
        data = self._entity.data
        self._entity.set_joint_effort_target(self.compute_efforts(), joint_ids=self._columns)
        # Position and velocity errors of zero, so that the gains of PD actuators add nothing.
        self._entity.set_joint_position_target(
            data.joint_pos[:, self._columns], joint_ids=self._columns
        )
        self._entity.set_joint_velocity_target(
            data.joint_vel[:, self._columns], joint_ids=self._columns
        )

    def compute_efforts(self) -> torch.Tensor:
        """Return the joint efforts, (N, number of joints), without applying them.

        With the pose error e = (p* - p, log(Q* Q^-1)), frame velocity v, Jacobian J, mass matrix M
        and bias forces h of the controlled joints (Khatib, "A unified approach for motion and force
        control of robot manipulators: the operational space formulation", 1987),

            L   = (J M^-1 J')^-1                        inertia of the frame
            F   = L (k e - 2 z sqrt(k) v)               stiffness k, damping ratio z
            t0  = M (k_q (q0 - q) - 2 sqrt(k_q) dq)     posture, critically damped
            t   = J' F + (1 - J' L J M^-1) t0 + h.

        J, M and h belong to the state before the last substep (at the first substep of a step, to
        the current state); q and dq are current. Joints that are not controlled count as locked.
        """
        cfg, data, sim = self.cfg, self._entity.data, self._env.sim
        rows = slice(None if cfg.controls_orientation else 3)
        error = compute_pose_error(
            self._frame.pos, self._frame.quat, self._desired_pos, self._desired_quat
        )
        error = torch.cat(error, dim=1)[:, rows]
        jacobian = torch.cat(sim.jacobian(self._frame.pos, self._body_ids), dim=1)
        # Double precision: the inertias of an arm span three orders of magnitude.
        J = jacobian[:, rows, self._dofs].double()  # (N, m, n)
        M = sim.mass_matrix()[:, self._dofs[:, None], self._dofs].double()  # (N, n, n)
        acceleration = cfg.stiffness * error - (
            2.0 * cfg.damping_ratio * math.sqrt(cfg.stiffness) * self._frame.velocity[:, rows]
        )
        MinvJt, _ = torch.linalg.solve_ex(M, J.mT)  # (N, n, m)
        mobility = J @ MinvJt
        diagonal = mobility.diagonal(dim1=-2, dim2=-1)
        diagonal += _RIDGE * diagonal.mean(dim=1, keepdim=True)
        q, dq = data.joint_pos[:, self._columns], data.joint_vel[:, self._columns]
        q0, k_q = data.default_joint_pos[:, self._columns], cfg.posture_stiffness
        ddq = (k_q * (q0 - q) - 2.0 * math.sqrt(k_q) * dq).double().unsqueeze(-1)
        # J' F - J' L J M^-1 t0 = J' L (a - J ddq).
        wanted = acceleration.double().unsqueeze(-1) - J @ ddq
        force, _ = torch.linalg.solve_ex(mobility, wanted)
        efforts = (J.mT @ force + M @ ddq).squeeze(-1).float()
        if cfg.gravity_compensation:
            # Gravity that the bodies' `gravcomp` cancels is not compensated twice.
            efforts += (sim.data.qfrc_bias - sim.data.qfrc_gravcomp)[:, self._dofs]
        return efforts


def _check_actuators(entity: Entity, joints: list[str], env: ManagerBasedRlEnv) -> None:
    owner = "OperationalSpaceControllerActionCfg.actuator_names"
    for actuator in entity.actuators:
        driven = [name for name in actuator.target_names if name in joints]
        if not driven:
            continue
        if isinstance(actuator, DirectActuator) and "effort" not in actuator.command_fields:
            raise ValueError(
                f"{owner}: expected actuators that take efforts, got {type(actuator).__name__} for "
                f"{driven}; use BuiltinMotorActuatorCfg."
            )
        gears = env.sim.mj_model.actuator_gear[actuator.global_ctrl_ids.tolist(), 0]
        if (gears != 1.0).any():
            raise ValueError(
                f"{owner}: expected actuators with gear 1, got {gears.tolist()} for {driven}."
            )
