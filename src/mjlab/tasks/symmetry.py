"""Left-right symmetry augmentation of observations and actions.

For a robot that is symmetric, the mirror image of each sample is a further sample without simulation cost
(Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024). Name
`mirror_left_right` of `mjlab.tasks.velocity.symmetry` or `mjlab.tasks.manipulation.symmetry` in
`symmetry_cfg` of `RslRlPpoAlgorithmCfg`. They know the terms of their tasks; others are mirrored by a
function of the task's own:

    def mirror(env, obs=None, actions=None):
        return mirror_left_right(env, obs, actions, terms={my_distance_to_door: of_direction})

The mirror plane is the x-z plane of the robot's root. Mirroring flips the sign of y of polar vectors, and
of x and z of axial vectors. Joints and feet find their partners by geometry, see `mjlab.utils.mirror`, or
by the argument `pairs`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, cast
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
import torch

from mjlab.envs import mdp as envs_mdp
from mjlab.utils.mirror import (
    DIRECTION,
    ROTATION,
    describe_unpaired,
    joint_that_moves,
    mirror_elements,
    mirror_pairs,
    reference_pose,
)

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

# Tolerances: default positions of partners (rad or m), distance from the mirror plane (m).
_POSE_TOLERANCE, _PLANE_TOLERANCE = 1e-3, 5e-3
HINT = "To learn without mirror images, set agent.algorithm.symmetry_cfg to None."
"""Advice at the end of error messages."""
_ROBOT = "robot"
_SENSOR_SIGNS = {
    mujoco.mjtSensor.mjSENS_GYRO: ROTATION,
    mujoco.mjtSensor.mjSENS_VELOCIMETER: DIRECTION,
    mujoco.mjtSensor.mjSENS_ACCELEROMETER: DIRECTION,
}
# Tolerance of ray positions (m) and axes (unit vectors).
_TOLERANCE = 1e-4
MirrorOfTerm: TypeAlias = "Callable[[SymmetricRobot, dict[str, Any]], Mirror]"
"""Function of the robot and of the `params` of an observation term; returns the mirror of its vector."""
# Building the mirrors of a Go1 takes 25 ms, mirroring 3072 samples 1.3 ms.
_cache: WeakKeyDictionary[Any, _Mirrors] = WeakKeyDictionary()


def mirror_left_right(
    env: Any,
    obs: Any = None,
    actions: torch.Tensor | None = None,
    pairs: Mapping[str, str] | None = None,
    terms: Mapping[Any, MirrorOfTerm] | None = None,
) -> tuple[Any, torch.Tensor | None]:
    """Append mirror images to observations and actions.

    Args:
        env: Environment, wrapped or not.
        obs: TensorDict of observation groups, each (N, D), or None.
        actions: Actions (N, A), or None.
        pairs: Names of joints and feet (geoms, bodies, sites) and of their partners on the other side, in
            either direction. Others are found by geometry; None: all are.
        terms: Mirrors of observation functions that are not in `TERMS`. Use functions of a module: with new
            ones in each call, such as lambdas, all mirrors are built again (25 ms).

    Returns:
        Observations and actions with 2 N rows, the originals first.

    Raises:
        ValueError: the robot is not symmetric, or a term has no known mirror image.
    """
    env = env.unwrapped
    mirrors = _cache.get(env)
    if mirrors is None or (mirrors.pairs, mirrors.terms) != (pairs or {}, terms or {}):
        mirrors = _cache[env] = _Mirrors(env, pairs or {}, terms or {})
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

    def __init__(
        self, env: ManagerBasedRlEnv, pairs: Mapping[str, str], terms: Mapping[Any, MirrorOfTerm]
    ) -> None:
        # Without the robot, which refers to the environment: that would never be freed.
        self.pairs, self.terms = dict(pairs), dict(terms)
        kinds = {**TERMS, **self.terms}
        robot = SymmetricRobot(env, self.pairs)
        manager = env.observation_manager
        self.groups: dict[str, Mirror] = {}
        for group, names in manager.active_terms.items():
            if not manager.group_obs_concatenate[group]:
                raise ValueError(
                    f"Observation group {group!r}: mirror_left_right expected concatenate_terms=True, got "
                    f"concatenate_terms=False. {HINT}"
                )
            # Numbers of time steps in the terms.
            instants = [max(1, manager.get_term_cfg(group, n).history_length) for n in names]
            shapes = manager.group_obs_term_dim[group]
            mirrors = [
                _mirror_of_term(robot, kinds, group, name, count, shape)
                for name, count, shape in zip(names, instants, shapes, strict=True)
            ]
            starts = accumulate(map(len, mirrors), initial=0)
            spans = dict(zip(names, zip(starts, instants, strict=False), strict=True))
            self.groups[group] = Mirror.concatenate(mirrors, _lever_arms(robot, group, spans))
        self.actions = of_actions(robot)


class SymmetricRobot:
    """Robot of an environment before the mirror: model, pose at `qpos0`, and partners."""

    def __init__(self, env: ManagerBasedRlEnv, pairs: Mapping[str, str]) -> None:
        self.env, self.pairs = env, pairs
        self.model = env.sim.mj_model
        self.entity: Entity = env.scene[_ROBOT]
        self.root = int(self.entity.indexing.root_body_id)
        self.data, self.origin, self.rotation = reference_pose(self.model, self.root)

    def is_central(self, body: int) -> bool:
        """True if `body` moves with the root or with a joint on the mirror plane."""
        joint = joint_that_moves(self.model, body)
        joints = mirror_pairs(self.model, self.root, self.pairs)
        return joint < 0 or (joint in joints and joints[joint].joint == joint)

    def is_on_plane(self, kind: Literal["body", "site", "geom"], index: int) -> bool:
        """True if a body, site or geom lies on the mirror plane, whatever the joints on it do."""
        data = self.data
        points = {"body": data.xpos, "site": data.site_xpos, "geom": data.geom_xpos}[kind]
        body = index if kind == "body" else int(getattr(self.model, f"{kind}_bodyid")[index])
        return self.is_central(body) and abs(self.left_of_plane(points[index])) <= _PLANE_TOLERANCE

    def left_of_plane(self, point: np.ndarray) -> float:
        """Return the distance of a world position from the mirror plane (m), positive to the left."""
        return float((point - self.origin) @ self.rotation[:, 1])

    def partners(self, owner: str, kind: Any, ids: Sequence[int]) -> list[int]:
        """Return the indices in `ids` of the partners of bodies, sites or geoms `ids`.

        Raises:
            ValueError: an element has no mirror image among `ids`.
        """
        found = mirror_elements(self.model, kind, ids, self.root, self.pairs)
        missing = [getattr(self.model, kind)(i).name for i in ids if i not in found]
        if missing:
            raise ValueError(
                f"{owner}: mirror_left_right expected the {kind} of the other side for each, got none for "
                f"{', '.join(missing)}; add it, or name partners in `pairs`. {HINT}"
            )
        return [list(ids).index(found[i]) for i in ids]


def _mirror_of_term(
    robot: SymmetricRobot,
    kinds: Mapping[Any, MirrorOfTerm],
    group: str,
    name: str,
    instants: int,
    shape: tuple[int, ...],
) -> Mirror:
    cfg = robot.env.cfg.observations[group].terms[name]
    owner = f"Observation {group}/{name}"
    kind = kinds.get(cfg.func)
    if kind is None:
        supported = sorted(getattr(func, "__name__", str(func)) for func in kinds)
        raise ValueError(
            f"{owner}: mirror_left_right does not support this term. Supported: {', '.join(supported)}. Name "
            f"its mirror in `terms`, in a function of your own. {HINT}"
        )
    clip = cfg.clip
    is_even = clip is None or clip[0] == -clip[1]
    if not isinstance(cfg.scale, int | float | None) or not is_even:
        raise ValueError(
            f"{owner}: mirror_left_right expected a scalar scale and a clip (-c, c), got scale "
            f"{cfg.scale!r} and clip {clip!r}. {HINT}"
        )
    mirror = Mirror.concatenate([kind(robot, cfg.params)] * instants)
    if shape != (len(mirror),):
        raise ValueError(
            f"{owner}: mirror_left_right expected shape ({len(mirror)},) per environment, got {shape}; "
            f"select all joints, and flatten the history. {HINT}"
        )
    return mirror


# Mirrors of terms.


def of_direction(robot: SymmetricRobot, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a vector in the frame of the root, such as a velocity: y changes sign."""
    return Mirror(range(3), DIRECTION)


