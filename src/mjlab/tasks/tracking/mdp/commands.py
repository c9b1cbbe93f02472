"""Motion command: reference playback, episode starts, tracking metrics and visualization."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, cast

import mujoco
import numpy as np
import torch

from mjlab.compat import older_names
from mjlab.entity.building import short_name
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.tasks.tracking.mdp.motion_library import (
    MotionFrame,
    MotionLibrary,
    MotionLoader,
    MotionReader,
)
from mjlab.tasks.tracking.mdp.motion_panel import MotionPanel
from mjlab.tasks.tracking.mdp.motion_sampling import (
    AXES,
    Drawn,
    HardSegmentSampler,
    draw_uniform,
    perturbed_start,
)
from mjlab.tasks.tracking.motion_file import PER_BODY, PER_JOINT, check_rate, read_motion
from mjlab.tasks.tracking.motion_order import Skeleton, arranged
from mjlab.tasks.tracking.motion_sources import find_motions
from mjlab.utils.errors import check_one_of
from mjlab.utils.indexing import as_ids, is_empty
from mjlab.utils.lab_api.math import matrix_from_quat, quat_error_magnitude
from mjlab.utils.torch import constant_tensor

if TYPE_CHECKING:
    from collections.abc import Sequence

    import viser

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import DebugVisualizer

__all__ = [
    "MotionCommand",
    "MotionCommandCfg",
    "MotionLoader",
]

_MODES = ("adaptive", "uniform", "start")
# Axis lengths of bodies and of the anchor (m).
_REFERENCE_LENGTHS = (0.08, 0.1)
_ROBOT_LENGTHS = (0.12, 0.15)
_PASTEL = ((1.0, 0.6, 0.6), (0.6, 1.0, 0.6), (0.6, 0.6, 1.0))
_AXIS_RADIUS = 0.008
# Geom group hidden in ghosts by all viewers.
_HIDDEN_GROUP = 3
_SAMPLING_METRICS = ("sampling_entropy", "sampling_top1_prob", "sampling_top1_bin")


@dataclass(kw_only=True)
class MotionCommandCfg(CommandTermCfg):
    """Motion command configuration."""

    @dataclass
    class VizCfg:
        """Visualization of the reference."""

        mode: Literal["ghost", "frames"] = "ghost"
        """Drawing mode. `ghost`: a transparent robot. `frames`: axes of the tracked bodies of the
        reference (short) and of the robot (long)."""
        ghost_color: tuple[float, float, float, float] = (0.5, 0.7, 0.5, 0.5)
        """Color and opacity of the ghost (RGBA)."""
        ghost_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """Offset of the ghost from the reference (m). Zero: overlaid on the robot; (0, 1, 0):
        beside it."""

    motion_file: str
    """Motions: files, folders, or names of bundled motions, separated by commas."""
    anchor_body_name: str
    """Body that aligns robot and reference; one of `body_names`."""
    body_names: tuple[str, ...]
    """Bodies to track; the first is the floating base, which episodes start from."""
    entity_name: str
    """Name of the robot entity."""
    pose_range: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Perturbation of the root pose at a start: ranges of `x`, `y`, `z` (m), `roll`, `pitch` and
    `yaw` (rad, world axes). Missing keys: 0."""
    velocity_range: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Perturbation of the root velocity at a start, same keys (m/s, rad/s)."""
    joint_position_range: tuple[float, float] = (-0.52, 0.52)
    """Perturbation of joint positions at a start (rad)."""
    adaptive_kernel_size: int = 1
    """Kernel size in bins, ahead of and including a bin, whose failures raise its probability."""
    adaptive_lambda: float = 0.8
    """Decay of the kernel per bin ahead."""
    adaptive_uniform_ratio: float = 0.1
    """Weight of uniform sampling relative to failures."""
    adaptive_alpha: float = 0.001
    """Update rate per step of the running mean of failures."""
    sampling_mode: Literal["adaptive", "uniform", "start"] = "adaptive"
    """Start frame sampling. `adaptive`: more often before failures. `uniform`: any frame. `start`:
    the first frame of each motion in turn."""
    viz: VizCfg = field(default_factory=VizCfg)
    """Visualization settings."""
    advance_after_teleport: bool = True
    """Keep the reference one frame ahead of the robot after resampling at the end of a motion, as
    after a reset. False: behavior of mjlab 1.6. Without effect if a termination (`motion_ended`)
    ends the episode there."""

    def build(self, env: ManagerBasedRlEnv) -> MotionCommand:
        """Build the term; raises `ValueError` if motions or settings do not match the robot."""
        return MotionCommand(self, env)


class MotionCommand(MotionReader, CommandTerm):
    """Motion command: plays reference motions, one frame per step, and places robots on them.

    In a step, rewards and terminations compare the robot with frame t, the frame observed by the
    policy. Done environments are then reset: the robot is placed, perturbed, on a frame k. The
    command update measures errors, advances t by one in all environments (the robot is then at k,
    the reference at k + 1), and updates the relative poses. At the end of a motion the robot is
    placed on a newly sampled frame in the middle of its episode, unless a termination such as
    `motion_ended` ends the episode first.

    Relative poses (`relative_poses`) are updated once per step, so rewards use the robot anchor of
    the previous step.

    Attributes:
        motion: Motions; see `MotionLibrary`.
        motion_files: Paths of the motion files.
        motion_ids: (N,) int64, motion of each environment.
        time_steps: (N,) int64, frame t within the motion.
        body_pos_relative_w: (N, K, 3) relative positions; `body_quat_relative_w` (N, K, 4).
        sampler: Failure statistics; None unless sampling is adaptive.
        start_perturbation: Scale of the configured start perturbation, from 0 to 1.
        drawing: Visualization of the reference.
    """

    cfg: MotionCommandCfg

    # Derived from the config and the files, or used within a call; not checkpointed.
    _transient = {
        "scene", "robot", "body_names", "body_indexes", "anchor_index", "anchor_body", "motion_files",
        "_num_bins", "_moved", "_started",
    }  # fmt: skip

    def __init__(self, cfg: MotionCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        check_one_of("anchor_body_name", cfg.anchor_body_name, cfg.body_names)
        check_one_of("sampling_mode", cfg.sampling_mode, _MODES)
        if ignored := {*cfg.pose_range, *cfg.velocity_range} - {*AXES}:
            warnings.warn(
                f"MotionCommandCfg pose_range and velocity_range: expected keys {list(AXES)}, got "
                f"{sorted(ignored)}, ignored.",
                UserWarning,
                stacklevel=2,
            )
        self.scene = env.scene
        self.robot: Entity = env.scene[cfg.entity_name]
        root = short_name(self.robot.root_body.name)
        if cfg.body_names[0] != root:
            warnings.warn(
                f"MotionCommandCfg body_names: expected the floating base {root!r} first, got "
                f"{cfg.body_names[0]!r}; episodes start with the base in its pose.",
                UserWarning,
                stacklevel=2,
            )
        self.body_names = tuple(cfg.body_names)
        self.anchor_index = self.body_names.index(cfg.anchor_body_name)
        indexes, _ = self.robot.find_bodies(self.body_names, preserve_order=True)
        self.body_indexes = torch.tensor(indexes, device=self.device)
        self.anchor_body = indexes[self.anchor_index]
        self.motion_files = tuple(find_motions(cfg.motion_file))
        skeleton = Skeleton.of_entity(self.robot, env.sim.mj_model)
        motions = [arranged(path, read_motion(path), skeleton) for path in self.motion_files]
        for path, motion in zip(self.motion_files, motions, strict=True):
            check_rate(path, motion, env.step_dt)
        self.motion = MotionLibrary(self.motion_files, motions, self.body_indexes, self.device)
        self.time_steps = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.motion_ids = torch.zeros_like(self.time_steps)
        shape = (self.num_envs, len(indexes))
        self.body_pos_relative_w = torch.zeros(*shape, 3, dtype=torch.float32, device=self.device)
        self.body_quat_relative_w = torch.zeros(*shape, 4, dtype=torch.float32, device=self.device)
        self.body_quat_relative_w[..., 0] = 1.0
        self.metrics = {
            name: torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
            for name in (*tracking_metrics(self), *_SAMPLING_METRICS)
        }
        sampler = HardSegmentSampler(
            self.motion.lengths.tolist(),
            env.step_dt,
            cfg.adaptive_kernel_size,
            cfg.adaptive_lambda,
            cfg.adaptive_uniform_ratio,
            cfg.adaptive_alpha,
            self.device,
        )
        self._num_bins = sampler.num_bins
        self.sampler = sampler if cfg.sampling_mode == "adaptive" else None
        self.start_perturbation = 1.0
        # Number of starts of each environment, to play the motions in turn.
        self._num_starts = torch.zeros_like(self.time_steps)
        # Step of the last counted failure of each environment, to count each failure once.
        self._counted_at = torch.full_like(self.time_steps, -1)
        self._moved: list[torch.Tensor] = []
        self._started: list[torch.Tensor] = []
        # Lengths of the motions, encoded as shapes: loading the state of a run on motions of other
        # lengths then raises, since its frames may not exist here.
        lengths = self.motion.lengths.tolist()
        self._extent = [
            torch.empty(count, 0, dtype=torch.float32) for count in (len(lengths), *lengths)
        ]
        self.drawing = MotionDrawing(self)
        self._panel: MotionPanel | None = None

    @property
    def command(self) -> torch.Tensor:
        """Joint positions and velocities of the reference, (N, 2 nj)."""
        return torch.cat((self.joint_pos, self.joint_vel), dim=1)

    @property
    def motion_anchor_body_index(self) -> int:
        """Index of the anchor in `body_names`."""
        return self.anchor_index

    @property
    def robot_anchor_body_index(self) -> int:
        """Index of the anchor in the robot's bodies."""
        return self.anchor_body

    @property
    def bin_count(self) -> int:
        """Number of bins of about 1 s, over all motions."""
        return self._num_bins

    @property
    def bin_failed_count(self) -> torch.Tensor:
        """Running mean of failures per bin, (bin_count,). Zeros unless sampling is adaptive."""
        if self.sampler is None:
            return torch.zeros(self._num_bins, dtype=torch.float32, device=self.device)
        return self.sampler.failed

    @property
    def frame_indexes(self) -> torch.Tensor:
        """(N,) int64, frame of each environment, indexed over all motions."""
        if len(self.motion) == 1:
            return self.time_steps
        return self.time_steps + self.motion.starts.index_select(0, self.motion_ids)

    @property
    def current_frame(self) -> MotionFrame:
        """Reference of the command, with current relative poses."""
        return MotionFrame(self, self.frame_indexes)

    @property
    def matching_frame(self) -> MotionFrame:
        """Reference at the time of the robot's state, with current relative poses.

        Between steps the command itself is one frame ahead of the robot.
        """
        # The first frame of a motion has no predecessor.
        return MotionFrame(self, self.frame_indexes - self.time_steps.clamp(max=1))

    def motion_arrays(self) -> dict[str, np.ndarray]:
        """Return all motions in sequence as the arrays of a motion file, with all bodies of the robot."""
        skeleton = Skeleton.of_entity(self.robot, self._env.sim.mj_model)
        motions = [arranged(path, read_motion(path), skeleton) for path in self.motion_files]
        arrays = {
            name: np.concatenate([getattr(motion, name) for motion in motions])
            for name in (*PER_JOINT, *PER_BODY)
        }
        return {
            "fps": np.array([1.0 / self._env.step_dt]),
            "joint_names": np.array(skeleton.joint_names),
            "body_names": np.array(skeleton.body_names),
            **arrays,
        }

    def update_relative_body_poses(self) -> None:
        """Update the relative poses from the current reference and robot state."""
        pos, quat = self.relative_poses()
        self.body_pos_relative_w.copy_(pos)
        self.body_quat_relative_w.copy_(quat)

    # Starts.

    def reset(self, env_ids: torch.Tensor | slice | None) -> dict[str, float]:
        """Start `env_ids` on a sampled frame; return the metrics of the episodes that ended.

        Writes the robot state; derived quantities are stale until `sim.forward()`.
        """
        ids = as_ids(env_ids, self.num_envs, self.device)
        log = super().reset(ids)
        # The environment calls forward after resets.
        self._moved.clear()
        self._started.append(ids)
        return log

    def reset_to_frame(self, env_ids: torch.Tensor, frame: int) -> None:
        """Set robot and reference to a frame of their motion, without perturbation.

        Joint positions are clipped to their soft limits. Quantities derived from the robot state,
        and the relative poses, are stale until `sim.forward()` and `update_relative_body_poses()`.

        Args:
            env_ids: (n,) int64.
            frame: Frame within the motion of each environment, clamped to the last frame.
        """
        last = self.motion.lengths[self.motion_ids[env_ids]] - 1
        self.time_steps[env_ids] = torch.full_like(last, max(frame, 0)).minimum(last)
        self._write_start(env_ids, perturbed=False)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        self._count_failures(env_ids)
        self.motion_ids[env_ids], self.time_steps[env_ids] = self._draw(env_ids)
        self._write_start(env_ids, perturbed=True)
        self._moved.append(env_ids)

    def take_turns_from(self, episode: int) -> None:
        """Play motion (`episode` + i) % M next in environment i, of M motions, in mode `start`.

        Needed because the number of previous starts depends on how often the robots fell.
        """
        self._num_starts.fill_(episode)

    def _draw(self, env_ids: torch.Tensor) -> Drawn:
        """Sample a motion and a frame for each of `env_ids`."""
        if self.cfg.sampling_mode == "start":
            motions = (env_ids + self._num_starts[env_ids]) % len(self.motion)
            self._num_starts[env_ids] += 1
            return motions, torch.zeros_like(motions)
        if self.sampler is None:
            statistics: tuple[Any, ...] = (1.0, 1.0 / self._num_bins, 0.5)
            drawn = draw_uniform(self.motion, len(env_ids))
        else:
            probabilities = self.sampler.probabilities()
            statistics = self.sampler.statistics(probabilities)
            drawn = self.sampler.draw(self.motion, len(env_ids), probabilities)
        for name, value in zip(_SAMPLING_METRICS, statistics, strict=True):
            self.metrics[name][:] = value
        return drawn

    def _write_start(self, env_ids: torch.Tensor, perturbed: bool) -> None:
        """Write the robot state of the current frame; reset targets, delays and histories."""
        robot, cfg = self.robot, self.cfg
        at = self.frame_indexes[env_ids]
        root_state, joint_pos = perturbed_start(
            self.motion,
            at,
            pose_range=cfg.pose_range,
            velocity_range=cfg.velocity_range,
            joint_position_range=cfg.joint_position_range,
            scale=self.start_perturbation if perturbed else 0.0,
        )
        root_state[:, :3] += self.scene.env_origins[env_ids]
        limits = robot.data.soft_joint_pos_limits[env_ids]
        joint_pos = joint_pos.clamp(limits[..., 0], limits[..., 1])
        robot.write_joint_state_to_sim(joint_pos, self.motion.joint_vel[at], env_ids=env_ids)
        robot.write_root_state_to_sim(root_state, env_ids=env_ids)
        robot.reset(env_ids)
        if robot.seeds_lengths:
            self._env.sim.forward(env_ids, stage="pos")
        robot.seed_position_targets(env_ids)

    def _count_failures(self, env_ids: torch.Tensor) -> None:
        """Count the failures of this step at the frames where they occurred, each once.

        Termination flags stay set until the next step, and environments may be reset again before.
        """
        if self.sampler is None:
            return
        now = int(self._env.common_step_counter)
        terminated = self._env.termination_manager.terminated[env_ids]
        failed = terminated & (self._counted_at[env_ids] != now)
        self._counted_at[env_ids] = now
        ids = env_ids[failed]
        if not is_empty(ids):
            self.sampler.count_failures(self.motion, self.motion_ids[ids], self.time_steps[ids])

    # Step update.

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Update metrics, advance the reference by one frame, and update the relative poses.

        The arguments are those of `CommandTerm.compute`. With `env_ids` None (once per step), the
        failures of the step are added to the statistics.
        """
        super().compute(dt, env_ids)
        if self.sampler is not None and env_ids is None:
            self.sampler.end_step()
        if self._panel is not None:
            # Needed even if the reference is not drawn.
            self._panel.update()

    def _update_metrics(self) -> None:
        if self._started:
            # Relative poses of restarted environments are still from before the reset.
            ids = torch.cat(self._started)
            pos, quat = self.relative_poses(ids)
            self.body_pos_relative_w[ids], self.body_quat_relative_w[ids] = pos, quat
            self._started.clear()
        for name, value in tracking_metrics(self).items():
            self.metrics[name].copy_(value)

    def _update_command(self, env_ids: torch.Tensor | None = None) -> None:
        self.time_steps[slice(None) if env_ids is None else env_ids] += 1
        over = (self.time_steps >= self.motion.lengths[self.motion_ids]).nonzero().flatten()
        if not is_empty(over):
            self._resample_command(over)
            if self.cfg.advance_after_teleport:
                self.time_steps[over] += 1
        if self._moved:
            # The robots were moved after the step's forward pass.
            self._env.sim.forward(torch.cat(self._moved).unique())
            self._moved.clear()
        self.update_relative_body_poses()

    # Viewers.

    def _debug_vis_impl(self, visualizer: DebugVisualizer) -> None:
        if self._panel is not None:
            self._panel.update()
        self.drawing.draw(visualizer)

    def create_gui(
        self,
        name: str,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add a frame slider, a button to start there, and a table of body errors."""
        self._panel = MotionPanel(name, server, self, get_env_idx, on_change, request_action)

    def on_viewer_pause(self, paused: bool) -> None:
        """Enable the frame slider while the viewer is paused."""
        if self._panel is not None:
            self._panel.set_paused(paused)

    def apply_gui_reset(self, env_ids: torch.Tensor) -> bool:
        """Reset `env_ids` to the frame selected in the panel; return False if none is selected.

        As after every reset, the reference is then one frame ahead of the robot.
        """
        chosen = None if self._panel is None else self._panel.take_start()
        if chosen is None:
            return False
        self.motion_ids[env_ids], frame = chosen
        self.reset_to_frame(env_ids, frame)
        last = self.motion.lengths[self.motion_ids[env_ids]] - 1
        self.time_steps[env_ids] = (self.time_steps[env_ids] + 1).minimum(last)
        self._env.sim.forward(env_ids)
        self.update_relative_body_poses()
        return True


