"""Mirror images of what a legged robot senses and does, so that PPO learns from both sides at once.

A robot whose left is made like its right can take the mirror image of each sample as one more
sample, which costs no physics (Mittal et al., "Symmetry Considerations for Learning Task Symmetric
Robot Policies", ICRA 2024). `mirror_left_right` is what `symmetry_cfg` of `RslRlPpoAlgorithmCfg`
names.

The mirror is the plane of x and z of the robot's root. In it directions change the sign of y, and axes of
rotation those of x and z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
import torch

from mjlab.envs import mdp as envs_mdp
from mjlab.tasks.velocity import mdp

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

DIRECTION = (1.0, -1.0, 1.0)
ROTATION = (-1.0, 1.0, -1.0)
_SIDES = {"left": "right", "FL": "FR", "RL": "RR"}
_OTHER_SIDE = _SIDES | {right: left for left, right in _SIDES.items()}

# By how much partners may differ: axes (unit vectors), default positions (rad), places (m).
_AXIS_TOLERANCE, _POSE_TOLERANCE, PLACE_TOLERANCE = 1e-4, 1e-3, 5e-3
WITHOUT = "To learn without mirror images, set agent.algorithm.symmetry_cfg to None."
_ROBOT = "robot"
_PLANAR_VELOCITY = (1.0, -1.0, -1.0)
# Of (sin, cos): the other side steps then, for walks and trots.
_HALF_A_CYCLE_LATER = (-1.0, -1.0)
_OF_SENSOR = {
    mujoco.mjtSensor.mjSENS_GYRO: ROTATION,
    mujoco.mjtSensor.mjSENS_VELOCIMETER: DIRECTION,
    mujoco.mjtSensor.mjSENS_ACCELEROMETER: DIRECTION,
}
# Metres, or parts of a unit vector, that rays and axes may be off.
_TOLERANCE = 1e-4
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
        mirrors = _known[env] = _Mirrors(env)
    if obs is not None:
        image = obs.clone()
        for group in set(image.keys()):
            image[group] = mirrors.groups[group](obs[group])
        obs = torch.cat([obs, image], dim=0)
    if actions is not None:
        actions = torch.cat([actions, mirrors.actions(actions)], dim=0)
    return obs, actions


class _Mirrors:
    """The mirrors of an environment's observation groups, by name, and of its actions."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        manager = env.observation_manager
        self.groups: dict[str, Mirror] = {}
        for group, names in manager.active_terms.items():
            if not manager.group_obs_concatenate[group]:
                raise ValueError(
                    f"The observation group {group!r} has concatenate_terms=False, and mirror_left_right "
                    f"takes groups that are one tensor. {WITHOUT}"
                )
            shapes = manager.group_obs_term_dim[group]
            terms = {
                name: _mirror_of_term(env, group, name, shape)
                for name, shape in zip(names, shapes, strict=True)
            }
            starts = accumulate(map(len, terms.values()), initial=0)
            couplings = _lever_arms(env, group, dict(zip(terms, starts, strict=False)))
            self.groups[group] = Mirror.joined(list(terms.values()), couplings)
        self.actions = _of_actions(env)


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
    mirror = Mirror.joined([kind(env, cfg.params)] * _num_instants(env, group, name))
    if shape != (len(mirror),):
        raise ValueError(
            f"{label} has shape {shape} for each environment, and mirror_left_right expects "
            f"({len(mirror)},): everything that the term measures, with any history flattened. {WITHOUT}"
        )
    return mirror


def _num_instants(env: ManagerBasedRlEnv, group: str, name: str) -> int:
    """Return the number of steps whose values a term shows, one behind the other."""
    return max(1, env.observation_manager.get_term_cfg(group, name).history_length)


# Terms: what each measures, and so its mirror image.


