"""Gait clock, a command that times the swing of each foot, and reward terms for gaits.

Policies that observe a clock learn to step sooner than policies that must find a rhythm. The clock is a
command, so observations and rewards share one phase, and the phase is checkpointed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import torch

from mjlab.envs.mdp.rewards import values_of_joints
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.tasks.velocity.mdp.rewards import command_speed, if_commanded
from mjlab.utils.lab_api.math import quat_apply_inverse
from mjlab.utils.torch import constant_tensor

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.reward_manager import RewardTermCfg

__all__ = [
    "GaitClockCommand",
    "GaitClockCommandCfg",
    "feet_alternate",
    "feet_apart_l2",
    "feet_height_by_phase",
    "feet_tilt",
    "height_over_feet",
    "root_height_l2",
    "root_near_feet",
    "weighted_joint_deviation",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")
# Longer than any episode: the phase is resampled at resets only.
_ONLY_AT_RESETS = (1e9, 1e9)


@dataclass(kw_only=True)
class GaitClockCommandCfg(CommandTermCfg):
    """Gait clock configuration. Observe it with `generated_commands`."""

    resampling_time_range: tuple[float, float] = _ONLY_AT_RESETS
    """Range of the time until the phase is resampled (s). Every reset resamples the phase."""
    frequency: float = 1.5
    """Stride frequency f (Hz)."""
    velocity_command_name: str | None = "twist"
    """Velocity command that stops the clock. None: the clock always runs."""
    standing_threshold: float = 0.1
    """Threshold of the commanded motion `|c_xy| + |c_z|`; the clock stops below."""
    starts: tuple[float, ...] | None = None
    """Offsets o to sample from (strides), such as (0, 0.5): both feet on the ground. None: any in [0, 1)."""
    fade_s: float = 0.0
    """Ramp time of the amplitude from 0 to 1 after resets and standing, and back to 0 (s)."""

    def build(self, env: ManagerBasedRlEnv) -> GaitClockCommand:
        """Build the term."""
        return GaitClockCommand(self, env)


class GaitClockCommand(CommandTerm):
    """Clock of a periodic gait with frequency f, (A sin phi, A cos phi), where

        phi = 2 pi (f t + o)

    with t the time since the reset (s), and o in [0, 1) sampled at each reset. The amplitude A is 1, or
    0 for standing commands; the phase advances in both cases. With `fade_s`, A starts at 0 and changes
    linearly.

    Attributes:
        cycles: Phase `f t + o` modulo 1 (strides), (N,).
    """

    cfg: GaitClockCommandCfg

    def __init__(self, cfg: GaitClockCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self.cycles = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self._faded = torch.zeros_like(self.cycles)

    @property
    def command(self) -> torch.Tensor:
        """Clock (A sin phi, A cos phi), (N, 2)."""
        phase = self.phase
        clock = torch.stack((torch.sin(phase), torch.cos(phase)), dim=1)
        return clock.mul_(self.amplitude.unsqueeze(1))

    @property
    def amplitude(self) -> torch.Tensor:
        """Amplitude A, (N,)."""
        return self._faded if self.cfg.fade_s > 0.0 else (~self.is_standing).float()

    @property
    def phase(self) -> torch.Tensor:
        """Phase phi in [0, 2 pi) (rad), (N,)."""
        return self.cycles * (2.0 * math.pi)

    @property
    def is_standing(self) -> torch.Tensor:
        """True for standing commands, (N,) bool."""
        # Computed on access, so that the order of the commands does not matter.
        if self.cfg.velocity_command_name is None:
            return torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        return command_speed(self._env, self.cfg.velocity_command_name) < (
            self.cfg.standing_threshold
        )

    def swing(self, offsets: tuple[float, ...]) -> torch.Tensor:
        """Return the swing phase variable of each foot, `A max(0, sin(phi + 2 pi o_i))^2`, (N, feet)."""
        return swing_at(self.cycles, offsets).mul_(self.amplitude.unsqueeze(1))

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Advance the phase by `dt` seconds. Arguments are those of `CommandTerm.compute`."""
        index = slice(None) if env_ids is None else env_ids
        self.cycles[index] = torch.remainder(self.cycles[index] + self.cfg.frequency * dt, 1.0)
        if self.cfg.fade_s > 0.0:
            change = torch.where(self.is_standing[index], -dt, dt) / self.cfg.fade_s
            self._faded[index] = (self._faded[index] + change).clamp_(0.0, 1.0)
        super().compute(dt, env_ids)

    def export_metadata(self, name: str) -> dict[str, list | str | float]:
        """Return the clock parameters under the keys of `mjlab.rl.exporter_utils`."""
        cfg = self.cfg
        follows = cfg.velocity_command_name is not None
        return {
            "clock_command": name,
            "clock_frequency": cfg.frequency,
            "clock_fade_s": cfg.fade_s,
            "clock_standing_threshold": cfg.standing_threshold if follows else 0.0,
            "clock_starts": list(cfg.starts or ()),
        }

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        starts = self.cfg.starts
        if starts is None:
            cycles = torch.rand(len(env_ids), dtype=torch.float32, device=self.device)
        else:
            drawn = torch.randint(len(starts), (len(env_ids),), device=self.device)
            cycles = constant_tensor(starts, self.device)[drawn]
        self.cycles[env_ids] = cycles
        self._faded[env_ids] = 0.0


