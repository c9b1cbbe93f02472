"""The commands of the manipulation tasks: goals for one object, or for one of several."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
import torch

from mjlab.compat import older_names
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.managers.term_checks import check_range
from mjlab.tasks.manipulation.mdp.goal_panel import GoalPanel
from mjlab.utils.errors import check_exists, check_one_of, check_positive
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
"""The goal of difficulty `fixed`, in metres from the environment's origin."""
_GOAL_RADIUS = 0.03
_GOAL_COLOR: Color = (1.0, 0.5, 0.0, 0.3)
_DIFFICULTIES = ("fixed", "dynamic")
logger = logging.getLogger(__name__)
_MAX_TRIES = 200
# Discs that are put down at random one after the other leave no room for another one once they
# cover 55 % of the ground. Well below that there is room at the first few tries.
_CROWDED = 0.35
_NO_GEOM = -999
_MARK_HEIGHT = 0.04
_MARK_RADIUS = 0.01
_MARK_COLOR: Color = (1.0, 0.0, 0.0, 1.0)


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
        check_one_of("difficulty", cfg.difficulty, _DIFFICULTIES)
        check_positive("success_threshold", cfg.success_threshold)
        for axis in ("x", "y", "z"):
            check_range(f"target_position_range.{axis}", getattr(cfg.target_position_range, axis))
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
        raise NotImplementedError

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
        if self.cfg.difficulty == "fixed":
            goals = torch.tensor(FIXED_GOAL, dtype=torch.float32, device=self.device)
        else:
            within = self.cfg.target_position_range
            goals = sample_ranges((within.x, within.y, within.z), len(env_ids), self.device)
        self.target_pos[env_ids] = goals + self._env.scene.env_origins[env_ids]
        self._place_objects(env_ids)

    def _draw_command(self, env_ids: torch.Tensor) -> None:
        """Draw what comes before the goal; nothing unless overridden."""

    def _place_objects(self, env_ids: torch.Tensor) -> None:
        """Put the objects of these environments to where they start, with `_place`."""
        raise NotImplementedError

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


@dataclass(kw_only=True)
class LiftingCommandCfg(GoalCommandCfg):
    """A goal for one object, which is put somewhere else with every new goal."""

    @dataclass
    class ObjectPoseRangeCfg:
        """Where the object is put, from the environment's origin."""

        x: tuple[float, float] = (0.3, 0.35)
        """Forward, in metres."""
        y: tuple[float, float] = (-0.1, 0.1)
        """To the left, in metres."""
        z: tuple[float, float] = (0.02, 0.05)
        """Up, in metres. The object falls from there."""
        yaw: tuple[float, float] = (-math.pi, math.pi)
        """Turn about the vertical, in rad."""

    @dataclass
    class VizCfg:
        """How the command is drawn."""

        target_color: tuple[float, float, float, float] = (1.0, 0.5, 0.0, 0.3)
        """Red, green, blue and opacity of the goal."""

    entity_name: str
    """The object, which has a free joint."""
    object_pose_range: ObjectPoseRangeCfg | None = field(default_factory=ObjectPoseRangeCfg)
    """Where the object is put. None: it stays where it is, or where reset events put it."""
    viz: VizCfg = field(default_factory=VizCfg)
    """Drawing."""

    def build(self, env: ManagerBasedRlEnv) -> LiftingCommand:
        """Return the term; raises `ValueError` for ranges or an object that make no sense."""
        return LiftingCommand(self, env)


