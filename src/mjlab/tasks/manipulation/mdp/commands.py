"""Commands of the manipulation tasks: goals for a single object, or for one of several."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch

from mjlab.compat import older_names
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.tasks.manipulation.mdp.goal_panel import GoalPanel
from mjlab.utils.errors import check_one_of
from mjlab.utils.lab_api.math import sample_ranges

if TYPE_CHECKING:
    import viser

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.sim import Simulation
    from mjlab.viewer.debug_visualizer import Color, DebugVisualizer

__all__ = [
    "LiftingCommand",
    "LiftingCommandCfg",
    "MultiCubeLiftingCommand",
    "MultiCubeLiftingCommandCfg",
]

FIXED_GOAL = (0.4, 0.0, 0.3)
"""Goal of difficulty `fixed`, relative to the environment's origin (m)."""
_GOAL_RADIUS = 0.03
_DIFFICULTIES = ("fixed", "dynamic")
logger = logging.getLogger(__name__)
_MAX_TRIES = 200
# Random sequential packing of disks jams at 55 % coverage. Well below that, a few tries suffice.
_CROWDED = 0.35
_NO_GEOM = -999
_MARK_HEIGHT = 0.04
_MARK_RADIUS = 0.01
_MARK_COLOR: Color = (1.0, 0.0, 0.0, 1.0)


@dataclass(kw_only=True)
class GoalCommandCfg(CommandTermCfg):
    """Configuration of a goal for an object, resampled periodically."""

    @dataclass
    class TargetPositionRangeCfg:
        """Ranges of goals relative to the environment's origin (m)."""

        x: tuple[float, float] = (0.3, 0.5)
        """Range along x, forward (m)."""
        y: tuple[float, float] = (-0.2, 0.2)
        """Range along y, to the left (m)."""
        z: tuple[float, float] = (0.2, 0.4)
        """Range along z, up (m)."""

    success_threshold: float = 0.05
    """Distance from object origin to goal below which the object counts as at its goal (m)."""
    difficulty: Literal["fixed", "dynamic"] = "fixed"
    """Goal sampling. `fixed`: always (0.4, 0, 0.3). `dynamic`: uniform within
    `target_position_range`."""
    target_position_range: TargetPositionRangeCfg = field(default_factory=TargetPositionRangeCfg)
    """Sampling ranges of dynamic goals."""