def swing_at(cycles: torch.Tensor, offsets: tuple[float, ...]) -> torch.Tensor:
    """Return `max(0, sin(2 pi (c + o_i)))^2` of phases c (strides), (N,), as (N, feet)."""
    phases = cycles.unsqueeze(1) + constant_tensor(tuple(offsets), cycles.device)
    return torch.sin(phases * (2.0 * math.pi)).clamp_(min=0.0).square_()


def require_gait_clock(env: ManagerBasedRlEnv, command_name: str) -> GaitClockCommand:
    """Return the gait clock `command_name`.

    Raises:
        KeyError: unknown command.
        ValueError: the command is not a gait clock.
    """
    term = env.command_manager.get_term(command_name)
    if not isinstance(term, GaitClockCommand):
        raise ValueError(
            f"command_name: expected a GaitClockCommand, got {command_name!r} of type "
            f"{type(term).__name__}; use the name of a GaitClockCommandCfg."
        )
    return term


def feet_height_by_phase(
    env: ManagerBasedRlEnv,
    height_sensor_name: str,
    command_name: str = "gait",
    swing_height: float = 0.09,
    variance: float = 0.005,
    offsets: tuple[float, ...] = (0.0, 0.5),
    rest_height: float = 0.0,
) -> torch.Tensor:
    """Reward foot heights that follow the gait clock:

        exp(-sum_i (h_i - h*_i)^2 / variance),    h*_i = swing_height A max(0, sin(phi + 2 pi o_i))^2

    with h_i the height of foot i above `rest_height`, phi the phase and A the amplitude of the clock.
    Feet swing in one half of the cycle and stand in the other; all feet stand while the clock is
    stopped. Heights and phase are those that the policy observed.

    Args:
        env: The environment.
        height_sensor_name: Height sensor with one frame per foot.
        command_name: Gait clock.
        swing_height: Peak height of a swing (m).
        variance: Sum of squared errors that reduces the reward to 1/e (m^2).
        offsets: Offset o_i of each foot (fraction of a cycle), in the order of the sensor's frames.
            For a trot of four, diagonal feet have equal offsets.
        rest_height: Sensor reading of a standing foot (m): 0 for the G1, whose sites are in the
            soles, and 0.0225 for the Go1, whose sites are at the foot centers.
    """
    clock = require_gait_clock(env, command_name)
    target = clock.swing(offsets).mul_(swing_height)
    error = env.scene[height_sensor_name].data.heights - rest_height - target
    return torch.exp(error.square().sum(dim=1) / -variance)


def feet_alternate(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    groups: tuple[tuple[int, ...], tuple[int, ...]],
    longest_swing: float = 0.35,
    command_name: str | None = None,
    command_threshold: float = 0.1,
) -> torch.Tensor:
    """Reward a stance in which all feet of one group are on the ground and all others in the air.

    The reward is 1 in such stances, else 0. With diagonal feet as groups, the gait that earns most is a
    trot; with a foot each, a walk. A swing longer than `longest_swing` earns nothing, so that the groups
    take turns.

    Args:
        env: The environment.
        sensor_name: Contact sensor of the feet, with `track_air_time`.
        groups: Feet of each group, by their position in the sensor; together all feet.
        longest_swing: Longest air time of a foot (s).
        command_name: Velocity command that enables the reward. None: always enabled.
        command_threshold: Commanded motion that must be exceeded to enable the reward.

    Raises `ValueError` unless each foot is in one group.
    """
    air_time = env.scene[sensor_name].data.current_air_time
    first, second = groups
    if sorted((*first, *second)) != list(range(air_time.shape[1])):
        raise ValueError(
            f"feet_alternate groups: expected each of {air_time.shape[1]} feet of the sensor {sensor_name!r} "
            f"in one group, got {groups}."
        )
    swings = air_time > 0.0
    swings_in_turn = constant_tensor(
        tuple(foot in first for foot in range(air_time.shape[1])), air_time.device, torch.bool
    )
    alternate = (swings == swings_in_turn).all(dim=1) | (swings != swings_in_turn).all(dim=1)
    alternate &= (air_time < longest_swing).all(dim=1)
    return if_commanded(alternate.float(), env, command_name, command_threshold)


