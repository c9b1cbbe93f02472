"""Pose command: goals for a frame of an entity, such as a hand, and terms that use them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import suggests_fields
from mjlab.envs.mdp.frames import Frame, FrameType
from mjlab.envs.mdp.pose_panel import PosePanel
from mjlab.envs.mdp.reachable_poses import draw_reachable_poses, quat_near
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.utils.errors import WrongTypeError, check_count, check_in_range
from mjlab.utils.lab_api.math import (
    combine_frame_transforms,
    compute_pose_error,
    matrix_from_quat,
    quat_error_magnitude,
    quat_from_euler_xyz,
    sample_ranges,
    subtract_frame_transforms,
)

if TYPE_CHECKING:
    import viser

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import DebugVisualizer

__all__ = [
    "UniformPoseCommand",
    "UniformPoseCommandCfg",
    "goal_joint_deviation_l1",
    "orientation_command_error",
    "orientation_command_error_tanh",
    "pose_command_error",
    "position_command_error",
    "position_command_error_tanh",
]

_END_METRICS = ("end_position_error", "end_orientation_error", "goals_reached")
# A goal counts if it lasted for this part of the shortest resampling time. Below 1, because timers
# are sums of float32 steps, and the last goal of an episode ends one step before its time.
_COUNTED_PART = 0.95
_GOAL_SIZE, _FRAME_SIZE = 0.12, 0.08


@suggests_fields
@dataclass(kw_only=True)
class UniformPoseCommandCfg(CommandTermCfg):
    """Pose command configuration."""

    @dataclass
    class Ranges:
        """Ranges (low, high) of uniform sampling, in the root frame of the entity."""

        pos_x: tuple[float, float]
        """Position along x (m)."""
        pos_y: tuple[float, float]
        """Position along y (m)."""
        pos_z: tuple[float, float]
        """Position along z (m)."""
        roll: tuple[float, float] = (0.0, 0.0)
        """Rotation about x, the first of the three (rad)."""
        pitch: tuple[float, float] = (0.0, 0.0)
        """Rotation about y (rad)."""
        yaw: tuple[float, float] = (0.0, 0.0)
        """Rotation about z, the last (rad)."""

    entity_name: str
    """Name of the entity."""

    frame_type: FrameType = "body"
    """Element type of the commanded frame: `body`, `site` or `geom` of the entity."""

    frame_name: str
    """Pattern of the frame's name. Must match exactly one element."""

    ranges: Ranges | None = None
    """Ranges of goals. None: goals that can be reached, which are poses of the frame at joint
    positions drawn at random, without contact."""

    joint_range_fraction: float = 0.8
    """Middle part of the joint ranges from which goals are drawn if `ranges` is None, in (0, 1]. Hinges are at most
    a quarter turn from their default positions."""

    num_goals: int = 2048
    """Number of goals drawn if `ranges` is None, once, when the term is built."""

    position_tolerance: float = 0.05
    """Position error below which a goal counts as reached (m)."""

    orientation_tolerance: float = 0.35
    """Orientation error below which a goal counts as reached (rad)."""

    def build(self, env: ManagerBasedRlEnv) -> UniformPoseCommand:
        """Build the term."""
        return UniformPoseCommand(self, env)


