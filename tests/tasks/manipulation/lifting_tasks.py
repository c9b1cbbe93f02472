"""Small versions of the tasks under test."""

from __future__ import annotations

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.sensor import ContactSensorCfg
from mjlab.tasks.registry import load_env_cfg

LIFT = "Mjlab-Lift-Cube-Yam"
RGB = "Mjlab-Lift-Cube-Yam-Rgb"
DEPTH = "Mjlab-Lift-Cube-Yam-Depth"
MULTI = "Mjlab-Multi-Cube-Seg-Yam"


def task_cfg(
    task: str = LIFT, num_envs: int = 4, play: bool = False, images: bool = True
) -> ManagerBasedRlEnvCfg:
    """Return the config of a task with few environments; without `images`, nothing is rendered."""
    cfg = load_env_cfg(task, play=play)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = num_envs, 1, "native"
    cfg.sim.num_threads = 1
    if not images:
        cfg.observations.pop("camera", None)
        contacts = [one for one in cfg.scene.sensors if isinstance(one, ContactSensorCfg)]
        cfg.scene.sensors = tuple(contacts)
    return cfg


def move(env: ManagerBasedRlEnv, steps: int, seed: int = 0) -> torch.Tensor:
    """Step with random actions; return the rewards, (steps, N)."""
    generator = torch.Generator().manual_seed(seed)
    shape = (env.num_envs, env.action_manager.total_action_dim)
    actions = [2.0 * torch.rand(shape, generator=generator) - 1.0 for _ in range(steps)]
    return torch.stack([env.step(action)[1].clone() for action in actions])


def lifting(env: ManagerBasedRlEnv):
    """Return the command of an environment."""
    return env.command_manager.get_term("lift_height")
