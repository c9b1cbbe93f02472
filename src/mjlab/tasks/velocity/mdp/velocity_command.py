"""Velocity command: forward and lateral velocity, and yaw rate."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import older_names, suggests_fields
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.tasks.velocity.mdp.velocity_joystick import VelocityJoystick
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
"""Ranges of the command components (vx, vy, wz)."""
# Colors of the arrows, by meaning.
_ARROW_COLORS: dict[str, Color] = {
    "commanded velocity": (0.2, 0.2, 0.6, 1.0),
    "commanded yaw rate": (0.2, 0.6, 0.2, 1.0),
    "measured velocity": (0.0, 0.6, 1.0, 0.9),
    "measured yaw rate": (0.0, 1.0, 0.4, 0.9),
}
_MIN_FORWARD_SPEED = 0.3
"""Minimum speed of forward commands (m/s)."""


@suggests_fields
@dataclass(kw_only=True)
class UniformVelocityCommandCfg(CommandTermCfg):
    """Uniform velocity command configuration."""

    @dataclass
    class Ranges:
        """Ranges (low, high) of uniform sampling."""

        lin_vel_x: tuple[float, float]
        """Forward velocity (m/s)."""
        lin_vel_y: tuple[float, float]
        """Velocity to the left (m/s)."""
        ang_vel_z: tuple[float, float]
        """Yaw rate (rad/s). Also clips the yaw rate of heading commands."""
        heading: tuple[float, float] | None = None
        """Target heading (rad). Required with `heading_command`, else None."""

    @dataclass
    class VizCfg:
        """Visualization settings."""

        z_offset: float = 0.2
        """Height of the arrows above the root (m), before `scale`."""
        scale: float = 0.5
        """Arrow length per m/s or rad/s (m)."""
        show_measured: bool = False
        """Draw arrows of the measured velocity beside those of the command."""

    entity_name: str
    """Name of the commanded entity."""
    heading_command: bool = False
    """Command a heading instead of a yaw rate in a fraction of environments."""
    heading_control_stiffness: float = 1.0
    """Gain from heading error to yaw rate (1/s)."""
    rel_standing_envs: float = 0.0
    """Fraction of standing (zero) commands."""
    rel_heading_envs: float = 1.0
    """Fraction of heading commands, with `heading_command`."""
    rel_world_envs: float = 0.0
    """Fraction of commands with linear velocity in the world frame instead of the root frame."""
    rel_forward_envs: float = 0.0
    """Fraction of forward commands: vx >= 0.3 m/s, other components zero."""
    init_velocity_prob: float = 0.0
    """Probability that an episode starts at the commanded velocity."""
    ranges: Ranges
    """Ranges to sample from."""
    viz: VizCfg = field(default_factory=VizCfg)
    """Visualization."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for `heading_command` without `ranges.heading`."""
        if self.heading_command and self.ranges.heading is None:
            raise ValueError(
                "UniformVelocityCommandCfg ranges.heading: expected a range with heading_command=True, "
                "got None; use e.g. (-math.pi, math.pi)."
            )

    def build(self, env: ManagerBasedRlEnv) -> UniformVelocityCommand:
        """Build the term. Raises `ValueError` for contradictory heading settings."""
        return UniformVelocityCommand(self, env)