class UniformPoseCommand(CommandTerm):
    """Goal pose of a frame in the root frame of its entity, (N, 7): position, quaternion.

    Of the two signs of a quaternion, the one closer to the frame's default orientation; with `ranges`,
    w >= 0.

    Metrics at the end of the last step: `position_error` (m) and `orientation_error` (rad). Means over
    the goals of the episode, each counted at its end, 0 before the first: `end_position_error` (m),
    `end_orientation_error` (rad), `goals_reached` (fraction with both errors within the tolerances).
    Goals that were cut short, below the shortest resampling time, do not count, and resets do not log
    episodes without a goal that counts.

    Attributes:
        pose_command_b: (N, 7) goal in the root frame.
        frame: The commanded frame.
        goals: (number of goals, 7) reachable poses in the root frame; None with `ranges`.
        goals_joint_pos: (number of goals, joints) joint positions at these poses (rad or m).
        joint_ids: (joints,) columns of these joints in the entity's joint data.
        goal_joint_pos: (N, joints) joint positions at the goal (rad or m), zeros with `ranges`. The same pose
            may be reached at others.
        goals_torque, goal_torque: Torques that hold the joints there against gravity (N m or N).
        goals_jacobian, goal_jacobian: Motion of the frame per motion of each joint there, in the root frame,
            (., 6, joints): translation, rotation.
        goal_age: (N,) time since the goal was sampled (s).
        num_ended: (N,) number of goals of the episode that ended, without the current one.
    """

    cfg: UniformPoseCommandCfg

    # Views of the simulation, and what the viewer adds.
    _transient = {"frame", "_entity", "_panel"}

    def __init__(self, cfg: UniformPoseCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self._entity: Entity = env.scene[cfg.entity_name]
        self.frame = Frame(env.sim, self._entity, cfg.entity_name, cfg.frame_type, cfg.frame_name)
        self._panel: PosePanel | None = None
        self._reference_quat = torch.tensor([1.0, 0.0, 0.0, 0.0], device=self.device)
        self.goals: torch.Tensor | None = None
        self.goals_joint_pos = self.goals_torque = torch.empty(0, 0, device=self.device)
        self.goals_jacobian = torch.empty(0, 6, 0, device=self.device)
        if cfg.ranges is None:
            check_in_range(
                "UniformPoseCommandCfg.joint_range_fraction", cfg.joint_range_fraction, 0, 1
            )
            check_count("UniformPoseCommandCfg.num_goals", cfg.num_goals)
            found = draw_reachable_poses(
                env, self._entity, self.frame, cfg.num_goals, cfg.joint_range_fraction
            )
            self.goals, self.goals_joint_pos, self.joint_ids = found[:3]
            self.goals_torque, self.goals_jacobian, self._reference_quat = found[3:]

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(*shape, self.num_envs, dtype=torch.float32, device=self.device)

        self.pose_command_b = zeros(7).T.contiguous()
        self.pose_command_b[:, 3] = 1.0
        self.goal_joint_pos = zeros(self.goals_joint_pos.shape[1]).T.contiguous()
        self.goal_torque = torch.zeros_like(self.goal_joint_pos)
        self.goal_jacobian = zeros(6, self.goals_joint_pos.shape[1]).movedim(2, 0).contiguous()
        self.goal_age, self.num_ended = zeros(), zeros()
        self._end_sums = zeros(3)
        self.metrics = {
            name: zeros() for name in ("position_error", "orientation_error", *_END_METRICS)
        }

    @property
    def command(self) -> torch.Tensor:
        """Goal in the root frame, (N, 7)."""
        return self.pose_command_b

    @property
    def pose_command_w(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Position, (N, 3), and quaternion, (N, 4), of the goal in the world."""
        root, goal = self._entity.data, self.pose_command_b
        return combine_frame_transforms(
            root.root_link_pos_w, root.root_link_quat_w, goal[:, :3], goal[:, 3:]
        )

    @property
    def pose_b(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Position, (N, 3), and quaternion, (N, 4), of the frame in the root frame."""
        root = self._entity.data
        return subtract_frame_transforms(
            root.root_link_pos_w, root.root_link_quat_w, self.frame.pos, self.frame.quat
        )

    def export_metadata(self, name: str) -> dict[str, list | str | float]:
        """Return the commanded frame and the sign of quaternions under the keys of `mjlab.rl.exporter_utils`."""
        cfg = self.cfg
        return {
            "pose_command": name,
            "pose_frame": f"{cfg.frame_type} {cfg.entity_name}/{cfg.frame_name}",
            "pose_reference_quat": self._reference_quat.tolist(),
        }

    def errors(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the distance (m) and the angle (rad) from the frame to its goal, (N,) each."""
        position, quat = self.pose_b
        goal = self.pose_command_b
        distance = torch.linalg.vector_norm(goal[:, :3] - position, dim=1)
        return distance, quat_error_magnitude(goal[:, 3:], quat)

    def is_reached(self) -> torch.Tensor:
        """Return True where both metrics of the last step are within the tolerances, (N,) bool."""
        metrics, cfg = self.metrics, self.cfg
        return (metrics["position_error"] < cfg.position_tolerance) & (
            metrics["orientation_error"] < cfg.orientation_tolerance
        )

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Update metrics, advance time and resample expired goals; see `CommandTerm.compute`."""
        self.goal_age[slice(None) if env_ids is None else env_ids] += dt
        super().compute(dt, env_ids)
        if self._panel is not None:
            self._follow(self._panel)

    def create_gui(
        self,
        name: str,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add a handle to drag and turn the goal of the displayed environment."""
        self._panel = PosePanel(name, server, get_env_idx, on_change)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        # In a new episode, nothing has ended, and the metrics are those of the old episode.
        continues = self.command_counter[env_ids] > 0
        counts = (self._is_counted()[env_ids] & continues).float()
        self.num_ended[env_ids] = self.num_ended[env_ids] * continues + counts
        self._end_sums[:, env_ids] = (
            self._end_sums[:, env_ids] * continues + self._current()[:, env_ids] * counts
        )
        self.goal_age[env_ids] = 0.0
        if self.goals is None:
            self.pose_command_b[env_ids] = self._draw(len(env_ids))
        else:
            picks = torch.randint(len(self.goals), (len(env_ids),), device=self.device)
            self.pose_command_b[env_ids] = self.goals[picks]
            self.goal_joint_pos[env_ids] = self.goals_joint_pos[picks]
            self.goal_torque[env_ids] = self.goals_torque[picks]
            self.goal_jacobian[env_ids] = self.goals_jacobian[picks]

    def _follow(self, panel: PosePanel) -> None:
        """Move a goal that the user holds to the panel's handle, else the handle to the goal."""
        held = panel.held(self.num_envs)
        if held is None:
            panel.show(torch.cat(self.pose_command_w, dim=1))
            return
        index, pose = held
        pose = pose.to(self.device)
        root = self._entity.data
        position, quat = subtract_frame_transforms(
            root.root_link_pos_w[index], root.root_link_quat_w[index], pose[:3], pose[3:]
        )
        self.pose_command_b[index] = torch.cat((position, quat_near(quat, self._reference_quat)))
        # Do not resample the goal.
        self.time_left[index] = self.cfg.resampling_time_range[1]

    def _draw(self, count: int) -> torch.Tensor:
        """Return goals within `ranges`, (count, 7)."""
        r = self.cfg.ranges
        assert r is not None
        bounds = (r.pos_x, r.pos_y, r.pos_z, r.roll, r.pitch, r.yaw)
        drawn = sample_ranges(bounds, count, self.device)
        quat = quat_from_euler_xyz(drawn[:, 3], drawn[:, 4], drawn[:, 5])
        return torch.cat((drawn[:, :3], quat_near(quat, self._reference_quat)), dim=1)

    def _is_counted(self) -> torch.Tensor:
        return self.goal_age >= _COUNTED_PART * self.cfg.resampling_time_range[0]

    def _current(self) -> torch.Tensor:
        """Return both errors of the last step, and 1 if the goal is reached, else 0, (3, N)."""
        metrics = self.metrics
        return torch.stack(
            (metrics["position_error"], metrics["orientation_error"], self.is_reached().float())
        )

    def _update_metrics(self) -> None:
        for name, error in zip(("position_error", "orientation_error"), self.errors(), strict=True):
            self.metrics[name].copy_(error)
        counts = self._is_counted().float()
        number = (self.num_ended + counts).clamp_(min=1.0)
        means = (self._end_sums + self._current() * counts) / number
        for name, mean in zip(_END_METRICS, means, strict=True):
            self.metrics[name].copy_(mean)

    def _is_measured(self, env_ids: torch.Tensor) -> torch.Tensor:
        return self._is_counted()[env_ids] | (self.num_ended[env_ids] > 0)

    def _debug_vis_impl(self, visualizer: DebugVisualizer) -> None:
        goal, quat = self.pose_command_w
        poses = (
            (goal, matrix_from_quat(quat), _GOAL_SIZE),
            (self.frame.pos, matrix_from_quat(self.frame.quat), _FRAME_SIZE),
        )
        for index in visualizer.get_env_indices(self.num_envs):
            for position, rotation, size in poses:
                visualizer.add_frame(
                    position[index].cpu().numpy(), rotation[index].cpu().numpy(), scale=size
                )


# Observations and rewards.


def pose_command_error(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Displacement from the frame to its goal in the root frame, (N, 6): translation (m), rotation
    vector (rad).

    Raises:
        TypeError: the command is not a `UniformPoseCommand`.
    """
    command = pose_command(env, command_name)
    goal = command.pose_command_b
    return torch.cat(compute_pose_error(*command.pose_b, goal[:, :3], goal[:, 3:]), dim=1)


def position_command_error(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Distance from the frame to its goal (m). Raises as `pose_command_error`."""
    return pose_command(env, command_name).errors()[0]


def position_command_error_tanh(
    env: ManagerBasedRlEnv, command_name: str, std: float
) -> torch.Tensor:
    """`1 - tanh(d / std)` of the distance d to the goal (m). Raises as `pose_command_error`."""
    return 1.0 - torch.tanh(position_command_error(env, command_name) / std)


def orientation_command_error(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Angle from the frame to its goal (rad). Raises as `pose_command_error`."""
    return pose_command(env, command_name).errors()[1]


def orientation_command_error_tanh(
    env: ManagerBasedRlEnv, command_name: str, std: float
) -> torch.Tensor:
    """`1 - tanh(a / std)` of the angle a to the goal (rad). Raises as `pose_command_error`."""
    return 1.0 - torch.tanh(orientation_command_error(env, command_name) / std)


def goal_joint_deviation_l1(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Sum of the distances of joints from their positions at the goal (rad or m).

    Leads around joint limits and out of postures from which the goal is out of reach.

    Raises:
        TypeError: the command is not a `UniformPoseCommand`.
        ValueError: it has `ranges`, so the joint positions at its goals are unknown.
    """
    command = reachable_pose_command(env, command_name)
    joint_pos = env.scene[command.cfg.entity_name].data.joint_pos[:, command.joint_ids]
    return (joint_pos - command.goal_joint_pos).abs().sum(dim=1)


def reachable_pose_command(env: ManagerBasedRlEnv, command_name: str) -> UniformPoseCommand:
    """Return a pose command whose joint positions at goals are known."""
    command = pose_command(env, command_name)
    if command.goals is None:
        raise ValueError(
            f"Command {command_name!r}: expected one without ranges, whose joint positions at goals are known; "
            "remove the term, or the ranges."
        )
    return command


def pose_command(env: ManagerBasedRlEnv, command_name: str) -> UniformPoseCommand:
    """Return a pose command by name. Raises `TypeError` for a command of another class."""
    term = env.command_manager.get_term(command_name)
    if not isinstance(term, UniformPoseCommand):
        raise WrongTypeError(
            f"Command {command_name!r}: expected a UniformPoseCommand, got {type(term).__name__}."
        )
    return term
