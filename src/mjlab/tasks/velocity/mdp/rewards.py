"""Reward terms of the velocity task, without weight. Each returns (N,).

Derived quantities (velocities of links, orientations, contacts) are one physics substep old here,
and what rays see is one environment step old; `ManagerBasedRlEnv.step` says why. A command is the
one that the policy saw.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import older_names
from mjlab.envs.mdp._checks import (
    check_contact_sensor,
    check_std,
    require_command,
    require_sensor,
)
from mjlab.envs.mdp._indexing import columns
from mjlab.managers.build_checks import checked_when_built
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.sensor import RayCastSensor
from mjlab.tasks.velocity.mdp._shared import (
    command_speed,
    log_metric,
    masked_mean,
    single_body,
    tilt_of,
    values_of_joints,
    velocity_command,
)
from mjlab.tasks.velocity.mdp.feet_rewards import feet_air_time as feet_air_time
from mjlab.tasks.velocity.mdp.feet_rewards import feet_clearance as feet_clearance
from mjlab.tasks.velocity.mdp.feet_rewards import feet_slip as feet_slip
from mjlab.tasks.velocity.mdp.feet_rewards import feet_swing_height as feet_swing_height
from mjlab.tasks.velocity.mdp.feet_rewards import soft_landing as soft_landing
from mjlab.tasks.velocity.mdp.sensor_checks import check_builtin_sensor
from mjlab.tasks.velocity.mdp.terrain_utils import terrain_normal_from_sensors
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.reward_manager import RewardTermCfg
    from mjlab.viewer.debug_visualizer import DebugVisualizer

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")

__getattr__ = older_names(__name__)


def _check_tracking(env: ManagerBasedRlEnv, std: float, command_name: str, **_: Any) -> None:
    check_std(std)
    require_command(env, command_name)


@checked_when_built(_check_tracking)
def track_linear_velocity(
    env: ManagerBasedRlEnv,
    std: float,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Reward following the commanded horizontal velocity, without vertical velocity:

        exp(-(|c_xy - v_xy|^2 + v_z^2) / std^2)

    with v the velocity of the root link in its own frame (m/s).
    """
    asset: Entity = env.scene[asset_cfg.name]
    command = velocity_command(env, command_name)
    error = asset.data.root_link_lin_vel_b.clone()
    error[:, :2].sub_(command[:, :2])
    return torch.exp(error.square().sum(dim=1) / -(std**2))


