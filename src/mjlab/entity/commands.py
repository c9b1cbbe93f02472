"""Commands to an entity: targets of its actuators, and state written into the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from mjlab.entity.indexing import Ids
from mjlab.entity.state_writer import EnvIds, as_values, assign

if TYPE_CHECKING:
    from mjlab.entity.data import EntityData


class EntityCommands:
    """The setters and writers of `Entity`.

    `env_ids` is None (all), a slice, a boolean mask or a one-dimensional tensor of indices; element
    ids count within the entity and may also be a list. Tensors of both select their product. Values
    are tensors or arrays of any float type. All raise `ValueError` if a width is wrong or the entity
    has no such elements.

    Setters store a target for the next `write_data_to_sim`; writers change the simulation now, and
    what derives from the state follows at the next `sim.forward()`.
    """

    @property
    def data(self) -> EntityData:
        """State and targets of the entity."""
        raise NotImplementedError

    def set_joint_position_target(
        self, position: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set position targets (k, number of joints), in radians or metres."""
        _set_target(self.data.joint_pos_target, position, joint_ids, env_ids, "joint")

    def set_joint_velocity_target(
        self, velocity: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set velocity targets (k, number of joints)."""
        _set_target(self.data.joint_vel_target, velocity, joint_ids, env_ids, "joint")

    def set_joint_effort_target(
        self, effort: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set effort targets (k, number of joints)."""
        _set_target(self.data.joint_effort_target, effort, joint_ids, env_ids, "joint")

    def set_tendon_len_target(
        self, length: torch.Tensor, tendon_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set length targets (k, number of tendons)."""
        _set_target(self.data.tendon_len_target, length, tendon_ids, env_ids, "tendon")

    def set_tendon_vel_target(
        self, velocity: torch.Tensor, tendon_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set velocity targets (k, number of tendons)."""
        _set_target(self.data.tendon_vel_target, velocity, tendon_ids, env_ids, "tendon")

    def set_tendon_effort_target(
        self, effort: torch.Tensor, tendon_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set effort targets (k, number of tendons)."""
        _set_target(self.data.tendon_effort_target, effort, tendon_ids, env_ids, "tendon")

    def set_site_effort_target(
        self, effort: torch.Tensor, site_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set effort targets (k, number of sites)."""
        _set_target(self.data.site_effort_target, effort, site_ids, env_ids, "site")

    def seed_position_targets(self, env_ids: EnvIds = None) -> None:
        """Where no joint position target was set since the reset, take the current position.

        A reset leaves all targets at zero. Position actuators would then pull towards zero until
        the first action: after the reset events have placed the joints, this holds them there.
        """
        target = self.data.joint_pos_target
        if target.shape[1] == 0:
            return
        rows = slice(None) if env_ids is None else env_ids
        chosen = target[rows]
        target[rows] = torch.where(chosen == 0.0, self.data.joint_pos[rows], chosen)

    def write_root_state_to_sim(self, root_state: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the root link's pose and velocity (k, 13)."""
        self.data.write_root_state(root_state, env_ids)

    def write_root_link_pose_to_sim(self, root_pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the root link's world pose (k, 7): position, quaternion (w, x, y, z)."""
        self.data.write_root_pose(root_pose, env_ids)

    def write_root_link_velocity_to_sim(
        self, root_velocity: torch.Tensor, env_ids: EnvIds = None
    ) -> None:
        """Write the root link's world velocity (k, 6). Write its pose before."""
        self.data.write_root_velocity(root_velocity, env_ids)

    def write_root_link_velocity_b_to_sim(
        self, root_velocity_b: torch.Tensor, env_ids: EnvIds = None
    ) -> None:
        """Write the root link's velocity given in its own frame (k, 6). Write its pose before."""
        self.data.write_root_velocity_b(root_velocity_b, env_ids)

    def write_root_com_velocity_to_sim(
        self, root_velocity: torch.Tensor, env_ids: EnvIds = None
    ) -> None:
        """Write the world velocity of the root body's centre of mass (k, 6), after its pose."""
        self.data.write_root_com_velocity(root_velocity, env_ids)

    def write_joint_state_to_sim(
        self,
        position: torch.Tensor,
        velocity: torch.Tensor,
        joint_ids: Ids = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Write joint positions and velocities (k, number of joints); (k, 1) for all joints alike."""
        self.data.write_joint_state(position, velocity, joint_ids, env_ids)

    def write_joint_position_to_sim(
        self, position: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write joint positions (k, number of joints); (k, 1) for all joints alike."""
        self.data.write_joint_position(position, joint_ids, env_ids)

    def write_joint_velocity_to_sim(
        self, velocity: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write joint velocities (k, number of joints); (k, 1) for all joints alike."""
        self.data.write_joint_velocity(velocity, joint_ids, env_ids)

    def write_external_wrench_to_sim(
        self,
        forces: torch.Tensor | None,
        torques: torch.Tensor | None,
        env_ids: EnvIds = None,
        body_ids: Sequence[int] | torch.Tensor | slice | None = None,
    ) -> None:
        """Set world force and torque on bodies (k, number of bodies, 3), at their mass centres."""
        self.data.write_external_wrench(forces, torques, body_ids, env_ids)

    def write_ctrl_to_sim(
        self, ctrl: torch.Tensor, ctrl_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write controls (k, number of controls) of actuators `ctrl_ids`, as `find_actuators` counts.

        See `EntityData.write_ctrl` for actuators with several controls.
        """
        self.data.write_ctrl(ctrl, ctrl_ids, env_ids)

    def write_mocap_pose_to_sim(self, mocap_pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the pose of the mocap root (k, 7): position, quaternion (w, x, y, z)."""
        self.data.write_mocap_pose(mocap_pose, env_ids)


def _set_target(
    target: torch.Tensor, value: torch.Tensor, ids: Ids, env_ids: EnvIds, what: str
) -> None:
    width = target.shape[1]
    if width == 0:
        raise ValueError(
            f"This entity has no {what} targets: it has no {what}s"
            + ("." if what == "joint" else f", or no configured actuator acts on a {what}.")
        )
    columns: slice | torch.Tensor
    if ids is None:
        columns = slice(None)
    elif isinstance(ids, slice):
        columns, width = ids, len(range(*ids.indices(width)))
    else:
        columns = torch.as_tensor(ids, device=target.device)
        if columns.dtype == torch.bool:
            columns = columns.nonzero().flatten()
        width = columns.shape[0]
    values = as_values(value, width, f"The {what} target", str(target.device), broadcasts=True)
    assign(target, values, env_ids, columns)
