"""Biped stepping controller: marches in place and keeps balance, as a teacher for policies.

Policies that learn to balance with the ankles do not discover steps, because lifting a foot slightly
costs balance. This controller steps from the beginning and balances as one-legged hoppers (Raibert,
Legged Robots That Balance, 1986) and simulated bipeds (SIMBICON; Yin, Loken and van de Panne,
SIGGRAPH 2007) do: foot placement follows the root velocity, and the stance hip keeps the trunk
upright. The controller ignores commands and reads the true state, so it cannot run on a robot.
`RslRlSacAlgorithmCfg.teacher` lets policies imitate the controller early in training.

Legs are those of any biped (`mjlab.utils.leg_kinematics`), and gains have no units, so that robots of other
sizes and masses step alike (Froude scaling): velocities are in units of sqrt(g l), torques of m g l and
times of sqrt(l / g), with the length l of a leg and the mass m of the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from mjlab.envs.mdp.actions import JointPositionAction
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.rl.exporter_utils import joint_gains
from mjlab.tasks.velocity.mdp.gait import default_pose, require_gait_clock
from mjlab.utils.errors import check_exists
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse
from mjlab.utils.leg_kinematics import Leg, LegTable, find_legs

if TYPE_CHECKING:
    from mjlab.entity import Entity, EntityData
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import ObservationTermCfg

__all__ = [
    "SteppingGains",
    "stepping_action",
]

_GRAVITY = 9.81
# Time until feet swing to their full height, in units of sqrt(l / g): 0.7 s of the G1. Robots that step at
# once from rest fall sideways in the first strides: of 20, 12 instead of 18 G1 stand after 5 s.
_START = 2.75
# Largest action: atanh(1) is infinite.
_LARGEST = 0.97
# Outside the action range: not imitated.
_FREE = 1e6


@dataclass(kw_only=True)
class SteppingGains:
    """Gains of the stepping controller: numbers, or tensors (N, 1)."""

    lift: float = 0.52
    """Additional bend of the leg at mid-swing (rad)."""
    lead: float = 0.0
    """Forward angle of the swing leg at rest, ahead of the center of mass (rad)."""
    step_forward: float = 1.49
    """Gain from forward velocity to forward angle of the swing leg."""
    step_sideways: float = 2.25
    """Gain from lateral velocity to lateral angle of the swing leg."""
    trunk_pitch: float = 1.75
    """Gain from trunk pitch to torque of the stance hip."""
    trunk_roll: float = 2.83
    """Gain from trunk roll to torque of the stance hip."""
    trunk_roll_rate: float = 0.49
    """Gain from trunk roll rate to torque of the stance hip."""
    carry: float = 1.0
    """Torque of the stance hip at mid-stance, as a share of that which carries the robot's weight."""
    ankle_forward: float = 1.3
    """Gain from forward velocity to torque of the stance ankle."""
    ankle_sideways: float = 0.45
    """Gain from lateral velocity to torque of the stance ankle."""


