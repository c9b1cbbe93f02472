"""Starts of episodes: which frame of which motion, and the perturbed state of the robot there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch

from mjlab.utils.lab_api.math import quat_from_euler_xyz, quat_mul, sample_uniform
from mjlab.utils.state import stateful
from mjlab.utils.torch import constant_tensor

if TYPE_CHECKING:
    from mjlab.tasks.tracking.mdp.motion_library import MotionLibrary

Drawn = tuple[torch.Tensor, torch.Tensor]
"""Motions (n,) and frames within them (n,), int64."""

_TINY = 1e-12

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""What a range of poses or velocities may name."""


def draw_uniform(motion: MotionLibrary, count: int) -> Drawn:
    """Draw frames uniformly over all motions.

    The last frame of a motion is none of them, because nothing follows it.
    """
    device = motion.starts.device
    usable = motion.lengths - 1
    ends = torch.cumsum(usable, 0)
    drawn = torch.randint(0, int(ends[-1]), (count,), device=device)
    motions = torch.bucketize(drawn, ends, right=True)
    return motions, drawn - (ends - usable)[motions]


@stateful
class HardSegmentSampler:
    """Draws frames more often where episodes failed: adaptive sampling.

    Each motion is cut into bins of about a second, N in all. `failed` (F) is a running mean of the
    failures in each bin. With the kernel k_i ~ decay^i, i < kernel_size, which looks ahead within
    the motion, because what fails later was begun before,

        p_b ~ sum_i k_i s_(b+i),   s_b = F_b + uniform_ratio / N.

    Attributes:
        failed: (N,) running mean F of the failures of a step; run-time state.
        current_failed: (N,) failures C of the running step.
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
        """Prepare a sampler that has seen no failure.

        Args:
            lengths: Frames of each motion.
            step_dt: Seconds from one frame to the next.
            kernel_size: How many bins ahead failures count, the bin itself included.
            decay: Weight of a failure one bin further ahead.
            uniform_ratio: Weight that bins have without failures, in all.
            alpha: Share of the running mean that one step replaces.
            device: Where the tensors lie.
        """
        self._uniform_ratio, self._alpha = uniform_ratio, alpha
        # The small number keeps 3.0 seconds at 3, whatever the division makes of it.
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
        """Draw a bin by its probability, and a frame uniformly within it."""
        bins = torch.multinomial(probabilities, count, replacement=True)
        within = torch.rand(count, dtype=torch.float32, device=bins.device)
        motions = self._bin_motions[bins]
        place = (bins - self._first_bins[motions] + within) / self._motion_bins[motions]
        last = motion.lengths[motions] - 1
        frames = (place * last).long()
        # Rounding may reach the last frame, which nothing follows.
        return motions, torch.minimum(frames, last - 1)

    def count_failures(
        self, motion: MotionLibrary, motions: torch.Tensor, frames: torch.Tensor
    ) -> None:
        """Take down the failures of this step: frames (n,) of motions (n,). Replaces earlier ones."""
        bins = self._motion_bins[motions]
        local = torch.div(frames * bins, motion.lengths[motions], rounding_mode="floor")
        local = torch.minimum(local.clamp(min=0), bins - 1)
        counts = torch.bincount(self._first_bins[motions] + local, minlength=self.num_bins)
        self.current_failed.copy_(counts)

    def end_step(self) -> None:
        """Take the failures of this step up into the running mean."""
        self.failed.lerp_(self.current_failed, self._alpha)
        self.current_failed.zero_()

    def figures(
        self, probabilities: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the normalized entropy of p, its largest value, and where that is, in [0, 1)."""
        top, where = probabilities.max(dim=0)
        if self.num_bins == 1:
            return torch.ones_like(top), top, torch.zeros_like(top)
        entropy = -(probabilities * (probabilities + _TINY).log()).sum() / math.log(self.num_bins)
        return entropy, top, where / self.num_bins


def perturbed_start(
    motion: MotionLibrary,
    frames: torch.Tensor,
    *,
    pose_range: Mapping[str, tuple[float, float]],
    velocity_range: Mapping[str, tuple[float, float]],
    joint_position_range: tuple[float, float],
    scale: float = 1.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return states on frames (n,), with uniform perturbations.

    Positions and velocities are added to, p + (x, y, z) and v + (x, y, z), w + (roll, pitch, yaw);
    orientations are turned in world axes, q_euler(roll, pitch, yaw) q. Numbers are drawn in the
    order pose, velocity, joints, and multiplied by `scale`. The root is the first of the tracked bodies.

    Returns:
        Root states (n, 13), without origins of environments, and joint positions (n, nj).
    """
    count, device = len(frames), str(frames.device)
    pos, quat, lin_vel, ang_vel = (
        of_bodies[:, 0].index_select(0, frames)
        for of_bodies in (
            motion.body_pos_w, motion.body_quat_w, motion.body_lin_vel_w, motion.body_ang_vel_w
        )
    )  # fmt: skip
    joint_pos = motion.joint_pos[frames]
    pose = scale * _drawn(pose_range, count, device)
    turn = quat_from_euler_xyz(*pose[:, 3:].unbind(1))
    velocity = scale * _drawn(velocity_range, count, device)
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


def _drawn(ranges: Mapping[str, tuple[float, float]], count: int, device: str) -> torch.Tensor:
    bounds = zip(*(ranges.get(axis, (0.0, 0.0)) for axis in AXES), strict=True)
    low, high = (constant_tensor(side, device) for side in bounds)
    return sample_uniform(low, high, (count, len(AXES)), device)
