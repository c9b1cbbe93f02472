"""The velocity command: how fast to go forward, sideways and around."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import older_names
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.managers.term_checks import check_range
from mjlab.tasks.velocity.mdp.velocity_joystick import VelocityJoystick
from mjlab.utils.errors import check_exists, check_in_range
from mjlab.utils.indexing import as_ids, is_empty
from mjlab.utils.lab_api.math import matrix_from_quat, quat_apply, wrap_to_pi

if TYPE_CHECKING:
    import viser

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import Color, DebugVisualizer

__all__ = [
    "UniformVelocityCommand",
    "UniformVelocityCommandCfg",
]

RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""The ranges that every velocity command has."""
_PROBABILITIES = (
    "rel_standing_envs",
    "rel_heading_envs",
    "rel_world_envs",
    "rel_forward_envs",
    "init_velocity_prob",
)
# Of arrows: commanded linear and yaw, actual linear and yaw velocity.
_ARROW_COLORS: tuple[Color, ...] = (
    (0.2, 0.2, 0.6, 0.6),
    (0.2, 0.6, 0.2, 0.6),
    (0.0, 0.6, 1.0, 0.7),
    (0.0, 1.0, 0.4, 0.7),
)
_MIN_FORWARD_SPEED = 0.3
"""Least speed that environments which only go forward are asked for, in m/s."""


@dataclass(kw_only=True)
class UniformVelocityCommandCfg(CommandTermCfg):
    """Velocities drawn uniformly, some of them with a heading to keep, some of them zero."""

    @dataclass
    class Ranges:
        """Smallest and largest values that are drawn."""

        lin_vel_x: tuple[float, float]
        """Forward velocity, in m/s."""
        lin_vel_y: tuple[float, float]
        """Velocity to the left, in m/s."""
        ang_vel_z: tuple[float, float]
        """Yaw rate, in rad/s; also the bounds of what heading control asks for."""
        heading: tuple[float, float] | None = None
        """Heading to turn to, in rad; needed for `heading_command`, and only then."""

    @dataclass
    class VizCfg:
        """How the command is drawn."""

        z_offset: float = 0.2
        """Where the arrows start: above the root, in metres, before `scale`."""
        scale: float = 0.5
        """Length of the arrow for 1 m/s or 1 rad/s, in metres."""

    entity_name: str
    """Entity that the command is for."""
    heading_command: bool = False
    """Whether some environments are given a heading instead of a yaw rate."""
    heading_control_stiffness: float = 1.0
    """Yaw rate for a heading error of 1 rad, in 1/s."""
    rel_standing_envs: float = 0.0
    """Share of the commands that ask to stand still."""
    rel_heading_envs: float = 1.0
    """Share of the commands with a heading, under `heading_command`."""
    rel_world_envs: float = 0.0
    """Share of the commands whose linear velocity is in world axes instead of the root's."""
    rel_forward_envs: float = 0.0
    """Share of the commands that only go forward, at no less than 0.3 m/s."""
    init_velocity_prob: float = 0.0
    """Probability that an episode starts with the robot moving as commanded."""
    ranges: Ranges
    """What is drawn from."""
    viz: VizCfg = field(default_factory=VizCfg)
    """Drawing."""

    def __post_init__(self) -> None:
        """Refuse a heading command without a range of headings."""
        if self.heading_command and self.ranges.heading is None:
            raise ValueError(
                "UniformVelocityCommandCfg: heading_command is True, but ranges.heading is None. "
                "Give the range of headings, such as (-math.pi, math.pi)."
            )

    def build(self, env: ManagerBasedRlEnv) -> UniformVelocityCommand:
        """Return the term; raises `ValueError` for ranges or shares that make no sense."""
        return UniformVelocityCommand(self, env)


