"""The exported policy together with the reference that it follows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from mjlab.tasks.tracking.mdp.motion_loader import MotionLibrary

REFERENCE = (
    "joint_pos",
    "joint_vel",
    "body_pos_w",
    "body_quat_w",
    "body_lin_vel_w",
    "body_ang_vel_w",
)
"""Tensors of a motion that the exported policy returns, with a row for each frame."""


class PolicyWithReference(torch.nn.Module):
    """What is exported: (obs, time_step) -> actions and the reference at that time step.

    | input | shape | | output | shape |
    | --- | --- | --- | --- | --- |
    | `obs` | (1, observations) | | `actions` | (1, nj), the mean; the normalizer is inside |
    | `time_step` | (1, 1) | | `joint_pos`, `joint_vel` | (1, nj) |
    | | | | `body_pos_w`, `body_lin_vel_w`, `body_ang_vel_w` | (1, K, 3) |
    | | | | `body_quat_w` | (1, K, 4) |

    The time step is a number of frames, truncated to an integer and kept within the reference; it
    counts over all motions, one after the other. Bodies are the tracked ones, without origins of
    environments.
    """

    def __init__(self, policy: Any, motion: MotionLibrary) -> None:
        """Take what rsl_rl's `as_onnx` returns, and the motions, which are copied.

        Raises:
            ValueError: the policy has other inputs than observations.
        """
        super().__init__()
        self.policy = policy
        if list(policy.input_names) != ["obs"]:
            raise ValueError(
                f"A policy with the inputs {list(policy.input_names)} cannot be exported with the "
                "reference; one that reads observations only can."
            )
        for name in REFERENCE:
            self.register_buffer(name, getattr(motion, name).detach().cpu().clone())
        self.last_frame = motion.time_step_total - 1

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs."""
        return ["obs", "time_step"]

    @property
    def output_names(self) -> list[str]:
        """Names of the outputs."""
        return ["actions", *REFERENCE]

    def get_dummy_inputs(self) -> tuple[torch.Tensor, ...]:
        """Return inputs of the right shapes."""
        return (*self.policy.get_dummy_inputs(), torch.zeros(1, 1))

    def forward(self, obs: torch.Tensor, time_step: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the outputs."""
        frame = time_step.long().squeeze(-1).clamp(0, self.last_frame)
        return (self.policy(obs), *(getattr(self, name)[frame] for name in REFERENCE))
