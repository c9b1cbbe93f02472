"""Contract: everything that a program needs to run a policy, as one dictionary for JSON.

`docs/reference/contract.md` describes the layout. `SCHEMA` and `VERSION` identify it: keys are added within
a version, and a program of version 1 reads any file of version 1.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.actuator import IdealPdActuator
from mjlab.actuator.actuator import DirectActuator
from mjlab.deploy.commands import command_entry
from mjlab.deploy.measurements import (
    Measurement,
    Subject,
    joint_pos,
    joint_vel,
    name_of,
    plain,
    root_quat,
    scene_joints,
    shape_of,
)
from mjlab.deploy.nominal import Nominal, robot_of
from mjlab.deploy.terms import Term, describe, unmeasured
from mjlab.envs.mdp.actions import (
    BinaryJointPositionAction,
    JointEffortAction,
    JointPositionAction,
    JointVelocityAction,
    RelativeJointPositionAction,
)
from mjlab.rl.exporter_utils import action_limit, joint_actuators, joint_gains, shortest
from mjlab.utils.lab_api.string import resolve_matching_names_values

if TYPE_CHECKING:
    from mjlab.actuator import Actuator
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

SCHEMA = "mjlab-contract"
VERSION = 1
_ACTIONS: dict[type, str] = {
    JointPositionAction: "joint_position",
    JointVelocityAction: "joint_velocity",
    JointEffortAction: "joint_effort",
    RelativeJointPositionAction: "relative_joint_position",
    BinaryJointPositionAction: "binary_joint_position",
}
# Limits that a robot's program should replace by those of its motors.
_HINGE_SPEED, _SLIDE_SPEED = 30.0, 5.0
_TILT = 1.2
_MAX_AGE_STEPS = 5


class Contract:
    """Contract of a policy in an environment.

    Attributes:
        subject: Environment and robot.
        nominal: Settings that the environment lacks.
        terms: Formula of each term, by (input, term).
        measurements: All measurements by name.
        groups: Observation groups of each network input.
    """

    def __init__(self, env: ManagerBasedRlEnv, policy: Path, nominal: Nominal) -> None:
        """Describe all terms.

        Args:
            env: Environment as evaluated, without randomization.
            policy: ONNX file.
            nominal: Settings that `env` lacks, because it is nominal.

        Raises:
            ValueError: actions drive two entities, or terms of an input share a name.
        """
        self.subject = Subject(env, robot_of(env.cfg))
        _check_entity(env, self.subject.robot)
        self.policy, self.nominal = policy, nominal
        self.inputs, self.groups = _network_inputs(policy)
        self.terms: dict[tuple[str, str], Term] = {}
        self.measurements: dict[str, Measurement] = {}
        manager = env.observation_manager
        for name, groups in self.groups.items():
            for group in groups:
                for term in manager.active_terms[group]:
                    if (name, term) in self.terms:
                        raise ValueError(
                            f"Observation term {term!r}: expected it in one of the groups "
                            f"{', '.join(groups)}, got it in several; rename it in {group!r}."
                        )
                    found = describe(self.subject, term, manager.get_term_cfg(group, term))
                    found = self._with_own_names(term, found)
                    self.terms[name, term] = found
                    self._add(*(one for one in found.inputs if isinstance(one, Measurement)))
        robot = self.subject.robot
        # Needed for damping, hand-over and tilt, also where the policy does not observe them.
        self._add(joint_pos(self.subject, robot), joint_vel(self.subject, robot))
        if not self.subject.entity.is_fixed_base:
            self._add(root_quat(self.subject, robot))

    def _with_own_names(self, name: str, term: Term) -> Term:
        """Return the term called `name`; values named as another's, such as a second scan by one
        sensor, are named after the term."""
        inputs = tuple(
            dataclasses.replace(one, name=f"term/{name}")
            if isinstance(one, Measurement) and one.term is not None and self._is_taken(one)
            else one
            for one in term.inputs
        )
        return dataclasses.replace(term, inputs=inputs)

    def _is_taken(self, measurement: Measurement) -> bool:
        """Return True if the name is that of a measurement with another source."""
        known = self.measurements.get(measurement.name)
        return known is not None and known.source != measurement.source

    def _add(self, *measurements: Measurement) -> None:
        for measurement in measurements:
            if self._is_taken(measurement):
                known = self.measurements[measurement.name].source
                raise ValueError(
                    f"Measurement {measurement.name!r}: expected one source, got {known} and "
                    f"{measurement.source}; rename the sensor or the observation term."
                )
            self.measurements.setdefault(measurement.name, measurement)

    @property
    def _clip(self) -> float | None:
        """Bound of the actions; None if there is none, or the network has it."""
        clip = self.nominal.action_clip
        # The network's is in single precision.
        has_own = clip is None or action_limit(self.policy) <= np.float32(clip)
        return None if has_own else clip

    def as_dict(self, source: Mapping[str, Any], golden: Mapping[str, Any]) -> dict[str, Any]:
        """Return the contract, with the origin of the policy and a summary of the golden trace."""
        env, entity = self.subject.env, self.subject.entity
        observations = [self._input(name) for name in self.groups]
        actions = _actions(env)
        joints = _joints(self.subject)
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "source": dict(source),
            "rates": {
                "physics_dt": env.physics_dt,
                "decimation": env.cfg.decimation,
                "step_dt": env.step_dt,
            },
            "robot": {
                "entity": self.subject.robot,
                "root_body": self.subject.model.body(int(entity.indexing.root_body_id)).name,
                "is_floating": not entity.is_fixed_base,
                "initial_pos": list(entity.cfg.init_state.pos),
                "initial_quat": list(entity.cfg.init_state.rot),
                "initial_height": float(entity.cfg.init_state.pos[2]),
            },
            "joints": joints,
            "actuators": _actuators(env, self.nominal),
            "policy": {
                "file": "policy.onnx",
                "inputs": self.inputs,
                "output": "actions",
                "size": env.action_manager.total_action_dim,
                "clip": self._clip,
            },
            "observations": observations,
            "commands": [
                {
                    **command_entry(self.subject, name),
                    "resampling_s": list(self.nominal.resampling[name]),
                }
                for name in env.command_manager.active_terms
            ],
            "measurements": [one.entry() for one in self.measurements.values()],
            "actions": actions,
            "limits": {**_limits(self.subject, actions, joints), "tilt_from": self._tilt_from()},
            "terminations": _terminations(env),
            "episode_length_s": env.max_episode_length_s,
            "unmeasured": self._unmeasured(),
            "golden": dict(golden),
        }

    def _input(self, name: str) -> dict[str, Any]:
        """Return the entry of one network input, with its terms."""
        manager = self.subject.env.observation_manager
        shape = next(one["shape"] for one in self.inputs if one["name"] == name)[1:]
        (first, *_), position, entries = self.groups[name], 0, []
        axis = 0
        if len(shape) > 1:
            cfg = manager.cfg[first]
            dim = -1 if cfg is None else cfg.concatenate_dim
            axis = dim if dim >= 0 else len(shape) + dim
        for group in self.groups[name]:
            dims = manager.group_obs_term_dim[group]
            for term, dim in zip(manager.active_terms[group], dims, strict=True):
                size = int(np.prod(dim)) if len(shape) == 1 else dim[axis]
                entry = self._term(name, group, term)
                entries.append({**entry, "start": position, "stop": position + size})
                position += size
        return {"input": name, "shape": shape, "axis": axis, "terms": entries}

    def _term(self, input_name: str, group: str, name: str) -> dict[str, Any]:
        term = self.terms[input_name, name]
        cfg = self.subject.env.observation_manager.get_term_cfg(group, name)
        shape = list(shape_of(self.subject.env, cfg))
        return {
            "name": name,
            "kind": term.kind,
            "inputs": [one if isinstance(one, str) else one.name for one in term.inputs],
            "columns": term.columns,
            "offset": term.offset,
            "factor": term.factor,
            "shape": shape,
            "size": int(np.prod(shape)),
            "unit": term.unit,
            "frame": term.frame,
            "function": name_of(cfg.func),
            "params": {key: plain(value) for key, value in cfg.params.items()},
            "noise": plain(self.nominal.noise.get((group, name))),
            "clip": _bounds(cfg.clip),
            "scale": None if cfg.scale is None else np.ravel(shortest(cfg.scale)).tolist(),
            "delay": list(self.nominal.delays.get((group, name), (0, 0))),
            "history": {
                "length": cfg.history_length,
                "order": "oldest_first",
                "start": "first_value",
            },
        }

    def _tilt_from(self) -> str | None:
        """Return the orientation of the robot that its program measures: of the root if possible."""
        root = root_quat(self.subject, self.subject.robot).name
        bodies = f"{self.subject.robot}/"
        quats = [
            name
            for name, one in self.measurements.items()
            if one.source["kind"] == "body_quat" and one.source["body"].startswith(bodies)
        ]
        return root if root in quats else next(iter(quats), None)

    def _unmeasured(self) -> list[dict[str, str]]:
        return [
            {"term": name, "measurement": one.name, "why": one.why}
            for (_, name), term in self.terms.items()
            for one in unmeasured(term)
        ]


# Policy.


def _network_inputs(policy: Path) -> tuple[list[dict[str, Any]], dict[str, list[str]]]:
    """Return the entries of the network's inputs, and the observation groups of each observation."""
    import onnx

    model = onnx.load(str(policy))
    metadata = {item.key: item.value for item in model.metadata_props}
    outputs = {item.name for item in model.graph.output}
    entries, groups = [], {}
    for item in model.graph.input:
        shape = [dim.dim_value or 1 for dim in item.type.tensor_type.shape.dim]
        entry: dict[str, Any] = {"name": item.name, "shape": shape, "kind": "observation"}
        if item.name.endswith("_in") and f"{item.name.removesuffix('_in')}_out" in outputs:
            entry |= {"kind": "memory", "output": f"{item.name.removesuffix('_in')}_out"}
        elif item.name == "time_step":
            entry["kind"] = "frame"
        elif len(shape) == 2:
            groups[item.name] = (metadata.get("observation_group") or "actor").split(",")
        else:
            groups[item.name] = [item.name]
        entries.append(entry)
    return entries, groups


