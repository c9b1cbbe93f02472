"""The lifting command: where one object is to be brought."""

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
from mjlab.utils.lab_api.math import sample_ranges

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import Color


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
        check_goal_cfg(cfg)
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
