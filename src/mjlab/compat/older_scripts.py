"""Legacy task registry and functions of scripts; resolved through the tables of `mjlab.compat`."""

from __future__ import annotations

import dataclasses
import logging
import tempfile
from collections.abc import Iterator, MutableMapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mjlab.tasks import registry

logger = logging.getLogger(__name__)

# Task registry as a dict.


class _Registry(MutableMapping[str, SimpleNamespace]):
    """Registered tasks by name: copies of the configs, and the runner class."""

    def __getitem__(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(
            env_cfg=registry.load_env_cfg(name),
            play_env_cfg=registry.load_env_cfg(name, play=True),
            rl_cfg=registry.load_rl_cfg(name),
            runner_cls=registry.load_runner_cls(name),
        )

    def __setitem__(self, name: str, task: Any) -> None:
        registry._tasks.pop(name, None)
        registry.register_mjlab_task(
            name, task.env_cfg, task.play_env_cfg, task.rl_cfg, task.runner_cls
        )

    def __delitem__(self, name: str) -> None:
        del registry._tasks[name]

    def __contains__(self, name: object) -> bool:
        return name in registry.list_tasks()

    def __iter__(self) -> Iterator[str]:
        return iter(registry.list_tasks())

    def __len__(self) -> int:
        return len(registry.list_tasks())


REGISTRY = _Registry()


# Legacy functions of scripts.


def run_sim(
    sim: Any,
    scene: Any,
    joint_names: Sequence[str],
    input_file: str,
    input_fps: float,
    output_fps: float,
    output_name: str,
    render: bool,
    line_range: tuple[int, int] | None,
    renderer: Any = None,
) -> None:
    """Convert a CSV of poses of the scene's `robot` to `motion.npz`.

    Writes to the temporary folder, as in 1.6, with a copy `<output_name>.npz` in the working folder.
    `csv_to_npz` uploads it with `--upload True`.

    Args:
        sim: No effect; the conversion needs no simulation.
        scene: Scene with the robot.
        joint_names: Joints in column order. Other joints keep their default position.
        input_file: CSV file.
        input_fps: Poses per second of the CSV.
        output_fps: Frames per second of the motion.
        output_name: Name of the motion.
        render: Record a video next to the copy.
        line_range: First and last line to read, counted from 1. None: all lines.
        renderer: No effect.
    """
    from mjlab.scripts.csv_to_npz import record_motion
    from mjlab.tasks.tracking.motion_file import npz_path, write_motion
    from mjlab.tasks.tracking.motion_recording import make_motion, read_csv, resampled

    robot = scene["robot"]
    recording = read_csv(input_file, input_fps, joint_names, line_range)
    joint_pos = robot.data.default_joint_pos[0].cpu().numpy()
    joint_pos = np.tile(joint_pos, (len(recording), 1)).astype(recording.joint_pos.dtype)
    columns, _ = robot.find_joints(joint_names, preserve_order=True)
    joint_pos[:, columns] = recording.joint_pos
    recording = dataclasses.replace(recording, joint_pos=joint_pos)
    robot = robot.cfg.build()
    motion = make_motion(
        resampled(recording, output_fps), robot.compile(), robot.joint_names, robot.body_names
    )
    write_motion(Path(tempfile.gettempdir()) / "motion.npz", motion)
    path = write_motion(npz_path(f"{output_name}.npz"), motion)
    logger.warning("Motion written to %s; upload it with csv_to_npz --upload True.", path)
    if render:
        record_motion(motion, robot, path.with_suffix(".mp4"))


# Of the bundled policy.
_DEMO_MOTION = "squat"


def ensure_default_motion() -> str:
    """Return the path of a bundled G1 motion."""
    from mjlab.tasks.tracking.motion_sources import shipped_motions

    return str(shipped_motions()[_DEMO_MOTION])


def ensure_default_checkpoint() -> str:
    """Return the path of the bundled tracking policy, in ONNX, of squats and waves."""
    from mjlab.scripts.demo import DEMOS

    return str(DEMOS["g1-tracking"].policy)


def ensure_asset_downloaded(asset_name: str, force_download: bool = False) -> Path:
    """Return the path of the bundled file that stands for `demo_motion.npz` or `demo_ckpt.pt`."""
    assets = {"demo_motion.npz": ensure_default_motion, "demo_ckpt.pt": ensure_default_checkpoint}
    if asset_name not in assets:
        raise ValueError(f"asset_name: expected one of {sorted(assets)}, got {asset_name!r}.")
    return Path(assets[asset_name]())