# Helpers for terms that read a motion command.


def motion_command(env: ManagerBasedRlEnv, command_name: str) -> MotionCommand:
    """Return the motion command called `command_name`, a `MotionCommand` or a term with its attributes."""
    return cast("MotionCommand", env.command_manager.get_term(command_name))


def body_columns(command: MotionReader, body_names: tuple[str, ...] | None) -> slice | torch.Tensor:
    """Return the columns of `body_names` (None: all) among the tracked bodies, in their order."""
    if body_names is None:
        return slice(None)
    tracked = command.body_names if isinstance(command, MotionReader) else command.cfg.body_names
    columns = tuple(i for i, name in enumerate(tracked) if name in body_names)
    if len(columns) < max(len(body_names), 1):
        warnings.warn(
            f"body_names: expected tracked bodies, got {tuple(body_names)}; others are ignored. "
            f"Available: {tuple(tracked)}.",
            UserWarning,
            stacklevel=2,
        )
    return constant_tensor(columns, command.body_pos_relative_w.device, torch.long)


# Visualization.


class MotionDrawing:
    """Visualization of the reference of a motion command."""

    def __init__(self, command: MotionCommand) -> None:
        """Store the command; settings are read from its config."""
        self._command = command
        self._ghost: mujoco.MjModel | None = None
        self.offset = np.array(command.cfg.viz.ghost_offset, dtype=float)
        """Drawing offset from the reference (m), (3,); may be changed."""

    def draw(self, visualizer: DebugVisualizer) -> None:
        """Draw the reference of the environments that `visualizer` displays."""
        indices = list(visualizer.get_env_indices(self._command.num_envs))
        if not indices:
            return
        if self._command.cfg.viz.mode == "ghost":
            self._draw_ghosts(visualizer, indices)
        else:
            self._draw_frames(visualizer, indices)

    def _draw_ghosts(self, visualizer: DebugVisualizer, indices: Sequence[int]) -> None:
        command, viz = self._command, self._command.cfg.viz
        visualizer.add_legend(viz.ghost_color, "reference motion")
        if self._ghost is None:
            self._ghost = ghost_model(command.robot, viz.ghost_color)
        model = self._ghost
        frames = command.frame_indexes[indices]
        pos = command.motion.body_pos_w[frames, 0] + command.scene.env_origins[indices]
        root = torch.cat((pos, command.motion.body_quat_w[frames, 0]), dim=1).cpu().numpy()
        joints = command.motion.joint_pos[frames].cpu().numpy()
        root[:, :3] += self.offset
        is_free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        free, others = int(model.jnt_qposadr[is_free][0]), model.jnt_qposadr[~is_free]
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


