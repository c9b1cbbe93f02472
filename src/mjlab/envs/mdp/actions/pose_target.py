"""Target pose of a frame: base of the task-space actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.envs.mdp.frames import FrameType
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.utils.lab_api.math import normalize, quat_box_plus

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

# Minimum norm of a quaternion that defines an orientation.
_MIN_QUAT_NORM = 1.0e-6

# Maximum magnitude of targets (m, rad); larger numbers would overflow.
_MAX_TARGET = 1.0e6


@dataclass(kw_only=True)
class PoseTargetActionCfg(ActionTermCfg):
    """Frame, joints that may move it, and meaning of the action."""

    actuator_names: tuple[str, ...] | list[str]
    """Patterns of the actuated joints that may move, matched in full."""

    frame_type: FrameType = "body"
    """Element type of the frame: `body`, `site` or `geom` of the entity."""

    frame_name: str
    """Pattern of the frame's name. Must match exactly one element."""

    use_relative_mode: bool = True
    """Interpret actions as displacements from the current frame pose instead of absolute poses."""

    delta_pos_scale: float = 1.0
    """Translation per unit action in relative mode (m)."""

    delta_ori_scale: float = 1.0
    """Rotation per unit action in relative mode (rad)."""


class PoseTargetAction(ActionTerm):
    """Sets the target pose of a frame. Subclasses track it.

    Target: `_desired_pos`, (N, 3), and `_desired_quat`, (N, 4), in the world.
    """

    # Derived from the config; not checkpointed.
    _transient = {"_entity", "_is_relative", "_scale"}

    def __init__(self, cfg: PoseTargetActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self._is_relative = cfg.use_relative_mode
        # Absolute poses are not scaled.
        scales = (cfg.delta_pos_scale,) * 3 + (cfg.delta_ori_scale,) * 3
        scales = scales[: self.action_dim] if self._is_relative else (1.0,) * self.action_dim
        self._scale = torch.tensor(scales, dtype=torch.float32, device=self.device)
        shape = (self.num_envs, self.action_dim)
        self._raw_actions = torch.zeros(shape, dtype=torch.float32, device=self.device)
        self._desired_pos = torch.zeros(self.num_envs, 3, dtype=torch.float32, device=self.device)
        self._desired_quat = torch.zeros(self.num_envs, 4, dtype=torch.float32, device=self.device)
        self.reset()

    @property
    def controls_orientation(self) -> bool:
        """True if the target has an orientation."""
        raise NotImplementedError

    @property
    def action_dim(self) -> int:
        """Action dimension: 3 without orientation, 6 for relative poses, 7 for absolute poses."""
        if not self.controls_orientation:
            return 3
        return 6 if self._is_relative else 7

    @property
    def raw_action(self) -> torch.Tensor:
        """Last unprocessed action, (N, action_dim). Zero after a reset."""
        return self._raw_actions

    def process_actions(self, actions: torch.Tensor) -> None:
        """Set the target pose from `actions`, (N, action_dim), and the current frame pose."""
        self._raw_actions.copy_(actions)
        position, quat = self._get_frame_pose()
        if self._is_relative:
            delta = (self._raw_actions * self._scale).clamp_(-_MAX_TARGET, _MAX_TARGET)
            position = position + delta[:, :3]
            if self.action_dim == 6:
                quat = quat_box_plus(quat, delta[:, 3:])
        else:
            position = self._raw_actions[:, :3].clamp(-_MAX_TARGET, _MAX_TARGET)
            if self.action_dim == 7:
                target = self._raw_actions[:, 3:]
                is_valid = torch.linalg.vector_norm(target, dim=1, keepdim=True) > _MIN_QUAT_NORM
                # A zero quaternion defines no orientation: keep the current one.
                quat = torch.where(is_valid, normalize(target), quat)
        self._desired_pos.copy_(position)
        self._desired_quat.copy_(quat)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Zero the raw action and clear the target pose of `env_ids` (None: all)."""
        index = slice(None) if env_ids is None else env_ids
        self._raw_actions[index] = 0.0
        self._desired_pos[index] = 0.0
        self._desired_quat[index] = 0.0
        self._desired_quat[index, 0] = 1.0

    def _get_frame_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return position, (N, 3), and quaternion, (N, 4), of the frame in the world."""
        raise NotImplementedError