class stepping_action:
    """Action of the stepping controller for a joint position action, in [-1, 1], (N, A).

    With c the gait clock's phase of a leg (strides), the leg swings for c < 1/2, else it stands. Measured
    angles of a leg relative to the trunk are alpha, forward, and beta, to the left. Targets, with v and w
    the linear and angular velocity of the root in the root frame, and x = 3 s^2 - 2 s^3 with
    s = min(1, 4 c):

        swing    alpha* = alpha + x (rest + lead + step_forward v_x + pitch - alpha)
                 beta*  = beta + x (rest_sideways + step_sideways v_y - roll - beta)
        stance   alpha* = alpha, beta* = beta
        bend     b = b_0 + A lift max(0, sin 2 pi c), with A the clock's amplitude
        joints   q* = inverse kinematics of alpha*, beta* and b, with a level sole

    The bend b_0 and the angle `rest_sideways` of a leg are those of the default pose, as feet may be wider
    apart than the hips; at the angle `rest` the ankle is below the center of mass.
    A grows from 0 to that of the clock at the start of an episode. Stance legs add torques t about the axes
    of the trunk, as offsets of the targets of joints with axis a and stiffness k,

        dq = (a . t) / k,   hip     t_x = trunk_roll roll + trunk_roll_rate w_x - carry (y / l) sin 2 pi c
                                    t_y = trunk_pitch pitch
                            ankle   t_x = -ankle_sideways v_y,  t_y = ankle_forward v_x

    with y the distance of the hip from the middle, and swing legs turn the ankles against the trunk,
    dq = -a . (roll, pitch, 0). Hips of stance legs start from their measured positions. Other joints are at
    their default positions. A joint that turns the leg about the vertical is 1e6, outside the action range,
    and therefore not imitated.

    Params:
        asset_cfg: Robot, and the soles of its two feet as `site_names`.
        gains: `SteppingGains`.
        command_name: Gait clock.
        action_name: Joint position action of the biped, with a scale.

    Raises, when built: `ValueError` for an action of another type, legs that are not supported, missing
    joints or stiffness, or a command that is not a gait clock.
    """

    # Derived from config and model; not checkpointed.
    _transient = {"_clock", "_term", "_legs", "_length", "_rest"}

    def __init__(self, cfg: ObservationTermCfg, env: ManagerBasedRlEnv) -> None:
        params = cfg.params
        self._clock = require_gait_clock(env, params.get("command_name", "gait"))
        name = params.get("action_name", "joint_pos")
        term = env.action_manager.get_term(name)
        if not isinstance(term, JointPositionAction):
            raise ValueError(
                f"action_name: expected a JointPositionAction, got {name!r} of type "
                f"{type(term).__name__}."
            )
        self._term = term
        asset_cfg: SceneEntityCfg = params["asset_cfg"]
        asset: Entity = env.scene[asset_cfg.name]
        model, root = env.sim.mj_model, int(asset.indexing.root_body_id)
        pose = default_pose(model, asset)
        soles = asset.indexing.site_ids[columns_of(asset_cfg, "site", env)].tolist()
        legs = find_legs(model, pose, root, soles)
        self._length = 0.5 * (legs[0].length + legs[1].length)
        center = (pose.subtree_com[root] - pose.xpos[root]) @ pose.xmat[root].reshape(3, 3)
        self._rest = math.atan2(center[0] - legs[0].hip[0], self._length)
        unit = float(model.body_subtreemass[root]) * _GRAVITY * self._length
        stiffness = {joint: kp for joint, (kp, _) in joint_gains(asset, model).items()}
        gains = params.get("gains") or SteppingGains()
        lift = float(torch.as_tensor(gains.lift).max())
        self._legs = [_SteppingLeg(leg, asset, term, stiffness, unit, lift) for leg in legs]
        # Steps since the reset, of environments whose first episode starts in the middle too.
        self._age = torch.zeros(env.num_envs, 1, device=env.device)
        self._last_step = env.common_step_counter

    def reset(self, env_ids: torch.Tensor | slice) -> None:
        """Start to step slowly."""
        self._age[env_ids] = 0.0

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        asset_cfg: SceneEntityCfg,
        gains: SteppingGains | None = None,
        command_name: str = "gait",
        action_name: str = "joint_pos",
    ) -> torch.Tensor:
        """Return the action, (N, A)."""
        g = SteppingGains() if gains is None else gains
        data = env.scene[asset_cfg.name].data
        time_unit = math.sqrt(self._length / _GRAVITY)
        velocity = data.root_link_lin_vel_b / (_GRAVITY * time_unit)
        forward, left = velocity[:, :1], velocity[:, 1:2]
        roll_rate = data.root_link_ang_vel_b[:, :1] * time_unit
        gravity = data.projected_gravity_b
        pitch, roll = gravity[:, :1], -gravity[:, 1:2]
        # Torques and tilt about the axes x and y of the trunk, (N, 2).
        hip = torch.cat(
            (g.trunk_roll * roll + g.trunk_roll_rate * roll_rate, g.trunk_pitch * pitch), dim=1
        )
        ankle = torch.cat((-g.ankle_sideways * left, g.ankle_forward * forward), dim=1)
        tilt = torch.cat((roll, pitch), dim=1)

        self._age += env.common_step_counter - self._last_step
        self._last_step = env.common_step_counter
        start = (self._age * (env.step_dt / (_START * time_unit))).clamp(max=1.0)
        lift = g.lift * start * self._clock.amplitude.unsqueeze(1)
        phase = self._clock.phase.unsqueeze(1)
        s = (torch.remainder(phase, torch.pi) * (2.0 / torch.pi)).clamp(max=1.0)
        x = s * s * (3.0 - 2.0 * s)
        targets = data.default_joint_pos[:, self._term.target_ids].clone()
        for leg, height in zip(self._legs, (torch.sin(phase), -torch.sin(phase)), strict=True):
            swings = height > 0.0
            measured = leg.place(data)
            alpha, beta, _ = measured.split(1, dim=1)
            moved = torch.where(swings, x, 0.0)
            alpha = torch.lerp(alpha, self._rest + g.lead + g.step_forward * forward + pitch, moved)
            beta = torch.lerp(beta, leg.rest_sideways + g.step_sideways * left - roll, moved)
            bend = leg.bend + lift * height.clamp(min=0.0)
            q = leg.table(torch.cat((alpha, beta, bend), dim=1))
            # Measured hips differ from those of the table after the leg has turned.
            q += (1.0 - moved) * ((leg.joint_pos(data) - leg.table(measured)) @ leg.hold)
            carried = g.carry * leg.side * (-height).clamp(min=0.0) * leg.hip_torque[0]
            stance = hip @ leg.hip_torque + ankle @ leg.ankle_torque + carried
            targets[:, leg.columns] = q + torch.where(swings, -tilt @ leg.ankle_tilt, stance)
        actions = ((targets - self._term.offset) / self._term.scale).clamp_(-_LARGEST, _LARGEST)
        for leg in self._legs:
            actions[:, leg.free] = _FREE
        return actions


