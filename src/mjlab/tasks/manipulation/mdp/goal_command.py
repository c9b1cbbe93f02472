"""What commands have in common that say where an object is to be brought."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch

from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.tasks.manipulation.mdp.goal_panel import GoalPanel
from mjlab.utils.lab_api.math import sample_ranges

if TYPE_CHECKING:
    import viser

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import Color, DebugVisualizer

FIXED_GOAL = (0.4, 0.0, 0.3)
"""The goal of difficulty `fixed`, in metres from the environment's origin."""
_GOAL_RADIUS = 0.03
_GOAL_COLOR: Color = (1.0, 0.5, 0.0, 0.3)


@dataclass(kw_only=True)
class GoalCommandCfg(CommandTermCfg):
    """A goal for an object, drawn anew from time to time."""

    @dataclass
    class TargetPositionRangeCfg:
        """Where goals are, in metres from the environment's origin."""

        x: tuple[float, float] = (0.3, 0.5)
        """Forward."""
        y: tuple[float, float] = (-0.2, 0.2)
        """To the left."""
        z: tuple[float, float] = (0.2, 0.4)
        """Up."""

    success_threshold: float = 0.05
    """The object is at its goal when its origin is closer to it than this, in metres."""
    difficulty: Literal["fixed", "dynamic"] = "fixed"
    """`fixed`: the goal is always at (0.4, 0, 0.3). `dynamic`: it is uniform within
    `target_position_range`."""
    target_position_range: TargetPositionRangeCfg = field(default_factory=TargetPositionRangeCfg)
    """Where goals are drawn from."""


