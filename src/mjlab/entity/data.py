"""The state of one entity, in every environment, as torch tensors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch

from mjlab.compat import offers_older_attributes, older_names
from mjlab.entity.indexing import EntityIndexing
from mjlab.entity.kinematics import KinematicsReader
from mjlab.entity.kinematics import compute_velocity_from_cvel as compute_velocity_from_cvel
from mjlab.entity.state_writer import EnvIds, StateWriter
from mjlab.utils.state import stateful


@offers_older_attributes
@stateful
@dataclass(eq=False)
class EntityData(KinematicsReader, StateWriter):
    """State and targets of one entity. N environments, nb bodies, nj joints, and so on.

    World frame unless a name ends in `_b` (frame of the root link); quaternions are (w, x, y, z);
    SI units, radians; velocities of links and of centres of mass are (linear, angular).

    A property computes only itself, when it is read. Where the entity's elements follow each other
    in the simulation, `joint_pos`, `body_link_pos_w` and other plain fields are **views of the
    simulation**: they change as it advances, so clone what has to last.

    After `sim.step()` joint positions and velocities are current, and everything that MuJoCo
    derives from them (poses, velocities of links, forces, accelerations) belongs to the state
    before the last substep, until `sim.forward()`. In observations poses and velocities are
    current; forces and accelerations are those of the last substep (`ManagerBasedRlEnv.step`).
    """

    _transient = {
        "indexing", "data", "model", "device", "_views", "gravity_vec_w", "forward_vec_b",
        "moved_envs",
    }  # fmt: skip

    POS_DIM = 3
    QUAT_DIM = 4
    LIN_VEL_DIM = 3
    ANG_VEL_DIM = 3
    ROOT_POSE_DIM = POS_DIM + QUAT_DIM
    ROOT_VEL_DIM = LIN_VEL_DIM + ANG_VEL_DIM
    ROOT_STATE_DIM = ROOT_POSE_DIM + ROOT_VEL_DIM

    indexing: EntityIndexing
    """Where the entity's elements are in the model."""
    data: Any
    """The simulation's data fields."""
    model: Any
    """The simulation's model fields."""
    device: str
    default_root_state: torch.Tensor
    """(N, 13) configured position, quaternion, linear and angular velocity, without environment
    origins; (N, 7) with a fixed base."""
    default_joint_pos: torch.Tensor
    """(N, nj) configured joint positions."""
    default_joint_vel: torch.Tensor
    """(N, nj) configured joint velocities."""
    default_joint_pos_limits: torch.Tensor
    """(N, nj, 2) limits of the compiled model; infinite where a joint has none."""
    joint_pos_limits: torch.Tensor
    """(N, nj, 2) limits in use. Changing `jnt_range` afterwards does not change them."""
    soft_joint_pos_limits: torch.Tensor
    """(N, nj, 2) limits shrunk about their middle by the configured factor."""
    gravity_vec_w: torch.Tensor
    """(N, 3) unit vector down, (0, 0, -1); not the model's gravity."""
    forward_vec_b: torch.Tensor
    """(N, 3) forward direction of the root link, (1, 0, 0)."""
    is_fixed_base: bool
    is_articulated: bool
    is_actuated: bool
    joint_pos_target: torch.Tensor
    joint_vel_target: torch.Tensor
    joint_effort_target: torch.Tensor
    """(N, nj) commands for joint actuators; zero after a reset."""
    tendon_len_target: torch.Tensor
    tendon_vel_target: torch.Tensor
    tendon_effort_target: torch.Tensor
    """(N, number of tendons) commands for tendon actuators; (N, 0) without such actuators."""
    site_effort_target: torch.Tensor
    """(N, number of sites) commands for site actuators; (N, 0) without such actuators."""
    encoder_bias: torch.Tensor
    """(N, nj) added to joint positions in `joint_pos_biased`; kept over resets."""
    moved_envs: torch.Tensor | None = None
    """(N,) bool, where a pose or joint positions were written since the last substep; None for
    nowhere."""
    _views: dict[Any, torch.Tensor] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._find_addresses()

    def clear_state(self, env_ids: EnvIds = None) -> None:
        """Set all targets to zero."""
        for target in self._targets():
            if target.shape[1] == 0:
                continue
            if env_ids is None:
                target.zero_()
            else:
                target[env_ids] = 0.0

    def _targets(self) -> tuple[torch.Tensor, ...]:
        return (
            self.joint_pos_target,
            self.joint_vel_target,
            self.joint_effort_target,
            self.tendon_len_target,
            self.tendon_vel_target,
            self.tendon_effort_target,
            self.site_effort_target,
        )

    # Joints, tendons, actuators.

    @property
    def joint_pos(self) -> torch.Tensor:
        """(N, nj) joint positions."""
        return self._columns("qpos", self._joint_q)

    @property
    def joint_pos_biased(self) -> torch.Tensor:
        """(N, nj) joint positions as encoders with a bias report them."""
        return self.joint_pos + self.encoder_bias

    @property
    def joint_vel(self) -> torch.Tensor:
        """(N, nj) joint velocities."""
        return self._columns("qvel", self._joint_v)

    @property
    def joint_acc(self) -> torch.Tensor:
        """(N, nj) joint accelerations, of the last substep."""
        return self._columns("qacc", self._joint_v)

    @property
    def joint_torques(self) -> torch.Tensor:
        """Not offered: see the error for the two things it could mean."""
        raise NotImplementedError(
            "joint_torques could mean two things. Use qfrc_actuator for what the actuators apply "
            "to the joints, or actuator_force for the force of each actuator before its gear."
        )

    @property
    def tendon_len(self) -> torch.Tensor:
        """(N, number of tendons) tendon lengths."""
        return self._columns("ten_length", self._tendons)

    @property
    def tendon_vel(self) -> torch.Tensor:
        """(N, number of tendons) tendon velocities."""
        return self._columns("ten_velocity", self._tendons)

    @property
    def actuator_force(self) -> torch.Tensor:
        """(N, number of forces) forces of the actuators in turn, before their gear.

        Those of the last substep. An orientation servo has three, every other actuator one; see
        `indexing.force_columns`.
        """
        return self._columns("actuator_force", self._forces)

    @property
    def qfrc_actuator(self) -> torch.Tensor:
        """(N, nj) generalized forces of the actuators on the joints in the last substep."""
        return self._columns("qfrc_actuator", self._joint_v)

    @property
    def qfrc_external(self) -> torch.Tensor:
        """(N, nj) generalized forces on the joints of the wrenches now applied to bodies.

        `sum_b S_j . (tau_b + (p_b - c) x f_b, f_b)` over the bodies b that joint axis j moves, with
        its motion axis `S_j` (`cdof`) about c, the centre of mass of the tree.
        """
        # Not `qfrc_smooth` without its other parts: those are of different stages of MuJoCo.
        force, torque = self._columns("xfrc_applied", self._bodies).split(3, dim=-1)
        arm = self._columns("xipos", self._bodies) - self._tree_com(self._body_trees)
        wrench = torch.cat((torque + torch.linalg.cross(arm, force), force), dim=-1)
        # A sum, because products of matrices may be rounded to TF32.
        below = (self.indexing.moved_bodies[..., None] * wrench[:, None]).sum(dim=2)
        return (self._columns("cdof", self._joint_v) * below).sum(dim=-1)


__getattr__ = older_names(__name__)
