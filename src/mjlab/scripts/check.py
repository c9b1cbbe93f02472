"""Look for faults of a robot's model or task: `uv run mjlab check TARGET [flags]`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import mujoco

from mjlab.cli.flags import parse_flags
from mjlab.own_robot.anatomy import finger_joints
from mjlab.own_robot.findings import Finding, find_faults, missed_joints
from mjlab.own_robot.gains import servo_stiffness
from mjlab.own_robot.model_source import load_model, name_elements
from mjlab.own_robot.source_lines import SourceLines, find_source
from mjlab.own_robot.subject import Subject, driven_joints, effort_limits, subject_of
from mjlab.scripts.export_scene import ROBOTS, made_robot
from mjlab.utils.errors import MjlabError, UserError
from mjlab.utils.string import compile_pattern, counted

if TYPE_CHECKING:
    from mjlab.entity import Entity, EntityCfg
    from mjlab.envs import ManagerBasedRlEnvCfg


@dataclass(frozen=True)
class CheckConfig:
    """Flags of `check`."""

    profile: str | None = None
    """Task profile, such as `cpu`."""
    floating_base: bool = False
    """Add a free joint to the root link of a URDF."""
    strict: bool = False
    """Exit with status 1 if there are findings."""
    json: bool = False
    """Print JSON."""


def command(argv: list[str], prog: str) -> None:
    """Run `check`."""
    target, *flags = argv
    cfg = parse_flags(CheckConfig, CheckConfig(), flags, f"{prog} TARGET")
    findings = check(target, cfg)
    if cfg.json:
        print(json.dumps([dataclasses.asdict(finding) for finding in findings], indent=2))
    else:
        print(report(target, findings))
    if cfg.strict and findings:
        raise SystemExit(1)


def report(target: str, findings: list[Finding]) -> str:
    """Return the findings as text, below their number."""
    return "\n\n".join([f"{target}: {counted(len(findings), 'finding')}", *map(str, findings)])


def check(target: str, cfg: CheckConfig | None = None) -> list[Finding]:
    """Return the findings of a model or task.

    Args:
        target: MJCF or URDF, folder or zip archive with one, `menagerie:NAME`; a robot (g1, go1, yam,
            or `module:function` that returns an MjSpec or EntityCfg); or the name of a task.
        cfg: Flags. None: the defaults.

    Raises:
        UserError: not found, or MuJoCo cannot compile it.
    """
    cfg = cfg or CheckConfig()
    if Path(target).exists() or target.startswith("menagerie:"):
        with _reading(target):
            robot = load_model(target, floating_base=cfg.floating_base)
            lines = None if robot.file is None else SourceLines(robot.file)
            return find_faults(subject_of(robot.spec, lines))
    if target in ROBOTS or ":" in target:
        robot = made_robot(target)
        if not isinstance(robot, mujoco.MjSpec):
            return check_entity("robot", robot)
        with _reading(target):
            return find_faults(subject_of(robot, find_source(robot)))
    from mjlab.tasks.registry import UnknownTaskError, load_env_cfg

    try:
        env_cfg = load_env_cfg(target, profile=cfg.profile)
    except UnknownTaskError as error:
        raise UserError(
            f"{error} The target may also be a model file, menagerie:NAME, module:function or a robot "
            f"({', '.join(ROBOTS)})."
        ) from None
    return check_task(env_cfg)


@contextlib.contextmanager
def _reading(target: str) -> Generator[None]:
    """Raise `UserError` with the name of the target where MuJoCo cannot read it."""
    try:
        yield
    except MjlabError:
        raise
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise UserError(f"{target}: {' '.join(str(error).split())}") from error


def check_task(env_cfg: ManagerBasedRlEnvCfg) -> list[Finding]:
    """Return the findings of the robots of a task: their models, and the patterns of the task."""
    findings = []
    for name, entity_cfg in env_cfg.scene.entities.items():
        findings += check_entity(name, entity_cfg, env_cfg)
    return findings


def check_entity(
    name: str, entity_cfg: EntityCfg, env_cfg: ManagerBasedRlEnvCfg | None = None
) -> list[Finding]:
    """Return the findings of an entity, with its own actuators, collisions and initial state.

    Args:
        name: Name of the entity in the scene.
        entity_cfg: Entity. One without joints has no findings.
        env_cfg: Task, for physics, ray sensors and patterns. None: the defaults of the physics.
    """
    entity = entity_cfg.build()
    if not entity.is_articulated:
        return []
    subject = _subject_of_entity(name, entity, env_cfg)
    findings = find_faults(subject)
    if env_cfg is not None:
        findings += _missed_by_patterns(name, _pattern_joints(subject), env_cfg)
    return findings


def _subject_of_entity(name: str, entity: Entity, env_cfg: ManagerBasedRlEnvCfg | None) -> Subject:
    from mjlab.sensor import RayCastSensorCfg
    from mjlab.sim import MujocoCfg

    spec, place = entity.spec, f"scene.entities[{name!r}]"
    unnamed = frozenset(name_elements(spec))
    physics = MujocoCfg() if env_cfg is None else env_cfg.sim.mujoco
    options: Any = SimpleNamespace(opt=spec.option)
    physics.apply(options)
    model = entity.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    stiffness, gain_places = servo_stiffness(model), {}
    for index, actuator in enumerate(entity.actuators):
        kp = getattr(actuator.cfg, "stiffness", None)
        for joint in actuator.target_names:
            gain_places[joint] = f"{place}.articulation.actuators[{index}]"
            if kp is not None:
                stiffness[joint] = kp
    sensors = () if env_cfg is None else env_cfg.scene.sensors
    groups = [
        range(6) if sensor.include_geom_groups is None else sensor.include_geom_groups
        for sensor in sensors
        if isinstance(sensor, RayCastSensorCfg)
    ]
    return Subject(
        spec,
        model,
        data,
        pose="init_state",
        pose_place=f"{place}.init_state",
        stiffness=stiffness,
        effort=effort_limits(model),
        driven=driven_joints(model),
        lines=find_source(entity.cfg.spec_fn()),
        unnamed=unnamed,
        gain_places=gain_places,
        ray_groups=tuple({group for own in groups for group in own}),
    )


# Patterns.


def _pattern_joints(subject: Subject) -> list[str]:
    """Return the joints that patterns should match: those with an actuator, without fingers.

    A task may well leave the gripper alone.
    """
    fingers = {subject.model.joint(j).name for j in finger_joints(subject.model)}
    return [name for name in subject.joint_pos if name in subject.driven - fingers]


def _missed_by_patterns(
    name: str, driven: list[str], env_cfg: ManagerBasedRlEnvCfg
) -> Iterator[Finding]:
    """Yield findings of actions and observations that leave out joints with an actuator."""
    actions = {
        term_name: term
        for term_name, term in env_cfg.actions.items()
        if term is not None and getattr(term, "entity_name", None) == name
    }
    commanded = [
        _matches(getattr(term, "actuator_names", None), driven) for term in actions.values()
    ]
    if actions and None not in commanded:
        yield from missed_joints(
            f"actions ({', '.join(actions)})",
            [joint for joints in commanded for joint in joints or ()],
            driven,
            "The policy does not command them: they hold their default position.",
        )
    for term_name, term in actions.items():
        scale, own = (
            getattr(term, "scale", None),
            _matches(getattr(term, "actuator_names", None), driven),
        )
        if isinstance(scale, dict) and own:
            yield from missed_joints(
                f"actions[{term_name!r}].scale",
                _matches(list(scale), own) or [],
                own,
                "Their scale is 1: actions move them several times as far as the other joints.",
            )
    for group_name, group in env_cfg.observations.items():
        observed = [
            _observed(name, term, driven)
            for term in (group.terms if group else {}).values()
            if term
        ]
        found = [joint for joints in observed for joint in joints]
        if found:
            yield from missed_joints(
                f"observations[{group_name!r}]",
                found,
                driven,
                "The policy does not see their positions or velocities.",
            )


def _observed(entity: str, term: Any, joints: list[str]) -> list[str]:
    """Return the joints that an observation term reads; none unless its function is of joints."""
    from mjlab.managers import SceneEntityCfg

    if "joint" not in getattr(term.func, "__name__", ""):
        return []
    selections = [value for value in term.params.values() if isinstance(value, SceneEntityCfg)]
    own = [one for one in selections if one.name == entity]
    if selections and not own:
        return []
    patterns = own[0].joint_names if own else None
    return joints if patterns is None else _matches(patterns, joints) or []


def _matches(patterns: Any, names: list[str]) -> list[str] | None:
    """Return the names that a pattern, or one of several, matches; None without patterns."""
    if patterns is None:
        return None
    compiled = [
        compile_pattern(one) for one in ([patterns] if isinstance(patterns, str) else patterns)
    ]
    return [name for name in names if any(pattern.fullmatch(name) for pattern in compiled)]
