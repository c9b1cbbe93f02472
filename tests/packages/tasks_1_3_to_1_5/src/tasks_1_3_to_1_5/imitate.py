"""Imitation from the tracking template, with a motion command that watches its bins."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.tasks.tracking import mdp
from mjlab.tasks.tracking.mdp import MotionCommand, MotionCommandCfg
from mjlab.tasks.tracking.tracking_env_cfg import VELOCITY_RANGE, make_tracking_env_cfg

from .hopper import BODIES, get_hopper_cfg
from .make_motion import MOTION


class WatchedMotionCommand(MotionCommand):
    """Motion command that reports how failures spread over the motion."""

    def __init__(self, cfg: WatchedMotionCommandCfg, env):
        super().__init__(cfg, env)
        assert self.motion_anchor_body_index == cfg.body_names.index(cfg.anchor_body_name)
        self.metrics["worst_bin"] = torch.zeros(self.num_envs, device=self.device)

    def _update_metrics(self) -> None:
        super()._update_metrics()
        assert len(self.bin_failed_count) == self.bin_count
        self.metrics["worst_bin"][:] = self.bin_failed_count.max()

    def _update_command(self) -> None:
        super()._update_command()


@dataclass(kw_only=True)
class WatchedMotionCommandCfg(MotionCommandCfg):
    def build(self, env) -> WatchedMotionCommand:
        return WatchedMotionCommand(self, env)


def imitate_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    cfg = make_tracking_env_cfg()
    cfg.scene.entities = {"robot": get_hopper_cfg()}
    cfg.scene.sensors = ()
    cfg.commands["motion"] = WatchedMotionCommandCfg(
        entity_name="robot",
        resampling_time_range=(1e9, 1e9),
        motion_file=str(MOTION),
        anchor_body_name="torso",
        body_names=BODIES,
        pose_range={"x": (-0.02, 0.02)},
        velocity_range={axis: VELOCITY_RANGE[axis] for axis in ("x", "y")},
        joint_position_range=(-0.1, 0.1),
        sampling_mode="start" if play else "adaptive",
    )
    action = cfg.actions["joint_pos"]
    assert isinstance(action, JointPositionActionCfg)
    action.scale = 0.3
    cfg.events["foot_friction"].params["asset_cfg"].geom_names = ("foot_collision",)
    cfg.events["base_com"].params["asset_cfg"].body_names = ("torso",)
    cfg.terminations["ee_body_pos"].params["body_names"] = ("shank",)
    cfg.rewards.pop("self_collisions")
    cfg.viewer.body_name = "torso"
    assert mdp.motion_anchor_pos_b
    if play:
        cfg.episode_length_s = int(1e9)
        cfg.observations["actor"].enable_corruption = False
    return cfg