def check_command_cfg(cfg: UniformVelocityCommandCfg) -> None:
    """Raise `ValueError` for ranges, shares or a heading that make no sense."""
    for name in RANGES:
        check_range(f"ranges.{name}", getattr(cfg.ranges, name))
    if cfg.heading_command and cfg.ranges.heading is None:
        raise ValueError("heading_command is True, but ranges.heading is None. Give the range.")
    if not cfg.heading_command and cfg.ranges.heading is not None:
        raise ValueError(
            f"ranges.heading is {cfg.ranges.heading}, but heading_command is False, so that no "
            "heading is ever commanded. Set heading_command=True, or ranges.heading=None."
        )
    if cfg.ranges.heading is not None:
        check_range("ranges.heading", cfg.ranges.heading)
    for name in _PROBABILITIES:
        check_in_range(name, getattr(cfg, name), 0.0, 1.0)


class UniformVelocityCommand(CommandTerm):
    """Commands (vx, vy, wz) in the frame of the root, uniform within ranges.

    A command keeps until its time is over. Of these kinds, which are drawn independently,

    - a **forward** command has vx of at least 0.3 m/s and no other component;
    - a **heading** command turns towards a heading: `wz = clip(k wrap(target - heading))`;
    - a **world** command holds its linear velocity in world axes, whichever way the robot turns;
    - a **standing** command is zero, whatever else it is.

    The ranges in use are those of the term's own config (`term.cfg.ranges`), a copy: a curriculum
    that widens them changes no config that others hold, and they are saved with a checkpoint.

    The metrics `error_vel_xy` (m/s) and `error_vel_yaw` (rad/s) are means over the steps of an
    episode.

    Attributes:
        vel_command_b: (N, 3) the command.
        vel_command_w: (N, 3) what world commands hold.
        heading_target: (N,) heading of heading commands, in rad.
        heading_error: (N,) how far heading commands have to turn, in rad.
        is_heading_env: (N,) bool; likewise `is_standing_env`, `is_world_env`, `is_forward_env`.
    """

    cfg: UniformVelocityCommandCfg

    def __init__(self, cfg: UniformVelocityCommandCfg, env: ManagerBasedRlEnv) -> None:
        # The ranges change at run time, so that they are the term's own.
        super().__init__(dataclasses.replace(cfg, ranges=dataclasses.replace(cfg.ranges)), env)
        check_command_cfg(cfg)
        check_exists("entity in entity_name", cfg.entity_name, env.scene.entities)
        self.robot: Entity = env.scene[cfg.entity_name]
        if cfg.init_velocity_prob > 0.0 and self.robot.is_fixed_base:
            raise ValueError(
                f"init_velocity_prob is {cfg.init_velocity_prob}, but entity {cfg.entity_name!r} "
                "has a fixed base, which cannot start moving. Set it to 0."
            )
        self.vel_command_b = torch.zeros(self.num_envs, 3, dtype=torch.float32, device=self.device)
        self.vel_command_w = torch.zeros_like(self.vel_command_b)
        self.heading_target = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self.heading_error = torch.zeros_like(self.heading_target)
        self.is_heading_env = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.is_standing_env = torch.zeros_like(self.is_heading_env)
        self.is_world_env = torch.zeros_like(self.is_heading_env)
        self.is_forward_env = torch.zeros_like(self.is_heading_env)
        self.metrics = {
            "error_vel_xy": torch.zeros(self.num_envs, dtype=torch.float32, device=self.device),
            "error_vel_yaw": torch.zeros(self.num_envs, dtype=torch.float32, device=self.device),
        }
        self._samples = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self._joystick: VelocityJoystick | None = None

    @property
    def command(self) -> torch.Tensor:
        """The command (vx, vy, wz) in the frame of the root, (N, 3), in m/s and rad/s."""
        return self.vel_command_b

    @property
    def ranges(self) -> UniformVelocityCommandCfg.Ranges:
        """The ranges in use, which may be changed; commands already given stay."""
        return self.cfg.ranges

    @property
    def elapsed_s(self) -> torch.Tensor:
        """Seconds since each environment was last reset, (N,).

        Unlike the length of an episode, which training starts at a random number, this is the time
        that was really spent.
        """
        return self._samples * self._env.step_dt

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Measure errors, advance time, redraw commands whose time is over, and update.

        The arguments are those of `CommandTerm.compute`. A step that took no time, as the first
        one after a reset does, is no sample of the error.
        """
        self._add_sample(dt, env_ids)
        if self._joystick is None:
            super().compute(dt, env_ids)
            return
        # Below the joystick the command goes on as drawn, so that it is there when that lets go.
        self._joystick.let_go(self.vel_command_b)
        super().compute(dt, env_ids)
        self._joystick.write_to(self.vel_command_b)

    def reset(self, env_ids: torch.Tensor | slice | None) -> dict[str, float]:
        """Draw new commands in these environments; return the mean errors of their episodes.

        Environments that have not made a step are left out of the means. With
        `init_velocity_prob`, writes the root velocity of some, in place of that of reset events.
        """
        ids = as_ids(env_ids, self.num_envs, self.device)
        if is_empty(ids):
            return {}
        if self._joystick is not None:
            self._joystick.let_go(self.vel_command_b)
        log = super().reset(ids)
        self._samples[ids] = 0.0
        if self.cfg.init_velocity_prob > 0.0:
            is_moving = (
                torch.rand(len(ids), dtype=torch.float32, device=self.device)
                < self.cfg.init_velocity_prob
            )
            self._start_moving(ids[is_moving])
        return log

    def create_gui(
        self,
        name: str,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add sliders that, while they are enabled, command the environment in view."""
        self._joystick = VelocityJoystick(name, server, self.ranges, get_env_idx, on_change)

    # Drawing commands.

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        cfg = self.cfg
        # One draw for all numbers, a row each, in the order in which rows are taken.
        rows = iter(
            torch.rand(
                8 if cfg.heading_command else 6,
                len(env_ids),
                dtype=torch.float32,
                device=self.device,
            )
        )
        ranges = [getattr(cfg.ranges, name) for name in RANGES]
        command = torch.stack([_scaled(next(rows), bounds) for bounds in ranges], dim=1)
        if cfg.heading_command:
            self.heading_target[env_ids] = _scaled(next(rows), cfg.ranges.heading or (0.0, 0.0))
            self.is_heading_env[env_ids] = next(rows) < cfg.rel_heading_envs
        self.is_standing_env[env_ids] = next(rows) < cfg.rel_standing_envs
        self.is_world_env[env_ids] = next(rows) < cfg.rel_world_envs
        is_forward = next(rows) < cfg.rel_forward_envs
        self.is_forward_env[env_ids] = is_forward
        forward = torch.zeros_like(command)
        forward[:, 0] = command[:, 0].abs().clamp_(min=_MIN_FORWARD_SPEED)
        command = torch.where(is_forward.unsqueeze(1), forward, command)
        self.vel_command_b[env_ids] = command
        # Taken after the forward rule, which holds for world commands too.
        self.vel_command_w[env_ids] = command

    def _update_command(self, env_ids: torch.Tensor | None = None) -> None:
        index = slice(None) if env_ids is None else env_ids
        self._update_rows(index, self.robot.data.root_link_quat_w[index])

    def _update_rows(self, index: torch.Tensor | slice, quat: torch.Tensor) -> None:
        """Update the commands of environments whose roots have the orientations `quat`."""
        cfg = self.cfg
        command = self.vel_command_b[index]
        if cfg.heading_command or cfg.rel_world_envs > 0.0:
            heading = _heading_of(quat)
            if cfg.heading_command:
                error = wrap_to_pi(self.heading_target[index] - heading)
                self.heading_error[index] = error
                turn = (cfg.heading_control_stiffness * error).clamp_(*cfg.ranges.ang_vel_z)
                command[:, 2] = torch.where(self.is_heading_env[index], turn, command[:, 2])
            if cfg.rel_world_envs > 0.0:
                turned = _rotated(self.vel_command_w[index], -heading)
                is_world = self.is_world_env[index].unsqueeze(1)
                command[:, :2] = torch.where(is_world, turned, command[:, :2])
        is_standing = self.is_standing_env[index].unsqueeze(1)
        self.vel_command_b[index] = command.masked_fill_(is_standing, 0.0)
        if cfg.rel_world_envs > 0.0:
            self.vel_command_w[index] = self.vel_command_w[index].masked_fill_(is_standing, 0.0)

    def _start_moving(self, env_ids: torch.Tensor) -> None:
        """Write the commanded velocity into the state of environments that just reset."""
        if is_empty(env_ids):
            return
        # The state was written and nothing is derived from it yet.
        pose = self.robot.data.indexing.free_joint_q_adr
        quat = self._env.sim.data.qpos[env_ids[:, None], pose[3:7]]
        # What is commanded is known only after the update: it may be to stand, or in world axes.
        self._update_rows(env_ids, quat)
        command = self.vel_command_b[env_ids]
        linear, angular = torch.zeros_like(command), torch.zeros_like(command)
        linear[:, :2], angular[:, 2] = command[:, :2], command[:, 2]
        velocity = torch.cat((quat_apply(quat, linear), quat_apply(quat, angular)), dim=1)
        self.robot.write_root_link_velocity_to_sim(velocity, env_ids=env_ids)

    # Metrics and drawing.

    def _is_measured(self, env_ids: torch.Tensor) -> torch.Tensor:
        return self._samples[env_ids] > 0.0

    def _add_sample(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None) -> None:
        """Take up the error of the command that the last step followed into the running means."""
        if isinstance(dt, torch.Tensor) and dt.numel() > 1:
            is_sample: torch.Tensor | float = (dt > 0.0).float()
        elif dt > 0.0:
            is_sample = 1.0
        else:
            return
        index = slice(None) if env_ids is None else env_ids
        data = self.robot.data
        command = self.vel_command_b[index]
        self._samples[index] += is_sample
        share = is_sample / self._samples[index].clamp(min=1.0)
        xy_error = torch.linalg.vector_norm(
            command[:, :2] - data.root_link_lin_vel_b[index, :2], dim=1
        )
        yaw_error = (command[:, 2] - data.root_link_ang_vel_b[index, 2]).abs()
        for name, error in (("error_vel_xy", xy_error), ("error_vel_yaw", yaw_error)):
            mean = self.metrics[name][index]
            self.metrics[name][index] = mean + (error - mean) * share

    def _debug_vis_impl(self, visualizer: DebugVisualizer) -> None:
        """Draw four arrows above the root: commanded (blue) and actual (cyan) horizontal velocity, and
        commanded (green) and actual (light green) yaw rate along the root's z axis.
        """
        indices = list(visualizer.get_env_indices(self.num_envs))
        if not indices:
            return
        data, viz = self.robot.data, self.cfg.viz
        rotations = matrix_from_quat(data.root_link_quat_w[indices])
        linear = data.root_link_lin_vel_b[indices]
        angular = data.root_link_ang_vel_b[indices]
        asked = self.vel_command_b[indices]
        zero = torch.zeros_like(asked[:, 0])
        vectors = torch.stack(
            (
                torch.stack((zero, zero, zero + viz.z_offset), dim=1),
                torch.stack((asked[:, 0], asked[:, 1], zero), dim=1),
                torch.stack((zero, zero, asked[:, 2]), dim=1),
                torch.stack((linear[:, 0], linear[:, 1], zero), dim=1),
                torch.stack((zero, zero, angular[:, 2]), dim=1),
            ),
            dim=2,
        )
        # Columns of (3, 5) matrices are the five vectors, in world axes.
        drawn = (viz.scale * rotations @ vectors).transpose(1, 2).cpu().numpy()
        roots = data.root_link_pos_w[indices].cpu().numpy()
        for root, (offset, *arrows) in zip(roots, drawn, strict=True):
            for arrow, color in zip(arrows, _ARROW_COLORS, strict=True):
                visualizer.add_arrow(root + offset, root + offset + arrow, color)


def _scaled(unit: torch.Tensor, bounds: tuple[float, float]) -> torch.Tensor:
    return unit * (bounds[1] - bounds[0]) + bounds[0]


def _heading_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the angle from world x to the horizontal projection of the frame's x axis, (K,)."""
    w, x, y, z = quat.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _rotated(vector: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Return the horizontal parts of vectors, turned about z, (K, 2)."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = vector[:, 0], vector[:, 1]
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=1)


__getattr__ = older_names(__name__)