@checked_when_built(_check_tracking)
def track_angular_velocity(
    env: ManagerBasedRlEnv,
    std: float,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Reward following the commanded yaw rate, without roll and pitch:

        exp(-((c_z - w_z)^2 + w_x^2 + w_y^2) / std^2)

    with w the angular velocity of the root link in its own frame (rad/s). In environments that
    keep a heading, c_z is the yaw rate that heading control asks for.
    """
    asset: Entity = env.scene[asset_cfg.name]
    command = velocity_command(env, command_name)
    error = asset.data.root_link_ang_vel_b.clone()
    error[:, 2].sub_(command[:, 2])
    return torch.exp(error.square().sum(dim=1) / -(std**2))


class upright:
    """Reward a body that stands upright, or perpendicular to the ground.

    It is `exp(-(n_x^2 + n_y^2) / std^2)`, where n is the unit vector down, or, with terrain
    sensors, the normal of the ground that they see, in the frame of the body. At a tilt t the
    exponent is `-sin(t)^2 / std^2`.

    Params:
        std: Sine of the tilt at which the reward is 1/e; positive.
        asset_cfg: Entity and one body; the root link where no body is selected.
        terrain_sensor_names: Ray sensors that see the ground. Their hits are those of the last
            environment step.

    Raises, when built: `ValueError` for several bodies or a sensor that does not exist, `TypeError`
    for one that casts no rays.
    """

    _transient = {"_normal"}

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        check_std(cfg.params["std"])
        self._env = env
        self._asset_cfg: SceneEntityCfg = cfg.params.get("asset_cfg", _DEFAULT_ASSET_CFG)
        self._body = single_body(env, self._asset_cfg)
        for name in cfg.params.get("terrain_sensor_names") or ():
            require_sensor(env, name, RayCastSensor)
        self._up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float32, device=env.device)
        # What the last reward was compared with, for drawing.
        self._normal = self._up.repeat(env.num_envs, 1)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        std: float,
        asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
        terrain_sensor_names: tuple[str, ...] | None = None,
    ) -> torch.Tensor:
        """Return the reward."""
        quat = self._quat()
        if terrain_sensor_names:
            # Into the term's own memory: a rollout under `inference_mode` would otherwise leave a
            # tensor that `reset` may not write afterwards.
            self._normal.copy_(terrain_normal_from_sensors(env, terrain_sensor_names))
            tilt = quat_apply_inverse(quat, self._normal)[:, :2].square().sum(dim=1)
        else:
            tilt = tilt_of(quat)
        return torch.exp(tilt / -(std**2))

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Forget the ground that these environments stood on."""
        self._normal[slice(None) if env_ids is None else env_ids] = self._up[0]

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw the direction to be upright to (green), and that of the body (blue)."""
        data = self._env.scene[self._asset_cfg.name].data
        for index in visualizer.get_env_indices(self._env.num_envs):
            start = data.root_link_pos_w[index]
            if self._body is not None:
                start = data.body_link_pos_w[index, self._body]
            own = quat_apply(self._quat()[index : index + 1], self._up)[0]
            base = start.cpu().numpy()
            for direction, color in (
                (self._normal[index], (0.2, 0.8, 0.2, 0.8)),
                (own, (0.2, 0.4, 1.0, 0.8)),
            ):
                visualizer.add_arrow(base, base + 0.3 * direction.cpu().numpy(), color)

    def _quat(self) -> torch.Tensor:
        data = self._env.scene[self._asset_cfg.name].data
        if self._body is None:
            return data.root_link_quat_w
        return data.body_link_quat_w[:, self._body]


@checked_when_built(check_contact_sensor)
def self_collision_cost(
    env: ManagerBasedRlEnv, sensor_name: str, force_threshold: float = 10.0
) -> torch.Tensor:
    """Count unwanted contacts, of the robot with itself or with the ground.

    With a history of forces it is the number of those last substeps in which any contact had a
    force above `force_threshold` (N), without one the number of contacts.
    """
    data = env.scene[sensor_name].data
    if data.force_history is None:
        return data.found.sum(dim=1).float()
    hits = data.force_history.square().sum(dim=-1) > force_threshold**2
    return hits.any(dim=1).sum(dim=1).float()


def _check_body(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG, **_: Any
) -> None:
    single_body(env, asset_cfg)


@checked_when_built(_check_body)
def body_angular_velocity_penalty(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Squared roll and pitch rate of a body, in world axes (rad^2/s^2).

    Raises:
        ValueError: several bodies are selected. Without a selection it is the root.
    """
    asset: Entity = env.scene[asset_cfg.name]
    body = single_body(env, asset_cfg)
    if body is None:
        velocity = asset.data.root_link_ang_vel_w
    else:
        velocity = asset.data.body_link_ang_vel_w[:, body]
    return velocity[:, :2].square().sum(dim=1)


@checked_when_built(check_builtin_sensor)
def angular_momentum_penalty(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Squared norm of the angular momentum that a MuJoCo sensor measures (kg^2 m^4/s^2)."""
    squared = env.scene[sensor_name].data.square().sum(dim=1)
    log_metric(env, "angular_momentum_mean", masked_mean(squared.sqrt(), squared >= 0.0))
    return squared


class variable_posture:
    """`exp(-mean_j ((q_j - q0_j) / std_j)^2)` with standard deviations that depend on the command.

    q0 are the default joint positions. With the commanded motion `s = |c_xy| + |c_z|` the standard
    deviations are those of standing (s < walking_threshold), walking, or running
    (s >= running_threshold).

    Params:
        std_standing: Dict of joint name pattern to standard deviation (rad or m). Read once; every
            selected joint must match one pattern, and every pattern a joint.
        std_walking: The same for walking.
        std_running: The same for running.
        asset_cfg: Entity and joints; `joint_names` must be set.
        command_name: The velocity command.
        walking_threshold: Least commanded motion that counts as walking.
        running_threshold: Least commanded motion that counts as running.

    Raises, when built: `ValueError` for a table that does not fit the joints, standard deviations
    that are not positive, thresholds in the wrong order, or no such command.
    """

    # Follows from the config, so it is no run-time state.
    _transient = {"_weights"}

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        params = cfg.params
        require_command(env, params["command_name"])
        thresholds = params.get("walking_threshold", 0.5), params.get("running_threshold", 1.5)
        if thresholds[0] > thresholds[1]:
            raise ValueError(
                f"walking_threshold is {thresholds[0]} and running_threshold is {thresholds[1]}; "
                "running cannot start at less motion than walking."
            )
        asset_cfg: SceneEntityCfg = params["asset_cfg"]
        if asset_cfg.joint_names is None:
            raise ValueError(
                "asset_cfg.joint_names must be set, since standard deviations are given by joint "
                "name. Use ('.*',) for all joints."
            )
        # The names are in the order of the joint ids, whichever order the config asks for.
        joints = list(asset_cfg.joint_names)
        tables = [f"std_{gait}" for gait in ("standing", "walking", "running")]
        stds = torch.tensor(
            [values_of_joints(joints, name, params[name], above=0.0) for name in tables],
            dtype=torch.float32,
        )
        # (3, joints): what squared errors are weighted with, which makes their sum a mean.
        self._weights = (1.0 / (stds.square() * len(joints))).to(env.device)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        std_standing: object,
        std_walking: object,
        std_running: object,
        asset_cfg: SceneEntityCfg,
        command_name: str,
        walking_threshold: float = 0.5,
        running_threshold: float = 1.5,
    ) -> torch.Tensor:
        """Return the reward."""
        asset: Entity = env.scene[asset_cfg.name]
        joints = columns(asset_cfg.joint_ids, env.device)
        error = asset.data.joint_pos[:, joints] - asset.data.default_joint_pos[:, joints]
        speed = command_speed(env, command_name)
        gait = (speed >= walking_threshold).long() + (speed >= running_threshold).long()
        return torch.exp(-(error.square_() * self._weights[gait]).sum(dim=1))