class _SteppingLeg:
    """A leg, by the columns of an action.

    Attributes:
        table: Inverse kinematics.
        bend: Bend in the default pose (rad).
        rest_sideways: Angle to the left in the default pose (rad).
        side: Distance of the hip from the middle, to the left, over the length of the leg.
        columns: Columns of the joints in the action, (J,).
        free: Columns of the joint that turns the leg, (1,), or none, (0,).
        hip_torque, ankle_torque: Offsets of joint targets by torques about x and y, (2, J).
        ankle_tilt: Angles of the ankles by the tilt of the sole about x and y, (2, J).
        hold: Offsets of hips, and of the ankles that level the sole, by those of all joints, (J, J).
    """

    def __init__(
        self,
        leg: Leg,
        asset: Entity,
        term: JointPositionAction,
        stiffness: dict[str, float],
        unit: float,
        lift: float,
    ) -> None:
        """Read a leg.

        Args:
            leg: Leg.
            asset: Robot.
            term: Joint position action.
            stiffness: Stiffness of the joints (N m/rad).
            unit: Unit of torques (N m).
            lift: Largest additional bend (rad).

        Raises:
            ValueError: a joint is not in the action, or has no stiffness.
        """
        device = asset.data.device
        ids = asset.indexing.joint_ids.tolist()
        joints = [ids.index(joint) for joint in leg.joints]
        names = [asset.joint_names[joint] for joint in joints]
        for name in names:
            check_exists("joint of the action", name, term.target_names)
            if not stiffness.get(name, 0.0) > 0.0:
                raise ValueError(
                    f"joint {name!r} stiffness: expected a position actuator, got "
                    f"{stiffness.get(name)}; use one with a stiffness."
                )
        columns = [term.target_names.index(name) for name in names]
        yaw = [] if leg.yaw is None else [leg.yaw]
        self.columns = torch.tensor(columns, device=device)
        self.free, self._joints = self.columns[yaw], torch.tensor(joints, device=device)
        self.table, self.bend = LegTable(leg, device, lift), leg.bend
        self.rest_sideways = leg.beta
        # The weight acts at the hip: with the lever of the soles, farther outside, the H1 stands for 4.6
        # instead of 5.1 s of 6 s.
        self.side, self._length = float(leg.hip[1]) / leg.length, leg.length
        self._foot = asset.indexing.body_ids.tolist().index(leg.foot)
        # Axes in the default pose, (2, J).
        axes, order = leg.axes[:, :2].T, np.arange(len(names))
        is_hip, is_ankle = order < leg.knee, order > leg.knee
        is_hip[yaw] = False
        softness = unit / np.array([stiffness[name] for name in names])
        hold = np.diag(1.0 * is_hip) - (axes * is_hip).T @ (axes * is_ankle)
        (
            self.hip_torque,
            self.ankle_torque,
            self.ankle_tilt,
            self.hold,
            self._hip,
            self._ankle,
        ) = (
            torch.tensor(values, dtype=torch.float32, device=device)
            for values in (
                axes * is_hip * softness,
                axes * is_ankle * softness,
                axes * is_ankle,
                hold,
                leg.hip,
                leg.ankle,
            )
        )

    def joint_pos(self, data: EntityData) -> torch.Tensor:
        """Return the measured joint positions (rad), (N, J)."""
        return data.joint_pos[:, self._joints]

    def place(self, data: EntityData) -> torch.Tensor:
        """Return the measured place of the foot: alpha, beta and bend (rad), (N, 3)."""
        turn = data.body_link_quat_w[:, self._foot]
        ankle = quat_apply(turn, self._ankle.expand(len(turn), 3))
        ankle += data.body_link_pos_w[:, self._foot] - data.root_link_pos_w
        x, y, z = (quat_apply_inverse(data.root_link_quat_w, ankle) - self._hip).unbind(dim=1)
        ahead = torch.hypot(x, z)
        bend = torch.acos((torch.hypot(ahead, y) / self._length).clamp(max=1.0))
        return torch.stack((torch.atan2(x, -z), torch.atan2(y, ahead), bend), dim=1)
