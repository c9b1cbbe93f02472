"""Left-right symmetry augmentation of observations and actions of legged robots.

For a robot that is symmetric, the mirror image of each sample is a further sample without simulation cost
(Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024). Name
`mirror_left_right` in `symmetry_cfg` of `RslRlPpoAlgorithmCfg`.

The mirror plane is the x-z plane of the robot's root. Mirroring flips the sign of y of polar vectors, and
of x and z of axial vectors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING, Any, NamedTuple, cast
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
import torch

from mjlab.envs import mdp as envs_mdp
from mjlab.sensor import ContactSensor
from mjlab.tasks.velocity import mdp

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

DIRECTION = (1.0, -1.0, 1.0)
ROTATION = (-1.0, 1.0, -1.0)
_SIDES = {"left": "right", "FL": "FR", "RL": "RR"}
_OTHER_SIDE = _SIDES | {right: left for left, right in _SIDES.items()}

# Tolerances between partners: axes (unit vectors), default positions (rad), anchor positions (m).
_AXIS_TOLERANCE, _POSE_TOLERANCE, _ANCHOR_TOLERANCE = 1e-4, 1e-3, 5e-3
_HINT = "To learn without mirror images, set agent.algorithm.symmetry_cfg to None."
_ROBOT = "robot"
_PLANAR_VELOCITY = (1.0, -1.0, -1.0)
# Signs of (sin, cos) half a cycle later, the phase of the other side in walks and trots.
_HALF_A_CYCLE_LATER = (-1.0, -1.0)
_SENSOR_SIGNS = {
    mujoco.mjtSensor.mjSENS_GYRO: ROTATION,
    mujoco.mjtSensor.mjSENS_VELOCIMETER: DIRECTION,
    mujoco.mjtSensor.mjSENS_ACCELEROMETER: DIRECTION,
}
# Tolerance of ray positions (m) and axes (unit vectors).
_TOLERANCE = 1e-4
# Building the mirrors of a Go1 takes 11 ms, mirroring 3072 samples 1.3 ms.
_cache: WeakKeyDictionary[Any, _Mirrors] = WeakKeyDictionary()


def mirror_left_right(
    env: Any, obs: Any = None, actions: torch.Tensor | None = None
) -> tuple[Any, torch.Tensor | None]:
    """Append mirror images to observations and actions.

    Args:
        env: Environment, wrapped or not.
        obs: TensorDict of observation groups, each (N, D), or None.
        actions: Actions (N, A), or None.

    Returns:
        Observations and actions with 2 N rows, the originals first.

    Raises:
        ValueError: the robot is not symmetric, or a term has no known mirror image.
    """
    env = env.unwrapped
    mirrors = _cache.get(env)
    if mirrors is None:
        mirrors = _cache[env] = _Mirrors(env)
    if obs is not None:
        image = obs.clone()
        for group in set(image.keys()):
            image[group] = mirrors.groups[group](obs[group])
        obs = torch.cat([obs, image], dim=0)
    if actions is not None:
        actions = torch.cat([actions, mirrors.actions(actions)], dim=0)
    return obs, actions


class _Mirrors:
    """Mirrors of the observation groups and actions of an environment."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        manager = env.observation_manager
        self.groups: dict[str, Mirror] = {}
        for group, names in manager.active_terms.items():
            if not manager.group_obs_concatenate[group]:
                raise ValueError(
                    f"Observation group {group!r}: mirror_left_right expected concatenate_terms=True, got "
                    f"concatenate_terms=False. {_HINT}"
                )
            # Numbers of time steps in the terms.
            instants = [max(1, manager.get_term_cfg(group, n).history_length) for n in names]
            shapes = manager.group_obs_term_dim[group]
            terms = [
                _mirror_of_term(env, group, name, count, shape)
                for name, count, shape in zip(names, instants, shapes, strict=True)
            ]
            starts = accumulate(map(len, terms), initial=0)
            spans = dict(zip(names, zip(starts, instants, strict=False), strict=True))
            self.groups[group] = Mirror.concatenate(terms, _lever_arms(env, group, spans))
        self.actions = _of_actions(env)


