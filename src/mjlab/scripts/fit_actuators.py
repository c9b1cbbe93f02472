"""Fit a robot's drives to logs of its joints: `uv run mjlab fit-actuators LOG --robot ROBOT [flags]`."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco

from mjlab.cli.flags import parse_flags
from mjlab.identification.estimate import UNITS, Estimate, LimbEstimate
from mjlab.identification.log import JointLog, read_log
from mjlab.identification.plant import KINDS
from mjlab.identification.randomization import actuators_source, events_source, removal_source
from mjlab.identification.robot import Drives, fit_robot
from mjlab.own_robot.anatomy import actuated_joint
from mjlab.own_robot.gains import servo_stiffness
from mjlab.own_robot.model_source import load_model, name_elements
from mjlab.own_robot.subject import driven_joints, effort_limits
from mjlab.scripts.export_scene import ROBOTS, made_robot
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.processes import available_cores
from mjlab.utils.string import counted
from mjlab.utils.tables import Table, tables_text

if TYPE_CHECKING:
    from mjlab.actuator import ActuatorCfg
    from mjlab.entity import Entity, EntityCfg

_MOST_JITTER = 0.2
_TIMESTEP = 0.005


@dataclass(frozen=True)
class FitActuatorsConfig:
    """Flags of `fit-actuators`."""

    robot: str | None = None
    """Robot of the log: MJCF or URDF, `menagerie:NAME`, g1, go1, yam, module:function, or a task."""
    more: tuple[str, ...] = ()
    """Further logs of the same joints and gains, fitted together with the first."""
    share: tuple[str, ...] = ()
    """Joint name patterns; the joints of each share their parameters. Default: each joint by itself."""
    stiffness: float | None = None
    """Commanded gain kp of all joints (N m/rad), the first guess. None: the robot's."""
    damping: float | None = None
    """Commanded gain kd of all joints (N m s/rad), the first guess. None: the robot's."""
    timestep: float | None = None
    """Physics timestep of the task (s), in which delays of actuators are counted. None: that of the
    task in --robot, or 0.005."""
    json: bool = False
    """Print JSON."""


@dataclass(frozen=True)
class Robot:
    """Robot of a log, as its file, function or task has it."""

    spec: mujoco.MjSpec
    """Spec with named elements."""
    drives: Drives
    actuators: tuple[tuple[ActuatorCfg, tuple[str, ...]], ...]
    """Each config with the names of its targets."""
    timestep: float
    """Physics timestep of the task (s)."""

    def of_file(self, joints: Sequence[str]) -> list[str]:
        """Return those of `joints` that an actuator of the robot's file drives."""
        from mjlab.actuator import XmlActuatorCfg

        driven = {
            name
            for cfg, names in self.actuators
            if isinstance(cfg, XmlActuatorCfg) and cfg.transmission_type.value == "joint"
            for name in names
        }
        return [name for name in joints if name in driven]

    def others(self, joints: Sequence[str]) -> list[ActuatorCfg]:
        """Return the actuators without those of `joints`."""
        configs = []
        for cfg, names in self.actuators:
            is_joint = cfg.transmission_type.value == "joint"
            rest = tuple(name for name in names if not (is_joint and name in joints))
            if len(rest) == len(names):
                configs.append(cfg)
            elif rest:
                configs.append(dataclasses.replace(cfg, target_names_expr=rest))
        return configs


def command(argv: list[str], prog: str) -> None:
    """Run `fit-actuators`."""
    log, *flags = argv
    cfg = parse_flags(FitActuatorsConfig, FitActuatorsConfig(), flags, f"{prog} LOG")
    robot = _robot(cfg)
    logs = [read_log(Path(path)) for path in (log, *cfg.more)]
    logging.getLogger("mjlab.identification").setLevel(logging.INFO)
    limbs = fit_robot(robot.spec, robot.drives, logs, cfg.share, num_threads=available_cores())
    if cfg.json:
        print(json.dumps([_as_json(limb) for limb in limbs], indent=2))
    else:
        print(report(logs, limbs, robot))


def report(logs: list[JointLog], limbs: list[LimbEstimate], robot: Robot) -> str:
    """Return the tables of estimates and residuals, remarks, and the randomization that follows."""
    seconds, rate = sum(log.duration for log in logs), 1.0 / logs[0].period
    parts = [f"{seconds:.1f} s at {rate:.0f} Hz, {counted(len(logs[0].joints), 'joint')}"]
    jitter = max(log.jitter for log in logs)
    if jitter > _MOST_JITTER:
        parts.append(
            f"Periods differ from their median by up to {jitter:.0%}: delays are less sure."
        )
    units = ", ".join(UNITS[kind] for kind in KINDS)
    parts += [tables_text(_tables(limbs)), f"Units: {units}, ms; rad, rad/s, N m."]
    remarks = [
        f"{', '.join(drive.joints)}: {remark}."
        for limb in limbs
        for drive in limb.drives
        for remark in drive.remarks
    ]
    if remarks:
        parts.append("\n".join(["Not separated by the log:", *remarks]))
    joints = logs[0].joints
    others = robot.others(joints)
    actuators = actuators_source(limbs, robot.drives.effort_limit, robot.timestep, others)
    if of_file := robot.of_file(joints):
        actuators += "\n\n\n" + removal_source(of_file)
    parts += [
        "Actuators (robot.py):\n\n" + actuators,
        "Events (task.py), ranges from the intervals:\n\n" + events_source(limbs),
    ]
    return "\n\n".join(parts)


