"""An action that moves a frame of the robot: inverse kinematics turns it into joint targets."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import torch

from mjlab.compat import accepts_older_fields, offers_older_attributes, older_names
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.utils.errors import check_one_of, check_positive
from mjlab.utils.indexing import as_columns
from mjlab.utils.lab_api.math import compute_pose_error, normalize, quat_box_plus, quat_from_matrix
from mjlab.utils.string import resolve_expr

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)
FrameType = Literal["body", "site", "geom"]

# Least damping: below it a singular arm would have no solution.
_MIN_DAMPING = 1.0e-6

# A quaternion shorter than this names no orientation.
_MIN_QUAT_NORM = 1.0e-6

# No target is further away than this (m, rad); larger numbers would overflow.
_FARTHEST = 1.0e6
_WEIGHTS = ("position_weight", "orientation_weight", "joint_limit_weight", "posture_weight")


@accepts_older_fields
@dataclass(kw_only=True)
class DifferentialIKActionCfg(ActionTermCfg):
    """Pose targets of one frame, followed by damped least squares; `clip` has no effect.

    The action has 3 components without orientation (`orientation_weight` 0), else 6 relative ones
    (shift, rotation vector) or 7 absolute ones (position, quaternion w x y z), in world axes.

    Joint targets start from where the joints are, so that drives which are soft sag under the
    arm's weight; `gravcomp` of its bodies compensates that, as many arms' own controllers do.
    """

    actuator_names: tuple[str, ...] | list[str]
    """Patterns of the actuated joints that may move; each must match a whole name."""

    frame_type: FrameType = "body"
    """What the frame is: a body, a site or a geom of the entity."""

    frame_name: str
    """Pattern of the frame's name; it must match exactly one."""

    use_relative_mode: bool = True
    """Whether actions move the target from the frame's present pose, instead of being the pose."""

    delta_pos_scale: float = 1.0
    """Metres for an action of 1, in relative mode."""

    delta_ori_scale: float = 1.0
    """Radians for an action of 1, in relative mode."""

    damping: float = 0.05
    """Damping of the joints' motion. Larger is calmer near singular poses, and slower."""

    max_dq: float = 0.5
    """Largest change of a joint target from its joint's position (rad or m)."""

    position_weight: float = 1.0
    """Weight of the position error (per metre)."""

    orientation_weight: float = 1.0
    """Weight of the orientation error (per radian). 0 leaves the orientation free."""

    joint_limit_weight: float = 0.0
    """Weight of bringing joints that are outside their soft limits back."""

    posture_weight: float = 0.0
    """Weight of the posture, which decides what the pose leaves open. It should be far below the
    other weights, since it also pulls the frame off its target."""

    posture_target: dict[str, float] | None = None
    """The posture: joint positions by pattern (matching the start of a name), where it is not the
    default one."""

    def build(self, env: ManagerBasedRlEnv) -> DifferentialIKAction:
        return DifferentialIKAction(self, env)


