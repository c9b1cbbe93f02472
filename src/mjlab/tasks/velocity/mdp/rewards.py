"""Reward terms of the velocity task, unweighted, (N,).

Derived quantities (link velocities, orientations, contacts) are one physics substep old, and ray hits
one environment step old; see `ManagerBasedRlEnv.step`. Commands are those that the policy observed.

Foot terms combine columns of different sources (contacts, heights, sites), so all sources must list the
feet in the same order. Terms warn of any other order: classes when they are built, functions in the
first step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import accepts_older_params, older_names
from mjlab.envs.mdp.rewards import self_collision_cost as self_collision_cost
from mjlab.envs.mdp.rewards import values_of_joints
from mjlab.managers import RewardTermCfg, SceneEntityCfg
from mjlab.managers.scene_entity_config import columns_of
from mjlab.tasks.velocity.mdp.observations import check_same_feet
from mjlab.tasks.velocity.mdp.terrain_utils import terrain_normal_from_sensors
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import DebugVisualizer

__all__ = [
    "angular_momentum_penalty",
    "body_angular_velocity_penalty",
    "feet_air_time",
    "feet_clearance",
    "feet_slip",
    "feet_swing_height",
    "soft_landing",
    "track_ang_vel_z_exp",
    "track_angular_velocity",
    "track_linear_velocity",
    "upright",
    "variable_posture",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")
_NORMAL_COLOR = (0.2, 0.8, 0.2, 0.8)
_BODY_Z_COLOR = (0.2, 0.4, 1.0, 0.8)


def track_linear_velocity(
    env: ManagerBasedRlEnv,
    std: float,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Reward tracking of the commanded horizontal velocity, and zero vertical velocity:

        exp(-(|c_xy - v_xy|^2 + v_z^2) / std^2)

    with v the root link velocity in its own frame (m/s).
    """
    asset: Entity = env.scene[asset_cfg.name]
    command = velocity_command(env, command_name)
    error = asset.data.root_link_lin_vel_b.clone()
    error[:, :2].sub_(command[:, :2])
    return torch.exp(error.square().sum(dim=1) / -(std**2))


def track_angular_velocity(
    env: ManagerBasedRlEnv,
    std: float,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Reward tracking of the commanded yaw rate, and zero roll and pitch rate:

        exp(-((c_z - w_z)^2 + w_x^2 + w_y^2) / std^2)

    with w the root link angular velocity in its own frame (rad/s). For heading commands, c_z is the
    output of heading control.
    """
    asset: Entity = env.scene[asset_cfg.name]
    command = velocity_command(env, command_name)
    error = asset.data.root_link_ang_vel_b.clone()
    error[:, 2].sub_(command[:, 2])
    return torch.exp(error.square().sum(dim=1) / -(std**2))


def track_ang_vel_z_exp(
    env: ManagerBasedRlEnv,
    std: float,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Reward tracking of the commanded yaw rate alone: exp(-(c_z - w_z)^2 / std^2).

    w_z is the yaw rate of the root link in its own frame (rad/s). A robot that rolls and pitches at 0.5 rad/s
    while it walks gets as much as one that does not; see `track_angular_velocity`.
    """
    command = velocity_command(env, command_name)
    error = command[:, 2] - env.scene[asset_cfg.name].data.root_link_ang_vel_b[:, 2]
    return torch.exp(error.square_() / -(std**2))


class upright:
    """Reward a body that is upright, or perpendicular to the terrain.

    The reward is `exp(-(n_x^2 + n_y^2) / std^2)`, with n the direction of gravity or, with terrain
    sensors, the terrain normal, in the body frame. At tilt angle θ the exponent is `-sin(θ)^2 / std^2`.

    Params:
        std: Sine of the tilt that reduces the reward to 1/e; positive.
        asset_cfg: Entity and one body; the root link by default.
        terrain_sensor_names: Ray sensors of the terrain normal. Hits are those of the last environment
            step.

    Raises, when built: `ValueError` for several bodies.
    """

    _transient = {"_normal"}

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        self._env = env
        self._asset_cfg: SceneEntityCfg = cfg.params.get("asset_cfg", _DEFAULT_ASSET_CFG)
        self._body = single_body(env, self._asset_cfg)
        self._up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float32, device=env.device)
        # Reference direction of the last reward, for drawing.
        self._normal = self._up.repeat(env.num_envs, 1)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        std: float,
        asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
        terrain_sensor_names: tuple[str, ...] | None = None,
    ) -> torch.Tensor:
        """Return the reward."""
        quat = body_quat(env.scene[asset_cfg.name].data, self._body)
        if terrain_sensor_names:
            # Copied in place: assignment in a rollout under `inference_mode` would leave an inference
            # tensor, and `reset` could not write it afterwards.
            self._normal.copy_(terrain_normal_from_sensors(env, terrain_sensor_names))
            tilt = quat_apply_inverse(quat, self._normal)[:, :2].square().sum(dim=1)
        else:
            tilt = tilt_of(quat)
        return torch.exp(tilt / -(std**2))

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Reset the drawn normal of `env_ids` to world z."""
        self._normal[slice(None) if env_ids is None else env_ids] = self._up[0]

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw the reference direction (green) and the body z axis (blue)."""
        data = self._env.scene[self._asset_cfg.name].data
        quat = body_quat(data, self._body)
        visualizer.add_legend(_NORMAL_COLOR, "terrain normal")
        visualizer.add_legend(_BODY_Z_COLOR, "body z axis")
        for index in visualizer.get_env_indices(self._env.num_envs):
            start = data.root_link_pos_w[index]
            if self._body is not None:
                start = data.body_link_pos_w[index, self._body]
            body_z = quat_apply(quat[index : index + 1], self._up)[0]
            base = start.cpu().numpy()
            for direction, color in (
                (self._normal[index], _NORMAL_COLOR),
                (body_z, _BODY_Z_COLOR),
            ):
                visualizer.add_arrow(base, base + 0.3 * direction.cpu().numpy(), color)


