"""Task-space action: differential inverse kinematics converts frame poses to joint targets."""

from __future__ import annotations

import logging
import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

import torch

from mjlab.compat import accepts_older_fields, offers_older_attributes, older_names, suggests_fields
from mjlab.envs.mdp.actions.pose_target import PoseTargetAction, PoseTargetActionCfg
from mjlab.envs.mdp.frames import Frame, FrameType
from mjlab.utils.errors import check_one_of
from mjlab.utils.indexing import as_columns
from mjlab.utils.lab_api.math import compute_pose_error, quat_from_matrix
from mjlab.utils.string import resolve_expr

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)

# Minimum damping: with less, a singular arm has no solution.
_MIN_DAMPING = 1.0e-6

_WEIGHTS = ("position_weight", "orientation_weight", "joint_limit_weight", "posture_weight")


@suggests_fields
@accepts_older_fields
@dataclass(kw_only=True)
class DifferentialIKActionCfg(PoseTargetActionCfg):
    """Pose target of one frame, tracked by damped least squares. `clip` has no effect.

    Action dimension: 3 without orientation (`orientation_weight` 0); else 6 in relative mode
    (translation, rotation vector) or 7 in absolute mode (position, quaternion w x y z). World axes.

    Joint targets start from the current joint positions, so that soft position servos sag under
    the arm's weight; compensate with `gravcomp` of the bodies, as many arm controllers do.
    """

    damping: float = 0.05
    """Damping of joint motion. Larger values are smoother near singularities, and slower."""

    max_dq: float = 0.5
    """Maximum distance of a joint target from the joint position (rad or m)."""

    position_weight: float = 1.0
    """Weight of the position error (1/m)."""

    orientation_weight: float = 1.0
    """Weight of the orientation error (1/rad). 0 leaves the orientation free."""

    joint_limit_weight: float = 0.0
    """Weight of returning joints to their soft limits."""

    posture_weight: float = 0.0
    """Weight of the posture, which resolves redundancy. Choose it far below the other weights,
    since it also pulls the frame off its target."""

    posture_target: dict[str, float] | None = None
    """Posture: joint name pattern, matching the start of a name, to joint position (rad or m).
    Other joints: default positions."""

    def build(self, env: ManagerBasedRlEnv) -> DifferentialIKAction:
        return DifferentialIKAction(self, env)