class weighted_joint_deviation:
    """Weighted squared joint deviation from the default positions q0: `sum_j w_j (q_j - q0_j)^2`.

    Params:
        weights: Dict of joint name pattern to weight w >= 0, read once. Every selected joint must match
            exactly one pattern, and every pattern a joint.
        asset_cfg: Entity and joints; all joints by default.

    Raises, when built: `ValueError` for weights that do not match the joints.
    """

    # Derived from the config; not checkpointed.
    _transient = {"_weights"}

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        asset_cfg: SceneEntityCfg = cfg.params.get("asset_cfg", _DEFAULT_ASSET_CFG)
        values = values_of_joints(env, asset_cfg, "weights", cfg.params["weights"])
        self._weights = torch.tensor(values, dtype=torch.float32, device=env.device)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        weights: object,
        asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    ) -> torch.Tensor:
        """Return the cost, (N,)."""
        asset: Entity = env.scene[asset_cfg.name]
        joints = columns_of(asset_cfg, "joint", env)
        error = asset.data.joint_pos[:, joints] - asset.data.default_joint_pos[:, joints]
        return (error.square_() * self._weights).sum(dim=1)


class feet_tilt:
    """Tilt of feet relative to the default pose: `sum_i sin(angle_i)^2`.

    The angle of foot i is that between world z and the foot-fixed axis that points up in the default
    pose with an upright root. For feet with frames aligned to the sole, each summand is the squared
    horizontal component of projected gravity in the foot frame.

    Params:
        asset_cfg: Entity, and the feet as `site_names` or `body_names`.

    Raises, when built: `ValueError` unless either sites or bodies are selected.
    """

    # Derived from the model; not checkpointed.
    _transient = {"_up", "_rest"}

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        asset_cfg: SceneEntityCfg = cfg.params["asset_cfg"]
        if bool(asset_cfg.site_names) == bool(asset_cfg.body_names):
            raise ValueError(
                "asset_cfg: expected site_names or body_names, got site_names="
                f"{asset_cfg.site_names} and body_names={asset_cfg.body_names}; name the feet."
            )
        self._up = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float32, device=env.device)
        # World z in each foot frame, in the default pose with an upright root, (feet, 3).
        asset: Entity = env.scene[asset_cfg.name]
        data = default_pose(env.sim.mj_model, asset)
        if asset_cfg.site_names:
            matrices = data.site_xmat[
                asset.indexing.site_ids[columns_of(asset_cfg, "site", env)].cpu()
            ]
        else:
            matrices = data.xmat[asset.indexing.body_ids[columns_of(asset_cfg, "body", env)].cpu()]
        # The third row of a rotation matrix is world z in the rotated frame.
        self._rest = torch.tensor(matrices[:, 6:], dtype=torch.float32, device=env.device)

    def __call__(self, env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
        """Return the cost, (N,)."""
        data = env.scene[asset_cfg.name].data
        if asset_cfg.site_names:
            quat = data.site_quat_w[:, columns_of(asset_cfg, "site", env)]
        else:
            quat = data.body_link_quat_w[:, columns_of(asset_cfg, "body", env)]
        up = quat_apply_inverse(quat, self._up.expand(*quat.shape[:-1], 3))
        # Norm of the cross product, because 1 - cos^2 cancels at small angles.
        return torch.linalg.cross(up, self._rest.expand_as(up)).square_().sum(dim=(1, 2))


def height_over_feet(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the height of the root above the lowest foot (m), (N,). Feet are `site_names`."""
    data = env.scene[asset_cfg.name].data
    feet = data.site_pos_w[:, columns_of(asset_cfg, "site", env), 2]
    return data.root_link_pos_w[:, 2] - feet.amin(dim=1)


def root_height_l2(
    env: ManagerBasedRlEnv, target_height: float, asset_cfg: SceneEntityCfg
) -> torch.Tensor:
    """Squared error of `height_over_feet` from `target_height` (m^2).

    Robots that sink fall seconds later, beyond the horizon of a small discount factor.
    """
    return (height_over_feet(env, asset_cfg) - target_height).square_()


def root_near_feet(
    env: ManagerBasedRlEnv, minimum_height: float, asset_cfg: SceneEntityCfg
) -> torch.Tensor:
    """`height_over_feet` below `minimum_height` (m)."""
    return height_over_feet(env, asset_cfg) < minimum_height


def feet_apart_l2(
    env: ManagerBasedRlEnv, distance: float, asset_cfg: SceneEntityCfg
) -> torch.Tensor:
    """Squared shortfall of the lateral foot distance below `distance` (m^2).

    Penalizes feet that come close enough to trip the robot. The distance is the y offset from the right
    to the left foot in the root frame (m). Feet are `site_names`, the left one first, in model order or
    with `preserve_order`.
    """
    data = env.scene[asset_cfg.name].data
    feet = data.site_pos_w[:, columns_of(asset_cfg, "site", env)]
    apart = quat_apply_inverse(data.root_link_quat_w, feet[:, 0] - feet[:, 1])[:, 1]
    return (distance - apart).clamp_(min=0.0).square_()


def default_pose(model: mujoco.MjModel, asset: Entity) -> mujoco.MjData:
    """Return kinematics and centers of mass of a robot in its default pose."""
    data = mujoco.MjData(model)
    addresses = model.jnt_qposadr[asset.indexing.joint_ids.tolist()]
    data.qpos[addresses] = asset.data.default_joint_pos[0].tolist()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data