class UniformVelocityCommand(CommandTerm):
    """Velocity command (vx, vy, wz) in the root frame, sampled uniformly.

    Commands hold until they are resampled. The kinds are drawn independently:

    - **forward**: vx >= 0.3 m/s, other components zero;
    - **heading**: turn to a target heading, `wz = clip(k wrap(target - heading))`;
    - **world**: constant linear velocity in the world frame;
    - **standing**: zero; overrides the other kinds.

    `term.cfg.ranges` holds the ranges in use, a copy of those in the environment config: curricula
    that edit them leave the environment config unchanged, and the ranges are checkpointed.

    The metrics `error_vel_xy` (m/s) and `error_vel_yaw` (rad/s) are means over the steps of an
    episode.

    Attributes:
        vel_command_b: Command in the root frame, (N, 3).
        vel_command_w: Command in the world frame, used by world commands, (N, 3).
        heading_target: Target heading of heading commands (rad), (N,).
        heading_error: Heading error of heading commands (rad), (N,).
        is_heading_env: True for heading commands, (N,) bool.
        is_standing_env: True for standing commands, (N,) bool.
        is_world_env: True for world commands, (N,) bool.
        is_forward_env: True for forward commands, (N,) bool.
    """

    cfg: UniformVelocityCommandCfg
    steerable = True

    def __init__(self, cfg: UniformVelocityCommandCfg, env: ManagerBasedRlEnv) -> None:
        # Copy the ranges, because curricula edit them at run time.
        super().__init__(dataclasses.replace(cfg, ranges=dataclasses.replace(cfg.ranges)), env)
        if cfg.heading_command != (cfg.ranges.heading is not None):
            expected = "a range" if cfg.heading_command else "None"
            raise ValueError(
                f"ranges.heading: expected {expected} with heading_command={cfg.heading_command}, got "
                f"{cfg.ranges.heading}."
            )
        self.robot: Entity = env.scene[cfg.entity_name]
        self.vel_command_b = torch.zeros(self.num_envs, 3, dtype=torch.float32, device=self.device)
        self.vel_command_w = torch.zeros_like(self.vel_command_b)
        self.heading_target = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self.heading_error = torch.zeros_like(self.heading_target)
        self.is_heading_env = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.is_standing_env = torch.zeros_like(self.is_heading_env)
        self.is_world_env = torch.zeros_like(self.is_heading_env)
        self.is_forward_env = torch.zeros_like(self.is_heading_env)
        for name in ("error_vel_xy", "error_vel_yaw"):
            self.metrics[name] = torch.zeros_like(self.heading_target)
        self._samples = torch.zeros_like(self.heading_target)
        self._joystick: VelocityJoystick | None = None

    @property
    def command(self) -> torch.Tensor:
        """Command (vx, vy, wz) in the root frame (m/s, rad/s), (N, 3)."""
        return self.vel_command_b

    @property
    def ranges(self) -> UniformVelocityCommandCfg.Ranges:
        """Ranges in use. May be edited; current commands are unchanged."""
        return self.cfg.ranges

    @property
    def elapsed_s(self) -> torch.Tensor:
        """Time since the last reset (s), (N,).

        Unlike `episode_length_buf`, which training initializes randomly, this is simulated time.
        """
        return self._samples * self._env.step_dt

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Update metrics, advance time, resample expired commands, and update the command.

        Arguments are those of `CommandTerm.compute`. Steps with `dt` = 0, such as the first one after
        a reset, are not counted in the metrics.
        """
        self._add_sample(dt, env_ids)
        if self._joystick is None:
            super().compute(dt, env_ids)
            return
        # Update the sampled command below the joystick, which takes over again on release.
        self._joystick.restore(self.vel_command_b)
        super().compute(dt, env_ids)
        self._joystick.write_to(self.vel_command_b)

    def reset(self, env_ids: torch.Tensor | slice | None) -> dict[str, float]:
        """Resample the commands of `env_ids`; return the mean errors of their episodes.

        Environments without a step are excluded from the means. With `init_velocity_prob`, overwrites
        the root velocity that reset events set in a fraction of the environments.
        """
        ids = as_ids(env_ids, self.num_envs, self.device)
        if is_empty(ids):
            return {}
        if self._joystick is not None:
            self._joystick.restore(self.vel_command_b)
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
        """Add sliders that command the environment in view while enabled."""
        self._joystick = VelocityJoystick(name, server, self.ranges, get_env_idx, on_change)
        viz = self.cfg.viz
        measured = server.gui.add_checkbox("Show measured velocity", viz.show_measured)

        @measured.on_update
        def _(_event: Any) -> None:
            viz.show_measured = measured.value
            if on_change is not None:
                on_change()

    def steer(
        self,
        shares: tuple[float, float, float] | None,
        get_env_idx: Callable[[], int],
        add: bool = True,
    ) -> None:
        """Change the command of the environment in view; it then holds until it is changed again."""
        if self._joystick is None:
            self._joystick = VelocityJoystick(self.name, None, self.ranges, get_env_idx)
        self._joystick.steer(shares, add)

    # Sampling.

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        cfg = self.cfg
        # One draw for all samples; each quantity takes the next row.
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
        # Set after the forward rule, which applies to world commands too.
        self.vel_command_w[env_ids] = command

    def _update_command(self, env_ids: torch.Tensor | None = None) -> None:
        index = slice(None) if env_ids is None else env_ids
        self._update_rows(index, self.robot.data.root_link_quat_w[index])

    def _update_rows(self, index: torch.Tensor | slice, quat: torch.Tensor) -> None:
        """Update the commands of environments `index` with root orientations `quat`."""
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
                # World to root frame: rotation about z by -heading.
                cos, sin = torch.cos(heading), torch.sin(heading)
                x, y = self.vel_command_w[index, 0], self.vel_command_w[index, 1]
                turned = torch.stack((cos * x + sin * y, cos * y - sin * x), dim=1)
                command[:, :2] = torch.where(self.is_world_env[index, None], turned, command[:, :2])
        is_standing = self.is_standing_env[index].unsqueeze(1)
        self.vel_command_b[index] = command.masked_fill_(is_standing, 0.0)
        if cfg.rel_world_envs > 0.0:
            self.vel_command_w[index] = self.vel_command_w[index].masked_fill_(is_standing, 0.0)

    def _start_moving(self, env_ids: torch.Tensor) -> None:
        """Set the root velocity of environments that just reset to the command."""
        if is_empty(env_ids):
            return
        # Read qpos, because derived quantities are not updated yet after the reset.
        pose = self.robot.data.indexing.free_joint_q_adr
        quat = self._env.sim.data.qpos[env_ids[:, None], pose[3:7]]
        # Update first, because standing and world commands change the command.
        self._update_rows(env_ids, quat)
        command = self.vel_command_b[env_ids]
        linear, angular = torch.zeros_like(command), torch.zeros_like(command)
        linear[:, :2], angular[:, 2] = command[:, :2], command[:, 2]
        velocity = torch.cat((quat_apply(quat, linear), quat_apply(quat, angular)), dim=1)
        self.robot.write_root_link_velocity_to_sim(velocity, env_ids=env_ids)

    # Metrics and visualization.

    def _is_measured(self, env_ids: torch.Tensor) -> torch.Tensor:
        return self._samples[env_ids] > 0.0

    def _add_sample(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None) -> None:
        """Add the tracking error of the last step to the running means."""
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
        """Draw arrows above the root: commanded horizontal velocity (blue), and commanded yaw rate
        along the root's z axis (green). With `cfg.viz.show_measured`, also the measured velocity
        (cyan) and yaw rate (light green).
        """
        indices = list(visualizer.get_env_indices(self.num_envs))
        if not indices:
            return
        data, viz = self.robot.data, self.cfg.viz
        rotations = matrix_from_quat(data.root_link_quat_w[indices])
        linear = data.root_link_lin_vel_b[indices]
        angular = data.root_link_ang_vel_b[indices]
        command = self.vel_command_b[indices]
        zero = torch.zeros_like(command[:, 0])
        vectors = torch.stack(
            (
                torch.stack((zero, zero, zero + viz.z_offset), dim=1),
                torch.stack((command[:, 0], command[:, 1], zero), dim=1),
                torch.stack((zero, zero, command[:, 2]), dim=1),
                torch.stack((linear[:, 0], linear[:, 1], zero), dim=1),
                torch.stack((zero, zero, angular[:, 2]), dim=1),
            ),
            dim=2,
        )
        # (M, 3, 5): the columns are the five vectors, rotated to the world frame.
        drawn = (viz.scale * rotations @ vectors).transpose(1, 2).cpu().numpy()
        roots = data.root_link_pos_w[indices].cpu().numpy()
        shown = dict(list(_ARROW_COLORS.items())[: 4 if viz.show_measured else 2])
        for meaning, color in shown.items():
            visualizer.add_legend(color, meaning)
        for root, (offset, *arrows) in zip(roots, drawn, strict=True):
            for arrow, color in zip(arrows, shown.values(), strict=False):
                visualizer.add_arrow(root + offset, root + offset + arrow, color)


def _scaled(unit: torch.Tensor, bounds: tuple[float, float]) -> torch.Tensor:
    return unit * (bounds[1] - bounds[0]) + bounds[0]


def _heading_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the heading: angle from world x to the horizontal projection of body x (rad), (K,)."""
    w, x, y, z = quat.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


__getattr__ = older_names(__name__)
