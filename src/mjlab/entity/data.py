"""Entity state: batched torch tensors of all environments, and writers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from mjlab.compat import offers_older_attributes, older_names, suggests_attributes
from mjlab.entity.indexing import Addresses, EntityIndexing, Ids
from mjlab.utils.errors import UnsupportedError
from mjlab.utils.indexing import EnvIds, as_ids, as_index, read_columns
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse, quat_from_matrix, quat_mul
from mjlab.utils.state import stateful


@offers_older_attributes
@suggests_attributes
@stateful
@dataclass(eq=False)
class EntityData:
    """State and targets of one entity. Shapes: N environments, nb bodies, nj joints.

    World frame unless a name ends in `_b` (frame of the root link); quaternions are (w, x, y, z);
    SI units and radians; spatial velocities are (linear, angular).

    Properties are computed on read. If the entity's elements are contiguous in the simulation,
    `joint_pos`, `body_link_pos_w` and other plain fields are **views of the simulation**: their
    values change as it advances; clone tensors that must persist.

    After `sim.step()` joint positions and velocities are current; derived quantities (link poses,
    link velocities, forces, accelerations) belong to the state before the last substep, until
    `sim.forward()`. In observations, poses and velocities are current; forces and accelerations are
    those of the last substep (`ManagerBasedRlEnv.step`).

    Writers: `env_ids` is None (all), a slice, a boolean mask or a 1-D tensor of indices; element ids
    count within the entity and may also be a list. If both are tensors, they select their product.
    Values are tensors or arrays of any float type; the simulation holds float32.

    Writes go directly to the simulation. Derived quantities (`body_link_pos_w`, link velocities,
    sensors, ...) keep their old values until the next `sim.forward()`. `moved_envs` marks
    environments whose poses or joint positions were written: their forces of the last substep are
    stale, so `env.step` and `env.reset` recompute them.
    """

    _transient = {
        "indexing", "data", "model", "device", "gravity_vec_w", "forward_vec_b",
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
    """Ids and addresses of the entity's elements in the model."""
    data: Any
    """Data fields of the simulation."""
    model: Any
    """Model fields of the simulation."""
    device: str
    default_root_state: torch.Tensor
    """(N, 13) configured position, quaternion, linear and angular velocity, without environment
    origins; (N, 7) with a fixed base."""
    default_joint_pos: torch.Tensor
    """(N, nj) configured joint positions."""
    default_joint_vel: torch.Tensor
    """(N, nj) configured joint velocities."""
    default_joint_pos_limits: torch.Tensor
    """(N, nj, 2) limits of the compiled model; infinite for unlimited joints."""
    joint_pos_limits: torch.Tensor
    """(N, nj, 2) limits in use. Later changes of `jnt_range` do not affect them."""
    soft_joint_pos_limits: torch.Tensor
    """(N, nj, 2) limits scaled about their center by `soft_joint_pos_limit_factor`."""
    gravity_vec_w: torch.Tensor
    """(N, 3) unit vector down, (0, 0, -1), independent of the model's gravity."""
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
    """(N, nj) offset added to joint positions in `joint_pos_biased`. Resets keep it."""
    moved_envs: torch.Tensor | None = None
    """(N,) bool, environments whose pose or joint positions were written since the last substep.
    None: no environment."""

    def __post_init__(self) -> None:
        ix, device = self.indexing, self.device
        self._joint_q = Addresses(ix.joint_q_adr, device)
        self._joint_v = Addresses(ix.joint_v_adr, device)
        self._bodies = Addresses(ix.body_ids, device)
        self._body_trees = Addresses(ix.body_tree_ids, device)
        self._geoms = Addresses(ix.geom_ids, device)
        self._geom_bodies = Addresses(ix.geom_body_ids, device)
        self._geom_trees = Addresses(ix.geom_tree_ids, device)
        self._sites = Addresses(ix.site_ids, device)
        self._site_bodies = Addresses(ix.site_body_ids, device)
        self._site_trees = Addresses(ix.site_tree_ids, device)
        self._tendons = Addresses(ix.tendon_ids, device)
        self._ctrl = Addresses(ix.ctrl_ids, device)
        self._forces = Addresses(ix.force_ids, device)
        # Addresses of a free joint are always contiguous.
        start_q, start_v = ix.free_joint_q_adr[:1].tolist(), ix.free_joint_v_adr[:1].tolist()
        self._free_q = slice(start_q[0], start_q[0] + 7) if start_q else slice(0, 0)
        self._free_v = slice(start_v[0], start_v[0] + 6) if start_v else slice(0, 0)

    # Root link.

    @property
    def root_link_pos_w(self) -> torch.Tensor:
        """(N, 3) position of the root link."""
        return self._root_row("xpos")

    @property
    def root_link_quat_w(self) -> torch.Tensor:
        """(N, 4) orientation of the root link."""
        return self._root_row("xquat")

    @property
    def root_link_pose_w(self) -> torch.Tensor:
        """(N, 7) position and orientation of the root link."""
        return torch.cat((self.root_link_pos_w, self.root_link_quat_w), dim=-1)

    @property
    def root_link_vel_w(self) -> torch.Tensor:
        """(N, 6) velocity of the root link's origin."""
        return torch.cat((self.root_link_lin_vel_w, self.root_link_ang_vel_w), dim=-1)

    @property
    def root_link_lin_vel_w(self) -> torch.Tensor:
        """(N, 3) linear velocity of the root link's origin."""
        return self._root_linear("xpos")

    @property
    def root_link_ang_vel_w(self) -> torch.Tensor:
        """(N, 3) angular velocity of the root link."""
        return self._root_row("cvel")[:, :3]

    @property
    def root_link_lin_vel_b(self) -> torch.Tensor:
        """(N, 3) linear velocity of the root link's origin, in the frame of the root link."""
        return quat_apply_inverse(self.root_link_quat_w, self.root_link_lin_vel_w)

    @property
    def root_link_ang_vel_b(self) -> torch.Tensor:
        """(N, 3) angular velocity of the root link, in the frame of the root link."""
        return quat_apply_inverse(self.root_link_quat_w, self.root_link_ang_vel_w)

    @property
    def projected_gravity_b(self) -> torch.Tensor:
        """(N, 3) unit vector down, in the frame of the root link."""
        return quat_apply_inverse(self.root_link_quat_w, self.gravity_vec_w)

    @property
    def heading_w(self) -> torch.Tensor:
        """(N,) angle from world x to the horizontal projection of the root's forward direction."""
        forward = quat_apply(self.root_link_quat_w, self.forward_vec_b)
        return torch.atan2(forward[:, 1], forward[:, 0])

    # Root center of mass.

    @property
    def root_com_pos_w(self) -> torch.Tensor:
        """(N, 3) center of mass of the root body."""
        return self._root_row("xipos")

    @property
    def root_com_quat_w(self) -> torch.Tensor:
        """(N, 4) orientation of the root body's inertial frame."""
        offset = self.model.body_iquat[:, self.indexing.root_body_id]
        return quat_mul(self.root_link_quat_w, offset)

    @property
    def root_com_pose_w(self) -> torch.Tensor:
        """(N, 7) pose of the root body's inertial frame."""
        return torch.cat((self.root_com_pos_w, self.root_com_quat_w), dim=-1)

    @property
    def root_com_vel_w(self) -> torch.Tensor:
        """(N, 6) velocity of the root body's center of mass."""
        return torch.cat((self.root_com_lin_vel_w, self.root_com_ang_vel_w), dim=-1)

    @property
    def root_com_lin_vel_w(self) -> torch.Tensor:
        """(N, 3) linear velocity of the root body's center of mass."""
        return self._root_linear("xipos")

    @property
    def root_com_ang_vel_w(self) -> torch.Tensor:
        """(N, 3) angular velocity of the root body."""
        return self._root_row("cvel")[:, :3]

    @property
    def root_com_lin_vel_b(self) -> torch.Tensor:
        """(N, 3) velocity of the root body's center of mass, in the frame of the root LINK."""
        return quat_apply_inverse(self.root_link_quat_w, self.root_com_lin_vel_w)

    @property
    def root_com_ang_vel_b(self) -> torch.Tensor:
        """(N, 3) angular velocity of the root body, in the frame of the root LINK."""
        return quat_apply_inverse(self.root_link_quat_w, self.root_com_ang_vel_w)

    def _root_linear(self, position: str) -> torch.Tensor:
        # The root is the top-level body of its tree.
        return _linear_velocity(
            self._root_row(position), self._root_row("subtree_com"), self._root_row("cvel")
        )

    # Bodies.

    @property
    def body_link_pos_w(self) -> torch.Tensor:
        """(N, nb, 3) positions of the links."""
        return self._columns("xpos", self._bodies)

    @property
    def body_link_quat_w(self) -> torch.Tensor:
        """(N, nb, 4) orientations of the links."""
        return self._columns("xquat", self._bodies)

    @property
    def body_link_pose_w(self) -> torch.Tensor:
        """(N, nb, 7) poses of the links."""
        return torch.cat((self.body_link_pos_w, self.body_link_quat_w), dim=-1)

    @property
    def body_link_lin_vel_w(self) -> torch.Tensor:
        """(N, nb, 3) linear velocities of the links' origins."""
        return self._linear_at(self.body_link_pos_w, self._body_trees, self._bodies)

    @property
    def body_link_ang_vel_w(self) -> torch.Tensor:
        """(N, nb, 3) angular velocities of the links."""
        return self._columns("cvel", self._bodies)[..., :3]

    @property
    def body_link_vel_w(self) -> torch.Tensor:
        """(N, nb, 6) velocities of the links' origins."""
        return torch.cat((self.body_link_lin_vel_w, self.body_link_ang_vel_w), dim=-1)

    @property
    def body_com_pos_w(self) -> torch.Tensor:
        """(N, nb, 3) centers of mass of the bodies."""
        return self._columns("xipos", self._bodies)

    @property
    def body_com_quat_w(self) -> torch.Tensor:
        """(N, nb, 4) orientations of the bodies' inertial frames."""
        return quat_mul(self.body_link_quat_w, self.model.body_iquat[:, self._bodies.all])

    @property
    def body_com_pose_w(self) -> torch.Tensor:
        """(N, nb, 7) poses of the bodies' inertial frames."""
        return torch.cat((self.body_com_pos_w, self.body_com_quat_w), dim=-1)

    @property
    def body_com_lin_vel_w(self) -> torch.Tensor:
        """(N, nb, 3) linear velocities of the bodies' centers of mass."""
        return self._linear_at(self.body_com_pos_w, self._body_trees, self._bodies)

    @property
    def body_com_ang_vel_w(self) -> torch.Tensor:
        """(N, nb, 3) angular velocities of the bodies."""
        return self.body_link_ang_vel_w

    @property
    def body_com_vel_w(self) -> torch.Tensor:
        """(N, nb, 6) velocities of the bodies' centers of mass."""
        return torch.cat((self.body_com_lin_vel_w, self.body_com_ang_vel_w), dim=-1)

    def link_lin_vel_of(self, bodies: slice | torch.Tensor) -> torch.Tensor:
        """Return linear velocities of the origins of links `bodies`, (N, n, 3)."""
        ids, trees = self._bodies.tensor[bodies], self._body_trees.tensor[bodies]
        return _linear_velocity(
            self.data.xpos.index_select(1, ids),
            self.data.subtree_com.index_select(1, trees),
            self.data.cvel.index_select(1, ids),
        )

    def link_ang_vel_of(self, bodies: slice | torch.Tensor) -> torch.Tensor:
        """Return angular velocities of links `bodies`, (N, n, 3)."""
        return self.data.cvel.index_select(1, self._bodies.tensor[bodies])[..., :3]

    def _linear_at(self, pos: torch.Tensor, trees: Addresses, bodies: Addresses) -> torch.Tensor:
        """Return the linear velocities of points `pos`, (N, n, 3), of `bodies` in `trees`."""
        return _linear_velocity(
            pos, self._columns("subtree_com", trees), self._columns("cvel", bodies)
        )

    @property
    def body_external_wrench(self) -> torch.Tensor:
        """(N, nb, 6) applied wrench (force, torque) at the bodies' centers of mass."""
        return self._columns("xfrc_applied", self._bodies)

    @property
    def body_external_force(self) -> torch.Tensor:
        """(N, nb, 3) applied forces."""
        return self.body_external_wrench[..., :3]

    @property
    def body_external_torque(self) -> torch.Tensor:
        """(N, nb, 3) applied torques."""
        return self.body_external_wrench[..., 3:]

    # Geoms and sites.

    @property
    def geom_pos_w(self) -> torch.Tensor:
        """(N, number of geoms, 3) positions of the geoms."""
        return self._columns("geom_xpos", self._geoms)

    @property
    def geom_quat_w(self) -> torch.Tensor:
        """(N, number of geoms, 4) orientations; the largest component is positive."""
        return quat_from_matrix(self._columns("geom_xmat", self._geoms))

    @property
    def geom_pose_w(self) -> torch.Tensor:
        """(N, number of geoms, 7) poses of the geoms."""
        return torch.cat((self.geom_pos_w, self.geom_quat_w), dim=-1)

    @property
    def geom_lin_vel_w(self) -> torch.Tensor:
        """(N, number of geoms, 3) linear velocities of the geoms' centers."""
        return self._linear_at(self.geom_pos_w, self._geom_trees, self._geom_bodies)

    @property
    def geom_ang_vel_w(self) -> torch.Tensor:
        """(N, number of geoms, 3) angular velocities of the geoms."""
        return self._columns("cvel", self._geom_bodies)[..., :3]

    @property
    def geom_vel_w(self) -> torch.Tensor:
        """(N, number of geoms, 6) velocities of the geoms' centers."""
        return torch.cat((self.geom_lin_vel_w, self.geom_ang_vel_w), dim=-1)

    @property
    def site_pos_w(self) -> torch.Tensor:
        """(N, number of sites, 3) positions of the sites."""
        return self._columns("site_xpos", self._sites)

    @property
    def site_quat_w(self) -> torch.Tensor:
        """(N, number of sites, 4) orientations; the largest component is positive."""
        return quat_from_matrix(self._columns("site_xmat", self._sites))

    @property
    def site_pose_w(self) -> torch.Tensor:
        """(N, number of sites, 7) poses of the sites."""
        return torch.cat((self.site_pos_w, self.site_quat_w), dim=-1)

    @property
    def site_lin_vel_w(self) -> torch.Tensor:
        """(N, number of sites, 3) linear velocities of the sites."""
        return self._linear_at(self.site_pos_w, self._site_trees, self._site_bodies)

    @property
    def site_ang_vel_w(self) -> torch.Tensor:
        """(N, number of sites, 3) angular velocities of the sites."""
        return self._columns("cvel", self._site_bodies)[..., :3]

    @property
    def site_vel_w(self) -> torch.Tensor:
        """(N, number of sites, 6) velocities of the sites."""
        return torch.cat((self.site_lin_vel_w, self.site_ang_vel_w), dim=-1)

    # Joints, tendons, actuators.

    @property
    def joint_pos(self) -> torch.Tensor:
        """(N, nj) joint positions."""
        return self._columns("qpos", self._joint_q)

    @property
    def joint_pos_biased(self) -> torch.Tensor:
        """(N, nj) joint positions plus `encoder_bias`."""
        return self.joint_pos + self.encoder_bias

    @property
    def joint_vel(self) -> torch.Tensor:
        """(N, nj) joint velocities."""
        return self._columns("qvel", self._joint_v)

    @property
    def joint_acc(self) -> torch.Tensor:
        """(N, nj) joint accelerations of the last substep."""
        return self._columns("qacc", self._joint_v)

    @property
    def joint_torques(self) -> torch.Tensor:
        """Not supported, because the name is ambiguous; raises with the alternatives."""
        raise UnsupportedError(
            "EntityData.joint_torques is ambiguous; use qfrc_actuator for the generalized forces of "
            "the actuators on the joints, or actuator_force for actuator forces before their gear."
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
        """(N, number of forces) forces of the actuators, in order, before their gear.

        Values of the last substep. An orientation servo has three forces, every other actuator one;
        see `indexing.force_columns`.
        """
        return self._columns("actuator_force", self._forces)

    @property
    def qfrc_actuator(self) -> torch.Tensor:
        """(N, nj) generalized actuator forces on the joints in the last substep."""
        return self._columns("qfrc_actuator", self._joint_v)

    @property
    def qfrc_external(self) -> torch.Tensor:
        """(N, nj) generalized joint forces due to the wrenches applied to bodies.

        `sum_b S_j . (tau_b + (p_b - c) x f_b, f_b)` over the bodies b moved by joint axis j, with
        motion axis `S_j` (`cdof`) about c, the center of mass of the tree.
        """
        # Not `qfrc_smooth` minus its other parts: MuJoCo computes these at different stages.
        force, torque = self._columns("xfrc_applied", self._bodies).split(3, dim=-1)
        arm = self._columns("xipos", self._bodies) - self._columns("subtree_com", self._body_trees)
        wrench = torch.cat((torque + torch.linalg.cross(arm, force), force), dim=-1)
        # A sum, because matrix products may be rounded to TF32.
        below = (self.indexing.moved_bodies[..., None] * wrench[:, None]).sum(dim=2)
        return (self._columns("cdof", self._joint_v) * below).sum(dim=-1)

    # Targets.

    def clear_state(self, env_ids: EnvIds = None) -> None:
        """Set all targets to zero."""
        for target in (
            self.joint_pos_target,
            self.joint_vel_target,
            self.joint_effort_target,
            self.tendon_len_target,
            self.tendon_vel_target,
            self.tendon_effort_target,
            self.site_effort_target,
        ):
            if target.shape[1] > 0:
                target[as_index(env_ids)] = 0.0

    # Writers.

    def write_root_state(self, root_state: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write pose and velocity of the root link, (k, 13); see the next two writers."""
        self._require_floating("write_root_state")
        root_state = as_values(root_state, 13, "root state", self.device)
        self.write_root_pose(root_state[..., :7], env_ids)
        self.write_root_velocity(root_state[..., 7:], env_ids)

    def write_root_pose(self, pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the world pose of the root link, (k, 7): position, quaternion (w, x, y, z).

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        self._require_floating("write_root_pose")
        pose = as_values(pose, 7, "root pose", self.device)
        assign(self.data.qpos, pose, env_ids, self._free_q)
        self._note_move(env_ids)

    def write_root_velocity(self, velocity: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the world velocity of the root link, (k, 6): linear (of its origin), angular.

        MuJoCo stores angular velocity in the body frame, so it is rotated by the current
        orientation in `qpos`: write the pose first.

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        quat, linear, angular = self._read_velocity("write_root_velocity", velocity, env_ids)
        angular_b = quat_apply_inverse(quat, angular)
        assign(self.data.qvel, torch.cat((linear, angular_b), dim=-1), env_ids, self._free_v)

    def write_root_velocity_b(self, velocity_b: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the velocity of the root link in the link frame, (k, 6): linear, angular.

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        quat, linear_b, angular_b = self._read_velocity(
            "write_root_velocity_b", velocity_b, env_ids
        )
        linear = quat_apply(quat, linear_b)
        assign(self.data.qvel, torch.cat((linear, angular_b), dim=-1), env_ids, self._free_v)

    def write_root_com_velocity(self, velocity: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the world velocity of the root body's center of mass, (k, 6): linear, angular.

        The velocity of the link origin is `v_com - omega x (R body_ipos)`.

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        quat, linear, angular = self._read_velocity("write_root_com_velocity", velocity, env_ids)
        offset_b = self.model.body_ipos[:, self.indexing.root_body_id][as_index(env_ids)]
        linear = linear - torch.linalg.cross(angular, quat_apply(quat, offset_b))
        self.write_root_velocity(torch.cat((linear, angular), dim=-1), env_ids)

    def write_joint_state(
        self,
        position: torch.Tensor,
        velocity: torch.Tensor,
        joint_ids: Ids = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Write joint positions and velocities, each (k, number of joints) or (k, 1)."""
        self.write_joint_position(position, joint_ids, env_ids)
        self.write_joint_velocity(velocity, joint_ids, env_ids)

    def write_joint_position(
        self, position: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write joint positions, (k, number of joints) or (k, 1).

        Raises:
            ValueError: the entity has no joints, or the width is wrong.
        """
        self._require_articulated("write_joint_position")
        columns, width = self._joint_q.select(joint_ids)
        position = as_values(position, width, "joint position", self.device, broadcasts=True)
        assign(self.data.qpos, position, env_ids, columns)
        self._note_move(env_ids)

    def write_joint_velocity(
        self, velocity: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write joint velocities, (k, number of joints) or (k, 1).

        Raises:
            ValueError: the entity has no joints, or the width is wrong.
        """
        self._require_articulated("write_joint_velocity")
        columns, width = self._joint_v.select(joint_ids)
        velocity = as_values(velocity, width, "joint velocity", self.device, broadcasts=True)
        assign(self.data.qvel, velocity, env_ids, columns)

    def write_external_wrench(
        self,
        force: torch.Tensor | None,
        torque: torch.Tensor | None,
        body_ids: Sequence[int] | torch.Tensor | slice | None = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Set force and torque on bodies, each (k, number of bodies, 3). None: unchanged.

        Wrenches are in the world frame, act at the bodies' centers of mass, and persist until
        overwritten or until the environment is reset.
        """
        columns, _ = self._bodies.select(body_ids)
        wrench = self.data.xfrc_applied
        for value, half, name in ((force, slice(0, 3), "force"), (torque, slice(3, 6), "torque")):
            if value is not None:
                values = as_values(value, 3, f"external {name}", self.device)
                assign(wrench[..., half], values, env_ids, columns)

    def write_ctrl(self, ctrl: torch.Tensor, ctrl_ids: Ids = None, env_ids: EnvIds = None) -> None:
        """Write controls of actuators, (k, number of controls), or (k, 1) to broadcast.

        `ctrl_ids` are actuator ids as returned by `find_actuators`. Controls are grouped by actuator:
        most have one; `<pid>`, `<dcmotor>` and `<orientation>` may have several.

        Raises:
            ValueError: the entity has no configured actuators, or the width is wrong.
        """
        if not self.is_actuated:
            raise ValueError(
                "write_ctrl: entity has no configured actuators; add them to "
                "EntityCfg.articulation.actuators."
            )
        columns, width = self._ctrl.select(self.indexing.control_columns(ctrl_ids))
        ctrl = as_values(ctrl, width, "control", self.device, broadcasts=True)
        assign(self.data.ctrl, ctrl, env_ids, columns)

    def write_mocap_pose(self, pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the pose of the mocap root, (k, 7): position, quaternion (w, x, y, z).

        Raises:
            ValueError: the root is not a mocap body, or the width is wrong.
        """
        mocap_id = self.indexing.mocap_id
        if mocap_id is None:
            raise ValueError(
                "write_mocap_pose: entity has no mocap root; use write_root_pose for a floating base."
            )
        pose = as_values(pose, 7, "mocap pose", self.device)
        assign(self.data.mocap_pos, pose[..., :3], env_ids, mocap_id)
        assign(self.data.mocap_quat, pose[..., 3:], env_ids, mocap_id)
        self._note_move(env_ids)

    def _note_move(self, env_ids: EnvIds) -> None:
        # A new tensor, because tensors created under `inference_mode` cannot be written outside it.
        if self.moved_envs is None:
            size = len(self.default_root_state)
            moved = torch.zeros(size, dtype=torch.bool, device=self.device)
        else:
            moved = self.moved_envs.clone()
        moved[as_index(env_ids)] = True
        self.moved_envs = moved

    def _read_velocity(
        self, writer: str, velocity: torch.Tensor, env_ids: EnvIds
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the current root orientations, (k, 4), and both halves of `velocity`, (k, 3).

        Raises `ValueError`, naming `writer`, for a fixed base or a wrong width.
        """
        self._require_floating(writer)
        velocity = as_values(velocity, 6, "root velocity", self.device)
        quat = self.data.qpos[:, self._free_q][as_index(env_ids), 3:7]
        halves = velocity.expand(len(quat), 6)
        return quat, halves[:, :3], halves[:, 3:]

    def _require_floating(self, writer: str) -> None:
        if self.is_fixed_base:
            raise ValueError(
                f"{writer}: entity has a fixed base; use write_mocap_pose, or add a free joint to its "
                "root body."
            )

    def _require_articulated(self, writer: str) -> None:
        if not self.is_articulated:
            raise ValueError(f"{writer}: entity has no joints other than a free joint.")

    # Simulation fields.

    def _columns(self, name: str, at: Addresses) -> torch.Tensor:
        """Return the entity's columns of a data field, as a view if they are contiguous."""
        return read_columns(getattr(self.data, name), at.all)

    def _root_row(self, name: str) -> torch.Tensor:
        return getattr(self.data, name)[:, self.indexing.root_body_id]


def compute_velocity_from_cvel(
    pos: torch.Tensor, subtree_com: torch.Tensor, cvel: torch.Tensor
) -> torch.Tensor:
    """Return the world velocity of points fixed to bodies, (..., 6): linear, angular.

    MuJoCo's `cvel = (omega, v_c)` is the velocity of the point of the (extended) body at `c`, the
    center of mass of the body's whole tree. Hence `v(p) = v_c - omega x (c - p)`.

    Args:
        pos: World positions p, (..., 3).
        subtree_com: Center of mass of the tree of each point's body, (..., 3).
        cvel: `cvel` of each point's body, (..., 6).
    """
    linear = _linear_velocity(pos, subtree_com, cvel)
    return torch.cat((linear, cvel[..., :3].expand_as(linear)), dim=-1)


def _linear_velocity(
    pos: torch.Tensor, subtree_com: torch.Tensor, cvel: torch.Tensor
) -> torch.Tensor:
    return torch.linalg.cross(cvel[..., :3], pos - subtree_com).add_(cvel[..., 3:])


def as_values(
    value: Any, width: int, name: str, device: str, broadcasts: bool = False
) -> torch.Tensor:
    """Return a tensor, array or number as float32; the last dimension must be `width`.

    With `broadcasts`, the last dimension may be 1: one value for all elements.

    Raises:
        ValueError: the last dimension is wrong.
    """
    if not isinstance(value, torch.Tensor):
        # Copied, because torch warns about read-only arrays.
        value = torch.as_tensor(np.array(value), dtype=torch.float32, device=device)
    elif value.dtype != torch.float32:
        value = value.to(device, torch.float32)
    widths = (1, width) if broadcasts else (width,)
    if value.ndim > 0 and value.shape[-1] not in widths:
        raise ValueError(
            f"{name}: expected a tensor of shape (number of envs, {width}), got "
            f"{value.shape[-1]} values per environment (shape {tuple(value.shape)})."
        )
    return value


def assign(
    field: torch.Tensor,
    value: torch.Tensor,
    env_ids: EnvIds,
    columns: slice | torch.Tensor | int,
) -> None:
    """Write `value` into rows `env_ids` and `columns` of `field`; two tensors select their product."""
    if env_ids is None:
        field[:, columns] = value
    elif isinstance(columns, torch.Tensor) and not isinstance(env_ids, slice):
        field[as_ids(env_ids, len(field), field.device)[:, None], columns] = value
    else:
        field[env_ids, columns] = value


__getattr__ = older_names(__name__)