@offers_older_attributes
class DifferentialIKAction(PoseTargetAction):
    """Commands the pose of a frame; joint position targets are updated every physics substep.

    See `compute_dq` for the formula. Targets never leave the soft joint limits, even if the pose is
    unreachable. Poses are in the world frame: tasks with separate environment origins add them to
    absolute positions.

    Raises `ValueError` if a joint pattern or the frame pattern matches nothing.
    """

    cfg: DifferentialIKActionCfg

    # Values derived from the config and views of the simulation are not checkpointed.
    _transient = {
        "_columns",
        "_dofs",
        "_body_ids",
        "_frame_pos",
        "_frame_rotation",
        "_posture_target",
    }

    def __init__(self, cfg: DifferentialIKActionCfg, env: ManagerBasedRlEnv) -> None:
        _check_cfg(cfg)
        super().__init__(cfg, env)
        if cfg.clip is not None:
            logger.warning("DifferentialIKActionCfg.clip has no effect; max_dq bounds the motion.")
        ids, self._joint_names = self._entity.find_joints_by_actuator_names(cfg.actuator_names)
        self._columns = as_columns(ids, self.device)
        joints = self._entity.indexing.joint_ids[ids].tolist()
        dofs = env.sim.mj_model.jnt_dofadr[joints].tolist()
        self._dofs = as_columns(dofs, self.device)
        self._find_frame()
        positions = resolve_expr(cfg.posture_target or {}, tuple(self._joint_names), None)
        # NaN: the default position.
        self._posture_target = torch.tensor(
            [math.nan if value is None else float(value) for value in positions],
            dtype=torch.float32,
            device=self.device,
        )

    @property
    def controls_orientation(self) -> bool:
        """True if the orientation has a weight."""
        return self.cfg.orientation_weight != 0.0

    def apply_actions(self) -> None:
        """Write joint position targets q + dq."""
        q = self._entity.data.joint_pos[:, self._columns]
        self._entity.set_joint_position_target(q + self.compute_dq(), joint_ids=self._columns)

    def compute_dq(self) -> torch.Tensor:
        """Return the joint displacements, (N, number of joints), without applying them.

        With the pose errors e_p = p* - p and e_R = log(Q* Q^-1), the Jacobians J_p and J_R of the
        frame, and the soft limit violations r = min(u - q, 0) + max(l - q, 0),

            dq = argmin  w_p^2 |J_p dq - e_p|^2 + w_o^2 |J_R dq - e_R|^2
                       + w_l^2 |[r != 0] (dq - r)|^2 + w_q^2 |dq - (q_posture - q)|^2
                       + damping^2 |dq|^2,

        clamped to +-max_dq. Joints that would pass a soft limit stop there, and the problem is
        solved again for the other joints; a joint outside its limits returns by at most `max_dq`
        per substep.

        Pose and Jacobian belong to the state before the last substep (at the first substep of a
        step, to the current state); q is current.
        """
        data, max_dq = self._entity.data, self.cfg.max_dq
        q = data.joint_pos[:, self._columns]
        limits = data.soft_joint_pos_limits[:, self._columns]
        low, high = (limits - q.unsqueeze(-1)).unbind(-1)
        jacobian, error, stiffness, pull = self._least_squares(q, low, high)
        dq = damped_least_squares(jacobian, error, stiffness, pull).clamp_(-max_dq, max_dq)
        low, high = low.clamp_(-max_dq, max_dq), high.clamp_(-max_dq, max_dq)
        bounded = torch.clamp(dq, low, high)
        blocked = bounded != dq
        # On a GPU, reading the mask takes longer than solving again.
        if not dq.is_cuda and not blocked.any():
            return dq
        known = torch.where(blocked, bounded, 0.0)
        dq = damped_least_squares(
            jacobian.masked_fill(blocked.unsqueeze(1), 0.0),
            # Not a matrix product: a GPU would compute it in TF32.
            error - (jacobian * known.unsqueeze(1)).sum(-1),
            stiffness,
            pull,
        )
        return torch.where(blocked, bounded, torch.clamp(dq, low, high))

    def _least_squares(
        self, q: torch.Tensor, low: torch.Tensor, high: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the arguments of `damped_least_squares`.

        `low` and `high` are the distances from q to the soft limits.
        """
        cfg = self.cfg
        position, quat = self._get_frame_pose()
        errors = compute_pose_error(position, quat, self._desired_pos, self._desired_quat)
        jacobians = self._env.sim.jacobian(position, self._body_ids)
        weights = (cfg.position_weight, cfg.orientation_weight)
        used = [k for k in (0, 1) if weights[k] != 0.0] or [0]
        jacobian = torch.cat([weights[k] * jacobians[k][:, :, self._dofs] for k in used], dim=1)
        error = torch.cat([weights[k] * errors[k] for k in used], dim=1)
        outside = high.clamp(max=0.0) + low.clamp(min=0.0)
        limit, posture = cfg.joint_limit_weight**2, cfg.posture_weight**2
        damping = max(cfg.damping, _MIN_DAMPING) ** 2
        stiffness = limit * (outside != 0.0) + (posture + damping)
        if posture == 0.0:
            return jacobian, error, stiffness, limit * outside
        return jacobian, error, stiffness, limit * outside + posture * (self._posture - q)

    @property
    def _posture(self) -> torch.Tensor:
        """Posture, (N, number of joints); default positions may change."""
        default = self._entity.data.default_joint_pos[:, self._columns]
        return torch.where(self._posture_target.isnan(), default, self._posture_target)

    def _get_frame_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return position, (N, 3), and quaternion, (N, 4), of the frame in the world.

        Override to control a custom frame; the point must move with the body.
        """
        if self.cfg.frame_type == "body":
            return self._frame_pos, self._frame_rotation
        return self._frame_pos, quat_from_matrix(self._frame_rotation)

    def _find_frame(self) -> None:
        cfg = self.cfg
        frame = Frame(self._env.sim, self._entity, cfg.entity_name, cfg.frame_type, cfg.frame_name)
        self._frame_pos, self._frame_rotation = frame.pos, frame.rotation
        self._body_ids = torch.full(
            (self.num_envs,), frame.body, dtype=torch.int32, device=self.device
        )


def damped_least_squares(
    jacobian: torch.Tensor, error: torch.Tensor, stiffness: torch.Tensor, pull: torch.Tensor
) -> torch.Tensor:
    """Return x = (J'J + D)^-1 (J'e + b), with D diagonal and positive.

    Computed by the matrix inversion lemma: x = D^-1 (b + J'y) with
    (J D^-1 J' + I) y = e - J D^-1 b. This system has the size of the task, not of the arm, and
    eigenvalues >= 1. For an arm that can move freely its condition number does not depend on the
    damping, whereas that of J'J + D grows with the inverse square of the damping: single precision
    fails below a damping of about 1e-3. Singular poses still make the system ill-conditioned, so it
    is solved in double precision, at no extra time.

    Args:
        jacobian: J, (N, m, n). error: e, (N, m). stiffness: D, (N, n). pull: b, (N, n).

    Returns (N, n), in the precision of `jacobian`.
    """
    j, e = jacobian.double(), error.double().unsqueeze(-1)
    d, b = stiffness.double().unsqueeze(-1), pull.double().unsqueeze(-1)
    scaled = j.mT / d
    system = j @ scaled
    system.diagonal(dim1=-2, dim2=-1).add_(1.0)
    # The matrix is positive definite; `solve` would check the result and synchronize with the GPU.
    multiplier, _ = torch.linalg.solve_ex(system, e - j @ (b / d))
    return (b / d + scaled @ multiplier).squeeze(-1).to(jacobian.dtype)


def _check_cfg(cfg: DifferentialIKActionCfg) -> None:
    check_one_of("frame_type", cfg.frame_type, get_args(FrameType))
    odd = [f"{n}={getattr(cfg, n)!r}" for n in (*_WEIGHTS, "damping") if not getattr(cfg, n) >= 0.0]
    if not cfg.max_dq > 0.0:
        odd.append(f"max_dq={cfg.max_dq!r}")
    if cfg.position_weight == 0.0 and cfg.orientation_weight == 0.0:
        odd.append("position_weight=0, orientation_weight=0")
    if odd:
        warnings.warn(
            f"DifferentialIKActionCfg: expected weights and damping >= 0, one of position_weight and "
            f"orientation_weight > 0, and max_dq > 0, got {', '.join(odd)}.",
            UserWarning,
            stacklevel=2,
        )


__getattr__ = older_names(__name__)
