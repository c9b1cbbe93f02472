"""The motion command: where the robot should be now, starting it there, drawing and logging that."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
import torch

from mjlab.compat import older_names
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.managers.lookup import Lookup
from mjlab.managers.term_checks import check_range, require_command
from mjlab.tasks.tracking.mdp.motion_library import (
    MotionFrame,
    MotionReader,
    read_library,
)
from mjlab.tasks.tracking.mdp.motion_library import (
    MotionLoader as MotionLoader,
)
from mjlab.tasks.tracking.mdp.motion_panel import MotionPanel
from mjlab.tasks.tracking.mdp.motion_sampling import (
    AXES,
    Drawn,
    HardSegmentSampler,
    draw_uniform,
    perturbed_start,
)
from mjlab.utils.errors import (
    WrongTypeError,
    check_count,
    check_exists,
    check_one_of,
    check_positive,
)
from mjlab.utils.indexing import as_ids, is_empty
from mjlab.utils.lab_api.math import (
    matrix_from_quat,
    quat_error_magnitude,
)

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
_DRAWINGS = ("ghost", "frames")
# Lengths of the axes, in metres: of bodies and of the anchor.
_REFERENCE_LENGTHS = (0.08, 0.1)
_ROBOT_LENGTHS = (0.12, 0.15)
_PASTEL = ((1.0, 0.6, 0.6), (0.6, 1.0, 0.6), (0.6, 0.6, 1.0))
_AXIS_RADIUS = 0.008
# A group of geoms that no viewer shows of a ghost.
_HIDDEN_GROUP = 3
_SAMPLING_METRICS = ("sampling_entropy", "sampling_top1_prob", "sampling_top1_bin")
# What terms read of a command, whose class may be a package's own.
_READ = (
    "anchor_pos_w",
    "anchor_quat_w",
    "robot_anchor_pos_w",
    "robot_anchor_quat_w",
    "body_pos_relative_w",
    "body_quat_relative_w",
    "robot_body_pos_w",
    "robot_body_quat_w",
)


@dataclass(kw_only=True)
class MotionCommandCfg(CommandTermCfg):
    """Motions to imitate."""

    @dataclass
    class VizCfg:
        """How the reference is drawn."""

        mode: Literal["ghost", "frames"] = "ghost"
        """`ghost` draws a see-through robot, `frames` the axes of each tracked body, of the
        reference (short) and of the robot (long)."""
        ghost_color: tuple[float, float, float, float] = (0.5, 0.7, 0.5, 0.5)
        """Red, green, blue and opacity of the ghost."""
        ghost_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """From the place of the reference to that of the ghost, in metres: zero is over the robot,
        (0, 1, 0) beside it."""

    motion_file: str
    """The motions: files, folders, or names of motions that ship with the package, separated by
    commas."""
    anchor_body_name: str
    """Body by which robot and reference are aligned; one of `body_names`."""
    body_names: tuple[str, ...]
    """Bodies to track; the first is the floating base."""
    entity_name: str
    """The robot."""
    pose_range: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Perturbation of the root's pose at a start: ranges of `x`, `y`, `z` (m), `roll`, `pitch` and
    `yaw` (rad, world axes); 0 where there is none."""
    velocity_range: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Perturbation of the root's velocity, likewise (m/s, rad/s)."""
    joint_position_range: tuple[float, float] = (-0.52, 0.52)
    """Perturbation of each joint's position at a start (rad)."""
    adaptive_kernel_size: int = 1
    """Bins ahead of a start, its own included, whose failures make it more likely."""
    adaptive_lambda: float = 0.8
    """Weight of failures one bin further ahead."""
    adaptive_uniform_ratio: float = 0.1
    """Weight of starts anywhere, against failures."""
    adaptive_alpha: float = 0.001
    """Share of the running mean of failures that one step replaces."""
    sampling_mode: Literal["adaptive", "uniform", "start"] = "adaptive"
    """Where episodes start: `adaptive` more often where they fail, `uniform` anywhere, `start` at
    the first frame, of one motion after the other."""
    viz: VizCfg = field(default_factory=VizCfg)
    """Drawing."""
    advance_after_teleport: bool = True
    """Whether the reference is a frame ahead of the robot after the end of a motion, as it is after
    a reset; False is what mjlab 1.6 does. A motion is played to its end only where no termination
    (`motion_ended`) ends the episode there."""

    def build(self, env: ManagerBasedRlEnv) -> MotionCommand:
        """Return the term; raises `ValueError` for motions or settings that do not fit the robot."""
        return MotionCommand(self, env)