def of_rotation(robot: SymmetricRobot, params: dict[str, Any]) -> Mirror:
    """Return the mirror of an axial vector in it, such as an angular velocity: x and z change sign."""
    return Mirror(range(3), ROTATION)


def _of_sensor(robot: SymmetricRobot, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a gyro, velocimeter or accelerometer, without lever arm effects."""
    sensor = _sensor(robot, params["sensor_name"])
    is_off_center = abs(sensor.y) > _PLANE_TOLERANCE
    if sensor.kind == mujoco.mjtSensor.mjSENS_ACCELEROMETER and is_off_center:
        raise ValueError(
            f"Accelerometer {sensor.name!r}: expected a position on the mirror plane, got "
            f"{sensor.y:.3g} m to its left. Its mirror image would need the angular acceleration, "
            f"an unobserved quantity. {HINT}"
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


def _sensor(robot: SymmetricRobot, name: str) -> _Sensor:
    """Return a gyro, velocimeter or accelerometer. Raises unless its site is aligned with the root."""
    model = robot.model
    found = model.sensor(name)
    kind, site = mujoco.mjtSensor(int(found.type.item())), int(found.objid.item())
    if kind not in _SENSOR_SIGNS:
        raise ValueError(
            f"Sensor {name!r}: mirror_left_right expected a gyro, velocimeter or accelerometer, got "
            f"{kind.name}. {HINT}"
        )
    body = int(model.site_bodyid[site])
    if np.abs(robot.data.site_xmat[site] - robot.rotation.ravel()).max() > _TOLERANCE:
        raise ValueError(
            f"Sensor {name!r}: mirror_left_right expected the orientation of the robot's root at qpos0, got "
            f"a rotated site. {HINT}"
        )
    if not robot.is_central(body):
        raise ValueError(
            f"Sensor {name!r}: expected a body on the mirror plane, got {model.body(body).name!r} on one "
            f"side of the robot. {HINT}"
        )
    return _Sensor(name, kind, body, robot.left_of_plane(robot.data.site_xpos[site]))


def _lever_arms(
    robot: SymmetricRobot, group: str, spans: dict[str, tuple[int, int]]
) -> list[Coupling]:
    """Return the lever arm corrections of mirrored linear velocities.

    The mirror image of a sensor at distance y from the mirror plane is at -y, but the sensor of the
    mirrored robot is at y. With the mirrored angular velocity w', the sensor reads

        v' = S v + w' x (0, 2 y, 0) = S v + 2 y (w_z, 0, -w_x).

    Args:
        robot: The robot.
        group: Observation group name.
        spans: First column and number of time steps of each term of the group.

    Raises:
        ValueError: the group does not observe the required angular velocity.
    """
    terms = {name: robot.env.cfg.observations[group].terms[name] for name in spans}
    # `_mirror_of_term` accepts no other scales.
    scales = {name: cast("float | None", cfg.scale) for name, cfg in terms.items()}
    factors = {name: 1.0 if scale is None else scale for name, scale in scales.items()}
    sensors = {
        name: _sensor(robot, cfg.params["sensor_name"])
        for name, cfg in terms.items()
        if cfg.func is envs_mdp.builtin_sensor
    }
    turning = {n: s.body for n, s in sensors.items() if s.kind == mujoco.mjtSensor.mjSENS_GYRO}
    for name, cfg in terms.items():
        if cfg.func is envs_mdp.base_ang_vel:
            turning[name] = robot.root
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
        elif abs(sensor.y) > _PLANE_TOLERANCE:
            raise ValueError(
                f"Observation {group}/{name}: expected a velocimeter on the mirror plane, got one "
                f"{sensor.y:.3g} m to its left. Its mirror image depends on the angular velocity of "
                f"{robot.model.body(sensor.body).name!r}; add that to group {group!r}, with the same "
                "history_length, and without delay or with the same fixed delay, or use "
                f"base_lin_vel. {HINT}"
            )
    return couplings


def _of_joints(robot: SymmetricRobot, params: dict[str, Any]) -> Mirror:
    asset_cfg = params.get("asset_cfg")
    if asset_cfg is None:
        return mirror_of_joints(robot.model, robot.entity, robot.pairs)
    if asset_cfg.preserve_order:
        raise ValueError(
            f"mirror_left_right asset_cfg: expected joints in model order, got preserve_order=True. {HINT}"
        )
    entity: Entity = robot.env.scene[asset_cfg.name]
    names = None
    if asset_cfg.joint_names is not None:
        names = entity.find_joints(asset_cfg.joint_names)[1]
    return mirror_of_joints(robot.model, entity, robot.pairs, names)


def of_actions(robot: SymmetricRobot, params: dict[str, Any] | None = None) -> Mirror:
    """Return the mirror of the actions of one `JointPositionAction`."""
    manager = robot.env.action_manager
    terms = {name: manager.get_term(name) for name in manager.active_terms}
    (term, *others) = terms.values()
    if others or not isinstance(term, envs_mdp.JointPositionAction):
        kinds = ", ".join(f"{name} ({type(term).__name__})" for name, term in terms.items())
        raise ValueError(
            f"mirror_left_right actions: expected one JointPositionAction, got {kinds}. {HINT}"
        )
    mirror = mirror_of_joints(robot.model, robot.entity, robot.pairs, term.target_names)
    size = len(mirror)
    scale = torch.as_tensor(term.scale, dtype=torch.float32).expand(robot.env.num_envs, size)
    if not torch.allclose(scale[:, mirror.sources], scale):
        raise ValueError(
            f"mirror_left_right actions: expected the same scale on both sides, got {term.cfg.scale}. {HINT}"
        )
    return mirror


def _of_rays(robot: SymmetricRobot, params: dict[str, Any]) -> Mirror:
    """Return the mirror of the rays of a sensor with one frame on the mirror plane."""
    cfg = robot.env.scene[params["sensor_name"]].cfg
    frames = cfg.frame if isinstance(cfg.frame, tuple) else (cfg.frame,)
    rays = torch.cat(cfg.pattern.generate_rays(robot.model, "cpu"), dim=1)
    distances = (
        (rays * torch.tensor(2 * DIRECTION, dtype=torch.float32))[:, None] - rays[None]
    ).norm(dim=-1)
    frame = frames[0]
    element = getattr(robot.model, frame.type)(frame.prefixed_name())
    is_central = len(frames) == 1 and robot.is_on_plane(frame.type, element.id)
    if not is_central or (distances.min(dim=1).values > _TOLERANCE).any():
        raise ValueError(
            f"Sensor {params['sensor_name']!r}: mirror_left_right expected symmetric rays; use one frame on "
            f"the mirror plane of the robot, and a pattern that is symmetric in y. {HINT}"
        )
    return Mirror(distances.argmin(dim=1).tolist(), [1.0] * len(rays))


TERMS: dict[Any, MirrorOfTerm] = {
    envs_mdp.builtin_sensor: _of_sensor,
    envs_mdp.base_lin_vel: of_direction,
    envs_mdp.base_ang_vel: of_rotation,
    envs_mdp.projected_gravity: of_direction,
    envs_mdp.joint_pos_rel: _of_joints,
    envs_mdp.joint_vel_rel: _of_joints,
    envs_mdp.last_action: of_actions,
    envs_mdp.height_scan: _of_rays,
}
"""Mirrors of the observation functions of all tasks."""


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


def mirror_of_joints(
    model: mujoco.MjModel,
    robot: Entity,
    pairs: Mapping[str, str] | None = None,
    names: Sequence[str] | None = None,
) -> Mirror:
    """Return the mirror of joints of entity `robot`.

    The sign of a joint is -1 if the mirror image of its axis is opposite to the partner's axis.

    Args:
        model: Model of the scene.
        robot: The robot.
        pairs: Names of joints and of their partners; others are found by geometry (`mirror_pairs`).
        names: Names of the joints, in the order of the mirror. None: all, in entity order.

    Raises:
        ValueError: a joint has no mirror image, or its default position is not that of its partner.
    """
    names = list(robot.joint_names if names is None else names)
    ids = [int(robot.indexing.joint_ids[robot.joint_names.index(name)]) for name in names]
    root = int(robot.indexing.root_body_id)
    found = mirror_pairs(model, root, pairs)
    if any(joint not in found for joint in ids):
        described = describe_unpaired(model, root, pairs)
        raise ValueError(
            "mirror_left_right joints: expected mirror images in the x-z plane of "
            f"{model.body(root).name!r}, got none of {', '.join(described[i] for i in ids if i in described)}"
            f"; name partners in `pairs`. {HINT}"
        )
    sources, signs = [], np.array([found[joint].sign for joint in ids])
    for position, joint in enumerate(ids):
        partner = found[joint].joint
        if partner in ids:
            sources.append(ids.index(partner))
            continue
        factor = _coupling_factor(model, partner, joint)
        if factor is None:
            raise ValueError(
                f"mirror_left_right joints: expected joints of both sides, got {names}. {HINT}"
            )
        # A finger that the other one follows stands for both.
        sources.append(position)
        signs[position] *= factor
    columns = [robot.joint_names.index(name) for name in names]
    pose = robot.data.default_joint_pos[0].cpu().numpy()[columns]
    differences = np.abs(pose - signs * pose[sources])
    if differences.max() > _POSE_TOLERANCE:
        pair = [int(differences.argmax()), sources[int(differences.argmax())]]
        raise ValueError(
            f"Joint {names[pair[0]]!r} is not the mirror image of {names[pair[1]]!r}: default positions "
            f"{pose[pair].round(4).tolist()}, sign {signs[pair[0]]:+.0f}. {HINT}"
        )
    return Mirror(sources, signs.tolist())


def _coupling_factor(model: mujoco.MjModel, follower: int, joint: int) -> float | None:
    """Return +-1 if an equality constraint makes joint `follower` that multiple of `joint`, else None."""
    is_coupling = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0
    for index in np.flatnonzero(is_coupling):
        if {model.eq_obj1id[index], model.eq_obj2id[index]} == {follower, joint}:
            offset, factor, *curvature = model.eq_data[index, :5].tolist()
            return factor if abs(factor) == 1.0 and not any((offset, *curvature)) else None
    return None
