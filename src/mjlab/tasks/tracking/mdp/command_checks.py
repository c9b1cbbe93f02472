"""What a motion command refuses when it is built, and reading its motions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mjlab.tasks.tracking.mdp.motion_loader import MotionLibrary, MotionLoader
from mjlab.tasks.tracking.mdp.perturbed_start import AXES
from mjlab.tasks.tracking.motion_file import check_motion_fits, read_motion
from mjlab.tasks.tracking.motion_sources import find_motions

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.scene import Scene
    from mjlab.tasks.tracking.mdp.motion_command import MotionCommandCfg

_MODES = ("adaptive", "uniform", "start")
_DRAWINGS = ("ghost", "frames")


def check_command_cfg(cfg: MotionCommandCfg) -> None:
    """Raise `ValueError` for names, ranges or numbers of the config that make no sense."""
    if len(set(cfg.body_names)) != len(cfg.body_names):
        raise ValueError(f"body_names names a body twice: {list(cfg.body_names)}.")
    if cfg.anchor_body_name not in cfg.body_names:
        raise ValueError(
            f"anchor_body_name is {cfg.anchor_body_name!r}; it has to be one of body_names, "
            f"which are {list(cfg.body_names)}."
        )
    if cfg.sampling_mode not in _MODES:
        raise ValueError(f"sampling_mode is {cfg.sampling_mode!r}; it is one of {_MODES}.")
    if cfg.viz.mode not in _DRAWINGS:
        raise ValueError(f"viz.mode is {cfg.viz.mode!r}; it is one of {_DRAWINGS}.")
    for name in ("pose_range", "velocity_range"):
        _check_ranges(name, getattr(cfg, name))
    _check_range("joint_position_range", cfg.joint_position_range)
    if cfg.adaptive_kernel_size < 1:
        raise ValueError(f"adaptive_kernel_size is {cfg.adaptive_kernel_size}; 1 is the least.")
    if not cfg.adaptive_uniform_ratio > 0.0:
        raise ValueError(
            f"adaptive_uniform_ratio is {cfg.adaptive_uniform_ratio}; it has to be above 0, "
            "because without it nothing could be drawn before the first failure."
        )
    for name in ("adaptive_lambda", "adaptive_alpha"):
        if not 0.0 < getattr(cfg, name) <= 1.0:
            raise ValueError(f"{name} is {getattr(cfg, name)}; it is above 0 and at most 1.")


def find_robot(cfg: MotionCommandCfg, scene: Scene) -> Entity:
    """Return the robot that the config names.

    Raises:
        ValueError: there is no such entity, it has a fixed base, it lacks a tracked body, or the
            first tracked body is not its floating base.
    """
    if cfg.entity_name not in scene.entities:
        raise ValueError(
            f"entity_name is {cfg.entity_name!r}, but the scene's entities are "
            f"{list(scene.entities)}."
        )
    robot: Entity = scene[cfg.entity_name]
    if robot.is_fixed_base:
        raise ValueError(
            f"Entity {cfg.entity_name!r} has a fixed base, and cannot be put onto a motion. Give "
            "its root body a free joint."
        )
    missing = [name for name in cfg.body_names if name not in robot.body_names]
    if missing:
        raise ValueError(
            f"body_names names {missing}, which entity {cfg.entity_name!r} lacks. Its bodies: "
            f"{list(robot.body_names)}."
        )
    root = robot.body_names[0]
    if cfg.body_names[0] != root:
        raise ValueError(
            f"The first of body_names is {cfg.body_names[0]!r}; it has to be the floating base "
            f"{root!r}, because starts of episodes take its pose."
        )
    return robot


def read_library(
    motion_file: str, robot: Entity, body_indexes: torch.Tensor, step_dt: float, device: str
) -> tuple[tuple[Path, ...], MotionLibrary]:
    """Return the files that `motion_file` names, and their motions.

    Raises:
        MotionFileError: a file does not exist, is no motion, or is none of this robot; the
            message says what is wrong.
    """
    files = tuple(find_motions(motion_file))
    loaders = []
    for path in files:
        motion = read_motion(path)
        check_motion_fits(path, motion, robot.joint_names, robot.body_names, step_dt)
        loaders.append(MotionLoader.from_motion(motion, body_indexes, device))
    return files, MotionLibrary(loaders, [path.stem for path in files])


def _check_ranges(name: str, ranges: Mapping[str, Any]) -> None:
    unknown = [axis for axis in ranges if axis not in AXES]
    if unknown:
        raise ValueError(f"{name} has the keys {unknown}; those there are: {list(AXES)}.")
    for axis, bounds in ranges.items():
        _check_range(f"{name}[{axis!r}]", bounds)


def _check_range(label: str, bounds: Any) -> None:
    try:
        low, high = (float(bound) for bound in bounds)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ValueError(
            f"{label} is {bounds!r}; it has to be two finite numbers, the smaller one first."
        )
