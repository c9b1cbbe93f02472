"""Writing the state of one entity into the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.entity.indexing import Addresses, Ids
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse

if TYPE_CHECKING:
    from mjlab.entity.indexing import EntityIndexing

EnvIds = torch.Tensor | slice | None


def assign(
    field: torch.Tensor,
    value: torch.Tensor,
    env_ids: EnvIds,
    columns: slice | torch.Tensor | int,
) -> None:
    """Write `value` into rows `env_ids` and `columns` of `field`; tensors select their product."""
    if env_ids is None:
        field[:, columns] = value
    elif isinstance(columns, torch.Tensor) and not isinstance(env_ids, slice):
        field[_row_numbers(env_ids)[:, None], columns] = value
    else:
        field[env_ids, columns] = value


def rows(field: torch.Tensor, env_ids: EnvIds) -> torch.Tensor:
    """Return the rows `env_ids` of `field`."""
    return field if env_ids is None else field[env_ids]


def as_values(
    value: Any, width: int, name: str, device: str, broadcasts: bool = False
) -> torch.Tensor:
    """Return a tensor, array or number as float32, whose last dimension must be `width`.

    With `broadcasts` it may be 1: one value for all elements.

    Raises:
        ValueError: the width is another.
    """
    if not isinstance(value, torch.Tensor):
        # Copied, because torch warns about arrays that it may not write to.
        value = torch.as_tensor(np.array(value), dtype=torch.float32, device=device)
    elif value.dtype != torch.float32:
        value = value.to(device, torch.float32)
    widths = (1, width) if broadcasts else (width,)
    if value.ndim > 0 and value.shape[-1] not in widths:
        raise ValueError(
            f"{name} has {value.shape[-1]} values per environment (shape {tuple(value.shape)}), "
            f"but {width} are to be written. Give a tensor of shape (number of envs, {width})."
        )
    return value


def _row_numbers(env_ids: torch.Tensor) -> torch.Tensor:
    env_ids = torch.as_tensor(env_ids)
    return env_ids.nonzero().flatten() if env_ids.dtype == torch.bool else env_ids


class StateWriter:
    """The writers of `EntityData`.

    `env_ids` is None (all), a slice, a boolean mask or a one-dimensional tensor of indices; element
    ids, which count within the entity, may also be a list. Tensors of both select their product.
    Values are tensors or arrays of any float type; the simulation holds float32.

    Writes go straight to the simulation. What derives from the state (`body_link_pos_w`, velocities
    of links, sensors, ...) keeps its old values until the next `sim.forward()`.

    Environments whose poses or joint positions were written are noted in `moved_envs`: forces of the
    last substep do not belong to them any more, so `env.step` and `env.reset` recompute these.
    """

    indexing: EntityIndexing
    data: Any
    model: Any
    device: str
    default_root_state: torch.Tensor
    moved_envs: torch.Tensor | None
    is_fixed_base: bool
    is_articulated: bool
    is_actuated: bool
    _joint_q: Addresses
    _joint_v: Addresses
    _bodies: Addresses
    _ctrl: Addresses
    _free_q: slice
    _free_v: slice

    def write_root_state(self, root_state: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write pose and velocity of the root link, (k, 13): see the next two writers."""
        self._require_floating("write_root_state")
        root_state = as_values(root_state, 13, "The root state", self.device)
        self.write_root_pose(root_state[..., :7], env_ids)
        self.write_root_velocity(root_state[..., 7:], env_ids)

    def write_root_pose(self, pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the world pose of the root link, (k, 7): position, quaternion (w, x, y, z).

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        self._require_floating("write_root_pose")
        pose = as_values(pose, 7, "The root pose", self.device)
        assign(self.data.qpos, pose, env_ids, self._free_q)
        self._note_move(env_ids)

    def write_root_velocity(self, velocity: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the world velocity of the root link, (k, 6): linear (of its origin), angular.

        MuJoCo keeps the angular part in the body frame, so it is rotated by the orientation that
        `qpos` holds now: write the pose first.

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        quat, linear, angular = self._read_velocity("write_root_velocity", velocity, env_ids)
        angular_b = quat_apply_inverse(quat, angular)
        assign(self.data.qvel, torch.cat((linear, angular_b), dim=-1), env_ids, self._free_v)

    def write_root_velocity_b(self, velocity_b: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the velocity of the root link given in its own frame, (k, 6): linear, angular.

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        quat, linear_b, angular_b = self._read_velocity(
            "write_root_velocity_b", velocity_b, env_ids
        )
        linear = quat_apply(quat, linear_b)
        assign(self.data.qvel, torch.cat((linear, angular_b), dim=-1), env_ids, self._free_v)

    def write_root_com_velocity(self, velocity: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the world velocity of the root body's centre of mass, (k, 6): linear, angular.

        The origin of the link then moves with `v_com - omega x (R body_ipos)`.

        Raises:
            ValueError: the entity has a fixed base, or the width is wrong.
        """
        quat, linear, angular = self._read_velocity("write_root_com_velocity", velocity, env_ids)
        offset_b = rows(self.model.body_ipos[:, self.indexing.root_body_id], env_ids)
        linear = linear - torch.linalg.cross(angular, quat_apply(quat, offset_b))
        self.write_root_velocity(torch.cat((linear, angular), dim=-1), env_ids)

    def write_joint_state(
        self,
        position: torch.Tensor,
        velocity: torch.Tensor,
        joint_ids: Ids = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Write joint positions and velocities, (k, number of joints) or (k, 1) each."""
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
        position = as_values(position, width, "The joint position", self.device, broadcasts=True)
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
        velocity = as_values(velocity, width, "The joint velocity", self.device, broadcasts=True)
        assign(self.data.qvel, velocity, env_ids, columns)

    def write_external_wrench(
        self,
        force: torch.Tensor | None,
        torque: torch.Tensor | None,
        body_ids: Sequence[int] | torch.Tensor | slice | None = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Set force and torque on bodies, (k, number of bodies, 3) each; None leaves a half alone.

        World frame, acting at the bodies' centres of mass. They persist until they are overwritten
        or the environment is reset.
        """
        columns, _ = self._bodies.select(body_ids)
        wrench = self.data.xfrc_applied
        for value, half, what in ((force, slice(0, 3), "force"), (torque, slice(3, 6), "torque")):
            if value is not None:
                values = as_values(value, 3, f"The external {what}", self.device)
                assign(wrench[..., half], values, env_ids, columns)

    def write_ctrl(self, ctrl: torch.Tensor, ctrl_ids: Ids = None, env_ids: EnvIds = None) -> None:
        """Write controls of actuators, (k, number of controls), or (k, 1) for all alike.

        `ctrl_ids` are ids of actuators as `find_actuators` returns them. Controls follow each other
        by actuator: most have one, `<pid>`, `<dcmotor>` and `<orientation>` may have several.

        Raises:
            ValueError: the entity has no configured actuators, or the width is wrong.
        """
        if not self.is_actuated:
            raise ValueError(
                "write_ctrl: this entity has no actuators. List them in "
                "EntityCfg.articulation.actuators."
            )
        columns, width = self._ctrl.select(self.indexing.control_columns(ctrl_ids))
        ctrl = as_values(ctrl, width, "The control", self.device, broadcasts=True)
        assign(self.data.ctrl, ctrl, env_ids, columns)

    def write_mocap_pose(self, pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the pose of the mocap root, (k, 7): position, quaternion (w, x, y, z).

        Raises:
            ValueError: the root is no mocap body, or the width is wrong.
        """
        mocap_id = self.indexing.mocap_id
        if mocap_id is None:
            raise ValueError(
                "write_mocap_pose: the root of this entity is no mocap body. Place a floating "
                "entity with write_root_pose."
            )
        pose = as_values(pose, 7, "The mocap pose", self.device)
        assign(self.data.mocap_pos, pose[..., :3], env_ids, mocap_id)
        assign(self.data.mocap_quat, pose[..., 3:], env_ids, mocap_id)
        self._note_move(env_ids)

    def _note_move(self, env_ids: EnvIds) -> None:
        # A new tensor, because one that was made under `inference_mode` cannot be written outside.
        if self.moved_envs is None:
            size = len(self.default_root_state)
            moved = torch.zeros(size, dtype=torch.bool, device=self.device)
        else:
            moved = self.moved_envs.clone()
        moved[slice(None) if env_ids is None else env_ids] = True
        self.moved_envs = moved

    def _read_velocity(
        self, what: str, velocity: torch.Tensor, env_ids: EnvIds
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the orientations of the root now, (k, 4), and both halves of `velocity`, (k, 3).

        Raises `ValueError`, naming the writer `what`, for a fixed base or a wrong width.
        """
        self._require_floating(what)
        velocity = as_values(velocity, 6, "The root velocity", self.device)
        quat = rows(self.data.qpos[:, self._free_q], env_ids)[:, 3:7]
        halves = velocity.expand(len(quat), 6)
        return quat, halves[:, :3], halves[:, 3:]

    def _require_floating(self, what: str) -> None:
        if self.is_fixed_base:
            raise ValueError(
                f"{what}: this entity has a fixed base. Place it with write_mocap_pose, or give "
                "its root body a free joint."
            )

    def _require_articulated(self, what: str) -> None:
        if not self.is_articulated:
            raise ValueError(f"{what}: this entity has no joints other than a free one.")
