"""Small versions of the task under test, and motions with known values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.tasks.tracking.motion_file import Motion, read_motion, write_motion
from mjlab.tasks.tracking.motion_sources import shipped_motions

G1 = "Mjlab-Tracking-Flat-Unitree-G1"
G1_BLIND = "Mjlab-Tracking-Flat-Unitree-G1-No-State-Estimation"


def task_cfg(
    motion: str | Path | None = None,
    num_envs: int = 4,
    task: str = G1,
    play: bool = False,
    edit: Callable[[ManagerBasedRlEnvCfg], None] | None = None,
    **command: Any,
) -> ManagerBasedRlEnvCfg:
    """Return the config of a task with few environments; `command` are fields of the command."""
    cfg = load_env_cfg(task, play=play)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = num_envs, 1, "native"
    cfg.sim.num_threads = 1
    if motion is not None:
        cfg.commands["motion"].motion_file = str(motion)
    for name, value in command.items():
        setattr(cfg.commands["motion"], name, value)
    if edit is not None:
        edit(cfg)
    return cfg


def unperturbed(cfg: ManagerBasedRlEnvCfg) -> None:
    """Remove start perturbations, observation noise and events."""
    command = cfg.commands["motion"]
    command.pose_range, command.velocity_range = {}, {}
    command.joint_position_range = (0.0, 0.0)
    cfg.observations["actor"].enable_corruption = False
    cfg.events = {}


def part_of(name: str, frames: slice, path: Path, **changes: Any) -> Path:
    """Write a part of a bundled motion, with values replaced."""
    motion = read_motion(shipped_motions()[name])
    values = {key: getattr(motion, key) for key in motion.__dataclass_fields__}
    for key, value in values.items():
        if isinstance(value, np.ndarray):
            values[key] = value[frames]
    return write_motion(path, Motion(**{**values, **changes}))
