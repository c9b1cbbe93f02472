"""Mirror images of what a legged robot senses and does, so that PPO learns from both sides at once.

A robot whose left is made like its right can take the mirror image of each sample as one more
sample, which costs no physics (Mittal et al., "Symmetry Considerations for Learning Task Symmetric
Robot Policies", ICRA 2024). The mirror is the plane of x and z, in which directions change the sign
of y, and axes of rotation those of x and z. `mirror_left_right` is what `symmetry_cfg` of
`RslRlPpoAlgorithmCfg` names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import mujoco
import torch

from mjlab.envs import mdp as envs_mdp
from mjlab.tasks.velocity import mdp

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import ObservationTermCfg

_DIRECTION = (1.0, -1.0, 1.0)
_ROTATION = (-1.0, 1.0, -1.0)
_PLANAR_VELOCITY = (1.0, -1.0, -1.0)
_ROTATION_SENSORS = (mujoco.mjtSensor.mjSENS_GYRO,)
_DIRECTION_SENSORS = (mujoco.mjtSensor.mjSENS_VELOCIMETER, mujoco.mjtSensor.mjSENS_ACCELEROMETER)
_SIDES = {"left": "right", "FL": "FR", "RL": "RR"}
_OTHER_SIDE = _SIDES | {right: left for left, right in _SIDES.items()}
# Metres or radians that mirrored poses, axes and rays may be apart.
_TOLERANCE = 1e-4


class Mirror:
    """What a vector of numbers is in the mirror: number i is `signs[i]` times number `sources[i]`."""

    def __init__(self, sources: Sequence[int], signs: Sequence[float]) -> None:
        """Take indices and signs, of one length."""
        self.sources, self.signs = torch.tensor(sources), torch.tensor(signs)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mirror image of `values` (N, numbers)."""
        if self.signs.device != values.device:
            self.sources, self.signs = self.sources.to(values.device), self.signs.to(values.device)
        return values[:, self.sources] * self.signs