def single_body(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> int | None:
    """Return the index of the selected body; None for the root, without selection or with an empty one.

    Raises:
        ValueError: several bodies are selected; the message names them.
    """
    ids = asset_cfg.body_ids
    if isinstance(ids, slice):
        if asset_cfg.body_names is None:
            return None
        ids = range(env.scene[asset_cfg.name].num_bodies)[ids]
    if len(ids) > 1:
        names = [env.scene[asset_cfg.name].body_names[i] for i in ids]
        raise ValueError(
            f"asset_cfg: expected exactly one body of entity {asset_cfg.name!r}, got {names}; omit "
            "body_names for the root."
        )
    return ids[0] if len(ids) == 1 else None


def body_quat(data: Any, body: int | None) -> torch.Tensor:
    """Return the orientation of a body, or of the root link for None, (N, 4)."""
    return data.root_link_quat_w if body is None else data.body_link_quat_w[:, body]


def body_angular_velocity_penalty(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Squared x and y angular velocity of a body in the world frame (rad^2/s^2). Default: the root link.

    Raises:
        ValueError: several bodies are selected.
    """
    asset: Entity = env.scene[asset_cfg.name]
    body = single_body(env, asset_cfg)
    if body is None:
        velocity = asset.data.root_link_ang_vel_w
    else:
        velocity = asset.data.body_link_ang_vel_w[:, body]
    return velocity[:, :2].square().sum(dim=1)


def angular_momentum_penalty(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Squared norm of the angular momentum from a MuJoCo sensor (kg^2 m^4/s^2)."""
    squared = env.scene[sensor_name].data.square().sum(dim=1)
    log_metric(env, "angular_momentum_mean", masked_mean(squared.sqrt(), squared >= 0.0))
    return squared


class variable_posture:
    """`exp(-mean_j ((q_j - q0_j) / std_j)^2)` with standard deviations that depend on the command.

    q0 are the default joint positions. The commanded motion `s = |c_xy| + |c_z|` selects the standard
    deviations: standing (s < walking_threshold), walking, or running (s >= running_threshold).

    Params:
        std_standing: Dict of joint name pattern to standard deviation (rad or m), read once. Every
            selected joint must match exactly one pattern, and every pattern a joint.
        std_walking: Standard deviations for walking.
        std_running: Standard deviations for running.
        asset_cfg: Entity and joints; all joints without `joint_names`.
        command_name: Velocity command.
        walking_threshold: Minimum commanded motion of walking.
        running_threshold: Minimum commanded motion of running.

    Raises, when built: `ValueError` for tables that do not match the joints.
    """

    # Derived from the config; not checkpointed.
    _transient = {"_weights"}

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        params = cfg.params
        stds = torch.tensor(
            [
                values_of_joints(env, params["asset_cfg"], name, params[name])
                for name in ("std_standing", "std_walking", "std_running")
            ],
            dtype=torch.float32,
        )
        # Weights of squared errors, (3, joints); 1 / joints makes the sum a mean.
        self._weights = (1.0 / (stds.square() * stds.shape[1])).to(env.device)

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
        joints = columns_of(asset_cfg, "joint", env)
        error = asset.data.joint_pos[:, joints] - asset.data.default_joint_pos[:, joints]
        speed = command_speed(env, command_name)
        gait = (speed >= walking_threshold).long() + (speed >= running_threshold).long()
        return torch.exp(-(error.square_() * self._weights[gait]).sum(dim=1))


# Feet: air time, clearance, swing height, slip, landing.


def feet_air_time(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    threshold_min: float = 0.05,
    threshold_max: float = 0.5,
    command_name: str | None = None,
    command_threshold: float = 0.5,
) -> torch.Tensor:
    """Number of feet with an air time between `threshold_min` and `threshold_max` (s).

    Args:
        env: The environment.
        sensor_name: Contact sensor of the feet, with `track_air_time`.
        threshold_min: Lower bound of the air time, exclusive (s).
        threshold_max: Upper bound of the air time, exclusive (s).
        command_name: Velocity command that enables the reward. None: always enabled.
        command_threshold: Commanded motion that must be exceeded to enable the reward.
    """
    air_time = env.scene[sensor_name].data.current_air_time
    log_metric(env, "air_time_mean", masked_mean(air_time, air_time > 0.0))
    swinging = (air_time > threshold_min) & (air_time < threshold_max)
    return if_commanded(swinging.sum(dim=1).float(), env, command_name, command_threshold)


@accepts_older_params
def feet_clearance(
    env: ManagerBasedRlEnv,
    target_height: float,
    height_sensor_name: str,
    command_name: str | None = None,
    command_threshold: float = 0.01,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Height error of moving feet, weighted by horizontal speed (m^2/s):

        sum over feet of |height - target_height| * |v_xy|

    Standing feet have zero speed and no cost.

    Args:
        env: The environment.
        target_height: Target height of swinging feet above the terrain (m).
        height_sensor_name: Height sensor with one frame per foot.
        command_name: Velocity command that enables the cost. None: always enabled.
        command_threshold: Commanded motion that must be exceeded to enable the cost.
        asset_cfg: Entity, and the sites of the feet in the order of the sensor's frames.
    """
    if env.common_step_counter == 1:
        check_same_feet(env, height_sensor_name, asset_cfg)
    error = env.scene[height_sensor_name].data.heights - target_height
    cost = (error.abs() * site_speed(env, asset_cfg)).sum(dim=1)
    return if_commanded(cost, env, command_name, command_threshold)


class feet_swing_height:
    """Error of the swing height at landing: sum of `(peak / target - 1)^2` over feet that land in this step.

    The peak is the maximum height (m) of the foot since lift-off. The cost is 0 for standing commands.

    Params:
        sensor_name: Contact sensor of the feet, with `track_air_time`.
        height_sensor_name: Height sensor with one frame per foot, in the same order.
        target_height: Target peak height of a swing (m).
        command_name: Velocity command.
        command_threshold: Commanded motion that must be exceeded to enable the cost.

    Warns, when built, if the sensors list different feet, or the feet in different orders.
    """

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        check_same_feet(env, cfg.params["sensor_name"], cfg.params["height_sensor_name"])
        feet = len(env.scene[cfg.params["sensor_name"]].primary_names)
        self.peak_heights = torch.zeros(env.num_envs, feet, dtype=torch.float32, device=env.device)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        sensor_name: str,
        height_sensor_name: str,
        target_height: float,
        command_name: str,
        command_threshold: float,
    ) -> torch.Tensor:
        """Update the peak heights; return the cost of landings in this step, (N,)."""
        heights = env.scene[height_sensor_name].data.heights
        cost = self.landing_cost(env, sensor_name, heights, target_height)
        return if_commanded(cost, env, command_name, command_threshold)

    def landing_cost(
        self, env: ManagerBasedRlEnv, sensor_name: str, heights: torch.Tensor, target_height: float
    ) -> torch.Tensor:
        """Update the peaks with `heights` (m), (N, feet); return the cost of landings in this step, (N,)."""
        sensor = env.scene[sensor_name]
        peaks = self.peak_heights
        is_swinging = sensor.data.found == 0
        higher = torch.maximum(peaks, heights)
        torch.where(is_swinging, higher, peaks, out=peaks)
        has_landed = sensor.compute_first_contact(dt=env.step_dt)
        log_metric(env, "peak_height_mean", masked_mean(peaks, has_landed))
        error = (peaks / target_height - 1.0).square_()
        cost = torch.where(has_landed, error, 0.0).sum(dim=1)
        peaks.masked_fill_(has_landed, 0.0)
        return cost

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Clear the peak heights of `env_ids`, so that unfinished swings do not affect the next episode."""
        self.peak_heights[slice(None) if env_ids is None else env_ids] = 0.0


def feet_slip(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    command_name: str,
    command_threshold: float = 0.01,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Sum of squared horizontal speeds of feet in contact (m^2/s^2).

    Args:
        env: The environment.
        sensor_name: Contact sensor of the feet.
        command_name: Velocity command that enables the cost.
        command_threshold: Commanded motion that must be exceeded to enable the cost.
        asset_cfg: Entity, and the sites of the feet in the order of the sensor's columns.
    """
    if env.common_step_counter == 1:
        check_same_feet(env, sensor_name, asset_cfg)
    in_contact = env.scene[sensor_name].data.found > 0
    speed = site_speed(env, asset_cfg)
    log_metric(env, "slip_velocity_mean", masked_mean(speed, in_contact))
    cost = torch.where(in_contact, speed.square_(), 0.0).sum(dim=1)
    return if_commanded(cost, env, command_name, command_threshold)


def soft_landing(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    command_name: str | None = None,
    command_threshold: float = 0.05,
) -> torch.Tensor:
    """Sum of ground contact forces of feet that land in this step (N).

    Forces are those of the last physics substep, not the peak of the impact.

    Args:
        env: The environment.
        sensor_name: Contact sensor of the feet, with `track_air_time`.
        command_name: Velocity command that enables the cost. None: always enabled.
        command_threshold: Commanded motion that must be exceeded to enable the cost.
    """
    sensor = env.scene[sensor_name]
    force = torch.linalg.vector_norm(sensor.data.force, dim=-1)
    has_landed = sensor.compute_first_contact(dt=env.step_dt)
    log_metric(env, "landing_force_mean", masked_mean(force, has_landed))
    cost = torch.where(has_landed, force, 0.0).sum(dim=1)
    return if_commanded(cost, env, command_name, command_threshold)


# Shared quantities.


def velocity_command(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Return a velocity command (vx, vy, wz) in the root frame (m/s, rad/s), (N, 3)."""
    return env.command_manager.get_command(command_name)


def command_speed(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Return the commanded motion `|c_xy| + |c_z|`, (N,)."""
    command = velocity_command(env, command_name)
    return torch.linalg.vector_norm(command[:, :2], dim=1).add_(command[:, 2].abs())


def if_commanded(
    cost: torch.Tensor, env: ManagerBasedRlEnv, command_name: str | None, threshold: float
) -> torch.Tensor:
    """Return `cost`, (N,), or 0 for commanded motion <= `threshold`.

    With `command_name` None, returns `cost` unchanged.
    """
    if command_name is None:
        return cost
    return torch.where(command_speed(env, command_name) > threshold, cost, 0.0)


def log_metric(env: ManagerBasedRlEnv, name: str, value: torch.Tensor) -> None:
    """Log a scalar of this step as `Metrics/<name>`."""
    env.extras.setdefault("log", {})[f"Metrics/{name}"] = value


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return the mean of finite values selected by `mask`, a scalar; 0 without values."""
    # Half the operations of `isfinite`.
    mask = mask & (values.abs() < torch.inf)
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def tilt_of(quat: torch.Tensor) -> torch.Tensor:
    """Return sin(tilt)^2 of orientations `quat`, (N, 4): squared horizontal part of body z, (N,).

    For a unit quaternion (w, x, y, z), the squared horizontal part of the third row of its rotation
    matrix is `4 s (1 - s)`, with s = x^2 + y^2.
    """
    x, y = quat[:, 1], quat[:, 2]
    s = x * x + y * y
    return 4.0 * s * (1.0 - s)


def site_speed(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the horizontal speed of the selected sites (m/s), (N, sites)."""
    asset: Entity = env.scene[asset_cfg.name]
    sites = columns_of(asset_cfg, "site", env)
    velocity = asset.data.site_lin_vel_w[:, sites]
    # By component: faster on CPU than a norm over a dimension of size 2.
    return velocity[..., 0].square().addcmul_(velocity[..., 1], velocity[..., 1]).sqrt_()


__getattr__ = older_names(__name__)
