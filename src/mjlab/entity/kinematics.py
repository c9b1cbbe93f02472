"""Poses and velocities of one entity's root, bodies, geoms and sites."""

from __future__ import annotations

from typing import Any

import torch

from mjlab.entity.indexing import Addresses, EntityIndexing
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse, quat_from_matrix, quat_mul


def compute_velocity_from_cvel(
    pos: torch.Tensor, subtree_com: torch.Tensor, cvel: torch.Tensor
) -> torch.Tensor:
    """Return the world velocity of points fixed to bodies: (..., 6) linear, angular.

    MuJoCo's `cvel = (omega, v_c)` is the velocity of the point of the (extended) body that is now
    at `c`, the centre of mass of the body's whole tree. Hence `v(p) = v_c - omega x (c - p)`.

    Args:
        pos: (..., 3) world positions p.
        subtree_com: (..., 3) centre of mass of the tree that each point's body belongs to.
        cvel: (..., 6) `cvel` of each point's body.
    """
    linear = _linear_velocity(pos, subtree_com, cvel)
    return torch.cat((linear, cvel[..., :3].expand_as(linear)), dim=-1)


def _linear_velocity(
    pos: torch.Tensor, subtree_com: torch.Tensor, cvel: torch.Tensor
) -> torch.Tensor:
    return torch.linalg.cross(cvel[..., :3], pos - subtree_com).add_(cvel[..., 3:])