def _of_sensor(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a gyro or the like, apart from the lever arm of its place."""
    sensor = _sensor(env, params["sensor_name"])
    is_off = abs(sensor.y) > PLACE_TOLERANCE
    if sensor.kind == mujoco.mjtSensor.mjSENS_ACCELEROMETER and is_off:
        raise ValueError(
            f"Accelerometer {sensor.name!r} stands {sensor.y:.3g} m to the left of the middle. What "
            "it reads in the mirror depends on the angular acceleration, which is not observed; "
            f"place it in the middle. {WITHOUT}"
        )
    return Mirror(range(3), _OF_SENSOR[sensor.kind])


class _Sensor(NamedTuple):
    """A sensor at a site."""

    name: str
    kind: mujoco.mjtSensor
    body: int
    """Id of the body that carries it."""
    y: float
    """Distance from the mirror plane (m), positive to the left."""


def _sensor(env: ManagerBasedRlEnv, name: str) -> _Sensor:
    """Return a gyro, velocimeter or accelerometer at a site that is turned as the root is."""
    model = env.sim.mj_model
    found = model.sensor(name)
    kind, site = mujoco.mjtSensor(int(found.type.item())), int(found.objid.item())
    if kind not in _OF_SENSOR:
        raise ValueError(
            f"mirror_left_right knows gyros, velocimeters and accelerometers; sensor {name!r} is "
            f"none of these. {WITHOUT}"
        )
    data, root = _reference_pose(env)
    body = int(model.site_bodyid[site])
    if np.abs(data.site_xmat[site] - data.xmat[root]).max() > _TOLERANCE:
        raise ValueError(
            f"Sensor {name!r} is turned against the robot's root, so mirror_left_right does not know "
            f"which of its axes points to the left. {WITHOUT}"
        )
    carrier = model.body(body).name
    if other_side(carrier.split("/")[-1]) != carrier.split("/")[-1]:
        raise ValueError(
            f"Sensor {name!r} is on body {carrier!r}, on one side of the robot; expected a body in "
            f"the middle. {WITHOUT}"
        )
    return _Sensor(name, kind, body, _to_left(data, root, data.site_xpos[site]))


def _reference_pose(env: ManagerBasedRlEnv) -> tuple[mujoco.MjData, int]:
    """Return the kinematics at `qpos0`, and the id of the robot's root."""
    data = mujoco.MjData(env.sim.mj_model)
    mujoco.mj_kinematics(env.sim.mj_model, data)
    robot: Any = env.scene[_ROBOT]
    return data, robot.indexing.root_body_id


def _to_left(data: mujoco.MjData, root: int, point: np.ndarray) -> float:
    """Return the distance of a point from the mirror plane of the body `root` (m)."""
    return float((point - data.xpos[root]) @ data.xmat[root].reshape(3, 3)[:, 1])


def _lever_arms(env: ManagerBasedRlEnv, group: str, starts: dict[str, int]) -> list[Coupling]:
    """Return what the angular velocity adds to the mirror images of linear velocities.

    The mirror image of a sensor at distance y from the mirror plane is at distance -y, where the
    mirrored robot has none: its own reads, for w' the mirrored angular velocity,

        v' = S v + w' x (0, 2 y, 0) = S v + 2 y (w_z, 0, -w_x).

    Args:
        env: The environment.
        group: Name of the observation group.
        starts: First column of each of its terms.

    Raises:
        ValueError: the group does not observe the angular velocity that is needed.
    """
    configs: Any = env.cfg.observations
    terms = {name: configs[group].terms[name] for name in starts}
    instants = {name: _num_instants(env, group, name) for name in starts}
    sensors = {
        name: _sensor(env, cfg.params["sensor_name"])
        for name, cfg in terms.items()
        if cfg.func is envs_mdp.builtin_sensor
    }
    turning = {n: s.body for n, s in sensors.items() if s.kind == mujoco.mjtSensor.mjSENS_GYRO}
    for name, cfg in terms.items():
        if cfg.func is envs_mdp.base_ang_vel:
            turning[name] = _reference_pose(env)[1]

    def has_same_lag(*names: str) -> bool:
        lags = [(terms[name].delay_min_lag, terms[name].delay_max_lag) for name in names]
        return len({lag for bounds in lags for lag in bounds}) == 1

    couplings = []
    for name, sensor in sensors.items():
        if sensor.kind != mujoco.mjtSensor.mjSENS_VELOCIMETER or abs(sensor.y) < _TOLERANCE:
            continue
        gyro = next(
            (
                other
                for other, body in turning.items()
                if body == sensor.body
                and _factor(terms[other]) != 0.0
                and instants[other] == instants[name]
                and has_same_lag(name, other)
            ),
            None,
        )
        if gyro is not None:
            factor = 2.0 * sensor.y * _factor(terms[name]) / _factor(terms[gyro])
            for instant in range(instants[name]):
                x, _, z = range(starts[name] + 3 * instant, starts[name] + 3 * instant + 3)
                turn_x, _, turn_z = range(
                    starts[gyro] + 3 * instant, starts[gyro] + 3 * instant + 3
                )
                couplings += [Coupling(x, turn_z, factor), Coupling(z, turn_x, -factor)]
        elif abs(sensor.y) > PLACE_TOLERANCE:
            raise ValueError(
                f"The observation {group}/{name} is the velocity of a point {sensor.y:.3g} m to the "
                "left of the middle. Its mirror image depends on the angular velocity of "
                f"{env.sim.mj_model.body(sensor.body).name!r}; observe that in group {group!r} too, "
                "with the same history_length, and without delay or with the same fixed one, or use "
                f"base_lin_vel. {WITHOUT}"
            )
    return couplings


def _factor(cfg: Any) -> float:
    """Return the scale of a term, which is one number."""
    return 1.0 if cfg.scale is None else float(cfg.scale)


def _of_command(env: ManagerBasedRlEnv, params: dict[str, Any]) -> Mirror:
    term = env.command_manager.get_term(params["command_name"])
    if isinstance(term, mdp.UniformVelocityCommand):
        return Mirror(range(3), _PLANAR_VELOCITY)
    if isinstance(term, mdp.GaitClockCommand):
        return Mirror(range(2), _HALF_A_CYCLE_LATER)
    raise ValueError(
        "mirror_left_right knows velocity commands (UniformVelocityCommandCfg) and gait clocks "
        f"(GaitClockCommandCfg); {params['command_name']!r} is a {type(term).__name__}. {WITHOUT}"
    )


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
    scale = torch.as_tensor(term.scale, dtype=torch.float32).expand(env.num_envs, len(driven))
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
    apart = ((rays * torch.tensor(2 * DIRECTION, dtype=torch.float32))[:, None] - rays[None]).norm(
        dim=-1
    )
    data, root = _reference_pose(env)
    frame = frames[0]
    element = getattr(env.sim.mj_model, frame.type)(frame.prefixed_name())
    points = {"body": data.xpos, "site": data.site_xpos, "geom": data.geom_xpos}[frame.type]
    is_central = (
        len(frames) == 1
        and other_side(frame.name) == frame.name
        and abs(_to_left(data, root, points[element.id])) <= PLACE_TOLERANCE
    )
    if not is_central or (apart.min(dim=1).values > _TOLERANCE).any():
        raise ValueError(
            f"The rays of sensor {params['sensor_name']!r} are not the same on both sides, so that "
            "mirror_left_right cannot swap them. Give it one frame in the middle of the robot, and a "
            f"pattern with as much on the left as on the right. {WITHOUT}"
        )
    return Mirror(apart.argmin(dim=1).tolist(), [1.0] * len(rays))


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
    mdp.foot_contact_forces: _of_foot_vectors,
}


