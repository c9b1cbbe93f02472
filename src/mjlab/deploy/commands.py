"""Commands as data: what a user gives, and what a robot's program computes, such as a gait clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjlab.deploy.measurements import Subject, body_pos, body_quat, joint_unit

if TYPE_CHECKING:
    from mjlab.managers import CommandTerm

Row = Callable[[Subject, Any], dict[str, Any]]


def command_entry(subject: Subject, name: str) -> dict[str, Any]:
    """Return the entry of a command in the contract; unknown classes are `given`, without ranges."""
    term: Any = subject.env.command_manager.get_term(name)
    shape = list(term.command.shape[1:])
    entry = {
        "name": name,
        "kind": "given",
        "size": term.command[0].numel(),
        "shape": shape,
        "class": name_of_class(term),
        "frame": "",
        "components": [],
    }
    row = row_of(term)
    return entry if row is None else {**entry, **row(subject, term)}


def row_of(term: CommandTerm) -> Row | None:
    """Return the row of a command's class, or of the nearest base class that has one."""
    names = (f"{kind.__module__}:{kind.__qualname__}" for kind in type(term).__mro__)
    return next((COMMANDS[name] for name in names if name in COMMANDS), None)


def name_of_class(term: CommandTerm) -> str:
    """Return `module:name` of the class of a command."""
    return f"{type(term).__module__}:{type(term).__qualname__}"


def _component(name: str, unit: str, bounds: Any) -> dict[str, Any]:
    return {
        "name": name,
        "unit": unit,
        "range": None if bounds is None else [float(bounds[0]), float(bounds[1])],
    }


def _velocity(subject: Subject, term: Any) -> dict[str, Any]:
    ranges = term.cfg.ranges
    units = {"lin_vel_x": "m/s", "lin_vel_y": "m/s", "ang_vel_z": "rad/s"}
    return {
        "frame": "root",
        "components": [
            _component(name, unit, getattr(ranges, name)) for name, unit in units.items()
        ],
    }


def _clock(subject: Subject, term: Any) -> dict[str, Any]:
    cfg = term.cfg
    return {
        "kind": "gait_clock",
        "components": [_component("sin", "", (-1.0, 1.0)), _component("cos", "", (-1.0, 1.0))],
        "frequency": float(cfg.frequency),
        "fade_s": float(cfg.fade_s),
        "standing_threshold": float(cfg.standing_threshold),
        "start": float((cfg.starts or (0.0,))[0]),
        "velocity_command": cfg.velocity_command_name,
    }


def _motion(subject: Subject, term: Any) -> dict[str, Any]:
    motion, cfg, entity = term.motion, term.cfg, subject.env.scene[term.cfg.entity_name]
    unit = joint_unit(entity)
    names = [(f"joint_pos.{joint}", unit) for joint in entity.joint_names]
    names += [(f"joint_vel.{joint}", f"{unit}/s") for joint in entity.joint_names]
    return {
        "kind": "motion",
        "components": [_component(name, unit, None) for name, unit in names],
        "file": "motion.npz",
        "start_frame": 1,
        "num_frames": int(motion.time_step_total),
        "motions": [
            {"name": name, "start": start, "length": length}
            for name, start, length in zip(
                motion.names, motion.starts.tolist(), motion.lengths.tolist(), strict=True
            )
        ],
        "bodies": list(entity.body_names),
        "anchor": cfg.anchor_body_name,
        "anchor_pos": body_pos(subject, cfg.entity_name, cfg.anchor_body_name).name,
        "anchor_quat": body_quat(subject, cfg.entity_name, cfg.anchor_body_name).name,
        "anchor_index": list(entity.body_names).index(cfg.anchor_body_name),
    }


def _pose(subject: Subject, term: Any) -> dict[str, Any]:
    names = (("x", "m"), ("y", "m"), ("z", "m"), ("qw", ""), ("qx", ""), ("qy", ""), ("qz", ""))
    ranges, bounds = term.cfg.ranges, [None] * 7
    if ranges is not None:
        bounds[:3] = [ranges.pos_x, ranges.pos_y, ranges.pos_z]
    elif term.goals is not None:
        lowest, highest = (
            term.goals.amin(0).tolist(),
            term.goals.amax(0).tolist(),
        )
        bounds = list(zip(lowest, highest, strict=True))
    return {
        "frame": "root",
        "components": [
            _component(name, unit, pair) for (name, unit), pair in zip(names, bounds, strict=True)
        ],
    }


def _goal(subject: Subject, term: Any) -> dict[str, Any]:
    within = term.cfg.target_position_range
    return {
        "frame": "world",
        "components": [_component(axis, "m", getattr(within, axis)) for axis in ("x", "y", "z")],
    }


COMMANDS: dict[str, Row] = {
    "mjlab.tasks.velocity.mdp.velocity_command:UniformVelocityCommand": _velocity,
    "mjlab.tasks.velocity.mdp.gait:GaitClockCommand": _clock,
    "mjlab.tasks.tracking.mdp.commands:MotionCommand": _motion,
    "mjlab.envs.mdp.pose_command:UniformPoseCommand": _pose,
    "mjlab.tasks.manipulation.mdp.commands:GoalCommand": _goal,
}
"""Rows by `module:class`."""