def _tables(limbs: list[LimbEstimate]) -> list[Table]:
    # Short enough for 100 columns: shares instead of half-widths.
    rows = [
        (
            ", ".join(drive.joints),
            *(_short(drive.parameters[kind]) for kind in KINDS),
            f"{1e3 * limb.delay.value:.1f} +-{1e3 * limb.delay.half_width:.1f}",
        )
        for limb in limbs
        for drive in limb.drives
    ]
    signals = ("position", "velocity", "torque")
    residuals = []
    for limb in limbs:
        joints = [joint for drive in limb.drives for joint in drive.joints]
        values = [max(limb.rms[name]) if name in limb.rms else None for name in signals]
        residuals.append((", ".join(joints), *values))
    return [
        Table(
            "estimates",
            ("joints", *KINDS, "delay"),
            rows,
            note="values with their 95 % intervals",
        ),
        Table("residuals", ("joints", *signals), residuals, note="largest root mean square"),
    ]


def _short(estimate: Estimate) -> str:
    return f"{estimate.value:.3g} +-{100.0 * estimate.share:.0f}%"


def _as_json(limb: LimbEstimate) -> dict[str, Any]:
    return {
        "delay": dataclasses.asdict(limb.delay),
        "rms": {name: values.tolist() for name, values in limb.rms.items()},
        "drives": [dataclasses.asdict(drive) for drive in limb.drives],
    }


def _robot(cfg: FitActuatorsConfig) -> Robot:
    """Return the robot of the flags."""
    if cfg.robot is None:
        raise BadCallError("fit-actuators --robot: expected the robot of the log, got none.")
    target, entity, timestep = cfg.robot, None, _TIMESTEP
    if Path(target).exists() or target.startswith("menagerie:"):
        made = load_model(target).spec
    elif target in ROBOTS or ":" in target:
        made = made_robot(target)
    else:
        made, timestep = _robot_of_task(target)
    if isinstance(made, mujoco.MjSpec):
        spec = made
    else:
        entity = made.build()
        spec = entity.spec
    name_elements(spec)
    model = spec.compile()
    gains, limits = _servo_gains(model), effort_limits(model)
    if entity is None:
        actuators = _file_actuators(model)
    else:
        gains |= _entity_gains(entity)
        limits = _entity_limits(entity, limits)
        actuators = tuple((one.cfg, tuple(one.target_names)) for one in entity.actuators)
    joints = [model.joint(j).name for j in range(model.njnt)]
    stiffness = {joint: kp for joint, (kp, _) in gains.items()}
    damping = {joint: kd for joint, (_, kd) in gains.items()}
    if cfg.stiffness is not None:
        stiffness = dict.fromkeys(joints, cfg.stiffness)
    if cfg.damping is not None:
        damping = dict.fromkeys(joints, cfg.damping)
    drives = Drives(stiffness, damping, limits)
    return Robot(spec, drives, actuators, cfg.timestep or timestep)


def _robot_of_task(task: str) -> tuple[EntityCfg, float]:
    """Return the robot and the physics timestep (s) of a task."""
    from mjlab.tasks.registry import load_env_cfg

    cfg = load_env_cfg(task)
    entities = cfg.scene.entities
    if "robot" not in entities:
        raise UserError(f"Task {task}: expected an entity 'robot', got {list(entities)}.")
    return entities["robot"], cfg.sim.mujoco.timestep


def _file_actuators(model: mujoco.MjModel) -> tuple[tuple[ActuatorCfg, tuple[str, ...]], ...]:
    """Return the config of the actuators of a model, if it has them."""
    from mjlab.actuator import XmlActuatorCfg

    names = tuple(sorted(driven_joints(model)))
    return ((XmlActuatorCfg(target_names_expr=names), names),) if names else ()


def _entity_limits(entity: Entity, of_model: dict[str, float]) -> dict[str, float]:
    """Return the effort limit of each joint with one: the lower of the model's and its config's."""
    limits = dict(of_model)
    for actuator in entity.actuators:
        limit = getattr(actuator.cfg, "effort_limit", None)
        if limit is None or actuator.transmission_type.value != "joint":
            continue
        limit = abs(getattr(actuator.cfg, "gear", 1.0)) * float(limit)
        for name in actuator.target_names if math.isfinite(limit) else ():
            limits[name] = min(limit, limits.get(name, limit))
    return limits


def _entity_gains(entity: Entity) -> dict[str, tuple[float, float]]:
    """Return kp and kd by joint, of actuators with both in their configs."""
    gains = {}
    for actuator in entity.actuators:
        kp = getattr(actuator.cfg, "stiffness", None)
        kd = getattr(actuator.cfg, "damping", None)
        if kp is not None and kd is not None:
            gains |= dict.fromkeys(actuator.target_names, (kp, kd))
    return gains


def _servo_gains(model: mujoco.MjModel) -> dict[str, tuple[float, float]]:
    """Return kp and kd by joint, of position servos in the model."""
    stiffness, gains = servo_stiffness(model), {}
    for actuator in range(model.nu):
        joint = actuated_joint(model, actuator)
        if joint is not None and model.joint(joint).name in stiffness:
            name, gear = model.joint(joint).name, float(model.actuator_gear[actuator, 0])
            gains[name] = (stiffness[name], -float(model.actuator_biasprm[actuator, 2]) * gear**2)
    return gains
