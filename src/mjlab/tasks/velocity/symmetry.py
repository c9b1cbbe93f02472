"""Mirror images of what a legged robot senses and does, so that PPO learns from both sides at once.

A robot whose left is made like its right can take the mirror image of each sample as one more
sample, which costs no physics (Mittal et al., "Symmetry Considerations for Learning Task Symmetric
Robot Policies", ICRA 2024). `mirror_left_right` is what `symmetry_cfg` of `RslRlPpoAlgorithmCfg`
names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
import torch

from mjlab.envs import mdp as envs_mdp
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.mirror import (
    DIRECTION,
    ROTATION,
    WITHOUT,
    Mirror,
    mirror_of_joints,
    other_side,
    partners,
)

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

_ROBOT = "robot"
_PLANAR_VELOCITY = (1.0, -1.0, -1.0)
_OF_SENSOR = {
    mujoco.mjtSensor.mjSENS_GYRO: ROTATION,
    mujoco.mjtSensor.mjSENS_VELOCIMETER: DIRECTION,
    mujoco.mjtSensor.mjSENS_ACCELEROMETER: DIRECTION,
}
# Metres, or parts of a unit vector, that rays and axes may be off.
_TOLERANCE = 1e-4


@dataclass(frozen=True)
class _Mirrors:
    """The mirrors of an environment's observation groups, by name, and of its actions."""

    groups: dict[str, Mirror]
    actions: Mirror


_known: WeakKeyDictionary[Any, _Mirrors] = WeakKeyDictionary()


def mirror_left_right(
    env: Any, obs: Any = None, actions: torch.Tensor | None = None
) -> tuple[Any, torch.Tensor | None]:
    """Append their mirror images to observations and actions.

    Args:
        env: The environments, wrapped or not.
        obs: Observation groups by name, each (N, numbers), as a TensorDict; or None.
        actions: (N, actions), or None.

    Returns:
        Both with 2 N rows, the given ones first.

    Raises:
        ValueError: the robot is not the same on both sides, or what a term is in the mirror is not
            known.
    """
    env = env.unwrapped
    mirrors = _known.get(env)
    if mirrors is None:
        mirrors = _known[env] = _build(env)
    if obs is not None:
        image = obs.clone()
        for group in set(image.keys()):
            image[group] = mirrors.groups[group](obs[group])
        obs = torch.cat([obs, image], dim=0)
    if actions is not None:
        actions = torch.cat([actions, mirrors.actions(actions)], dim=0)
    return obs, actions


def _build(env: ManagerBasedRlEnv) -> _Mirrors:
    manager = env.observation_manager
    groups = {}
    for group, names in manager.active_terms.items():
        if not manager.group_obs_concatenate[group]:
            raise ValueError(
                f"The observation group {group!r} has concatenate_terms=False, and mirror_left_right "
                f"takes groups that are one tensor. {WITHOUT}"
            )
        shapes = manager.group_obs_term_dim[group]
        terms = [
            _mirror_of_term(env, group, name, shape)
            for name, shape in zip(names, shapes, strict=True)
        ]
        groups[group] = Mirror.joined(terms)
    return _Mirrors(groups, _of_actions(env))


def _mirror_of_term(
    env: ManagerBasedRlEnv, group: str, name: str, shape: tuple[int, ...]
) -> Mirror:
    configs: Any = env.cfg.observations
    cfg = configs[group].terms[name]
    label = f"The observation {group}/{name}"
    kind = _KINDS.get(cfg.func)
    if kind is None:
        raise ValueError(
            f"{label}: mirror_left_right does not know what it is in the mirror. It knows "
            f"{', '.join(sorted(func.__name__ for func in _KINDS))}. Name a function of your own in "
            f"symmetry_cfg. {WITHOUT}"
        )
    clip = cfg.clip
    is_even = clip is None or clip[0] == -clip[1]
    if not isinstance(cfg.scale, int | float | None) or not is_even:
        raise ValueError(
            f"{label} has scale {cfg.scale!r} and clip {clip!r}; mirror_left_right takes one number "
            f"as scale, and a clip that is the same on both sides of 0. {WITHOUT}"
        )
    mirror = kind(env, cfg.params)
    if shape != (len(mirror),):
        raise ValueError(
            f"{label} has shape {shape} for each environment, and mirror_left_right expects "
            f"({len(mirror)},): the latest value, of everything that the term measures. {WITHOUT}"
        )
    return mirror


def _direction(*_: Any) -> Mirror:
    return Mirror(range(3), DIRECTION)


def _rotation(*_: Any) -> Mirror:
    return Mirror(range(3), ROTATION)


