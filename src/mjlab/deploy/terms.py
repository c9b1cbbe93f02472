"""Observation terms as data: what each function computes, in the kinds of a contract.

`TERMS` has one row a function, by its name `module:function`. A row is a function of the subject and of the
term's config that returns a `Term`. Packages add rows for terms of their own:

    from mjlab.deploy.terms import TERMS, Term
    TERMS["my_package.mdp:wheel_speed"] = lambda subject, cfg: Term("reading", (joint_vel(subject, "robot"),))

A function without a row is `custom`: the contract names it, and the runtime asks for its formula.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.deploy import availability as av
from mjlab.deploy import measurements as m
from mjlab.deploy.availability import Reason
from mjlab.deploy.measurements import Measurement, Subject, name_of
from mjlab.deploy.nominal import robot_of
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.rl.exporter_utils import shortest
from mjlab.utils.tables import Table

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import ObservationTermCfg

Params = Mapping[str, Any]


@dataclass(frozen=True)
class Term:
    """Formula of an observation term, before clip and scale."""

    kind: str
    """Kind; the page of the contract has the formulas."""
    inputs: tuple[Measurement | str, ...] = ()
    """Measurements, and commands as `command/<name>` or `command/<name>/<part>`."""
    columns: list[int] | None = None
    """Components of the input that are used. None: all."""
    offset: list[float] | None = None
    """Offset subtracted from the input."""
    factor: float | None = None
    """Factor of the input."""
    unit: str = ""
    """Unit of the value."""
    frame: str = ""
    """Frame of the value."""


def describe(subject: Subject, name: str, cfg: ObservationTermCfg) -> Term:
    """Return the formula of the term called `name`, of kind `custom` if no row has its function."""
    row = TERMS.get(name_of(cfg.func))
    if row is not None:
        return row(subject, cfg)
    function = name_of(cfg.func)
    reason = _NAMES.get(function.rpartition(":")[2], ("unknown", f"value of {function}"))
    return Term("custom", (m.traced(subject, f"term/{name}", "", reason, cfg),))


def unmeasured(term: Term) -> list[Measurement]:
    """Return the measurements of a term that a robot lacks."""
    found = [one for one in term.inputs if isinstance(one, Measurement)]
    return [one for one in found if one.availability in av.UNMEASURED]


def unmeasured_table(env: ManagerBasedRlEnv) -> Table:
    """Return the observation terms that a robot cannot measure: group, term and reason."""
    manager, subject = env.observation_manager, Subject(env, robot_of(env.cfg))
    rows = []
    for group, terms in manager.active_terms.items():
        for name in terms:
            lacking = unmeasured(describe(subject, name, manager.get_term_cfg(group, name)))
            if lacking:
                rows.append((group, name, "; ".join(dict.fromkeys(one.why for one in lacking))))
    return Table("unmeasured", ("group", "term", "reason"), rows, note="not measured by a robot")


Row = Callable[[Subject, "ObservationTermCfg"], Term]


# Selections.


def _asset(params: Params) -> SceneEntityCfg:
    return params.get("asset_cfg") or SceneEntityCfg("robot")


def _joints(subject: Subject, params: Params) -> tuple[str, list[int] | None, Any]:
    """Return entity name, selected joints (None: all), and their index."""
    cfg = _asset(params)
    index = columns_of(cfg, "joint", subject.env)
    count = subject.env.scene[cfg.name].num_joints
    chosen = torch.arange(count)[index.cpu() if isinstance(index, torch.Tensor) else index].tolist()
    return cfg.name, None if chosen == list(range(count)) else chosen, index


def _site(subject: Subject, params: Params) -> tuple[str, str]:
    cfg = _asset(params)
    entity = subject.env.scene[cfg.name]
    index = columns_of(cfg, "site", subject.env)
    names = torch.arange(len(entity.site_names))[index].tolist()
    return cfg.name, entity.site_names[names[0]]


# Rows.


def _joint_pos(subject: Subject, cfg: ObservationTermCfg) -> Term:
    entity, columns, index = _joints(subject, cfg.params)
    data = subject.env.scene[entity].data
    value = m.joint_pos(subject, entity)
    default = shortest(data.default_joint_pos[0, index])
    return Term("reading", (value,), columns, default, unit=value.unit)


def _joint_vel(subject: Subject, cfg: ObservationTermCfg) -> Term:
    entity, columns, index = _joints(subject, cfg.params)
    data = subject.env.scene[entity].data
    value = m.joint_vel(subject, entity)
    default = shortest(data.default_joint_vel[0, index])
    return Term("reading", (value,), columns, default if any(default) else None, unit=value.unit)


def _joint_cos_sin(subject: Subject, cfg: ObservationTermCfg) -> Term:
    entity, columns, _ = _joints(subject, cfg.params)
    return Term("cos_sin", (m.joint_pos(subject, entity),), columns)


def _sensor(subject: Subject, cfg: ObservationTermCfg, factor: float | None = None) -> Term:
    value = m.sensor(subject, cfg.params["sensor_name"])
    return Term("reading", (value,), factor=factor, unit=value.unit, frame=value.frame)


def _of_root(make: Callable[[Subject, str], Measurement]) -> Row:
    def row(subject: Subject, cfg: ObservationTermCfg) -> Term:
        value = make(subject, _asset(cfg.params).name)
        return Term("reading", (value,), unit=value.unit, frame=value.frame)

    return row


def _gravity(subject: Subject, cfg: ObservationTermCfg) -> Term:
    return Term("gravity", (m.root_quat(subject, _asset(cfg.params).name),), frame="root")


def _last_action(subject: Subject, cfg: ObservationTermCfg) -> Term:
    name, manager = cfg.params.get("action_name"), subject.env.action_manager
    if name is None:
        return Term("last_action")
    start = sum(manager.action_term_dim[: manager.active_terms.index(name)])
    size = manager.get_term(name).action_dim
    return Term("last_action", columns=list(range(start, start + size)))


def _command(subject: Subject, cfg: ObservationTermCfg) -> Term:
    return Term("command", (f"command/{cfg.params['command_name']}",))


def _pose_error(subject: Subject, cfg: ObservationTermCfg) -> Term:
    name = cfg.params["command_name"]
    command: Any = subject.env.command_manager.get_term(name)
    pose = m.frame_pose_b(subject, command.cfg.entity_name, command.frame)
    return Term("pose_error", (*pose, f"command/{name}"), unit="m, rad", frame="root")


def _traced(unit: str, reason: Reason) -> Row:
    """Return the row of a term whose whole value is one measurement, named after sensor and function."""

    def row(subject: Subject, cfg: ObservationTermCfg) -> Term:
        quantity = name_of(cfg.func).rpartition(":")[2].removeprefix("camera_")
        name = f"{cfg.params['sensor_name']}_{quantity}"
        value = m.traced(subject, name, unit, reason, cfg)
        return Term("reading", (value,), unit=unit)

    return row


def _anchor(subject: Subject, params: Params) -> tuple[str, str, str]:
    name = params["command_name"]
    command: Any = subject.env.command_manager.get_term(name)
    return f"command/{name}", command.cfg.entity_name, command.cfg.anchor_body_name


def _anchor_pos(subject: Subject, cfg: ObservationTermCfg) -> Term:
    command, entity, body = _anchor(subject, cfg.params)
    place, quat = m.body_pos(subject, entity, body), m.body_quat(subject, entity, body)
    inputs = (f"{command}/anchor_pos", place, quat)
    return Term("position_in_frame", inputs, unit="m", frame=f"body {body}")


def _anchor_ori(subject: Subject, cfg: ObservationTermCfg) -> Term:
    command, entity, body = _anchor(subject, cfg.params)
    inputs = (f"{command}/anchor_quat", m.body_quat(subject, entity, body))
    return Term("orientation_in_frame", inputs, frame=f"body {body}")


def _hand_to_object(subject: Subject, cfg: ObservationTermCfg) -> Term:
    entity, site = _site(subject, cfg.params)
    inputs = (
        m.root_pos(subject, cfg.params["object_name"]),
        m.site_pos(subject, entity, site),
        m.root_quat(subject, entity),
    )
    return Term("position_in_frame", inputs, unit="m", frame="root")


def _object_to_goal(subject: Subject, cfg: ObservationTermCfg) -> Term:
    inputs = (
        f"command/{cfg.params['command_name']}",
        m.root_pos(subject, cfg.params["object_name"]),
        m.root_quat(subject, _asset(cfg.params).name),
    )
    return Term("position_in_frame", inputs, unit="m", frame="root")


def _hand_to_goal(subject: Subject, cfg: ObservationTermCfg) -> Term:
    entity, site = _site(subject, cfg.params)
    place, quat = m.site_pos(subject, entity, site), m.site_quat(subject, entity, site)
    inputs = (f"command/{cfg.params['command_name']}", place, quat)
    return Term("position_in_frame", inputs, unit="m", frame=f"site {site}")


def _hand_velocity(subject: Subject, cfg: ObservationTermCfg) -> Term:
    entity, site = _site(subject, cfg.params)
    inputs = (m.site_lin_vel_w(subject, entity, site), m.site_quat(subject, entity, site))
    return Term("vector_in_frame", inputs, unit="m/s", frame=f"site {site}")


_MDP = "mjlab.envs.mdp.observations"
_LIFT = "mjlab.tasks.manipulation.mdp.observations"
_TRACK = "mjlab.tasks.tracking.mdp.observations"
_WALK = "mjlab.tasks.velocity.mdp.observations"
TERMS: dict[str, Row] = {
    f"{_MDP}:base_lin_vel": _of_root(m.root_lin_vel_b),
    f"{_MDP}:base_ang_vel": _of_root(m.root_ang_vel_b),
    f"{_MDP}:projected_gravity": _gravity,
    f"{_MDP}:projected_gravity_from_sensor": lambda s, p: _sensor(s, p, -1.0),
    f"{_MDP}:joint_pos_rel": _joint_pos,
    f"{_MDP}:joint_vel_rel": _joint_vel,
    f"{_MDP}:last_action": _last_action,
    f"{_MDP}:generated_commands": _command,
    f"{_MDP}:builtin_sensor": _sensor,
    f"{_MDP}:height_scan": _traced("m", av.SCAN),
    "mjlab.envs.mdp.pose_command:pose_command_error": _pose_error,
    "mjlab.tasks.cartpole.cartpole_env_cfg:pole_angle_cos_sin": _joint_cos_sin,
    f"{_WALK}:foot_height": _traced("m", av.HEIGHT),
    f"{_WALK}:foot_air_time": _traced("s", av.CONTACT),
    f"{_WALK}:foot_contact": _traced("", av.CONTACT),
    f"{_WALK}:foot_contact_forces": _traced("", av.CONTACT),
    f"{_TRACK}:motion_anchor_pos_b": _anchor_pos,
    f"{_TRACK}:motion_anchor_ori_b": _anchor_ori,
    f"{_LIFT}:ee_to_object_distance": _hand_to_object,
    f"{_LIFT}:object_to_goal_distance": _object_to_goal,
    f"{_LIFT}:target_position": _hand_to_goal,
    f"{_LIFT}:ee_velocity": _hand_velocity,
    f"{_LIFT}:camera_rgb": _traced("", av.CAMERA),
    f"{_LIFT}:camera_depth": _traced("", av.CAMERA),
    f"{_LIFT}:camera_segmentation": _traced("", av.SEGMENTATION),
    f"{_LIFT}:camera_target_cube_mask": _traced("", av.SEGMENTATION),
}
"""Rows by `module:function`."""
_NAMES: dict[str, Reason] = {
    "base_lin_vel": av.VELOCITY,
    "root_lin_vel_b": av.VELOCITY,
    "root_lin_vel_w": av.VELOCITY,
    "base_pos_z": av.POSITION,
    "root_pos_w": av.POSITION,
    "height_scan": av.SCAN,
    "foot_height": av.HEIGHT,
    "foot_air_time": av.CONTACT,
    "foot_contact": av.CONTACT,
    "foot_contact_forces": av.CONTACT,
}
"""Availability by name of functions without a row: packages give functions of one meaning one name."""