class GoalCommand(CommandTerm):
    """Base of commands that say where an object is to be brought.

    A subclass defines `wanted_object_pos()` and `_place_objects(env_ids)`, and may draw more with
    `_draw_command(env_ids)`.

    When the time of a goal is over within an episode, a new one is drawn and the objects are put
    elsewhere. Derived quantities of these environments, and of no others, are then computed once
    more, so that observations see objects where they are.

    Metrics, of the end of the last step: `position_error` (m), `at_goal` (whether that is below
    the threshold), `goal_success` (whether it has been at any step since this goal was drawn) and
    `episode_success` (likewise, since the episode began).

    Attributes:
        target_pos: (N, 3) the goal, in the world (m).
        goal_age: (N,) seconds since the goal was drawn.
        last_goal_met: (N,) bool, whether the object was at the goal before this one when its time
            was over; False in an episode's first goal.
    """

    # Where objects were moved, and the page's panel.
    _transient = {"_moved", "_panel"}

    # A GoalCommandCfg; subclasses have configs of their own.
    cfg: Any

    def __init__(self, cfg: GoalCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self.target_pos = torch.zeros(self.num_envs, 3, dtype=torch.float32, device=self.device)
        self.goal_age = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self.last_goal_met = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.metrics = {
            name: torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
            for name in ("position_error", "at_goal", "goal_success", "episode_success")
        }
        self._moved: torch.Tensor | None = None
        self._panel: GoalPanel | None = None

    @property
    def command(self) -> torch.Tensor:
        """The goal, (N, 3), in the world (m)."""
        return self.target_pos

    @property
    def episode_success(self) -> torch.Tensor:
        """1 where the object has been at a goal in this episode, else 0, (N,)."""
        return self.metrics["episode_success"]

    def wanted_object_pos(self) -> torch.Tensor:
        """Return where the object is that is to be brought, (N, 3), in the world (m)."""
        raise NotImplementedError(f"{self.name} must define wanted_object_pos().")

    def compute_success(self) -> torch.Tensor:
        """Return where the object was at its goal at the end of the last step, (N,) bool."""
        return self.metrics["position_error"] < self.cfg.success_threshold

    def goal_is_met(self) -> torch.Tensor:
        """Return whether the object was brought to its goal in the time that there was, (N,) bool.

        A goal that is younger than the shortest time a goal has is not judged, because nobody could
        have met it yet: there it is the goal before that counts, at the moment when its time was
        over. The first goal of an episode is always judged.
        """
        has_time = self.goal_age >= self.cfg.resampling_time_range[0]
        is_judged = has_time | (self.command_counter <= 1)
        return torch.where(is_judged, self.compute_success(), self.last_goal_met)

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Measure, advance time, and redraw goals whose time is over; see `CommandTerm.compute`."""
        self._moved = None
        self.goal_age[slice(None) if env_ids is None else env_ids] += dt
        super().compute(dt, env_ids)
        if self._moved is not None:
            self._env.sim.forward(self._moved)
        if self._panel is not None:
            held = self._panel.write_to(self.target_pos, self._env.scene.env_origins)
            if held is not None:
                # What a person holds is not taken away.
                self.time_left[held] = self.cfg.resampling_time_range[1]

    def create_gui(
        self,
        name: str,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add a handle at the goal of the environment in view, by which a person drags it."""
        self._panel = GoalPanel(
            name, server, self.cfg.target_position_range, get_env_idx, on_change
        )

    # Drawing goals.

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        metrics = self.metrics
        self.last_goal_met[env_ids] = metrics["at_goal"][env_ids] > 0.0
        metrics["goal_success"][env_ids] = 0.0
        self.goal_age[env_ids] = 0.0
        self._draw_command(env_ids)
        self.target_pos[env_ids] = self._draw_goals(len(env_ids))
        self.target_pos[env_ids] += self._env.scene.env_origins[env_ids]
        self._place_objects(env_ids)

    def _draw_command(self, env_ids: torch.Tensor) -> None:
        """Draw what comes before the goal; nothing unless overridden."""

    def _draw_goals(self, count: int) -> torch.Tensor:
        if self.cfg.difficulty == "fixed":
            return torch.tensor(FIXED_GOAL, dtype=torch.float32, device=self.device).expand(
                count, 3
            )
        within = self.cfg.target_position_range
        return sample_ranges((within.x, within.y, within.z), count, self.device)

    def _place_objects(self, env_ids: torch.Tensor) -> None:
        """Put the objects of these environments to where they start, with `_place`."""
        raise NotImplementedError(f"{self.name} must define _place_objects(env_ids).")

    def _place(
        self, entity: Entity, positions: torch.Tensor, yaws: torch.Tensor, env_ids: torch.Tensor
    ) -> None:
        """Put an object at rest at positions (n, 3) from the environments' origins, turned by `yaws`
        (n,) about the vertical."""
        pose = positions.new_zeros(len(env_ids), 7)
        pose[:, :3] = positions + self._env.scene.env_origins[env_ids]
        pose[:, 3] = torch.cos(yaws / 2.0)
        pose[:, 6] = torch.sin(yaws / 2.0)
        entity.write_root_link_pose_to_sim(pose, env_ids=env_ids)
        entity.write_root_link_velocity_to_sim(torch.zeros_like(pose[:, :6]), env_ids=env_ids)
        self._moved = env_ids

    # Metrics and drawing.

    def _is_measured(self, env_ids: torch.Tensor) -> torch.Tensor:
        # Before its first goal there was nothing to measure.
        return self.command_counter[env_ids] > 0

    def _update_metrics(self) -> None:
        metrics = self.metrics
        error = torch.linalg.vector_norm(self.target_pos - self.wanted_object_pos(), dim=1)
        metrics["position_error"].copy_(error)
        metrics["at_goal"].copy_(error < self.cfg.success_threshold)
        for name in ("goal_success", "episode_success"):
            torch.maximum(metrics[name], metrics["at_goal"], out=metrics[name])

    @property
    def _goal_color(self) -> Color:
        return _GOAL_COLOR

    def _debug_vis_impl(self, visualizer: DebugVisualizer) -> None:
        for index in visualizer.get_env_indices(self.num_envs):
            goal = self.target_pos[index].cpu().numpy()
            visualizer.add_sphere(goal, _GOAL_RADIUS, self._goal_color)
