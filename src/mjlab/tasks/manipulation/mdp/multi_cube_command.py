"""The lifting command of several objects: which one is wanted, and where it is to be brought."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch

from mjlab.tasks.manipulation.mdp.goal_checks import (
    check_goal_cfg,
    check_pose_range,
    require_object,
)
from mjlab.tasks.manipulation.mdp.goal_command import GoalCommand, GoalCommandCfg
from mjlab.tasks.manipulation.mdp.placement import distance_apart, keep_apart
from mjlab.utils.lab_api.math import sample_ranges

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import Color, DebugVisualizer

_NO_GEOM = -999
_MARK_HEIGHT = 0.04
_MARK_RADIUS = 0.01
_MARK_COLOR: Color = (1.0, 0.0, 0.0, 1.0)


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
        check_goal_cfg(cfg)
        check_pose_range(cfg.object_pose_range)
        if not cfg.entity_names:
            raise ValueError("entity_names is empty; name the objects, of which one is wanted.")
        self.objects: list[Entity] = [
            require_object(env, name, "A name in entity_names", is_moved=True)
            for name in cfg.entity_names
        ]
        self.target_selection = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self._geom_ids = _padded_geom_ids(self.objects).to(self.device)
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


def _padded_geom_ids(objects: list[Entity]) -> torch.Tensor:
    """Return the scene ids of each object's geoms, (objects, G) int64."""
    ids = [torch.as_tensor(entity.indexing.geom_ids).long().cpu() for entity in objects]
    return torch.nn.utils.rnn.pad_sequence(ids, batch_first=True, padding_value=_NO_GEOM)
