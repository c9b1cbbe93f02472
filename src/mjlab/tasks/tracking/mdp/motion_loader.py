"""Motions as tensors on the device, ready to be read by frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from mjlab.tasks.tracking.motion_file import Motion, MotionFileError, read_motion

_PER_BODY = ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
_PER_JOINT = ("joint_pos", "joint_vel")


class MotionLoader:
    """A motion of T frames, of which the bodies `body_indexes` (K of them) are kept.

    Attributes:
        fps: Frames per second, or None where the file does not say.
        joint_pos: (T, nj); likewise `joint_vel`.
        body_pos_w: (T, K, 3) without origins of environments; likewise `body_lin_vel_w` and
            `body_ang_vel_w`, and `body_quat_w` (T, K, 4).
        time_step_total: T.
    """

    joint_pos: torch.Tensor
    joint_vel: torch.Tensor
    body_pos_w: torch.Tensor
    body_quat_w: torch.Tensor
    body_lin_vel_w: torch.Tensor
    body_ang_vel_w: torch.Tensor

    def __init__(
        self, motion_file: str | Path, body_indexes: torch.Tensor, device: str = "cpu"
    ) -> None:
        """Read a file.

        Args:
            motion_file: The `.npz` file.
            body_indexes: Bodies to keep, (K,) int64, counted in the robot.
            device: Where the tensors lie.

        Raises:
            MotionFileError: the file is no motion, or has fewer bodies.
        """
        motion = read_motion(motion_file)
        bodies = motion.body_pos_w.shape[1]
        unknown = [i for i in body_indexes.tolist() if not 0 <= i < bodies]
        if unknown:
            raise MotionFileError(
                f"The motion {motion_file} has {bodies} bodies, and not those of the indexes "
                f"{unknown}."
            )
        self._take(motion, body_indexes, device)

    @classmethod
    def from_motion(
        cls, motion: Motion, body_indexes: torch.Tensor, device: str = "cpu"
    ) -> MotionLoader:
        """Return the loader of a motion that was read before; the arguments are as above."""
        loader = cls.__new__(cls)
        loader._take(motion, body_indexes, device)
        return loader

    def _take(self, motion: Motion, body_indexes: torch.Tensor, device: str) -> None:
        self.fps = motion.fps
        for name in _PER_JOINT:
            setattr(self, name, torch.from_numpy(getattr(motion, name)).to(device))
        chosen = body_indexes.cpu().numpy()
        for name in _PER_BODY:
            kept = getattr(motion, name)[:, chosen]
            setattr(self, name, torch.from_numpy(kept).to(device))
        self.time_step_total = motion.num_frames


class MotionLibrary:
    """Several motions, one after the other in the same tensors; one motion is as `MotionLoader`.

    Attributes:
        names: Name of each of the M motions.
        starts: (M,) int64, index of the first frame of each.
        lengths: (M,) int64, frames of each.
        time_step_total: Frames of all of them.

    The tensors are those of `MotionLoader`, over all frames.
    """

    joint_pos: torch.Tensor
    joint_vel: torch.Tensor
    body_pos_w: torch.Tensor
    body_quat_w: torch.Tensor
    body_lin_vel_w: torch.Tensor
    body_ang_vel_w: torch.Tensor

    def __init__(self, motions: Sequence[MotionLoader], names: Sequence[str]) -> None:
        """Put motions of the same robot together."""
        for name in (*_PER_JOINT, *_PER_BODY):
            setattr(self, name, torch.cat([getattr(motion, name) for motion in motions]))
        device = self.joint_pos.device
        self.names = tuple(names)
        self.lengths = torch.tensor([m.time_step_total for m in motions], device=device)
        self.starts = torch.cumsum(self.lengths, 0) - self.lengths
        self.time_step_total = int(self.lengths.sum())

    def __len__(self) -> int:
        return len(self.names)