# Joints and actuators.


def _joints(subject: Subject) -> list[dict[str, Any]]:
    entity, model = subject.entity, subject.model
    gains, limits, speeds = _gains(entity, model), _efforts(entity, model), _speeds(entity)
    data = entity.data
    entries = []
    for k, (name, full) in enumerate(
        zip(entity.joint_names, scene_joints(subject, entity), strict=True)
    ):
        joint = model.joint(full)
        dof = int(joint.dofadr[0])
        is_slide = int(joint.type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
        kp, kd = gains.get(name, (0.0, 0.0))
        entries.append(
            {
                "name": name,
                "scene_name": full,
                "type": "slide" if is_slide else "hinge",
                "unit": "m" if is_slide else "rad",
                "default_pos": shortest(data.default_joint_pos[0, k]),
                "default_vel": shortest(data.default_joint_vel[0, k]),
                "range": joint.range.tolist() if joint.limited[0] else None,
                "effort": limits.get(name),
                "speed": speeds.get(name),
                "kp": kp,
                "kd": kd,
                "armature": float(model.dof_armature[dof]),
                "damping": float(np.ravel(model.dof_damping[dof])[0]),
                "frictionloss": float(model.dof_frictionloss[dof]),
                "is_actuated": name in gains,
            }
        )
    return entries


def _gears(entity: Entity, model: mujoco.MjModel) -> dict[str, float]:
    """Return the gear of each actuated joint: motion of the actuator per motion of the joint."""
    return {
        name: float(model.actuator_gear[element, 0]) for name, _, element in joint_actuators(entity)
    }


def _gains(entity: Entity, model: mujoco.MjModel) -> dict[str, tuple[float, float]]:
    """Return kp and kd of each actuated joint, at the joint: those of the actuator times gear squared."""
    gears = _gears(entity, model)
    return {
        name: (kp * gears[name] ** 2, kd * gears[name] ** 2)
        for name, (kp, kd) in joint_gains(entity, model).items()
    }


def _efforts(entity: Entity, model: mujoco.MjModel) -> dict[str, float | None]:
    """Return the largest effort of each actuated joint; None without a limit."""
    found: dict[str, float | None] = {}
    for actuator in entity.actuators:
        elements = actuator.global_element_ids.tolist()
        for k, name in enumerate(actuator.target_names):
            element = elements[k * len(elements) // len(actuator.target_names)]
            found[name] = _effort(actuator, element, model)
    return found


def _speeds(entity: Entity) -> dict[str, float]:
    """Return the largest speed of the motor of each joint, of actuators whose config has one."""
    limits = {
        name: getattr(actuator.cfg, "velocity_limit", None)
        for actuator in entity.actuators
        for name in actuator.target_names
    }
    return {name: float(limit) for name, limit in limits.items() if isinstance(limit, int | float)}


def _effort(actuator: Actuator, element: int, model: mujoco.MjModel) -> float | None:
    limit = getattr(actuator.cfg, "effort_limit", None)
    gear = abs(float(model.actuator_gear[element, 0]))
    joint = int(model.actuator_trnid[element, 0])
    # Limits of configs with a gear are before it.
    factor = abs(getattr(actuator.cfg, "gear", 1.0))
    bounds = [factor * float(limit)] if isinstance(limit, int | float) else []
    if isinstance(actuator, DirectActuator) or not bounds:
        if model.actuator_forcelimited[element]:
            bounds.append(gear * float(np.abs(model.actuator_forcerange[element]).max()))
        is_motor = int(model.actuator_biastype[element]) == int(mujoco.mjtBias.mjBIAS_NONE)
        if is_motor and model.actuator_ctrllimited[element]:
            bounds.append(gear * float(np.abs(model.actuator_ctrlrange[element]).max()))
    if model.jnt_actfrclimited[joint]:
        bounds.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
    limit = min(bounds, default=math.inf)
    return limit if math.isfinite(limit) else None


def _actuators(env: ManagerBasedRlEnv, nominal: Nominal) -> list[dict[str, Any]]:
    """Return one entry for each control, in the order of `ctrl`."""
    model = env.sim.mj_model
    entries: dict[int, dict[str, Any]] = {}
    for entity_name, entity in env.scene.entities.items():
        gains = _gains(entity, model)
        for actuator in entity.actuators:
            laws = _laws(actuator)
            names, columns = actuator.target_names, actuator.global_ctrl_ids.tolist()
            pattern = tuple(actuator.cfg.target_names_expr)
            delay = nominal.actuator_delays.get((entity_name, pattern), (0, 0))
            elements = actuator.global_element_ids.tolist()
            for k, column in enumerate(columns):
                name = names[k % len(names)]
                kp, kd = gains.get(name, (0.0, 0.0))
                element = elements[k % len(elements)]
                is_joint = name in entity.joint_names
                entries[column] = {
                    "name": model.actuator(element).name,
                    "joint": f"{entity_name}/{name}" if is_joint else None,
                    "law": laws[k // len(names)] if k // len(names) < len(laws) else "custom",
                    "kp": kp,
                    "kd": kd,
                    "effort": _effort(actuator, element, model),
                    "gear": float(model.actuator_gear[element, 0]),
                    "delay": list(delay),
                }
    unknown = {"joint": None, "law": "custom", "kp": 0.0, "kd": 0.0, "effort": None, "gear": 1.0}
    return [
        entries.get(k, {"name": f"ctrl {k}", **unknown, "delay": [0, 0]})
        for k in range(env.sim.data.ctrl.shape[1])
    ]


def _laws(actuator: Actuator) -> tuple[str, ...]:
    """Return the law of the controls of an actuator: the first for all its targets, and so on."""
    if isinstance(actuator, DirectActuator):
        return tuple(actuator.command_fields)
    return ("pd",) if type(actuator) is IdealPdActuator else ()


# Actions and limits.


def _check_entity(env: ManagerBasedRlEnv, robot: str) -> None:
    for name in env.action_manager.active_terms:
        entity = env.action_manager.get_term(name).cfg.entity_name
        if entity != robot:
            raise ValueError(
                f"Action {name!r} entity_name: expected {robot!r} for all actions of a deployed policy, "
                f"got {entity!r}; use one entity with the joints of both."
            )


def _actions(env: ManagerBasedRlEnv) -> list[dict[str, Any]]:
    manager, start, target, entries = env.action_manager, 0, 0, []
    for name in manager.active_terms:
        term: Any = manager.get_term(name)
        factors = joint_factors(env, term)
        kind = _kind(term, factors)
        entry: dict[str, Any] = {
            "name": name,
            "kind": kind,
            "entity": term.cfg.entity_name,
            "joints": list(getattr(term, "target_names", ())),
            "start": start,
            "stop": start + term.action_dim,
            "target_start": target,
            "target_stop": target + len(getattr(term, "target_names", ())),
        }
        if kind == "binary_joint_position":
            cfg = term.cfg
            for key, table in (("open", cfg.open_command_expr), ("closed", cfg.close_command_expr)):
                targets = resolve_matching_names_values(table, term.target_names)[2]
                entry[key] = _at_joints(targets, factors)
        elif kind == "custom":
            entry["class"] = name_of(type(term))
        else:
            entry |= {
                "scale": _at_joints(_each(term.scale, term.action_dim), factors),
                "offset": _at_joints(_each(term.offset, term.action_dim), factors),
                "clip": _clips(term, factors),
            }
        entries.append(entry)
        start, target = entry["stop"], entry["target_stop"]
    return entries


def _kind(term: Any, factors: Sequence[float]) -> str:
    """Return the kind of an action, `custom` for one that the runtime does not know."""
    kind = _ACTIONS.get(type(term), "custom")
    if kind != "relative_joint_position":
        return kind
    # No program of a robot reads positions between the steps of the policy.
    is_known = not term.cfg.read_every_substep and set(factors) == {1.0}
    return kind if is_known else "custom"


def joint_factors(env: ManagerBasedRlEnv, term: Any) -> list[float]:
    """Return the motion of each joint, or the torque, per unit of the controls that an action sets.

    1 but for actuators with a gear g, which follow g q: 1 / g for positions and velocities, g for efforts.
    """
    entity: Any = env.scene[term.cfg.entity_name]
    gears = _gears(entity, env.sim.mj_model)
    power = 1 if _ACTIONS.get(type(term)) == "joint_effort" else -1
    return [gears.get(name, 1.0) ** power for name in getattr(term, "target_names", ())]


def _at_joints(values: Sequence[float], factors: Sequence[float]) -> list[float]:
    return [value * factor for value, factor in zip(values, factors, strict=True)]


def _each(value: Any, count: int) -> list[float]:
    return [float(value)] * count if isinstance(value, int | float) else shortest(value[0])


def _clips(term: Any, factors: Sequence[float]) -> list[list[float | None]] | None:
    if term.cfg.clip is None:
        return None
    bounds: list[Any] = [[None, None] for _ in term.target_names]
    found = resolve_matching_names_values(term.cfg.clip, term.target_names)
    for index, pair in zip(found[0], found[2], strict=True):
        bounds[index] = _bounds(sorted(factors[index] * bound for bound in pair)) or [None, None]
    return bounds


def _limits(
    subject: Subject, actions: Sequence[Mapping[str, Any]], joints: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return limits that act only where the robot would not follow anyway.

    Beyond the joint's range by effort / kp, a position target saturates the motor at any joint
    position; a change of twice effort / kp takes it from one end of its torque to the other.
    """
    by_name = {joint["name"]: joint for joint in joints}
    low, high, step = [], [], []
    for action in actions:
        for name in action["joints"]:
            bounds = _target_bounds(action["kind"], by_name.get(name))
            low.append(bounds[0])
            high.append(bounds[1])
            step.append(bounds[2])
    fell = [
        term["params"]["limit_angle"]
        for term in _terminations(subject.env)
        if "limit_angle" in term["params"]
    ]
    has_tilt = not subject.entity.is_fixed_base
    return {
        "target_low": low,
        "target_high": high,
        "target_step": step,
        "joint_speed": [
            joint["speed"] or (_SLIDE_SPEED if joint["type"] == "slide" else _HINGE_SPEED)
            for joint in joints
        ],
        "tilt": min([_TILT, *fell]) if has_tilt else None,
        "max_age": shortest(_MAX_AGE_STEPS * subject.env.step_dt),
    }


def _target_bounds(kind: str, joint: Mapping[str, Any] | None) -> tuple[float, float, float]:
    """Return lowest and highest target of a joint, and the largest change in a control step."""
    is_slide = joint is not None and joint["type"] == "slide"
    speed = _SLIDE_SPEED if is_slide else _HINGE_SPEED
    effort = None if joint is None else joint["effort"]
    if kind == "joint_effort":
        effort = 1000.0 if effort is None else effort
        return -effort, effort, 2 * effort
    if kind == "joint_velocity" or joint is None:
        return -speed, speed, 2 * speed
    widest = 1.0 if is_slide else 4 * math.pi
    low, high = joint["range"] or (-widest, widest)
    saturating = widest
    if effort is not None and joint["kp"] > 0.0:
        saturating = effort / joint["kp"]
    return low - saturating, high + saturating, 2 * saturating


# Ends, and conversion.


def _terminations(env: ManagerBasedRlEnv) -> list[dict[str, Any]]:
    manager = env.termination_manager
    return [
        {
            "name": name,
            "function": name_of(cfg.func),
            "params": {key: plain(value) for key, value in cfg.params.items()},
            "is_time_out": cfg.time_out,
        }
        for name in manager.active_terms
        for cfg in [manager.get_term_cfg(name)]
    ]


def _bounds(pair: Any) -> list[float | None] | None:
    values = [None if value is None else float(value) for value in pair or (None, None)]
    values = [None if value is None or math.isinf(value) else value for value in values]
    return None if values == [None, None] else values