def _of_sensor(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a gyro or the like, which stands at a site turned as the root is."""
    name, model = params["sensor_name"], env.sim.mj_model
    found = model.sensor(name)
    signs = _OF_SENSOR.get(mujoco.mjtSensor(int(found.type.item())))
    if signs is None:
        raise ValueError(
            f"mirror_left_right knows gyros, velocimeters and accelerometers; sensor {name!r} is "
            f"none of these. {WITHOUT}"
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    root: Any = env.scene[_ROBOT]
    turned = data.site_xmat[int(found.objid.item())] - data.xmat[root.indexing.root_body_id]
    if np.abs(turned).max() > _TOLERANCE:
        raise ValueError(
            f"Sensor {name!r} is turned against the robot's root, so mirror_left_right does not know "
            f"which of its axes points to the left. {WITHOUT}"
        )
    return Mirror(range(3), signs)


def _of_command(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    term = env.command_manager.get_term(params["command_name"])
    if not isinstance(term, mdp.UniformVelocityCommand):
        raise ValueError(
            f"mirror_left_right knows velocity commands (UniformVelocityCommandCfg); "
            f"{params['command_name']!r} is a {type(term).__name__}. {WITHOUT}"
        )
    return Mirror(range(3), _PLANAR_VELOCITY)


def _of_joints(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    asset_cfg = params.get("asset_cfg")
    if asset_cfg is not None and asset_cfg.preserve_order:
        raise ValueError(
            f"mirror_left_right takes joints in the robot's own order, without preserve_order. {WITHOUT}"
        )
    return mirror_of_joints(
        env.sim.mj_model, env.scene[_ROBOT if asset_cfg is None else asset_cfg.name]
    )


def _of_actions(env: ManagerBasedRlEnv, params: dict[str, Any] | None = None) -> Mirror:
    robot: Any = env.scene[_ROBOT]
    joints = mirror_of_joints(env.sim.mj_model, robot)
    manager = env.action_manager
    named = {name: manager.get_term(name) for name in manager.active_terms}
    (term, *others) = named.values()
    if others or not isinstance(term, envs_mdp.JointPositionAction):
        kinds = ", ".join(f"{name} ({type(term).__name__})" for name, term in named.items())
        raise ValueError(
            f"mirror_left_right knows one action term, of joint positions; there are: {kinds}. {WITHOUT}"
        )
    driven = [robot.joint_names.index(name) for name in term.target_names]
    across = joints.sources[driven].tolist()
    if set(across) != set(driven):
        raise ValueError(f"The actions drive joints of one side only. {WITHOUT}")
    sources = [driven.index(joint) for joint in across]
    scale = torch.as_tensor(term.scale).expand(env.num_envs, len(driven))
    if not torch.allclose(scale[:, sources], scale):
        raise ValueError(f"The actions have another scale on the left than on the right. {WITHOUT}")
    return Mirror(sources, joints.signs[driven].tolist())


def _of_feet(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    feet = partners(_feet(env, params["sensor_name"]))
    return Mirror(feet, [1.0] * len(feet))


def _of_foot_vectors(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    feet = partners(_feet(env, params["sensor_name"]))
    return Mirror([3 * foot + i for foot in feet for i in range(3)], DIRECTION * len(feet))


def _feet(env: ManagerBasedRlEnv, sensor_name: str) -> list[str]:
    sensor: Any = env.scene[sensor_name]
    if hasattr(sensor, "primary_names"):
        return sensor.primary_names
    return [frame.name for frame in sensor.cfg.frame]


def _of_rays(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a sensor's rays from one frame in the middle of the robot."""
    cfg: Any = env.scene[params["sensor_name"]].cfg
    frames = cfg.frame if isinstance(cfg.frame, tuple) else (cfg.frame,)
    rays = torch.cat(cfg.pattern.generate_rays(env.sim.mj_model, "cpu"), dim=1)
    apart = ((rays * torch.tensor(2 * DIRECTION))[:, None] - rays[None]).norm(dim=-1)
    is_central = len(frames) == 1 and other_side(frames[0].name) == frames[0].name
    if not is_central or (apart.min(dim=1).values > _TOLERANCE).any():
        raise ValueError(
            f"The rays of sensor {params['sensor_name']!r} are not the same on both sides, so that "
            "mirror_left_right cannot swap them. Give it one frame in the middle of the robot, and a "
            f"pattern with as much on the left as on the right. {WITHOUT}"
        )
    return Mirror(apart.argmin(dim=1).tolist(), [1.0] * len(rays))


_KINDS: dict[Any, Callable[..., Mirror]] = {
    envs_mdp.builtin_sensor: _of_sensor,
    envs_mdp.base_lin_vel: _direction,
    envs_mdp.base_ang_vel: _rotation,
    envs_mdp.projected_gravity: _direction,
    envs_mdp.joint_pos_rel: _of_joints,
    envs_mdp.joint_vel_rel: _of_joints,
    envs_mdp.last_action: _of_actions,
    envs_mdp.generated_commands: _of_command,
    envs_mdp.height_scan: _of_rays,
    mdp.foot_height: _of_feet,
    mdp.foot_air_time: _of_feet,
    mdp.foot_contact: _of_feet,
    mdp.foot_contact_forces: _of_foot_vectors,
}