# Mirrors of vectors, and the left and right of joints and feet.


class Mirror:
    """Mirror image of a vector of numbers.

    Number i is `signs[i]` times number `sources[i]`, and what the couplings of i add.
    """

    def __init__(
        self, sources: Sequence[int], signs: Sequence[float], couplings: Sequence[Coupling] = ()
    ) -> None:
        """Take indices and signs, of one length."""
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
        """Return the mirror image of `values` (N, numbers)."""
        if self.signs.device != values.device:
            for name in ("sources", "signs", "_targets", "_read", "_factors"):
                setattr(self, name, getattr(self, name).to(values.device))
        image = values[:, self.sources] * self.signs
        if len(self._targets):
            image.index_add_(1, self._targets, values[:, self._read] * self._factors)
        return image

    @staticmethod
    def joined(mirrors: Sequence[Mirror], couplings: Sequence[Coupling] = ()) -> Mirror:
        """Return the mirror of vectors that stand one behind the other, coupled as given."""
        sources: list[int] = []
        signs: list[float] = []
        for mirror in mirrors:
            sources += [len(signs) + source for source in mirror.sources.tolist()]
            signs += mirror.signs.tolist()
        return Mirror(sources, signs, couplings)


class Coupling(NamedTuple):
    """A share of one number in the mirror image of another."""

    target: int
    """Number of the image."""
    source: int
    """Number that is read."""
    factor: float