class KinematicsReader:
    """The properties of `EntityData` that read where things are and how they move.

    `EntityData` says what they have in common.
    """

    indexing: EntityIndexing
    data: Any
    model: Any
    device: str
    gravity_vec_w: torch.Tensor
    forward_vec_b: torch.Tensor
    _views: dict[Any, torch.Tensor]

    def _find_addresses(self) -> None:
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
        self._root = Addresses([ix.root_body_id], device)
        # A free joint's addresses always follow each other.
        start_q, start_v = ix.free_joint_q_adr[:1].tolist(), ix.free_joint_v_adr[:1].tolist()
        self._free_q = slice(start_q[0], start_q[0] + 7) if start_q else slice(0, 0)
        self._free_v = slice(start_v[0], start_v[0] + 6) if start_v else slice(0, 0)

    # Reading a simulation field.

    def _columns(self, name: str, at: Addresses) -> torch.Tensor:
        """Return the entity's part of a data field: a view, kept, where addresses allow one."""
        key = (name, id(at))
        view = self._views.get(key)
        if view is not None:
            return view
        field = getattr(self.data, name)
        if isinstance(at.all, torch.Tensor):
            # Several times as fast as indexing with the tensor.
            return field.index_select(1, at.all)
        # Tensors of data fields live as long as the simulation, so views of them do too.
        view = self._views[key] = field[:, at.all]
        return view

    def _root_row(self, name: str) -> torch.Tensor:
        key = (name, "root")
        view = self._views.get(key)
        if view is None:
            view = self._views[key] = getattr(self.data, name)[:, self.indexing.root_body_id]
        return view

    def _tree_com(self, trees: Addresses) -> torch.Tensor:
        """Return centres of mass of trees, (N, n, 3), or (N, 1, 3) if all are the root's tree.

        An entity with several top-level bodies has several trees, each with its own centre.
        """
        if trees.constant == self.indexing.root_body_id:
            return self._columns("subtree_com", self._root)
        return self._columns("subtree_com", trees)

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
        """(N, 3) linear velocity of the root link's origin, in its frame."""
        return quat_apply_inverse(self.root_link_quat_w, self.root_link_lin_vel_w)

    @property
    def root_link_ang_vel_b(self) -> torch.Tensor:
        """(N, 3) angular velocity of the root link, in its frame."""
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

    # Root centre of mass.

    @property
    def root_com_pos_w(self) -> torch.Tensor:
        """(N, 3) centre of mass of the root body."""
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
        """(N, 6) velocity of the root body's centre of mass."""
        return torch.cat((self.root_com_lin_vel_w, self.root_com_ang_vel_w), dim=-1)

    @property
    def root_com_lin_vel_w(self) -> torch.Tensor:
        """(N, 3) linear velocity of the root body's centre of mass."""
        return self._root_linear("xipos")

    @property
    def root_com_ang_vel_w(self) -> torch.Tensor:
        """(N, 3) angular velocity of the root body."""
        return self._root_row("cvel")[:, :3]

    @property
    def root_com_lin_vel_b(self) -> torch.Tensor:
        """(N, 3) velocity of the root body's centre of mass, in the frame of the root LINK."""
        return quat_apply_inverse(self.root_link_quat_w, self.root_com_lin_vel_w)

    @property
    def root_com_ang_vel_b(self) -> torch.Tensor:
        """(N, 3) angular velocity of the root body, in the frame of the root LINK."""
        return quat_apply_inverse(self.root_link_quat_w, self.root_com_ang_vel_w)

    def _root_linear(self, position: str) -> torch.Tensor:
        # The root is the top-level body of its own tree.
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
        return self._body_linear("xpos")

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
        """(N, nb, 3) centres of mass of the bodies."""
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
        """(N, nb, 3) linear velocities of the bodies' centres of mass."""
        return self._body_linear("xipos")

    @property
    def body_com_ang_vel_w(self) -> torch.Tensor:
        """(N, nb, 3) angular velocities of the bodies."""
        return self.body_link_ang_vel_w

    @property
    def body_com_vel_w(self) -> torch.Tensor:
        """(N, nb, 6) velocities of the bodies' centres of mass."""
        return torch.cat((self.body_com_lin_vel_w, self.body_com_ang_vel_w), dim=-1)

    def link_lin_vel_of(self, bodies: slice | torch.Tensor) -> torch.Tensor:
        """Return linear velocities of the origins of links `bodies` of the entity, (N, n, 3).

        This is faster than choosing from `body_link_lin_vel_w`, which computes those of all links.
        """
        ids = self._bodies.tensor[bodies]
        if self._body_trees.constant == self.indexing.root_body_id:
            com = self._columns("subtree_com", self._root)
        else:
            com = self.data.subtree_com.index_select(1, self._body_trees.tensor[bodies])
        pos, cvel = (field.index_select(1, ids) for field in (self.data.xpos, self.data.cvel))
        return _linear_velocity(pos, com, cvel)

    def link_ang_vel_of(self, bodies: slice | torch.Tensor) -> torch.Tensor:
        """Return angular velocities of links `bodies` of the entity, (N, n, 3)."""
        return self.data.cvel.index_select(1, self._bodies.tensor[bodies])[..., :3]

    def _body_linear(self, position: str) -> torch.Tensor:
        return _linear_velocity(
            self._columns(position, self._bodies),
            self._tree_com(self._body_trees),
            self._columns("cvel", self._bodies),
        )

    @property
    def body_external_wrench(self) -> torch.Tensor:
        """(N, nb, 6) applied force and torque, at the bodies' centres of mass."""
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
        """(N, number of geoms, 3) linear velocities of the geoms' centres."""
        return _linear_velocity(
            self.geom_pos_w,
            self._tree_com(self._geom_trees),
            self._columns("cvel", self._geom_bodies),
        )

    @property
    def geom_ang_vel_w(self) -> torch.Tensor:
        """(N, number of geoms, 3) angular velocities of the geoms."""
        return self._columns("cvel", self._geom_bodies)[..., :3]

    @property
    def geom_vel_w(self) -> torch.Tensor:
        """(N, number of geoms, 6) velocities of the geoms' centres."""
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
        return _linear_velocity(
            self.site_pos_w,
            self._tree_com(self._site_trees),
            self._columns("cvel", self._site_bodies),
        )

    @property
    def site_ang_vel_w(self) -> torch.Tensor:
        """(N, number of sites, 3) angular velocities of the sites."""
        return self._columns("cvel", self._site_bodies)[..., :3]

    @property
    def site_vel_w(self) -> torch.Tensor:
        """(N, number of sites, 6) velocities of the sites."""
        return torch.cat((self.site_lin_vel_w, self.site_ang_vel_w), dim=-1)