class MotionCommand(MotionReader, CommandTerm):
    """Plays motions as the reference, one frame a step, and starts the robot on them.

    In a step, rewards and terminations compare the robot with frame t, which the policy saw. Then
    environments that are done are reset: the robot is put, perturbed, onto a frame k. The update of
    the command measures errors, advances t by one everywhere (the robot is at k then, and the
    reference at k + 1), and refreshes the relative poses. Where the motion is over, the robot is put
    onto another frame at once, in the middle of its episode, unless a termination such as
    `motion_ended` has ended that.

    The relative poses (`relative_poses`) are refreshed once a step and then kept, so that rewards
    go by the robot's anchor of one step before.

    Attributes:
        motion: The motions; see `MotionLibrary`.
        motion_files: Where they were read from.
        motion_ids: (N,) int64, the motion of each environment.
        time_steps: (N,) int64, its frame t within that motion.
        body_pos_relative_w: (N, K, 3) relative positions; `body_quat_relative_w` (N, K, 4).
        sampler: The statistics of failures; None unless sampling is adaptive.
        start_perturbation: How much of the config's perturbation starts get, from 0 to 1.
        drawing: How the reference is drawn.
    """

    cfg: MotionCommandCfg

    # What the config and the files say, and what lasts no longer than a call.
    _transient = {
        "scene", "robot", "body_names", "body_indexes", "anchor_index", "anchor_body", "motion_files",
        "_num_bins", "_moved", "_started",
    }  # fmt: skip

    def __init__(self, cfg: MotionCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        check_command_cfg(cfg)
        self.scene = env.scene
        self.robot: Entity = find_robot(cfg, env)
        self.body_names = tuple(cfg.body_names)
        self.anchor_index = self.body_names.index(cfg.anchor_body_name)
        indexes = [self.robot.body_names.index(name) for name in self.body_names]
        self.body_indexes = torch.tensor(indexes, device=self.device)
        self.anchor_body = indexes[self.anchor_index]
        self.motion_files, self.motion = read_library(
            cfg.motion_file, self.robot, self.body_indexes, env.step_dt, self.device
        )
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
        # Number of starts of each environment, so that it plays one motion after the other.
        self._num_starts = torch.zeros_like(self.time_steps)
        # The step in which a failure was last counted, so that none is counted twice.
        self._counted_at = torch.full_like(self.time_steps, -1)
        self._moved: list[torch.Tensor] = []
        self._started: list[torch.Tensor] = []
        self._over = Lookup()
        # Frames are of motions with these lengths: by their shapes, the state of a run on other
        # motions is refused, whose frames may not exist here.
        lengths = self.motion.lengths.tolist()
        self._extent = [
            torch.empty(count, 0, dtype=torch.float32) for count in (len(lengths), *lengths)
        ]
        self.drawing = MotionDrawing(self)
        self._panel: MotionPanel | None = None

    @property
    def command(self) -> torch.Tensor:
        """Positions and velocities of all joints in the reference, (N, 2 nj)."""
        return torch.cat((self.joint_pos, self.joint_vel), dim=1)

    @property
    def motion_anchor_body_index(self) -> int:
        """Index of the anchor within `body_names`."""
        return self.anchor_index

    @property
    def robot_anchor_body_index(self) -> int:
        """Index of the anchor within the robot's bodies."""
        return self.anchor_body

    @property
    def bin_count(self) -> int:
        """Number of bins, of about a second each, that all motions are cut into."""
        return self._num_bins

    @property
    def bin_failed_count(self) -> torch.Tensor:
        """Running mean of the failures in each bin, (bin_count,). Zeros unless sampling is adaptive."""
        if self.sampler is None:
            return torch.zeros(self._num_bins, dtype=torch.float32, device=self.device)
        return self.sampler.failed

    @property
    def frame_indexes(self) -> torch.Tensor:
        """(N,) int64, the frame of each environment, counted over all motions."""
        return self._counted_over_all(self.time_steps)

    @property
    def matching_frame(self) -> MotionFrame:
        """The reference at the time of the robot's state, with relative poses of now.

        Between steps the command itself is a frame ahead of the robot: it is what comes next.
        """
        return MotionFrame(self, self._counted_over_all((self.time_steps - 1).clamp_(min=0)))

    def _counted_over_all(self, frames: torch.Tensor) -> torch.Tensor:
        if len(self.motion) == 1:
            return frames
        return frames + self.motion.starts.index_select(0, self.motion_ids)

    def update_relative_body_poses(self) -> None:
        """Refresh the relative poses from the reference and the robot as they are now."""
        pos, quat = self.relative_poses()
        self.body_pos_relative_w.copy_(pos)
        self.body_quat_relative_w.copy_(quat)

    # Starting.

    def reset(self, env_ids: torch.Tensor | slice | None) -> dict[str, float]:
        """Start these environments on a frame; return the metrics of the episodes that ended.

        Writes the robot's state; what derives from it is stale until `sim.forward()`.
        """
        ids = as_ids(env_ids, self.num_envs, self.device)
        log = super().reset(ids)
        # The environment runs forward after its resets.
        self._moved.clear()
        self._started.append(ids)
        return log

    def reset_to_frame(self, env_ids: torch.Tensor, frame: int) -> None:
        """Put robots exactly onto a frame of their motions, and the reference with them.

        Joints are clipped to their soft limits. What derives from the robot's state, and the
        relative poses, are stale until `sim.forward()` and `update_relative_body_poses()`.

        Args:
            env_ids: (n,) int64.
            frame: Counted within the motion of each environment; beyond the end is the last.
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
        """Let environment i play motion (`episode` + i) modulo their number next, in mode `start`.

        How often environments were started before depends on how often their robots fell.
        """
        self._num_starts.fill_(episode)

    def _draw(self, env_ids: torch.Tensor) -> Drawn:
        """Return a motion and a frame for each environment."""
        if self.cfg.sampling_mode == "start":
            motions = (env_ids + self._num_starts[env_ids]) % len(self.motion)
            self._num_starts[env_ids] += 1
            return motions, torch.zeros_like(motions)
        if self.sampler is None:
            self._write_sampling_metrics(1.0, 1.0 / self._num_bins, 0.5)
            return draw_uniform(self.motion, len(env_ids))
        probabilities = self.sampler.probabilities()
        self._write_sampling_metrics(*self.sampler.figures(probabilities))
        return self.sampler.draw(self.motion, len(env_ids), probabilities)

    def _write_sampling_metrics(self, *values: Any) -> None:
        for name, value in zip(_SAMPLING_METRICS, values, strict=True):
            self.metrics[name][:] = value

    def _write_start(self, env_ids: torch.Tensor, perturbed: bool) -> None:
        """Write the robot's state on its frame, and forget its targets, delays and histories."""
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
        robot.seed_position_targets(env_ids)

    def _count_failures(self, env_ids: torch.Tensor) -> None:
        """Count the environments that failed in this step, at the frame where they did.

        The flags of a step stand until the next one, and environments may be reset again meanwhile.
        """
        terminations: Any = getattr(self._env, "termination_manager", None)
        if self.sampler is None or terminations is None:
            return
        now = int(self._env.common_step_counter)
        failed = terminations.terminated[env_ids] & (self._counted_at[env_ids] != now)
        self._counted_at[env_ids] = now
        ids = env_ids[failed]
        if not is_empty(ids):
            self.sampler.count_failures(self.motion, self.motion_ids[ids], self.time_steps[ids])

    # The update of every step.

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Measure errors, advance the reference by a frame, and refresh what depends on it.

        The arguments are those of `CommandTerm.compute`. With `env_ids` None, which is once a step,
        the failures of the step are taken into the statistics.
        """
        super().compute(dt, env_ids)
        if self.sampler is not None and env_ids is None:
            self.sampler.end_step()
        if self._panel is not None:
            # Also where the reference is not drawn.
            self._panel.update()

    def plan_lookups(self, dt: float | torch.Tensor) -> list[Lookup]:
        """Plan the look-ups of `compute(dt)`; see `CommandTerm.plan_lookups`."""
        is_over = self._is_over(self.time_steps + 1)
        over = self._over.plan(is_over, self.time_steps, self.motion_ids)
        return [*super().plan_lookups(dt), over]

    def _is_over(self, time_steps: torch.Tensor) -> torch.Tensor:
        return time_steps >= self.motion.lengths[self.motion_ids]

    def _update_metrics(self) -> None:
        if self._started:
            # Their relative poses are still those of before the reset.
            ids = torch.cat(self._started)
            pos, quat = self.relative_poses(ids)
            self.body_pos_relative_w[ids], self.body_quat_relative_w[ids] = pos, quat
            self._started.clear()
        for name, value in tracking_metrics(self).items():
            self.metrics[name].copy_(value)

    def _update_command(self, env_ids: torch.Tensor | None = None) -> None:
        over = None if env_ids is not None else self._over.take(self.time_steps, self.motion_ids)
        self.time_steps[slice(None) if env_ids is None else env_ids] += 1
        if over is None:
            over = self._is_over(self.time_steps).nonzero().flatten()
        if not is_empty(over):
            self._resample_command(over)
            if self.cfg.advance_after_teleport:
                self.time_steps[over] += 1
        if self._moved:
            # These robots were put elsewhere after the step's own forward.
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
        """Add the frame slider, the button that starts there, and the errors of the bodies."""

        def set_frame(env: int, motion: int, frame: int) -> None:
            self.motion_ids[env], self.time_steps[env] = motion, frame
            self.update_relative_body_poses()

        self._panel = MotionPanel(
            name,
            server,
            self.motion,
            self.num_envs,
            self.drawing.offset,
            get_env_idx=get_env_idx,
            get_frame=lambda env: (int(self.motion_ids[env]), int(self.time_steps[env])),
            set_frame=set_frame,
            get_matching=lambda: self.matching_frame,
            get_current=lambda: MotionFrame(self, self.frame_indexes),
            on_change=on_change,
            request_action=request_action,
        )

    def on_viewer_pause(self, paused: bool) -> None:
        """Let the frame slider move the reference while the viewer is paused."""
        if self._panel is not None:
            self._panel.set_paused(paused)

    def apply_gui_reset(self, env_ids: torch.Tensor) -> bool:
        """Put these environments exactly onto the frame that the panel asks for, if it does.

        As after every reset, the reference is a frame ahead then.
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


# Terms that read a motion command.


def motion_command(env: ManagerBasedRlEnv, command_name: str) -> MotionCommand:
    """Return the motion command of that name."""
    # That it exists, and what it is, was checked when the term was built.
    manager: Any = env.command_manager
    return manager.get_term(command_name)


def check_motion_term(
    env: ManagerBasedRlEnv,
    command_name: str,
    body_names: tuple[str, ...] | None = None,
    std: float | None = None,
    threshold: float | None = None,
    **_: Any,
) -> None:
    """Check a term that reads a motion command.

    Raises:
        ValueError: there is no such command, a body is none of those it tracks, none is left, or
            `std` or `threshold` is not positive.
        TypeError: the command lacks what a `MotionCommand` has.
    """
    require_command(env, command_name)
    command: Any = motion_command(env, command_name)
    missing: list[str] = []
    if not isinstance(command, MotionCommand):
        # Listed rather than read: before the first reset, a property may have nothing to return.
        missing = sorted(set(_READ) - set(dir(command)))
        missing += [] if hasattr(command.cfg, "body_names") else ["cfg.body_names"]
    if missing:
        raise WrongTypeError(
            f"Command {command_name!r}: expected a MotionCommand or a term with its attributes, got "
            f"a {type(command).__name__} without {', '.join(missing)}."
        )
    body_columns(command, body_names)
    for name, value in (("std", std), ("threshold", threshold)):
        if value is not None:
            check_positive(name, value)


def body_columns(command: MotionReader, body_names: tuple[str, ...] | None) -> slice | torch.Tensor:
    """Return which of the tracked bodies are meant, in the command's order; None means all.

    Raises:
        ValueError: a name is none of the tracked bodies, or there is none.
    """
    if body_names is None:
        return slice(None)
    tracked = command.body_names if isinstance(command, MotionReader) else command.cfg.body_names
    device = str(command.body_pos_relative_w.device)
    return _columns_of(tuple(body_names), tuple(tracked), device)


@functools.lru_cache(maxsize=256)
def _columns_of(body_names: tuple[str, ...], tracked: tuple[str, ...], device: str) -> torch.Tensor:
    unknown = [name for name in body_names if name not in tracked]
    if unknown or not body_names:
        what = f"{unknown}, which are not tracked" if unknown else "no body"
        raise ValueError(f"body_names names {what}. The command tracks {list(tracked)}.")
    columns = [i for i, name in enumerate(tracked) if name in body_names]
    return torch.tensor(columns, device=device)


# Building: checks of the config and the robot.


def check_command_cfg(cfg: MotionCommandCfg) -> None:
    """Raise `ValueError` for names, ranges or numbers of the config that make no sense."""
    if len(set(cfg.body_names)) != len(cfg.body_names):
        raise ValueError(f"body_names names a body twice: {list(cfg.body_names)}.")
    if cfg.anchor_body_name not in cfg.body_names:
        raise ValueError(
            f"anchor_body_name is {cfg.anchor_body_name!r}; it has to be one of body_names, "
            f"which are {list(cfg.body_names)}."
        )
    check_one_of("sampling_mode", cfg.sampling_mode, _MODES)
    check_one_of("viz.mode", cfg.viz.mode, _DRAWINGS)
    for name in ("pose_range", "velocity_range"):
        for axis, bounds in getattr(cfg, name).items():
            check_one_of(f"key of {name}", axis, AXES)
            check_range(f"{name}[{axis!r}]", bounds)
    check_range("joint_position_range", cfg.joint_position_range)
    check_count("adaptive_kernel_size", cfg.adaptive_kernel_size)
    # Without it nothing could be drawn before the first failure.
    check_positive("adaptive_uniform_ratio", cfg.adaptive_uniform_ratio)
    for name in ("adaptive_lambda", "adaptive_alpha"):
        if not 0.0 < getattr(cfg, name) <= 1.0:
            raise ValueError(f"{name} is {getattr(cfg, name)}; it is above 0 and at most 1.")


def find_robot(cfg: MotionCommandCfg, env: ManagerBasedRlEnv) -> Entity:
    """Return the robot that the config names.

    Raises:
        ValueError: there is no such entity, it has a fixed base, it lacks a tracked body, or the
            first tracked body is not its floating base.
    """
    check_exists("entity in entity_name", cfg.entity_name, env.scene.entities)
    robot: Entity = env.scene[cfg.entity_name]
    if robot.is_fixed_base:
        raise ValueError(
            f"Entity {cfg.entity_name!r} has a fixed base, and cannot be put onto a motion. Give "
            "its root body a free joint."
        )
    missing = [name for name in cfg.body_names if name not in robot.body_names]
    if missing:
        raise ValueError(
            f"body_names names {missing}, which entity {cfg.entity_name!r} lacks. Its bodies: "
            f"{list(robot.body_names)}."
        )
    root = robot.body_names[0]
    if cfg.body_names[0] != root:
        raise ValueError(
            f"The first of body_names is {cfg.body_names[0]!r}; it has to be the floating base "
            f"{root!r}, because starts of episodes take its pose."
        )
    return robot


# Drawing.


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


# Errors that are logged in every episode.


def tracking_metrics(motion: MotionReader) -> dict[str, torch.Tensor]:
    """Return errors by name, (N,) each.

    Those of positions and velocities are Euclidean norms (m, m/s, rad/s), those of orientations
    angles (rad), those of bodies means over the tracked bodies, and those of joints the norm over
    all joints (rad, rad/s). Poses of bodies are compared with the relative ones; velocities are in
    world axes.
    """
    anchor = motion.anchor_index
    pos, quat = motion.robot_body_pos_w, motion.robot_body_quat_w
    # (3, N, K): of positions and both velocities.
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
    # By components: a reduction over three numbers takes a CPU twice as long.
    x, y, z = vectors.unbind(-1)
    return (x * x).addcmul_(y, y).addcmul_(z, z).sqrt_()


__getattr__ = older_names(__name__)
