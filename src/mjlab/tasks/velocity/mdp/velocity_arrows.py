"""Arrows that show commanded and actual velocity."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.utils.lab_api.math import matrix_from_quat

if TYPE_CHECKING:
    from mjlab.entity.data import EntityData
    from mjlab.viewer.debug_visualizer import Color, DebugVisualizer

_COMMANDED_LINEAR: Color = (0.2, 0.2, 0.6, 0.6)
_COMMANDED_YAW: Color = (0.2, 0.6, 0.2, 0.6)
_ACTUAL_LINEAR: Color = (0.0, 0.6, 1.0, 0.7)
_ACTUAL_YAW: Color = (0.0, 1.0, 0.4, 0.7)


def draw_velocity_arrows(
    visualizer: DebugVisualizer,
    data: EntityData,
    command: torch.Tensor,
    z_offset: float,
    scale: float,
) -> None:
    """Draw four arrows above the root: commanded (blue) and actual (cyan) horizontal velocity, and
    commanded (green) and actual (light green) yaw rate along the root's z axis.

    Args:
        visualizer: What to draw into.
        data: State of the robot.
        command: (N, 3) commanded vx, vy, wz in the frame of the root.
        z_offset: Height of the arrows' foot above the root, times `scale`, in metres.
        scale: Length of an arrow for 1 m/s or 1 rad/s, in metres.
    """
    indices = list(visualizer.get_env_indices(len(command)))
    if not indices:
        return
    rotations = matrix_from_quat(data.root_link_quat_w[indices])
    linear = data.root_link_lin_vel_b[indices]
    angular = data.root_link_ang_vel_b[indices]
    asked = command[indices]
    zero = torch.zeros_like(asked[:, 0])
    vectors = torch.stack(
        (
            torch.stack((zero, zero, zero + z_offset), dim=1),
            torch.stack((asked[:, 0], asked[:, 1], zero), dim=1),
            torch.stack((zero, zero, asked[:, 2]), dim=1),
            torch.stack((linear[:, 0], linear[:, 1], zero), dim=1),
            torch.stack((zero, zero, angular[:, 2]), dim=1),
        ),
        dim=2,
    )
    # Columns of (3, 5) matrices are the five vectors, in world axes.
    drawn = (scale * rotations @ vectors).transpose(1, 2).cpu().numpy()
    roots = data.root_link_pos_w[indices].cpu().numpy()
    colors = (_COMMANDED_LINEAR, _COMMANDED_YAW, _ACTUAL_LINEAR, _ACTUAL_YAW)
    for root, (offset, *arrows) in zip(roots, drawn, strict=True):
        for arrow, color in zip(arrows, colors, strict=True):
            visualizer.add_arrow(root + offset, root + offset + arrow, color)