def mirror_of_joints(model: mujoco.MjModel, robot: Any) -> Mirror:
    """Return the mirror of the joints of `robot`, an entity, in its order.

    Joints belong together by their names. A joint turns, or slides, the other way in the mirror
    where the mirror image of its axis points against its partner's.

    Raises:
        ValueError: a joint is not the mirror image of its partner.
    """
    names = robot.joint_names
    pairs = partners(names)
    axes, places, is_slide = _joint_frames(model, robot)
    reflect = torch.where(
        is_slide[:, None],
        torch.tensor(DIRECTION, dtype=torch.float32),
        torch.tensor(ROTATION, dtype=torch.float32),
    )
    signs = ((axes * reflect)[pairs] * axes).sum(dim=1)
    pose = robot.data.default_joint_pos[0].cpu()
    apart = (places[pairs] * torch.tensor(DIRECTION, dtype=torch.float32) - places).norm(dim=1)
    for i, partner in enumerate(pairs):
        if (
            abs(abs(signs[i]) - 1) > _AXIS_TOLERANCE
            or apart[i] > PLACE_TOLERANCE
            or abs(pose[i] - signs[i] * pose[partner]) > _POSE_TOLERANCE
        ):
            raise ValueError(
                f"Joint {names[i]!r} is not the mirror image of {names[partner]!r}: axes "
                f"{_shown(axes[i])} and {_shown(axes[partner])}, places {_shown(places[i])} and "
                f"{_shown(places[partner])}, default positions {pose[i]:.4g} and {pose[partner]:.4g}. "
                "Joints belong together by these parts of their names: "
                f"{', '.join(_OTHER_SIDE)}. {WITHOUT}"
            )
    return Mirror(pairs, signs.round().tolist())


def _joint_frames(
    model: mujoco.MjModel, robot: Any
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return axes and places (joints, 3) in the frame of the root at `qpos0`, and which slide."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    root = int(robot.indexing.root_body_id)
    ids = robot.indexing.joint_ids.tolist()
    to_root = data.xmat[root].reshape(3, 3)
    axes = data.xaxis[ids] @ to_root
    places = (data.xanchor[ids] - data.xpos[root]) @ to_root
    is_slide = model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_SLIDE
    return (
        torch.tensor(axes, dtype=torch.float32),
        torch.tensor(places, dtype=torch.float32),
        torch.tensor(is_slide),
    )


def _shown(vector: torch.Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in vector.tolist()) + ")"


def partners(names: Sequence[str]) -> list[int]:
    """Return the index of what is on the other side, for each name; what is in the middle stays.

    Raises:
        ValueError: the other side of a name is not among them.
    """
    others = [other_side(name) for name in names]
    missing = sorted(set(others) - set(names))
    if missing:
        raise ValueError(
            f"mirror_left_right finds no {', '.join(missing)} among {', '.join(names)}. It knows the "
            f"sides by these parts of names: {', '.join(_OTHER_SIDE)}. {WITHOUT}"
        )
    return [list(names).index(other) for other in others]


def other_side(name: str) -> str:
    """Return the name of what is on the other side; the same for what is in the middle."""
    return "_".join(_OTHER_SIDE.get(part, part) for part in name.split("_"))