def ghost_model(robot: Entity, color: tuple[float, float, float, float]) -> mujoco.MjModel:
    """Return a single-color model of the robot; collision geoms are hidden if it has visual geoms.

    The model contains the robot alone, so that nothing else in the scene has a ghost.
    """
    # Rebuild from the config, because the robot's spec is attached to the scene's spec.
    model = robot.cfg.build().compile()
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    model.geom_matid[:] = -1
    model.geom_rgba[:] = color
    if not collides.all():
        model.geom_group[collides] = _HIDDEN_GROUP
    return model


# Tracking metrics.


def tracking_metrics(motion: MotionReader) -> dict[str, torch.Tensor]:
    """Return tracking errors by name, (N,) each.

    Position and velocity errors are Euclidean norms (m, m/s, rad/s), orientation errors angles
    (rad), body errors means over the tracked bodies, and joint errors norms over all joints (rad,
    rad/s). Body poses are compared with the relative poses; velocities are in world axes.
    """
    anchor = motion.anchor_index
    pos, quat = motion.robot_body_pos_w, motion.robot_body_quat_w
    # Position, linear and angular velocity errors, (3, N, K).
    norms = _norm(
        torch.stack(
            (
                motion.body_pos_relative_w - pos,
                motion.body_lin_vel_w - motion.robot_body_lin_vel_w,
                motion.body_ang_vel_w - motion.robot_body_ang_vel_w,
            )
        )
    )
    mean_pos, mean_lin_vel, mean_ang_vel = norms.mean(dim=2)
    body_rot = quat_error_magnitude(motion.body_quat_relative_w, quat)
    return {
        "error_anchor_pos": _norm(motion.anchor_pos_w - pos[:, anchor]),
        "error_anchor_rot": quat_error_magnitude(motion.anchor_quat_w, quat[:, anchor]),
        "error_anchor_lin_vel": norms[1, :, anchor],
        "error_anchor_ang_vel": norms[2, :, anchor],
        "error_body_pos": mean_pos,
        "error_body_rot": body_rot.mean(dim=1),
        "error_body_lin_vel": mean_lin_vel,
        "error_body_ang_vel": mean_ang_vel,
        "error_joint_pos": (motion.joint_pos - motion.robot_joint_pos).norm(dim=-1),
        "error_joint_vel": (motion.joint_vel - motion.robot_joint_vel).norm(dim=-1),
    }


def _norm(vectors: torch.Tensor) -> torch.Tensor:
    """Return Euclidean norms of (..., 3) vectors."""
    # By components: a reduction over three numbers takes twice as long on a CPU.
    x, y, z = vectors.unbind(-1)
    return (x * x).addcmul_(y, y).addcmul_(z, z).sqrt_()


__getattr__ = older_names(__name__)
