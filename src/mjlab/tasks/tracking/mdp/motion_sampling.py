"""Episode starts: sampling of motion and frame, and perturbation of the robot state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch

from mjlab.utils.lab_api.math import quat_from_euler_xyz, quat_mul, sample_ranges, sample_uniform
from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.tasks.tracking.mdp.motion_library import MotionLibrary

Drawn = tuple[torch.Tensor, torch.Tensor]
"""Sampled motions (n,) and frames within them (n,), int64."""

_TINY = 1e-12

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Keys of pose and velocity ranges."""


def draw_uniform(motion: MotionLibrary, count: int) -> Drawn:
    """Sample frames uniformly over all motions.

    The last frame of a motion is excluded, because it has no successor.
    """
    device = motion.starts.device
    usable = motion.lengths - 1
    ends = torch.cumsum(usable, 0)
    drawn = torch.randint(0, int(ends[-1]), (count,), device=device)
    motions = torch.bucketize(drawn, ends, right=True)
    return motions, drawn - (ends - usable)[motions]


@stateful
class HardSegmentSampler:
    """Adaptive sampling: frames before failures are sampled more often.

    Each motion is divided into bins of about 1 s, N in total. `failed` (F) is a running mean of the
    failures per bin. The kernel k_i ~ decay^i, i < kernel_size, looks ahead within the motion,
    because the cause of a failure precedes it:

        p_b ~ sum_i k_i s_(b+i),   s_b = F_b + uniform_ratio / N.

    Attributes:
        failed: (N,) running mean F of the failures per step; run-time state.
        current_failed: (N,) failures C of the current step.
        num_bins: N.
    """

    _transient = {"_first_bins", "_bin_motions", "_motion_bins", "_ahead", "_kernel"}

    def __init__(
        self,
        lengths: Sequence[int],
        step_dt: float,
        kernel_size: int,
        decay: float,
        uniform_ratio: float,
        alpha: float,
        device: str,
    ) -> None:
        """Build a sampler without recorded failures.

        Args:
            lengths: Number of frames of each motion.
            step_dt: Time between frames (s).
            kernel_size: Number of bins in the kernel, starting with the bin itself.
            decay: Decay of the kernel per bin ahead.
            uniform_ratio: Total weight of bins without failures.
            alpha: Update rate of the running mean per step.
            device: Device of the tensors.
        """
        self._uniform_ratio, self._alpha = uniform_ratio, alpha
        # 1e-9 absorbs rounding, so that 3.0 s is not rounded down to 2.
        bins = [math.floor(length * step_dt + 1e-9) + 1 for length in lengths]
        self.num_bins = sum(bins)
        self._motion_bins = torch.tensor(bins, device=device)
        self._first_bins = torch.cumsum(self._motion_bins, 0) - self._motion_bins
        self._bin_motions = torch.repeat_interleave(
            torch.arange(len(bins), device=device), self._motion_bins
        )
        last = (self._first_bins + self._motion_bins - 1)[self._bin_motions]
        offsets = torch.arange(kernel_size, device=device)
        bin_ids = torch.arange(self.num_bins, device=device)
        self._ahead = torch.minimum(bin_ids[:, None] + offsets, last[:, None])
        kernel = decay ** offsets.float()
        self._kernel = kernel / kernel.sum()
        self.failed = torch.zeros(self.num_bins, dtype=torch.float32, device=device)
        self.current_failed = torch.zeros_like(self.failed)

    def probabilities(self) -> torch.Tensor:
        """Return p, (N,)."""
        weights = self.failed + self._uniform_ratio / self.num_bins
        smoothed = (weights[self._ahead] * self._kernel).sum(dim=1)
        return smoothed / smoothed.sum()

    def draw(self, motion: MotionLibrary, count: int, probabilities: torch.Tensor) -> Drawn:
        """Sample a bin by its probability, and a frame uniformly within it."""
        bins = torch.multinomial(probabilities, count, replacement=True)
        within = torch.rand(count, dtype=torch.float32, device=bins.device)
        motions = self._bin_motions[bins]
        place = (bins - self._first_bins[motions] + within) / self._motion_bins[motions]
        last = motion.lengths[motions] - 1
        frames = (place * last).long()
        # Exclude the last frame, reachable by rounding: it has no successor.
        return motions, torch.minimum(frames, last - 1)

    def count_failures(
        self, motion: MotionLibrary, motions: torch.Tensor, frames: torch.Tensor
    ) -> None:
        """Record the failures of this step, replacing earlier ones: frames (n,), motions (n,)."""
        bins = self._motion_bins[motions]
        local = torch.div(frames * bins, motion.lengths[motions], rounding_mode="floor")
        local = torch.minimum(local.clamp(min=0), bins - 1)
        counts = torch.bincount(self._first_bins[motions] + local, minlength=self.num_bins)
        self.current_failed.copy_(counts)

    def end_step(self) -> None:
        """Add the failures of this step to the running mean."""
        self.failed.lerp_(self.current_failed, self._alpha)
        self.current_failed.zero_()

    def statistics(
        self, probabilities: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return normalized entropy, maximum, and position of the maximum in [0, 1) of p."""
        top, index = probabilities.max(dim=0)
        if self.num_bins == 1:
            return torch.ones_like(top), top, torch.zeros_like(top)
        entropy = -(probabilities * (probabilities + _TINY).log()).sum() / math.log(self.num_bins)
        return entropy, top, index / self.num_bins


def perturbed_start(
    motion: MotionLibrary,
    frames: torch.Tensor,
    *,
    pose_range: Mapping[str, tuple[float, float]],
    velocity_range: Mapping[str, tuple[float, float]],
    joint_position_range: tuple[float, float],
    scale: float = 1.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return robot states on frames (n,), with uniform perturbations.

    Perturbations are added to positions and velocities, p + (x, y, z), v + (x, y, z) and w + (roll,
    pitch, yaw); orientations are rotated in world axes, q_euler(roll, pitch, yaw) q. Samples are
    taken in the order pose, velocity, joints, and multiplied by `scale`. The root is the first
    tracked body.

    Returns:
        Root states (n, 13), without environment origins, and joint positions (n, nj).
    """
    count, device = len(frames), str(frames.device)
    pos, quat, lin_vel, ang_vel = (
        of_bodies[:, 0].index_select(0, frames)
        for of_bodies in (
            motion.body_pos_w, motion.body_quat_w, motion.body_lin_vel_w, motion.body_ang_vel_w
        )
    )  # fmt: skip
    joint_pos = motion.joint_pos[frames]
    pose, velocity = (
        scale * sample_ranges([ranges.get(axis, (0.0, 0.0)) for axis in AXES], count, device)
        for ranges in (pose_range, velocity_range)
    )
    turn = quat_from_euler_xyz(*pose[:, 3:].unbind(1))
    joints = scale * sample_uniform(*joint_position_range, tuple(joint_pos.shape), device)
    root_state = torch.cat(
        (
            pos + pose[:, :3],
            quat_mul(turn, quat),
            lin_vel + velocity[:, :3],
            ang_vel + velocity[:, 3:],
        ),
        dim=1,
    )
    return root_state, joint_pos + joints