@offers_older_attributes
class DifferentialIKAction(ActionTerm):
    """Commands the pose of a frame; joint position targets follow it at every physics substep.

    See `compute_dq` for the formula. Targets never leave the soft joint limits, whether the pose
    can be reached or not. Poses are in the world frame, so tasks whose environments stand apart add
    their origins to absolute positions.

    Raises `ValueError` if a pattern of joints matches nothing, the frame's pattern not exactly one
    element, or a number of the config is not one that makes sense.
    """

    cfg: DifferentialIKActionCfg

    # What follows from the config and views of the simulation are no run-time state.
    _transient = {
        "_columns",
        "_dofs",
        "_body_ids",
        "_frame_pos",
        "_frame_rotation",
        "_posture",
        "_scale",
        "_entity",
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
        self._posture = self._entity.data.default_joint_pos[:, self._columns].clone()
        given = resolve_expr(cfg.posture_target or {}, tuple(self._joint_names), None)
        for column, value in enumerate(given):
            if value is not None:
                self._posture[:, column] = float(value)
        self._raw_actions = torch.zeros(
            self.num_envs, self.action_dim, dtype=torch.float32, device=self.device
        )
        scales = (cfg.delta_pos_scale,) * 3 + (cfg.delta_ori_scale,) * 3
        self._scale = torch.tensor(
            scales[: self.action_dim], dtype=torch.float32, device=self.device
        )
        self._desired_pos = torch.zeros(self.num_envs, 3, dtype=torch.float32, device=self.device)
        self._desired_quat = torch.zeros(self.num_envs, 4, dtype=torch.float32, device=self.device)
        self.reset()

    @property
    def action_dim(self) -> int:
        """3 without orientation, 6 for a relative pose, 7 for an absolute one."""
        if self.cfg.orientation_weight == 0.0:
            return 3
        return 6 if self.cfg.use_relative_mode else 7

    @property
    def raw_action(self) -> torch.Tensor:
        """(N, action_dim) last action as the policy gave it; zero after a reset."""
        return self._raw_actions

    def process_actions(self, actions: torch.Tensor) -> None:
        """Set the pose to reach, from the frame's present one; actions are (N, action_dim)."""
        self._raw_actions.copy_(actions)
        cfg, (position, quat) = self.cfg, self._get_frame_pose()
        if cfg.use_relative_mode:
            delta = (self._raw_actions * self._scale).clamp_(-_FARTHEST, _FARTHEST)
            position = position + delta[:, :3]
            if self.action_dim == 6:
                quat = quat_box_plus(quat, delta[:, 3:])
        else:
            position = self._raw_actions[:, :3].clamp(-_FARTHEST, _FARTHEST)
            if self.action_dim == 7:
                given = self._raw_actions[:, 3:]
                is_given = torch.linalg.vector_norm(given, dim=1, keepdim=True) > _MIN_QUAT_NORM
                # A policy that outputs zeros asks for no orientation: the present one is kept.
                quat = torch.where(is_given, normalize(given), quat)
        self._desired_pos.copy_(position)
        self._desired_quat.copy_(quat)

    def apply_actions(self) -> None:
        """Write joint position targets q + dq."""
        q = self._entity.data.joint_pos[:, self._columns]
        self._entity.set_joint_position_target(q + self.compute_dq(), joint_ids=self._columns)

    def compute_dq(self) -> torch.Tensor:
        """Return how far each joint should move, (N, number of joints), without applying it.

        With the pose errors e_p = p* - p and e_R = log(Q* Q^-1), the Jacobians J_p and J_R of the
        frame, and how far joints are outside their soft limits, r = min(u - q, 0) + max(l - q, 0),

            dq = argmin  w_p^2 |J_p dq - e_p|^2 + w_o^2 |J_R dq - e_R|^2
                       + w_l^2 |[r != 0] (dq - r)|^2 + w_q^2 |dq - (q_posture - q)|^2
                       + damping^2 |dq|^2,

        clamped to +-max_dq. Joints that this would take past a soft limit stop there, and the
        others do the best they can with that; a joint that is outside comes back, by at most
        `max_dq` at a time.

        Pose and Jacobian belong to the state before the last substep (at the first substep of a
        step to the present one), q is current.
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
        # On a GPU looking would take longer than solving again.
        if not dq.is_cuda and not blocked.any():
            return dq
        known = torch.where(blocked, bounded, 0.0)
        dq = damped_least_squares(
            jacobian.masked_fill(blocked.unsqueeze(1), 0.0),
            # No matrix product, which a GPU would compute in TF32.
            error - (jacobian * known.unsqueeze(1)).sum(-1),
            stiffness,
            pull,
        )
        return torch.where(blocked, bounded, torch.clamp(dq, low, high))

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Zero the raw action of environments (None means all) and forget their targets."""
        index = slice(None) if env_ids is None else env_ids
        self._raw_actions[index] = 0.0
        self._desired_pos[index] = 0.0
        self._desired_quat[index] = 0.0
        self._desired_quat[index, 0] = 1.0

    def _least_squares(
        self, q: torch.Tensor, low: torch.Tensor, high: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the arguments of `damped_least_squares`; `low` and `high` are the way to limits."""
        cfg = self.cfg
        position, quat = self._get_frame_pose()
        errors = compute_pose_error(position, quat, self._desired_pos, self._desired_quat)
        jacobians = self._env.sim.jacobian(position, self._body_ids)
        weights = (cfg.position_weight, cfg.orientation_weight)
        used = [k for k in (0, 1) if weights[k] != 0.0]
        jacobian = torch.cat([weights[k] * jacobians[k][:, :, self._dofs] for k in used], dim=1)
        error = torch.cat([weights[k] * errors[k] for k in used], dim=1)
        outside = high.clamp(max=0.0) + low.clamp(min=0.0)
        limit, posture = cfg.joint_limit_weight**2, cfg.posture_weight**2
        damping = max(cfg.damping, _MIN_DAMPING) ** 2
        stiffness = limit * (outside != 0.0) + (posture + damping)
        return jacobian, error, stiffness, limit * outside + posture * (self._posture - q)

    def _get_frame_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return position (N, 3) and quaternion (N, 4) of the frame in the world.

        Subclasses override it to control a custom frame; the point moves with the body.
        """
        if self.cfg.frame_type == "body":
            return self._frame_pos, self._frame_rotation
        return self._frame_pos, quat_from_matrix(self._frame_rotation)

    def _find_frame(self) -> None:
        cfg, entity, sim = self.cfg, self._entity, self._env.sim
        find = {"body": entity.find_bodies, "site": entity.find_sites, "geom": entity.find_geoms}
        ids, names = find[cfg.frame_type](cfg.frame_name)
        if len(ids) != 1:
            raise ValueError(
                f"frame_name {cfg.frame_name!r} matches {len(ids)} {cfg.frame_type}s of entity "
                f"{cfg.entity_name!r}: {names}. It has to match exactly one."
            )
        kinds = {"body": "body_ids", "site": "site_ids", "geom": "geom_ids"}
        frame = int(getattr(entity.indexing, kinds[cfg.frame_type])[ids[0]])
        body = frame
        if cfg.frame_type == "body":
            self._frame_pos, self._frame_rotation = (
                sim.data.xpos[:, frame],
                sim.data.xquat[:, frame],
            )
        else:
            body = int(getattr(sim.mj_model, f"{cfg.frame_type}_bodyid")[frame])
            self._frame_pos = getattr(sim.data, f"{cfg.frame_type}_xpos")[:, frame]
            self._frame_rotation = getattr(sim.data, f"{cfg.frame_type}_xmat")[:, frame]
        self._body_ids = torch.full((self.num_envs,), body, dtype=torch.int32, device=self.device)


def damped_least_squares(
    jacobian: torch.Tensor, error: torch.Tensor, stiffness: torch.Tensor, pull: torch.Tensor
) -> torch.Tensor:
    """Return x = (J'J + D)^-1 (J'e + b), with D a diagonal of positive numbers.

    It is computed as x = D^-1 (b + J'y) with (J D^-1 J' + I) y = e - J D^-1 b (the matrix inversion
    lemma). That system has the size of the task, not of the arm, its eigenvalues are at least 1,
    and for an arm that can move freely its condition does not depend on the damping, while that of
    J'J + D grows with its inverse square: in single precision that fails from a damping of about
    1e-3 downward. Singular poses still make it ill-conditioned, so it is solved in double
    precision, which costs no more time here.

    Args:
        jacobian: J, (N, m, n). error: e, (N, m). stiffness: D, (N, n). pull: b, (N, n).

    Returns (N, n), in the precision of `jacobian`.
    """
    j, e = jacobian.double(), error.double().unsqueeze(-1)
    d, b = stiffness.double().unsqueeze(-1), pull.double().unsqueeze(-1)
    scaled = j.mT / d
    system = j @ scaled
    system.diagonal(dim1=-2, dim2=-1).add_(1.0)
    # Without a check of the outcome, which would wait for a GPU: the matrix is positive definite.
    multiplier, _ = torch.linalg.solve_ex(system, e - j @ (b / d))
    return (b / d + scaled @ multiplier).squeeze(-1).to(jacobian.dtype)


def _check_cfg(cfg: DifferentialIKActionCfg) -> None:
    check_one_of("frame_type", cfg.frame_type, get_args(FrameType))
    for name in (*_WEIGHTS, "damping"):
        value = getattr(cfg, name)
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name}: expected a finite number >= 0, got {value!r}.")
    check_positive("max_dq", cfg.max_dq)
    if cfg.position_weight == 0.0 and cfg.orientation_weight == 0.0:
        raise ValueError(
            "position_weight and orientation_weight are both 0, so that the frame is free to be "
            "anywhere. Give at least one of them a positive weight."
        )


__getattr__ = older_names(__name__)
