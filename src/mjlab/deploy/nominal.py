"""Nominal environment: the evaluated task without what differs from episode to episode.

No randomization, no noise, no pushes, no delays: a robot brings its own. Starts are tilted, turned and
bent, and commands change every second, because an upright robot shows no wrong frame.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from mjlab.managers import EventTermCfg
from mjlab.utils.lab_api.math import quat_from_euler_xyz, quat_mul

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

TILT = 0.3
"""Tilt of the root at the starts (rad)."""
_TURN = math.radians(100.0)
_LIFT = 0.05
_BEND, _SPEED = 0.1, 0.5
_COMMAND_S = 1.0
_NEVER = (1e9, 1e9)
_TERRAIN_CELLS = 3
# Commands that change without moving an object.
_CHANGING = ("UniformVelocityCommandCfg", "UniformPoseCommandCfg")


@dataclass
class Nominal:
    """Settings of the evaluated task that the nominal environment lacks."""

    noise: dict[tuple[str, str], Any] = field(default_factory=dict)
    """Noise by (group, term)."""
    delays: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)
    """Shortest and longest delay of observations by (group, term), in control steps."""
    actuator_delays: dict[tuple[str, tuple[str, ...]], tuple[int, int]] = field(
        default_factory=dict
    )
    """Shortest and longest delay by entity and name patterns of the actuators, in physics steps."""
    resampling: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Range of the time until a command is resampled, by command (s)."""
    action_clip: float | None = None
    """Bound on raw actions."""


def nominal_cfg(
    evaluated: ManagerBasedRlEnvCfg, action_clip: float | None = None
) -> tuple[ManagerBasedRlEnvCfg, Nominal]:
    """Return the nominal config of one environment, and the settings that it lacks.

    Generated terrain has few cells: a scene of all of them would take minutes to load.
    """
    cfg, lacks = copy.deepcopy(evaluated), Nominal(action_clip=action_clip)
    cfg.scene.num_envs, cfg.auto_reset, cfg.sim.engine = 1, False, "native"
    terrain = cfg.scene.terrain
    if terrain is not None and terrain.terrain_generator is not None:
        generator = terrain.terrain_generator
        generator.num_rows = min(generator.num_rows, _TERRAIN_CELLS)
        generator.num_cols = min(generator.num_cols, _TERRAIN_CELLS)
    for group_name, group in cfg.observations.items():
        for name, term in (group.terms if group is not None else {}).items():
            if term is None:
                continue
            if group.enable_corruption and term.noise is not None:
                lacks.noise[group_name, name] = term.noise
            if term.delay_max_lag > 0:
                lacks.delays[group_name, name] = (term.delay_min_lag, term.delay_max_lag)
            term.delay_min_lag = term.delay_max_lag = 0
        if group is not None:
            group.enable_corruption = False
    for entity_name, entity in cfg.scene.entities.items():
        _without_delays(entity_name, entity, lacks)
    cfg.events = {
        name: event
        for name, event in cfg.events.items()
        if event is not None and event.mode == "reset" and not _randomizes(event)
    }
    cfg.events["deployment_start"] = EventTermCfg(func=OddStart, mode="reset")
    for name, command in cfg.commands.items():
        if command is not None:
            low, high = command.resampling_time_range
            lacks.resampling[name] = (float(low), float(high))
            _command_of_trace(command)
    return cfg, lacks


def robot_of(cfg: ManagerBasedRlEnvCfg) -> str:
    """Return the entity that the actions drive: "robot" if it is one of them."""
    names = [action.entity_name for action in cfg.actions.values() if action is not None]
    return "robot" if "robot" in names or not names else names[0]


def _without_delays(entity_name: str, entity: Any, lacks: Nominal) -> None:
    """Remove the delays of the actuators of an entity config, in place."""
    articulation = entity.articulation
    if articulation is None:
        return
    actuators = []
    for actuator in articulation.actuators:
        if actuator.delay_max_lag > 0:
            pattern = tuple(actuator.target_names_expr)
            lags = (actuator.delay_min_lag, actuator.delay_max_lag)
            lacks.actuator_delays[entity_name, pattern] = lags
            actuator = dataclasses.replace(actuator, delay_min_lag=0, delay_max_lag=0)
        actuators.append(actuator)
    articulation.actuators = tuple(actuators)


def _randomizes(event: EventTermCfg) -> bool:
    return getattr(event.func, "__module__", "").startswith("mjlab.envs.mdp.dr")


def _command_of_trace(command: Any) -> None:
    """Let a command config change often, start where a robot starts, and move no object, in place."""
    changes = any(kind.__name__ in _CHANGING for kind in type(command).__mro__)
    command.resampling_time_range = (_COMMAND_S, _COMMAND_S) if changes else _NEVER
    # Attributes of gait clocks, and of motions.
    if hasattr(command, "starts"):
        command.starts = ((command.starts or (0.0,))[0],)
    if hasattr(command, "sampling_mode"):
        command.sampling_mode = "start"


class OddStart:
    """Reset event that bends the joints of the actions and, with a floating base, turns, tilts and
    lifts the root. Other joints are held where they start, at their defaults.

    Each episode turns by 100 degrees more, and tilts about another axis.
    """

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRlEnv) -> None:
        self._robot = robot_of(env.cfg)
        self._episode = 0

    def __call__(self, env: ManagerBasedRlEnv, env_ids: torch.Tensor | None) -> None:
        """Write root pose and joint state of `env_ids`."""
        entity = env.scene[self._robot]
        data, ids = entity.data, slice(None) if env_ids is None else env_ids
        angle = torch.tensor(self._episode * _TURN)
        self._episode += 1
        shape = data.default_joint_pos[ids].shape
        names = {
            name
            for term in map(env.action_manager.get_term, env.action_manager.active_terms)
            for name in getattr(term, "target_names", ())
        }
        acted = torch.tensor([float(name in names) for name in entity.joint_names])
        pos = data.default_joint_pos[ids] + _BEND * acted * (2.0 * torch.rand(shape) - 1.0)
        limits = data.soft_joint_pos_limits[ids]
        pos = pos.clamp(limits[..., 0], limits[..., 1])
        vel = _SPEED * (2.0 * torch.rand(shape) - 1.0)
        entity.write_joint_state_to_sim(pos, vel, env_ids=env_ids)
        if entity.is_fixed_base:
            return
        pose = env.sim.data.qpos[ids][:, entity.indexing.free_joint_q_adr.long()].clone()
        pose[:, 2] += _LIFT
        tilt = quat_from_euler_xyz(TILT * torch.cos(angle), TILT * torch.sin(angle), angle)
        pose[:, 3:] = quat_mul(tilt.expand_as(pose[:, 3:]), pose[:, 3:])
        entity.write_root_link_pose_to_sim(pose, env_ids=env_ids)