_mirrors: WeakKeyDictionary[Any, dict[str, Mirror]] = WeakKeyDictionary()


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
        ValueError: the robot is not the same on both sides, or a term is of an unknown kind.
    """
    env = env.unwrapped
    mirrors = _mirrors.get(env)
    if mirrors is None:
        mirrors = _mirrors[env] = _build_mirrors(env)
    if obs is not None:
        image = obs.clone()
        for group in set(image.keys()):
            image[group] = mirrors[group](obs[group])
        obs = torch.cat([obs, image], dim=0)
    if actions is not None:
        actions = torch.cat([actions, mirrors["action"](actions)], dim=0)
    return obs, actions


def _build_mirrors(env: ManagerBasedRlEnv) -> dict[str, Mirror]:
    """Return the mirror of every observation group and, as `action`, that of actions."""
    groups: Any = env.cfg.observations
    mirrors = {}
    for group, names in env.observation_manager.active_terms.items():
        sizes = [size for size, *_ in env.observation_manager.group_obs_term_dim[group]]
        mirrors[group] = _joined(
            [
                _mirror_of_term(env, f"{group}/{name}", groups[group].terms[name], size)
                for name, size in zip(names, sizes, strict=True)
            ]
        )
    return mirrors | {"action": _of_actions(env)}


def _mirror_of_term(
    env: ManagerBasedRlEnv, name: str, cfg: ObservationTermCfg, size: int
) -> Mirror:
    kind = _KINDS.get(cfg.func)
    if kind is None:
        raise ValueError(
            f"mirror_left_right does not know what {name!r} is in the mirror. It knows "
            f"{', '.join(sorted(func.__name__ for func in _KINDS))}. Leave out symmetry_cfg, or name "
            "a function of your own there."
        )
    mirror = kind(env, cfg.params)
    if len(mirror.signs) != size:
        raise ValueError(
            f"mirror_left_right expects {len(mirror.signs)} numbers of {name!r}, which has {size}. "
            "It knows no history and no selection of joints."
        )
    return mirror


def _joined(mirrors: Sequence[Mirror]) -> Mirror:
    sources: list[int] = []
    signs: list[float] = []
    for mirror in mirrors:
        sources += [len(signs) + source for source in mirror.sources.tolist()]
        signs += mirror.signs.tolist()
    return Mirror(sources, signs)


def _of_sensor(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    kind = int(env.sim.mj_model.sensor(params["sensor_name"]).type.item())
    if kind in _ROTATION_SENSORS:
        return _rotation()
    if kind in _DIRECTION_SENSORS:
        return _direction()
    raise ValueError(
        f"mirror_left_right knows gyros, velocimeters and accelerometers; sensor "
        f"{params['sensor_name']!r} is of another type."
    )


def _direction(*_: Any) -> Mirror:
    return Mirror(range(3), _DIRECTION)


def _rotation(*_: Any) -> Mirror:
    return Mirror(range(3), _ROTATION)


def _planar_velocity(*_: Any) -> Mirror:
    return Mirror(range(3), _PLANAR_VELOCITY)


def _of_joints(env: ManagerBasedRlEnv, params: dict[str, Any] | None = None) -> Mirror:
    """Return the mirror of the joints of the robot, all of them in order."""
    asset_cfg = (params or {}).get("asset_cfg")
    robot: Any = env.scene["robot" if asset_cfg is None else asset_cfg.name]
    names = robot.joint_names
    partners = _partners(names)
    axes = _joint_axes(env, robot)
    images = axes * torch.tensor(_ROTATION)
    # A joint turns the other way in the mirror where its partner's axis points the other way.
    signs = (images[partners] * axes).sum(dim=1)
    pose = robot.data.default_joint_pos[0].cpu()
    for i, name in enumerate(names):
        if (
            abs(abs(signs[i]) - 1) > _TOLERANCE
            or abs(pose[i] - signs[i] * pose[partners[i]]) > 1e-3
        ):
            raise ValueError(
                f"Joint {name!r} is not the mirror image of {names[partners[i]]!r}: axes "
                f"{axes[i].tolist()} and {axes[partners[i]].tolist()}, default positions {pose[i]:.4g} "
                f"and {pose[partners[i]]:.4g}. Leave out symmetry_cfg."
            )
    return Mirror(partners, signs.round().tolist())


def _joint_axes(env: ManagerBasedRlEnv, robot: Any) -> torch.Tensor:
    """Return the axis of each joint in the world, where all joints are at 0, (joints, 3)."""
    model = env.sim.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ids = robot.indexing.joint_ids.tolist()
    return torch.tensor(data.xaxis[ids], dtype=torch.float32)


def _of_actions(env: ManagerBasedRlEnv, params: dict[str, Any] | None = None) -> Mirror:
    joints = _of_joints(env)
    names = list(env.scene["robot"].joint_names)
    terms: list[Any] = [env.action_manager.get_term(n) for n in env.action_manager.active_terms]
    if len(terms) != 1 or set(getattr(terms[0], "target_names", ())) - set(names):
        raise ValueError(
            "mirror_left_right knows one action term, of joints of the robot; there are "
            f"{', '.join(env.action_manager.active_terms)}. Leave out symmetry_cfg."
        )
    driven = [names.index(name) for name in terms[0].target_names]
    sources = [driven.index(int(joints.sources[joint])) for joint in driven]
    return Mirror(sources, joints.signs[driven].tolist())


def _of_feet(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    feet = _partners(_feet(env, params["sensor_name"]))
    return Mirror(feet, [1.0] * len(feet))


def _of_foot_vectors(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    feet = _partners(_feet(env, params["sensor_name"]))
    return Mirror([3 * foot + i for foot in feet for i in range(3)], _DIRECTION * len(feet))


def _feet(env: ManagerBasedRlEnv, sensor_name: str) -> list[str]:
    sensor: Any = env.scene[sensor_name]
    if hasattr(sensor, "primary_names"):
        return sensor.primary_names
    return [frame.name for frame in sensor.cfg.frame]


def _of_rays(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a sensor's rays from one frame in the middle of the robot."""
    cfg: Any = env.scene[params["sensor_name"]].cfg
    offsets, _ = cfg.pattern.generate_rays(env.sim.mj_model, "cpu")
    image = offsets * torch.tensor(_DIRECTION)
    apart = (image[:, None] - offsets[None]).norm(dim=-1)
    if (apart.min(dim=1).values > _TOLERANCE).any():
        raise ValueError(
            f"The rays of sensor {params['sensor_name']!r} are not the same on both sides, so that "
            "mirror_left_right cannot swap them. Centre the pattern, or leave out symmetry_cfg."
        )
    return Mirror(apart.argmin(dim=1).tolist(), [1.0] * len(offsets))


def _partners(names: Sequence[str]) -> list[int]:
    """Return the index of what is on the other side, for each name; what is in the middle stays."""
    others = ["_".join(_OTHER_SIDE.get(part, part) for part in name.split("_")) for name in names]
    missing = sorted(set(others) - set(names))
    if missing:
        raise ValueError(
            f"mirror_left_right finds no {', '.join(missing)} among {', '.join(names)}. It knows the "
            f"sides by these parts of names: {', '.join(_OTHER_SIDE)}."
        )
    return [list(names).index(other) for other in others]


_KINDS: dict[Any, Callable[..., Mirror]] = {
    envs_mdp.builtin_sensor: _of_sensor,
    envs_mdp.base_lin_vel: _direction,
    envs_mdp.base_ang_vel: _rotation,
    envs_mdp.projected_gravity: _direction,
    envs_mdp.joint_pos_rel: _of_joints,
    envs_mdp.joint_vel_rel: _of_joints,
    envs_mdp.last_action: _of_actions,
    envs_mdp.generated_commands: _planar_velocity,
    envs_mdp.height_scan: _of_rays,
    mdp.foot_height: _of_feet,
    mdp.foot_air_time: _of_feet,
    mdp.foot_contact: _of_feet,
    mdp.foot_contact_forces: _of_foot_vectors,
}
