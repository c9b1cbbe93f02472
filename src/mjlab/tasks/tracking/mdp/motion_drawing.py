"""How the reference is drawn: as a see-through robot, or as the frames of its bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from mjlab.utils.lab_api.math import matrix_from_quat

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mjlab.tasks.tracking.mdp.motion_command import MotionCommand
    from mjlab.viewer.debug_visualizer import DebugVisualizer

# Lengths of the axes, in metres: of bodies and of the anchor.
_REFERENCE_LENGTHS = (0.08, 0.1)
_ROBOT_LENGTHS = (0.12, 0.15)
_PASTEL = ((1.0, 0.6, 0.6), (0.6, 1.0, 0.6), (0.6, 0.6, 1.0))
_AXIS_RADIUS = 0.008
# A group of geoms that no viewer shows of a ghost.
_HIDDEN_GROUP = 3


class MotionDrawing:
    """Draws the reference of a motion command."""

    def __init__(self, command: MotionCommand) -> None:
        """Take the command whose reference is drawn, with the settings in its config."""
        self._command = command
        self._ghost: mujoco.MjModel | None = None
        self.offset = np.array(command.cfg.viz.ghost_offset, dtype=float)
        """From the reference to where it is drawn, (3,), in metres; may be changed."""

    def draw(self, visualizer: DebugVisualizer) -> None:
        """Draw into `visualizer`, for the environments that it shows."""
        indices = list(visualizer.get_env_indices(self._command.num_envs))
        if not indices:
            return
        if self._command.cfg.viz.mode == "ghost":
            self._draw_ghosts(visualizer, indices)
        else:
            self._draw_frames(visualizer, indices)

    def _draw_ghosts(self, visualizer: DebugVisualizer, indices: Sequence[int]) -> None:
        command, viz = self._command, self._command.cfg.viz
        if self._ghost is None:
            self._ghost = ghost_model(command.robot, viz.ghost_color)
        model = self._ghost
        frames = command.frame_indexes[indices]
        pos = command.motion.body_pos_w[frames, 0] + command.scene.env_origins[indices]
        root = torch.cat((pos, command.motion.body_quat_w[frames, 0]), dim=1).cpu().numpy()
        joints = command.motion.joint_pos[frames].cpu().numpy()
        root[:, :3] += self.offset
        free, others = _qpos_addresses(model)
        qpos = np.zeros(model.nq)
        for root_pose, joint_pos in zip(root, joints, strict=True):
            qpos[free : free + 7] = root_pose
            qpos[others] = joint_pos
            visualizer.add_ghost_mesh(qpos, model, alpha=viz.ghost_color[3])

    def _draw_frames(self, visualizer: DebugVisualizer, indices: Sequence[int]) -> None:
        command = self._command
        for pos, quat, lengths, colors, shift in (
            (command.body_pos_w, command.body_quat_w, _REFERENCE_LENGTHS, _PASTEL, self.offset),
            (command.robot_body_pos_w, command.robot_body_quat_w, _ROBOT_LENGTHS, None, 0.0),
        ):
            places = pos[indices].cpu().numpy() + shift
            axes = matrix_from_quat(quat[indices]).cpu().numpy()
            for body in range(places.shape[1]):
                length = lengths[body == command.anchor_index]
                for place, rotation in zip(places[:, body], axes[:, body], strict=True):
                    visualizer.add_frame(
                        place,
                        rotation,
                        scale=length,
                        axis_radius=_AXIS_RADIUS,
                        axis_colors=colors,
                    )


def ghost_model(robot: Any, color: tuple[float, float, float, float]) -> mujoco.MjModel:
    """Return a model of the robot in one colour, without its collision shapes if it has others.

    It is of the robot alone, so that nothing else in the scene gets a ghost.
    """
    # Built anew, because the robot's own spec has become part of the scene's.
    model = robot.cfg.build().compile()
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    model.geom_matid[:] = -1
    model.geom_rgba[:] = color
    if not collides.all():
        model.geom_group[collides] = _HIDDEN_GROUP
    return model


def _qpos_addresses(model: mujoco.MjModel) -> tuple[int, np.ndarray]:
    """Return where in qpos the free joint begins, and where the other joints are, in order."""
    is_free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    return int(model.jnt_qposadr[is_free][0]), model.jnt_qposadr[~is_free]