class LiftingCommand(GoalCommand):
    """A goal (x, y, z) in the world for one object; see `GoalCommand`.

    One more metric is `object_height`: the object's z in the world (m).
    """

    cfg: LiftingCommandCfg

    def __init__(self, cfg: LiftingCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        moved = cfg.object_pose_range is not None
        self.object: Entity = require_object(env, cfg.entity_name, "entity_name", moved)
        if cfg.object_pose_range is not None:
            check_pose_range(cfg.object_pose_range)
        self.metrics = {
            "object_height": torch.zeros(self.num_envs, dtype=torch.float32, device=self.device),
            **self.metrics,
        }

    def wanted_object_pos(self) -> torch.Tensor:
        return self.object.data.root_link_pos_w

    def _place_objects(self, env_ids: torch.Tensor) -> None:
        within = self.cfg.object_pose_range
        if within is None:
            return
        count = len(env_ids)
        positions = sample_ranges((within.x, within.y, within.z), count, self.device)
        yaws = sample_ranges((within.yaw,), count, self.device).squeeze(1)
        self._place(self.object, positions, yaws, env_ids)

    def _update_metrics(self) -> None:
        super()._update_metrics()
        self.metrics["object_height"].copy_(self.wanted_object_pos()[:, 2])

    @property
    def _goal_color(self) -> Color:
        return self.cfg.viz.target_color


@dataclass(kw_only=True)
class MultiCubeLiftingCommandCfg(GoalCommandCfg):
    """A goal for one of several objects, all of which are put elsewhere with every new goal."""

    @dataclass
    class ObjectPoseRangeCfg:
        """Where the objects are put, from the environment's origin."""

        x: tuple[float, float] = (0.25, 0.40)
        """Forward, in metres."""
        y: tuple[float, float] = (-0.15, 0.15)
        """To the left, in metres."""
        z: tuple[float, float] = (0.02, 0.05)
        """Up, in metres. The objects fall from there."""
        yaw: tuple[float, float] = (-math.pi, math.pi)
        """Turn about the vertical, in rad."""

    entity_names: tuple[str, ...] = ()
    """The objects, each with a free joint."""
    object_pose_range: ObjectPoseRangeCfg = field(default_factory=ObjectPoseRangeCfg)
    """Where the objects are put."""

    def build(self, env: ManagerBasedRlEnv) -> MultiCubeLiftingCommand:
        """Return the term; raises `ValueError` for ranges or objects that make no sense."""
        return MultiCubeLiftingCommand(self, env)


class MultiCubeLiftingCommand(GoalCommand):
    """A goal (x, y, z) in the world for one object out of several; see `GoalCommand`.

    Objects are put so far apart that they do not touch, whatever their yaw.

    Attributes:
        target_selection: (N,) int64, the wanted object: an index into `entity_names`.
    """

    _transient = {"_geom_ids", "_apart"}

    cfg: MultiCubeLiftingCommandCfg

    def __init__(self, cfg: MultiCubeLiftingCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        check_pose_range(cfg.object_pose_range)
        if not cfg.entity_names:
            raise ValueError("entity_names is empty; name the objects, of which one is wanted.")
        self.objects: list[Entity] = [
            require_object(env, name, "entity_names", is_moved=True) for name in cfg.entity_names
        ]
        self.target_selection = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        ids = [torch.as_tensor(one.indexing.geom_ids).long().cpu() for one in self.objects]
        # (K, G) scene ids of each object's geoms.
        self._geom_ids = torch.nn.utils.rnn.pad_sequence(
            ids, batch_first=True, padding_value=_NO_GEOM
        ).to(self.device)
        self._apart = distance_apart(
            env.sim, self._geom_ids, cfg.object_pose_range, cfg.entity_names
        )

    @property
    def target_geom_ids(self) -> torch.Tensor:
        """Scene ids of the wanted object's geoms, (N, G) int64, filled up with -999."""
        return self._geom_ids[self.target_selection]

    def wanted_object_pos(self) -> torch.Tensor:
        return self.target_object_pos()

    def target_object_pos(self) -> torch.Tensor:
        """Return where the wanted object is now, (N, 3), in the world (m)."""
        positions = torch.stack([entity.data.root_link_pos_w for entity in self.objects])
        wanted = self.target_selection.view(1, -1, 1).expand(1, -1, 3)
        return positions.gather(0, wanted).squeeze(0)

    def _draw_command(self, env_ids: torch.Tensor) -> None:
        self.target_selection[env_ids] = torch.randint(
            len(self.objects), (len(env_ids),), device=self.device
        )

    def _place_objects(self, env_ids: torch.Tensor) -> None:
        within = self.cfg.object_pose_range
        count = len(env_ids)
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
        wanted = self.target_object_pos()
        for index in visualizer.get_env_indices(self.num_envs):
            mark = wanted[index].cpu().numpy() + (0.0, 0.0, _MARK_HEIGHT)
            visualizer.add_sphere(mark, _MARK_RADIUS, _MARK_COLOR)


def check_pose_range(within: Any) -> None:
    """Raise `ValueError` for a range of poses that makes no sense."""
    for name in ("x", "y", "z", "yaw"):
        check_range(f"object_pose_range.{name}", getattr(within, name))


def require_object(env: ManagerBasedRlEnv, name: str, label: str, is_moved: bool) -> Entity:
    """Return an entity of the scene; raises `ValueError` if there is none, or it cannot move."""
    check_exists(f"entity in {label}", name, env.scene.entities)
    entity: Entity = env.scene.entities[name]
    if is_moved and entity.is_fixed_base:
        raise ValueError(
            f"{label}: {name!r} has a fixed base, so that it cannot be lifted. Give its root body a "
            "free joint."
        )
    return entity


# Placing several objects so that none is in another.


def keep_apart(
    positions: torch.Tensor,
    apart: torch.Tensor,
    x: tuple[float, float],
    y: tuple[float, float],
) -> None:
    """Draw x and y anew, in place, of objects that are too close to one before them.

    What is far enough apart keeps its place, so that as few numbers are drawn as can be. Where 200
    tries find no room, the last one stays.

    Args:
        positions: (n, K, 3) positions of K objects.
        apart: (n, K, K) or (K, K) least horizontal distances, in metres.
        x: Range of new x.
        y: Range of new y.
    """
    apart = apart.expand(len(positions), -1, -1)
    for index in range(1, positions.shape[1]):
        close = _too_close(positions, index, apart)
        for _ in range(_MAX_TRIES):
            rows = close.nonzero().flatten()
            if len(rows) == 0:
                break
            drawn = torch.rand(len(rows), 2, dtype=torch.float32, device=positions.device)
            positions[rows, index, 0] = drawn[:, 0] * (x[1] - x[0]) + x[0]
            positions[rows, index, 1] = drawn[:, 1] * (y[1] - y[0]) + y[0]
            close[rows] = _too_close(positions[rows], index, apart[rows])


def _too_close(positions: torch.Tensor, index: int, apart: torch.Tensor) -> torch.Tensor:
    """Return whether an object is too close to one of those before it, (n,) bool."""
    offsets = positions[:, :index, :2] - positions[:, index : index + 1, :2]
    distances = torch.linalg.vector_norm(offsets, dim=-1)
    return (distances < apart[:, index, :index]).any(dim=1)


def distance_apart(
    sim: Simulation, geom_ids: torch.Tensor, within: Any, names: Sequence[str]
) -> torch.Tensor:
    """Return how far apart the origins of objects have to be not to touch, (N, K, K) in metres.

    That is the sum of the radii of the spheres about their origins that hold them: for two equal
    cubes, the diagonal of one. Variants of objects have radii of their own. Warns if the range
    `within` is too small for all of them in any environment.

    Args:
        sim: The simulation of the scene.
        geom_ids: (K, G) scene ids of each object's geoms; negative ones are no geom.
        within: Ranges `x` and `y` that the objects are placed in.
        names: The objects' names.
    """
    # As these objects have one body, a geom's position is that from the origin.
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
            "object_pose_range is small for the %d objects %s: some may be put into one another, "
            "and are then thrown apart. Widen x or y, or take fewer or smaller objects.",
            len(largest),
            list(names),
        )
    return radii.unsqueeze(1) + radii.unsqueeze(2)


# How far an arm reaches.


def check_reach(
    env: ManagerBasedRlEnv, command_name: str, cfg: GoalCommandCfg, entity_name: str, site: str
) -> None:
    """Raise `ValueError` if goals or objects of a command are certainly out of an arm's reach.

    An object is at its goal within `success_threshold` of it, which is added to the reach.
    """
    found = reach(env.sim.mj_model, f"{entity_name}/{site}")
    if found is None:
        return
    center, longest = found
    goals, starts = cfg.target_position_range, getattr(cfg, "object_pose_range", None)
    narrow = "Narrow {} to what the arm can reach."
    places: list[tuple[str, list[tuple[float, ...]], str]]
    places = [("goals", _corners(goals), narrow.format("target_position_range"))]
    if cfg.difficulty == "fixed":
        nearer = "Put the arm nearer, or choose the difficulty 'dynamic', whose goals have a range."
        places = [("goals", [FIXED_GOAL], nearer)]
    if starts is not None:
        places.append(("objects", _corners(starts), narrow.format("object_pose_range")))
    for label, points, remedy in places:
        farthest = max(points, key=lambda point: math.dist(point, center))
        distance = math.dist(farthest, center)
        if distance > longest + cfg.success_threshold:
            raise ValueError(
                f"The command {command_name!r} puts {label} as far away as {farthest} (metres from "
                f"the environment's origin). That is {distance:.2f} m from the first joint of entity "
                f"{entity_name!r}, whose site {site!r} gets {longest:.2f} m from it at most. "
                f"{remedy}"
            )


def _corners(within: Any) -> list[tuple[float, ...]]:
    return list(itertools.product(within.x, within.y, within.z))


def reach(model: mujoco.MjModel, site: str) -> tuple[np.ndarray, float] | None:
    """Return the place from which a site reaches, (3,), and how far it gets at most, in metres.

    The place is the joint nearest to the base, where the model puts it. No configuration of the
    joints gets the site further from there than the sum of the distances from joint to joint; what
    joints slide comes on top. Limits of joints may well keep it closer.

    None: the arm can go anywhere, since its base floats, or a joint slides without limit.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    point, length, is_jointed = data.site(site).xpos.copy(), 0.0, False
    body = int(model.site_bodyid[model.site(site).id])
    while body > 0:
        first = int(model.body_jntadr[body])
        for joint in reversed(range(first, first + int(model.body_jntnum[body]))):
            kind = model.jnt_type[joint]
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                return None
            if kind == mujoco.mjtJoint.mjJNT_SLIDE:
                if not model.jnt_limited[joint]:
                    return None
                # A range is of the joint's position, which is not 0 where the model puts it.
                start = model.qpos0[model.jnt_qposadr[joint]]
                length += float(np.abs(model.jnt_range[joint] - start).max())
                continue
            anchor = data.xanchor[joint].copy()
            # What lies between the site and the last joint is turned as a whole; so is all else.
            length += float(np.linalg.norm(point - anchor))
            point, is_jointed = anchor, True
        body = int(model.body_parentid[body])
    return (point, length) if is_jointed or length > 0.0 else (point, 0.0)


__getattr__ = older_names(__name__)