class GoalCommand(CommandTerm):
    """Base class of commands with a goal position for an object.

    Subclasses define `object_pos()`, and extend `_resample_command(env_ids)` to place the objects
    with `_place`.

    When the goal is resampled within an episode, the objects are placed at new poses. `sim.forward`
    then recomputes the derived quantities of these environments only, so that observations are of
    the new poses.

    Metrics at the end of the last step: `position_error` (m), `at_goal` (1 if the error is below
    the threshold), `goal_success` (1 if at the goal in any step since the goal was sampled) and
    `episode_success` (1 if at a goal in any step since the episode began).

    Attributes:
        target_pos: (N, 3) goal, world frame (m).
        goal_age: (N,) time since the goal was sampled (s).
        last_goal_met: (N,) bool, True if the object was at the previous goal when that was
            replaced; False for the first goal of an episode.
    """

    # Rebuilt or set within a call; not checkpointed.
    _transient = {"_moved", "_panel"}

    # GoalCommandCfg or a subclass of it.
    cfg: Any
    _goal_color: Color = (1.0, 0.5, 0.0, 0.3)

    def __init__(self, cfg: GoalCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        check_one_of("difficulty", cfg.difficulty, _DIFFICULTIES)
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
        """Goal, world frame (m), (N, 3)."""
        return self.target_pos

    @property
    def episode_success(self) -> torch.Tensor:
        """1 if the object has been at a goal in this episode, else 0, (N,)."""
        return self.metrics["episode_success"]

    def object_pos(self) -> torch.Tensor:
        """Return the position of the target object, world frame (m), (N, 3)."""
        raise NotImplementedError

    def compute_success(self) -> torch.Tensor:
        """Return True if the object was at its goal at the end of the last step, (N,) bool."""
        return self.metrics["position_error"] < self.cfg.success_threshold

    def goal_is_met(self) -> torch.Tensor:
        """Return True if the object reached its goal in the time available, (N,) bool.

        A goal younger than the minimum resampling time is not scored, because it may be unreachable
        so early; the previous goal then counts, at the moment it was replaced. The first goal of an
        episode is always scored.
        """
        has_time = self.goal_age >= self.cfg.resampling_time_range[0]
        is_scored = has_time | (self.command_counter <= 1)
        return torch.where(is_scored, self.compute_success(), self.last_goal_met)

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Update metrics, advance time and resample expired goals; see `CommandTerm.compute`."""
        self._moved = None
        self.goal_age[slice(None) if env_ids is None else env_ids] += dt
        super().compute(dt, env_ids)
        if self._moved is not None:
            self._env.sim.forward(self._moved)
        if self._panel is not None:
            held = self._panel.write_to(self.target_pos, self._env.scene.env_origins)
            if held is not None:
                # Do not resample a goal that the user holds.
                self.time_left[held] = self.cfg.resampling_time_range[1]

    def create_gui(
        self,
        name: str,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add a handle to drag the goal of the displayed environment."""
        self._panel = GoalPanel(
            name, server, self.cfg.target_position_range, get_env_idx, on_change
        )

    # Resampling.

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        metrics = self.metrics
        self.last_goal_met[env_ids] = metrics["at_goal"][env_ids] > 0.0
        metrics["goal_success"][env_ids] = 0.0
        self.goal_age[env_ids] = 0.0
        if self.cfg.difficulty == "fixed":
            goals = torch.tensor(FIXED_GOAL, dtype=torch.float32, device=self.device)
        else:
            within = self.cfg.target_position_range
            goals = sample_ranges((within.x, within.y, within.z), len(env_ids), self.device)
        self.target_pos[env_ids] = goals + self._env.scene.env_origins[env_ids]

    def _place(
        self, entity: Entity, positions: torch.Tensor, yaws: torch.Tensor, env_ids: torch.Tensor
    ) -> None:
        """Place an object at rest at `positions` (n, 3), relative to the environments' origins,
        with rotations `yaws` (n,) about z."""
        pose = positions.new_zeros(len(env_ids), 7)
        pose[:, :3] = positions + self._env.scene.env_origins[env_ids]
        pose[:, 3] = torch.cos(yaws / 2.0)
        pose[:, 6] = torch.sin(yaws / 2.0)
        entity.write_root_link_pose_to_sim(pose, env_ids=env_ids)
        entity.write_root_link_velocity_to_sim(torch.zeros_like(pose[:, :6]), env_ids=env_ids)
        self._moved = env_ids

    # Metrics and visualization.

    def _is_measured(self, env_ids: torch.Tensor) -> torch.Tensor:
        # Metrics are undefined before the first goal.
        return self.command_counter[env_ids] > 0

    def _update_metrics(self) -> None:
        metrics = self.metrics
        error = torch.linalg.vector_norm(self.target_pos - self.object_pos(), dim=1)
        metrics["position_error"].copy_(error)
        metrics["at_goal"].copy_(error < self.cfg.success_threshold)
        for name in ("goal_success", "episode_success"):
            torch.maximum(metrics[name], metrics["at_goal"], out=metrics[name])

    def _debug_vis_impl(self, visualizer: DebugVisualizer) -> None:
        visualizer.add_legend(self._goal_color, "goal")
        for index in visualizer.get_env_indices(self.num_envs):
            goal = self.target_pos[index].cpu().numpy()
            visualizer.add_sphere(goal, _GOAL_RADIUS, self._goal_color)


@dataclass(kw_only=True)
class LiftingCommandCfg(GoalCommandCfg):
    """Configuration of a goal for a single object, placed at a new pose with every new goal."""

    @dataclass
    class ObjectPoseRangeCfg:
        """Ranges of the object pose relative to the environment's origin."""

        x: tuple[float, float] = (0.3, 0.35)
        """Range along x, forward (m)."""
        y: tuple[float, float] = (-0.1, 0.1)
        """Range along y, to the left (m)."""
        z: tuple[float, float] = (0.02, 0.05)
        """Range along z, up (m). The object falls from there."""
        yaw: tuple[float, float] = (-math.pi, math.pi)
        """Range of rotations about z (rad)."""

    @dataclass
    class VizCfg:
        """Visualization of the command."""

        target_color: tuple[float, float, float, float] = (1.0, 0.5, 0.0, 0.3)
        """Color and opacity of the goal (RGBA)."""

    entity_name: str
    """Name of the object, an entity with a free joint."""
    object_pose_range: ObjectPoseRangeCfg | None = field(default_factory=ObjectPoseRangeCfg)
    """Ranges of the object pose. None: keep the current pose, or the pose set by reset events."""
    viz: VizCfg = field(default_factory=VizCfg)
    """Visualization settings."""

    def build(self, env: ManagerBasedRlEnv) -> LiftingCommand:
        """Build the term."""
        return LiftingCommand(self, env)


class LiftingCommand(GoalCommand):
    """Goal (x, y, z) in the world frame for a single object; see `GoalCommand`.

    Additional metric: `object_height`, the object's z in the world (m).
    """

    cfg: LiftingCommandCfg

    def __init__(self, cfg: LiftingCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self.object: Entity = env.scene[cfg.entity_name]
        self._goal_color = cfg.viz.target_color
        self.metrics = {
            "object_height": torch.zeros(self.num_envs, dtype=torch.float32, device=self.device),
            **self.metrics,
        }

    def object_pos(self) -> torch.Tensor:
        return self.object.data.root_link_pos_w

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        super()._resample_command(env_ids)
        within = self.cfg.object_pose_range
        if within is None:
            return
        count = len(env_ids)
        positions = sample_ranges((within.x, within.y, within.z), count, self.device)
        yaws = sample_ranges((within.yaw,), count, self.device).squeeze(1)
        self._place(self.object, positions, yaws, env_ids)

    def _update_metrics(self) -> None:
        super()._update_metrics()
        self.metrics["object_height"].copy_(self.object_pos()[:, 2])


@dataclass(kw_only=True)
class MultiCubeLiftingCommandCfg(GoalCommandCfg):
    """Configuration of a goal for one of several objects. Every new goal places all objects."""

    @dataclass
    class ObjectPoseRangeCfg:
        """Ranges of the object poses relative to the environment's origin."""

        x: tuple[float, float] = (0.25, 0.40)
        """Range along x, forward (m)."""
        y: tuple[float, float] = (-0.15, 0.15)
        """Range along y, to the left (m)."""
        z: tuple[float, float] = (0.02, 0.05)
        """Range along z, up (m). The objects fall from there."""
        yaw: tuple[float, float] = (-math.pi, math.pi)
        """Range of rotations about z (rad)."""

    entity_names: tuple[str, ...] = ()
    """Names of the objects, entities with a free joint."""
    object_pose_range: ObjectPoseRangeCfg = field(default_factory=ObjectPoseRangeCfg)
    """Ranges of the object poses."""

    def build(self, env: ManagerBasedRlEnv) -> MultiCubeLiftingCommand:
        """Build the term."""
        return MultiCubeLiftingCommand(self, env)


class MultiCubeLiftingCommand(GoalCommand):
    """Goal (x, y, z) in the world frame for one of several objects; see `GoalCommand`.

    Objects are placed far enough apart not to touch at any yaw.

    Attributes:
        target_selection: (N,) int64, index of the target object in `entity_names`.
    """

    _transient = {"_geom_ids", "_apart"}

    cfg: MultiCubeLiftingCommandCfg

    def __init__(self, cfg: MultiCubeLiftingCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self.objects: list[Entity] = [env.scene[name] for name in cfg.entity_names]
        self.target_selection = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        ids = [torch.as_tensor(one.indexing.geom_ids).long().cpu() for one in self.objects]
        # Scene ids of the geoms of each object, (K, G).
        self._geom_ids = torch.nn.utils.rnn.pad_sequence(
            ids, batch_first=True, padding_value=_NO_GEOM
        ).to(self.device)
        self._apart = distance_apart(
            env.sim, self._geom_ids, cfg.object_pose_range, cfg.entity_names
        )

    @property
    def target_geom_ids(self) -> torch.Tensor:
        """Scene ids of the target object's geoms, padded with -999, (N, G) int64."""
        return self._geom_ids[self.target_selection]

    def object_pos(self) -> torch.Tensor:
        return self.target_object_pos()

    def target_object_pos(self) -> torch.Tensor:
        """Return the position of the target object, world frame (m), (N, 3)."""
        positions = torch.stack([entity.data.root_link_pos_w for entity in self.objects])
        index = self.target_selection.view(1, -1, 1).expand(1, -1, 3)
        return positions.gather(0, index).squeeze(0)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        within, count = self.cfg.object_pose_range, len(env_ids)
        selected = torch.randint(len(self.objects), (count,), device=self.device)
        self.target_selection[env_ids] = selected
        super()._resample_command(env_ids)
        positions, yaws = [], []
        for _ in self.objects:
            positions.append(sample_ranges((within.x, within.y, within.z), count, self.device))
            yaws.append(sample_ranges((within.yaw,), count, self.device).squeeze(1))
        placed = torch.stack(positions, dim=1)
        keep_apart(placed, self._apart[env_ids], within.x, within.y)
        for index, entity in enumerate(self.objects):
            self._place(entity, placed[:, index], yaws[index], env_ids)

    def _debug_vis_impl(self, visualizer: DebugVisualizer) -> None:
        super()._debug_vis_impl(visualizer)
        target = self.target_object_pos()
        visualizer.add_legend(_MARK_COLOR, "object to lift")
        for index in visualizer.get_env_indices(self.num_envs):
            mark = target[index].cpu().numpy() + (0.0, 0.0, _MARK_HEIGHT)
            visualizer.add_sphere(mark, _MARK_RADIUS, _MARK_COLOR)


# Placement of several objects without overlap.


def keep_apart(
    positions: torch.Tensor,
    apart: torch.Tensor,
    x: tuple[float, float],
    y: tuple[float, float],
) -> None:
    """Resample, in place, x and y of objects too close to an earlier object.

    Objects that are far enough apart keep their positions, to draw as few random numbers as
    possible. If 200 tries fail, the last sample is kept.

    Args:
        positions: (n, K, 3) positions of K objects.
        apart: (n, K, K) or (K, K) minimum horizontal distances (m).
        x: Range of new x.
        y: Range of new y.
    """
    apart = apart.expand(len(positions), -1, -1)
    for index in range(1, positions.shape[1]):
        rows = torch.arange(len(positions), device=positions.device)
        for _ in range(_MAX_TRIES):
            offsets = positions[rows, :index, :2] - positions[rows, index : index + 1, :2]
            distances = torch.linalg.vector_norm(offsets, dim=-1)
            rows = rows[(distances < apart[rows, index, :index]).any(dim=1)]
            if len(rows) == 0:
                break
            drawn = torch.rand(len(rows), 2, dtype=torch.float32, device=positions.device)
            positions[rows, index, 0] = drawn[:, 0] * (x[1] - x[0]) + x[0]
            positions[rows, index, 1] = drawn[:, 1] * (y[1] - y[0]) + y[0]


def distance_apart(
    sim: Simulation, geom_ids: torch.Tensor, within: Any, names: Sequence[str]
) -> torch.Tensor:
    """Return the minimum distances of object origins that prevent contact (m), (N, K, K).

    The distance is the sum of the radii of bounding spheres about the origins: for two equal
    cubes, the diagonal of one. Radii are per environment, for variants. Logs a warning if the range
    `within` is too small for all objects in any environment.

    Args:
        sim: Simulation of the scene.
        geom_ids: (K, G) scene ids of each object's geoms; negative ids are padding.
        within: Placement ranges, attributes `x` and `y`.
        names: Names of the objects.
    """
    # The objects have one body each, so geom_pos is relative to the object's origin.
    reach = sim.model.geom_pos.norm(dim=-1) + sim.model.geom_rbound
    if sim.absent_geoms is not None:
        reach = reach.masked_fill(sim.absent_geoms, 0.0)
    radii = reach.new_zeros(len(reach), len(geom_ids))
    for ids in geom_ids.T:
        radii = torch.maximum(radii, torch.where(ids >= 0, reach[:, ids.clamp(min=0)], 0.0))
    largest = radii[int(radii.square().sum(dim=1).argmax())].tolist()
    sides = [high - low + 2.0 * max(largest) for low, high in (within.x, within.y)]
    covered = sum(math.pi * radius**2 for radius in largest)
    if len(largest) > 1 and covered > _CROWDED * sides[0] * sides[1]:
        logger.warning(
            "object_pose_range is small for the objects %s: objects may start in penetration "
            "and be thrown apart. Widen x or y, or use fewer or smaller objects.", list(names),
        )  # fmt: skip
    return radii.unsqueeze(1) + radii.unsqueeze(2)


__getattr__ = older_names(__name__)
