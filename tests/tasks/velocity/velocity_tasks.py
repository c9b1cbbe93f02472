"""Small versions of the velocity tasks."""

from __future__ import annotations

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.tasks.registry import load_env_cfg

GO1_FLAT = "Mjlab-Velocity-Flat-Unitree-Go1"
GO1_ROUGH = "Mjlab-Velocity-Rough-Unitree-Go1"


def task_cfg(task: str = GO1_FLAT, num_envs: int = 4, play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of a task with few environments and a small terrain grid, if any."""
    cfg = load_env_cfg(task, play=play)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = num_envs, 1, "native"
    cfg.sim.num_threads = 1
    if cfg.scene.terrain and cfg.scene.terrain.terrain_generator:
        cfg.scene.terrain.terrain_generator.num_rows = 3
        cfg.scene.terrain.terrain_generator.seed = 3
    return cfg
