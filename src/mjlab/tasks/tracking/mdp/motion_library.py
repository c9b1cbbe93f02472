"""Motions as device tensors, and readers of reference frames and robot state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from mjlab.tasks.tracking.motion_file import (
    PER_BODY,
    PER_JOINT,
    Motion,
    MotionFileError,
    read_motion,
)
from mjlab.utils.lab_api.math import quat_inv, quat_mul, yaw_quat

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.scene import Scene


class MotionLibrary:
    """M motions, T frames in total, concatenated along the frame axis, with K of their bodies.

    Attributes:
        names: Names of the motions.
        starts: (M,) int64, index of the first frame of each motion.
        lengths: (M,) int64, number of frames of each motion.
        joint_pos, joint_vel: (T, nj).
        body_pos_w, body_lin_vel_w, body_ang_vel_w: (T, K, 3), without environment origins.
        body_quat_w: (T, K, 4).
        time_step_total: T.
    """

    joint_pos: torch.Tensor
    joint_vel: torch.Tensor
    body_pos_w: torch.Tensor
    body_quat_w: torch.Tensor
    body_lin_vel_w: torch.Tensor
    body_ang_vel_w: torch.Tensor

    def __init__(
        self,
        files: Sequence[Path],
        motions: Sequence[Motion],
        body_indexes: torch.Tensor,
        device: str,
    ) -> None:
        """Store motions of one robot.

        Args:
            files: Files of the motions.
            motions: The motions, in the same order.
            body_indexes: Bodies to keep, as indices in the robot, (K,) int64.
            device: Device of the tensors.

        Raises:
            MotionFileError: a motion has fewer bodies.
        """
        for path, motion in zip(files, motions, strict=True):
            bodies = motion.body_pos_w.shape[1]
            unknown = [i for i in body_indexes.tolist() if not 0 <= i < bodies]
            if unknown:
                raise MotionFileError(
                    f"Motion {path}: expected body indices in [0, {bodies - 1}], got {unknown}; it "
                    f"has {bodies} bodies."
                )
        columns = body_indexes.cpu().numpy()
        for name in (*PER_JOINT, *PER_BODY):
            values = [getattr(motion, name) for motion in motions]
            if name in PER_BODY:
                values = [value[:, columns] for value in values]
            setattr(self, name, torch.from_numpy(np.concatenate(values)).to(device))
        self.names = tuple(path.stem for path in files)
        counts = [motion.num_frames for motion in motions]
        self.lengths = torch.tensor(counts, device=device)
        self.starts = torch.cumsum(self.lengths, 0) - self.lengths
        self.time_step_total = sum(counts)

    def __len__(self) -> int:
        return len(self.names)


class MotionLoader(MotionLibrary):
    """Motion of a single file.

    Attributes:
        fps: Frames per second; None if not in the file.
    """

    def __init__(
        self, motion_file: str | Path, body_indexes: torch.Tensor, device: str = "cpu"
    ) -> None:
        """Read a file; arguments and errors are those of `MotionLibrary` and `read_motion`."""
        motion = read_motion(motion_file)
        super().__init__([Path(motion_file)], [motion], body_indexes, device)
        self.fps = motion.fps


class MotionReader:
    """Reader of one reference frame per environment, and of the current robot state.

    N environments, K tracked bodies, nj joints. World frame, quaternions (w, x, y, z), SI units.
    """

    motion: MotionLibrary
    robot: Entity
    body_indexes: torch.Tensor
    """(K,) int64, tracked bodies as indices in the robot."""
    anchor_index: int
    """Index of the anchor in the tracked bodies."""
    anchor_body: int
    """Index of the anchor in the robot's bodies."""
    body_names: tuple[str, ...]
    """Names of the tracked bodies."""
    scene: Scene
    body_pos_relative_w: torch.Tensor
    """(N, K, 3) relative positions, as of the last update; see `relative_poses`."""
    body_quat_relative_w: torch.Tensor
    """(N, K, 4) relative orientations, as of the last update."""

    @property
    def frame_indexes(self) -> torch.Tensor:
        """(N,) int64, frame of each environment, indexed over all motions."""
        raise NotImplementedError

    # Reference.

    @property
    def joint_pos(self) -> torch.Tensor:
        """(N, nj) joint positions of the reference."""
        return self.motion.joint_pos.index_select(0, self.frame_indexes)

    @property
    def joint_vel(self) -> torch.Tensor:
        """(N, nj) joint velocities of the reference."""
        return self.motion.joint_vel.index_select(0, self.frame_indexes)

    @property
    def body_pos_w(self) -> torch.Tensor:
        """(N, K, 3) positions of the tracked bodies in the reference."""
        pos = self.motion.body_pos_w.index_select(0, self.frame_indexes)
        return pos.add_(self.scene.env_origins[:, None])

    @property
    def body_quat_w(self) -> torch.Tensor:
        """(N, K, 4) orientations of the tracked bodies in the reference."""
        return self.motion.body_quat_w.index_select(0, self.frame_indexes)

    @property
    def body_lin_vel_w(self) -> torch.Tensor:
        """(N, K, 3) velocities of the tracked bodies' origins in the reference."""
        return self.motion.body_lin_vel_w.index_select(0, self.frame_indexes)

    @property
    def body_ang_vel_w(self) -> torch.Tensor:
        """(N, K, 3) angular velocities of the tracked bodies in the reference."""
        return self.motion.body_ang_vel_w.index_select(0, self.frame_indexes)

    @property
    def anchor_pos_w(self) -> torch.Tensor:
        """(N, 3) position of the anchor in the reference."""
        place = self.motion.body_pos_w[:, self.anchor_index].index_select(0, self.frame_indexes)
        return place.add_(self.scene.env_origins)

    @property
    def anchor_quat_w(self) -> torch.Tensor:
        """(N, 4) orientation of the anchor in the reference."""
        return self.motion.body_quat_w[:, self.anchor_index].index_select(0, self.frame_indexes)

    @property
    def anchor_lin_vel_w(self) -> torch.Tensor:
        """(N, 3) velocity of the anchor's origin in the reference."""
        return self.motion.body_lin_vel_w[:, self.anchor_index].index_select(0, self.frame_indexes)

    @property
    def anchor_ang_vel_w(self) -> torch.Tensor:
        """(N, 3) angular velocity of the anchor in the reference."""
        return self.motion.body_ang_vel_w[:, self.anchor_index].index_select(0, self.frame_indexes)

    # Robot.

    @property
    def robot_joint_pos(self) -> torch.Tensor:
        """(N, nj) joint positions of the robot."""
        return self.robot.data.joint_pos

    @property
    def robot_joint_vel(self) -> torch.Tensor:
        """(N, nj) joint velocities of the robot."""
        return self.robot.data.joint_vel

    @property
    def robot_body_pos_w(self) -> torch.Tensor:
        """(N, K, 3) positions of the tracked bodies of the robot."""
        return self.robot.data.body_link_pos_w.index_select(1, self.body_indexes)

    @property
    def robot_body_quat_w(self) -> torch.Tensor:
        """(N, K, 4) orientations of the tracked bodies of the robot."""
        return self.robot.data.body_link_quat_w.index_select(1, self.body_indexes)

    @property
    def robot_body_lin_vel_w(self) -> torch.Tensor:
        """(N, K, 3) velocities of the tracked bodies' origins."""
        return self.robot.data.link_lin_vel_of(self.body_indexes)

    @property
    def robot_body_ang_vel_w(self) -> torch.Tensor:
        """(N, K, 3) angular velocities of the tracked bodies."""
        return self.robot.data.link_ang_vel_of(self.body_indexes)

    @property
    def robot_anchor_pos_w(self) -> torch.Tensor:
        """(N, 3) position of the robot's anchor."""
        return self.robot.data.body_link_pos_w[:, self.anchor_body]

    @property
    def robot_anchor_quat_w(self) -> torch.Tensor:
        """(N, 4) orientation of the robot's anchor."""
        return self.robot.data.body_link_quat_w[:, self.anchor_body]

    @property
    def robot_anchor_lin_vel_w(self) -> torch.Tensor:
        """(N, 3) velocity of the origin of the robot's anchor."""
        return self.robot_body_lin_vel_w[:, self.anchor_index]

    @property
    def robot_anchor_ang_vel_w(self) -> torch.Tensor:
        """(N, 3) angular velocity of the robot's anchor."""
        return self.robot_body_ang_vel_w[:, self.anchor_index]

    def relative_poses(
        self, env_ids: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the reference moved to the robot's x, y and heading, at the reference height.

        With current anchors (p, q) of the reference and (p', q') of the robot, and D the rotation
        about z by the yaw of q' q^-1:

            q_rel = D q_body,   p_rel = (p'_x, p'_y, p_z) + D (p_body - p).

        Args:
            env_ids: (n,) int64. None: all environments.

        Returns:
            Positions (n, K, 3) and orientations (n, K, 4).
        """
        frames, origins = self.frame_indexes, self.scene.env_origins
        robot_pos, robot_quat = self.robot_anchor_pos_w, self.robot_anchor_quat_w
        if env_ids is not None:
            frames, origins, robot_pos, robot_quat = (
                part[env_ids] for part in (frames, origins, robot_pos, robot_quat)
            )
        # Environment origins cancel out along x and y.
        pos = self.motion.body_pos_w.index_select(0, frames)
        body_quat = self.motion.body_quat_w.index_select(0, frames)
        anchor_pos, anchor_quat = pos[:, self.anchor_index], body_quat[:, self.anchor_index]
        turn = yaw_quat(quat_mul(robot_quat, quat_inv(anchor_quat)))
        w, z = turn[:, :1], turn[:, 3:]
        # Written out: a rotation about z takes half the time of a general rotation.
        cos, sin = w * w - z * z, 2.0 * w * z
        x, y, height = pos.unbind(-1)
        dx, dy = x - anchor_pos[:, :1], y - anchor_pos[:, 1:2]
        torch.add(cos * dx - sin * dy, robot_pos[:, :1], out=x)
        torch.add(sin * dx + cos * dy, robot_pos[:, 1:2], out=y)
        height += origins[:, 2:]
        quat, turned = body_quat * w.unsqueeze(1), body_quat * z.unsqueeze(1)
        (qw, qx, qy, qz), (zw, zx, zy, zz) = quat.unbind(-1), turned.unbind(-1)
        qw -= zz
        qx -= zy
        qy += zx
        qz += zw
        return pos, quat


class MotionFrame(MotionReader):
    """Reader of frames other than the command's, with the current robot state.

    Relative poses are current; those of the command are from its last update.
    """

    def __init__(self, reader: MotionReader, frame_indexes: torch.Tensor) -> None:
        """Read the frames (N,), indexed over all motions, of the motions and robot of `reader`."""
        self.motion, self.robot, self.scene = reader.motion, reader.robot, reader.scene
        self.body_indexes, self.body_names = reader.body_indexes, reader.body_names
        self.anchor_index, self.anchor_body = reader.anchor_index, reader.anchor_body
        self._frame_indexes = frame_indexes
        self.body_pos_relative_w, self.body_quat_relative_w = self.relative_poses()

    @property
    def frame_indexes(self) -> torch.Tensor:
        """(N,) int64, frames, indexed over all motions."""
        return self._frame_indexes