def _mirror_of_term(
    env: ManagerBasedRlEnv, group: str, name: str, instants: int, shape: tuple[int, ...]
) -> Mirror:
    cfg = env.cfg.observations[group].terms[name]
    owner = f"Observation {group}/{name}"
    kind = _KINDS.get(cfg.func)
    if kind is None:
        raise ValueError(
            f"{owner}: mirror_left_right does not support this term. Supported: "
            f"{', '.join(sorted(func.__name__ for func in _KINDS))}. Use a custom function in "
            f"symmetry_cfg. {_HINT}"
        )
    clip = cfg.clip
    is_even = clip is None or clip[0] == -clip[1]
    if not isinstance(cfg.scale, int | float | None) or not is_even:
        raise ValueError(
            f"{owner}: mirror_left_right expected a scalar scale and a clip (-c, c), got scale "
            f"{cfg.scale!r} and clip {clip!r}. {_HINT}"
        )
    mirror = Mirror.concatenate([kind(env, cfg.params)] * instants)
    if shape != (len(mirror),):
        raise ValueError(
            f"{owner}: mirror_left_right expected shape ({len(mirror)},) per environment, got {shape}; "
            f"select all joints, and flatten the history. {_HINT}"
        )
    return mirror


# Mirrors of terms.


def _of_sensor(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a gyro, velocimeter or accelerometer, without lever arm effects."""
    sensor = _sensor(env, params["sensor_name"])
    is_off_center = abs(sensor.y) > _ANCHOR_TOLERANCE
    if sensor.kind == mujoco.mjtSensor.mjSENS_ACCELEROMETER and is_off_center:
        raise ValueError(
            f"Accelerometer {sensor.name!r}: expected a position on the mirror plane, got "
            f"{sensor.y:.3g} m to its left. Its mirror image would need the angular acceleration, "
            f"an unobserved quantity. {_HINT}"
        )
    return Mirror(range(3), _SENSOR_SIGNS[sensor.kind])


class _Sensor(NamedTuple):
    """Sensor at a site."""

    name: str
    kind: mujoco.mjtSensor
    body: int
    """Id of the body of the site."""
    y: float
    """Distance from the mirror plane (m), positive to the left."""


def _sensor(env: ManagerBasedRlEnv, name: str) -> _Sensor:
    """Return a gyro, velocimeter or accelerometer. Raises unless its site is aligned with the root."""
    model = env.sim.mj_model
    found = model.sensor(name)
    kind, site = mujoco.mjtSensor(int(found.type.item())), int(found.objid.item())
    if kind not in _SENSOR_SIGNS:
        raise ValueError(
            f"Sensor {name!r}: mirror_left_right expected a gyro, velocimeter or accelerometer, got "
            f"{kind.name}. {_HINT}"
        )
    data, origin, rotation = _reference_pose(model, env.scene[_ROBOT])
    body = int(model.site_bodyid[site])
    if np.abs(data.site_xmat[site] - rotation.ravel()).max() > _TOLERANCE:
        raise ValueError(
            f"Sensor {name!r}: mirror_left_right expected the orientation of the robot's root at qpos0, got "
            f"a rotated site. {_HINT}"
        )
    body_name = model.body(body).name
    if other_side(body_name.split("/")[-1]) != body_name.split("/")[-1]:
        raise ValueError(
            f"Sensor {name!r}: expected a body on the mirror plane, got {body_name!r} on one side of "
            f"the robot. {_HINT}"
        )
    return _Sensor(name, kind, body, float((data.site_xpos[site] - origin) @ rotation[:, 1]))


def _reference_pose(
    model: mujoco.MjModel, robot: Entity
) -> tuple[mujoco.MjData, np.ndarray, np.ndarray]:
    """Return the kinematics at `qpos0`, and position and rotation matrix of the robot's root."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    root = int(robot.indexing.root_body_id)
    return data, data.xpos[root], data.xmat[root].reshape(3, 3)


def _lever_arms(
    env: ManagerBasedRlEnv, group: str, spans: dict[str, tuple[int, int]]
) -> list[Coupling]:
    """Return the lever arm corrections of mirrored linear velocities.

    The mirror image of a sensor at distance y from the mirror plane is at -y, but the sensor of the
    mirrored robot is at y. With the mirrored angular velocity w', the sensor reads

        v' = S v + w' x (0, 2 y, 0) = S v + 2 y (w_z, 0, -w_x).

    Args:
        env: The environment.
        group: Observation group name.
        spans: First column and number of time steps of each term of the group.

    Raises:
        ValueError: the group does not observe the required angular velocity.
    """
    terms = {name: env.cfg.observations[group].terms[name] for name in spans}
    # `_mirror_of_term` accepts no other scales.
    scales = {name: cast("float | None", cfg.scale) for name, cfg in terms.items()}
    factors = {name: 1.0 if scale is None else scale for name, scale in scales.items()}
    sensors = {
        name: _sensor(env, cfg.params["sensor_name"])
        for name, cfg in terms.items()
        if cfg.func is envs_mdp.builtin_sensor
    }
    turning = {n: s.body for n, s in sensors.items() if s.kind == mujoco.mjtSensor.mjSENS_GYRO}
    robot: Entity = env.scene[_ROBOT]
    for name, cfg in terms.items():
        if cfg.func is envs_mdp.base_ang_vel:
            turning[name] = robot.indexing.root_body_id
    # Angular velocities by body, number of time steps and delay, which must not be random.
    gyros: dict[tuple[int, ...], str] = {}
    for name, body in turning.items():
        lag = terms[name].delay_min_lag
        if lag == terms[name].delay_max_lag and factors[name] != 0.0:
            gyros.setdefault((body, spans[name][1], lag, lag), name)
    couplings = []
    for name, sensor in sensors.items():
        if sensor.kind != mujoco.mjtSensor.mjSENS_VELOCIMETER or abs(sensor.y) < _TOLERANCE:
            continue
        cfg, (start, instants) = terms[name], spans[name]
        gyro = gyros.get((sensor.body, instants, cfg.delay_min_lag, cfg.delay_max_lag))
        if gyro is not None:
            factor = 2.0 * sensor.y * factors[name] / factors[gyro]
            for shift in range(0, 3 * instants, 3):
                v, w = start + shift, spans[gyro][0] + shift
                couplings += [Coupling(v, w + 2, factor), Coupling(v + 2, w, -factor)]
        elif abs(sensor.y) > _ANCHOR_TOLERANCE:
            raise ValueError(
                f"Observation {group}/{name}: expected a velocimeter on the mirror plane, got one "
                f"{sensor.y:.3g} m to its left. Its mirror image depends on the angular velocity of "
                f"{env.sim.mj_model.body(sensor.body).name!r}; add that to group {group!r}, with the same "
                "history_length, and without delay or with the same fixed delay, or use "
                f"base_lin_vel. {_HINT}"
            )
    return couplings


def _of_command(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    term = env.command_manager.get_term(params["command_name"])
    if isinstance(term, mdp.UniformVelocityCommand):
        return Mirror(range(3), _PLANAR_VELOCITY)
    if isinstance(term, mdp.GaitClockCommand):
        return Mirror(range(2), _HALF_A_CYCLE_LATER)
    raise ValueError(
        f"Command {params['command_name']!r}: mirror_left_right expected a UniformVelocityCommand or "
        f"GaitClockCommand, got {type(term).__name__}. {_HINT}"
    )


def _of_joints(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    asset_cfg = params.get("asset_cfg")
    if asset_cfg is not None and asset_cfg.preserve_order:
        raise ValueError(
            f"mirror_left_right asset_cfg: expected joints in model order, got preserve_order=True. {_HINT}"
        )
    return mirror_of_joints(
        env.sim.mj_model, env.scene[_ROBOT if asset_cfg is None else asset_cfg.name]
    )


def _of_actions(env: ManagerBasedRlEnv, params: dict[str, Any] | None = None) -> Mirror:
    robot: Entity = env.scene[_ROBOT]
    joints = mirror_of_joints(env.sim.mj_model, robot)
    manager = env.action_manager
    terms = {name: manager.get_term(name) for name in manager.active_terms}
    (term, *others) = terms.values()
    if others or not isinstance(term, envs_mdp.JointPositionAction):
        kinds = ", ".join(f"{name} ({type(term).__name__})" for name, term in terms.items())
        raise ValueError(
            f"mirror_left_right actions: expected one JointPositionAction, got {kinds}. {_HINT}"
        )
    driven = [robot.joint_names.index(name) for name in term.target_names]
    partner_ids = joints.sources[driven].tolist()
    if set(partner_ids) != set(driven):
        raise ValueError(
            f"mirror_left_right actions: expected joints of both sides, got {term.target_names}. {_HINT}"
        )
    sources = [driven.index(joint) for joint in partner_ids]
    scale = torch.as_tensor(term.scale, dtype=torch.float32).expand(env.num_envs, len(driven))
    if not torch.allclose(scale[:, sources], scale):
        raise ValueError(
            f"mirror_left_right actions: expected the same scale on both sides, got {term.cfg.scale}. {_HINT}"
        )
    return Mirror(sources, joints.signs[driven].tolist())


def _of_feet(
    env: ManagerBasedRlEnv, params: dict[str, Any], signs: tuple[float, ...] = (1.0,)
) -> Mirror:
    """Return the mirror of foot vectors with `signs`, of a contact or height sensor."""
    sensor = env.scene[params["sensor_name"]]
    is_contact = isinstance(sensor, ContactSensor)
    names = sensor.primary_names if is_contact else [frame.name for frame in sensor.cfg.frame]
    size, feet = len(signs), partners(names)
    return Mirror([size * foot + i for foot in feet for i in range(size)], signs * len(feet))


def _of_rays(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    """Return the mirror of the rays of a sensor with one frame on the mirror plane."""
    cfg = env.scene[params["sensor_name"]].cfg
    frames = cfg.frame if isinstance(cfg.frame, tuple) else (cfg.frame,)
    rays = torch.cat(cfg.pattern.generate_rays(env.sim.mj_model, "cpu"), dim=1)
    distances = (
        (rays * torch.tensor(2 * DIRECTION, dtype=torch.float32))[:, None] - rays[None]
    ).norm(dim=-1)
    data, origin, rotation = _reference_pose(env.sim.mj_model, env.scene[_ROBOT])
    frame = frames[0]
    element = getattr(env.sim.mj_model, frame.type)(frame.prefixed_name())
    points = {"body": data.xpos, "site": data.site_xpos, "geom": data.geom_xpos}[frame.type]
    is_central = (
        len(frames) == 1
        and other_side(frame.name) == frame.name
        and abs((points[element.id] - origin) @ rotation[:, 1]) <= _ANCHOR_TOLERANCE
    )
    if not is_central or (distances.min(dim=1).values > _TOLERANCE).any():
        raise ValueError(
            f"Sensor {params['sensor_name']!r}: mirror_left_right expected symmetric rays; use one frame on "
            f"the mirror plane of the robot, and a pattern that is symmetric in y. {_HINT}"
        )
    return Mirror(distances.argmin(dim=1).tolist(), [1.0] * len(rays))


_KINDS: dict[Any, Callable[..., Mirror]] = {
    envs_mdp.builtin_sensor: _of_sensor,
    envs_mdp.base_lin_vel: lambda *_: Mirror(range(3), DIRECTION),
    envs_mdp.base_ang_vel: lambda *_: Mirror(range(3), ROTATION),
    envs_mdp.projected_gravity: lambda *_: Mirror(range(3), DIRECTION),
    envs_mdp.joint_pos_rel: _of_joints,
    envs_mdp.joint_vel_rel: _of_joints,
    envs_mdp.last_action: _of_actions,
    mdp.stepping_action: _of_actions,
    envs_mdp.generated_commands: _of_command,
    envs_mdp.height_scan: _of_rays,
    mdp.foot_height: _of_feet,
    mdp.foot_air_time: _of_feet,
    mdp.foot_contact: _of_feet,
    mdp.foot_contact_forces: partial(_of_feet, signs=DIRECTION),
}


# Mirrors of vectors, and left-right partners of joints and feet.


class Mirror:
    """Mirror image of a vector: x'_i = signs[i] x_sources[i] + sum of the couplings with target i."""

    def __init__(
        self, sources: Sequence[int], signs: Sequence[float], couplings: Sequence[Coupling] = ()
    ) -> None:
        """Store `sources` and `signs`, of equal length, and `couplings`."""
        self.sources = torch.tensor(sources)
        self.signs = torch.tensor(signs, dtype=torch.float32)
        self._targets = torch.tensor([coupling.target for coupling in couplings]).long()
        self._read = torch.tensor([coupling.source for coupling in couplings]).long()
        self._factors = torch.tensor(
            [coupling.factor for coupling in couplings], dtype=torch.float32
        )

    def __len__(self) -> int:
        return len(self.signs)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mirror image of `values`, (N, D)."""
        if self.signs.device != values.device:
            for name in ("sources", "signs", "_targets", "_read", "_factors"):
                setattr(self, name, getattr(self, name).to(values.device))
        image = values[:, self.sources] * self.signs
        if len(self._targets):
            image.index_add_(1, self._targets, values[:, self._read] * self._factors)
        return image

    @staticmethod
    def concatenate(mirrors: Sequence[Mirror], couplings: Sequence[Coupling] = ()) -> Mirror:
        """Return the mirror of concatenated vectors, with `couplings` between them."""
        sources: list[int] = []
        signs: list[float] = []
        for mirror in mirrors:
            sources += [len(signs) + source for source in mirror.sources.tolist()]
            signs += mirror.signs.tolist()
        return Mirror(sources, signs, couplings)


class Coupling(NamedTuple):
    """Summand `factor * x_source` of the mirrored component `target`."""

    target: int
    """Index of the mirrored component."""
    source: int
    """Index of the original component."""
    factor: float


def mirror_of_joints(model: mujoco.MjModel, robot: Entity) -> Mirror:
    """Return the mirror of the joints of entity `robot`, in entity order.

    Partners are found by name. The sign of a joint is -1 if the mirror image of its axis is opposite to
    the partner's axis.

    Raises:
        ValueError: a joint is not the mirror image of its partner.
    """
    names = robot.joint_names
    pairs = partners(names)
    data, origin, rotation = _reference_pose(model, robot)
    ids = robot.indexing.joint_ids.tolist()
    axes = data.xaxis[ids] @ rotation
    anchors = (data.xanchor[ids] - origin) @ rotation
    is_slide = model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_SLIDE
    images = axes * np.where(is_slide[:, None], DIRECTION, ROTATION)
    signs = (images[pairs] * axes).sum(axis=1)
    pose = robot.data.default_joint_pos[0].cpu().numpy()
    is_image = (
        (np.abs(np.abs(signs) - 1) <= _AXIS_TOLERANCE)
        & (np.linalg.norm(anchors[pairs] * DIRECTION - anchors, axis=1) <= _ANCHOR_TOLERANCE)
        & (np.abs(pose - signs * pose[pairs]) <= _POSE_TOLERANCE)
    )
    if not is_image.all():
        pair = [is_image.argmin(), pairs[is_image.argmin()]]
        raise ValueError(
            f"Joint {names[pair[0]]!r} is not the mirror image of {names[pair[1]]!r}: axes "
            f"{axes[pair].round(3).tolist()}, anchors {anchors[pair].round(3).tolist()}, default "
            f"positions {pose[pair].round(4).tolist()}. Partners are found by these parts of names: "
            f"{', '.join(_OTHER_SIDE)}. {_HINT}"
        )
    return Mirror(pairs, signs.round().tolist())


def partners(names: Sequence[str]) -> list[int]:
    """Return the index of the left-right partner of each name; central names are their own partner.

    Raises:
        ValueError: a name has no partner in `names`.
    """
    others = [other_side(name) for name in names]
    missing = sorted(set(others) - set(names))
    if missing:
        raise ValueError(
            f"mirror_left_right: {', '.join(missing)} not found. Available: {', '.join(names)}. "
            f"Sides are found by these parts of names: {', '.join(_OTHER_SIDE)}. {_HINT}"
        )
    return [list(names).index(other) for other in others]


def other_side(name: str) -> str:
    """Return the name of the left-right partner; central names are returned unchanged."""
    return "_".join(_OTHER_SIDE.get(part, part) for part in name.split("_"))
