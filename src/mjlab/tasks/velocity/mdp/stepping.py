"""Biped stepping controller: marches in place and keeps balance, as a teacher for policies.

Policies that learn to balance with the ankles do not discover steps, because lifting a foot slightly
costs balance. This controller steps from the beginning and balances as one-legged hoppers (Raibert,
Legged Robots That Balance, 1986) and simulated bipeds (SIMBICON; Yin, Loken and van de Panne,
SIGGRAPH 2007) do: foot placement follows the root velocity, and the stance hip keeps the trunk
upright. The controller ignores commands and reads the true state, so it cannot run on a robot.
`RslRlSacAlgorithmCfg.teacher` lets policies imitate the controller early in training.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import torch

from mjlab.envs.mdp.actions import JointPositionAction
from mjlab.tasks.velocity.mdp.gait import require_gait_clock
from mjlab.utils.errors import check_exists

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import ObservationTermCfg

__all__ = [
    "SteppingGains",
    "stepping_action",
]

_SIDES = ("left", "right")
# Joint axes of a straight leg, as on Unitree humanoids.
_AXES = {
    "hip_pitch": (0.0, 1.0, 0.0),
    "hip_roll": (1.0, 0.0, 0.0),
    "hip_yaw": (0.0, 0.0, 1.0),
    "knee": (0.0, 1.0, 0.0),
    "ankle_pitch": (0.0, 1.0, 0.0),
    "ankle_roll": (1.0, 0.0, 0.0),
}
_MIN_ALIGNMENT = 0.9
# Largest action: atanh(1) is infinite.
_LARGEST = 0.97


@dataclass(kw_only=True)
class SteppingGains:
    """Gains of the stepping controller: numbers, or tensors (N, 1). Defaults are for the G1."""

    bend: float = 0.1
    """Bend of hip and ankle of the stance leg (rad). The knee bends twice as much."""
    lift: float = 0.42
    """Additional bend at mid-swing (rad)."""
    lead: float = 0.085
    """Forward angle of the swing leg at rest (rad)."""
    step_forward: float = 0.6
    """Gain from forward velocity to forward angle of the swing leg (rad s/m)."""
    step_sideways: float = 0.96
    """Gain from lateral velocity to lateral angle of the swing leg (rad s/m)."""
    trunk_pitch: float = 9.0
    """Gain from trunk pitch to stance hip pitch (rad/rad)."""
    trunk_roll: float = 5.9
    """Gain from trunk roll to stance hip roll (rad/rad)."""
    trunk_roll_rate: float = 0.26
    """Gain from trunk roll rate to stance hip roll (s)."""
    ankle_forward: float = 3.8
    """Gain from forward velocity to stance ankle pitch (rad s/m)."""
    ankle_sideways: float = 1.3
    """Gain from lateral velocity to stance ankle roll (rad s/m)."""


class stepping_action:
    """Action of the stepping controller for a joint position action, in [-1, 1], (N, A).

    With c the gait clock's phase of a leg (strides), the leg swings for c < 1/2, else it stands. Measured
    leg angles relative to the trunk are alpha = -q_hip_pitch - q_knee / 2, forward, and
    beta = q_hip_roll, to the left. Targets, with v and w the linear and angular velocity of the root in
    the root frame, and x = 3 s^2 - 2 s^3 with s = min(1, 4 c):

        swing    alpha* = alpha + x (lead + step_forward v_x - alpha)
                 beta*  = beta + x (step_sideways v_y - beta)
        stance   alpha* = alpha - trunk_pitch pitch
                 beta*  = beta + trunk_roll roll + trunk_roll_rate w_x
        bend     b = bend + A lift max(0, sin 2 pi c), with A the clock's amplitude
        joints   hip_pitch = -alpha* - b, knee = 2 b, hip_roll = beta*

    Ankles level the soles of an upright robot, for leg angles without trunk feedback. Swing ankles
    subtract trunk pitch and roll; stance ankles add `ankle_forward v_x` and `-ankle_sideways v_y`. Other
    joints are at their default positions. Hip yaw is 2, outside the action range, and therefore not
    imitated.

    Params:
        gains: `SteppingGains`.
        command_name: Gait clock.
        action_name: Joint position action of the biped, with a scale.
        joint: Joint name pattern with `{side}` (left, right) and `{joint}` (hip_pitch, hip_roll,
            hip_yaw, knee, ankle_pitch, ankle_roll). Axes are y, x, z, y, y, x of the robot.

    Raises, when built: `ValueError` for an action of another type, missing joints, joints about other
    axes, or a command that is not a gait clock.
    """

    # Derived from config and model; not checkpointed.
    _transient = {"_clock", "_term", "_columns", "_joints"}

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
        asset: Entity = env.scene[term.cfg.entity_name]
        pattern = params.get("joint", "{side}_{joint}_joint")
        self._joints: dict[str, torch.Tensor] = {}
        self._columns: dict[str, torch.Tensor] = {}
        reference = mujoco.MjData(env.sim.mj_model)
        mujoco.mj_kinematics(env.sim.mj_model, reference)
        for joint, axis in _AXES.items():
            names = [pattern.format(side=side, joint=joint) for side in _SIDES]
            for target in names:
                check_exists(f"joint of action {name!r}", target, term.target_names)
            ids = [asset.joint_names.index(target) for target in names]
            axes = reference.xaxis[asset.indexing.joint_ids[ids].cpu()]
            if (axes @ axis < _MIN_ALIGNMENT).any():
                raise ValueError(
                    f"joint: expected {names} to turn about {axis} in the model's reference pose, got "
                    f"{axes.round(2).tolist()}; the stepping controller does not support these legs."
                )
            columns = [term.target_names.index(target) for target in names]
            self._joints[joint] = torch.tensor(ids, device=env.device)
            self._columns[joint] = torch.tensor(columns, device=env.device)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        gains: SteppingGains | None = None,
        command_name: str = "gait",
        action_name: str = "joint_pos",
        joint: str = "{side}_{joint}_joint",
    ) -> torch.Tensor:
        """Return the action, (N, A)."""
        g = SteppingGains() if gains is None else gains
        data = env.scene[self._term.cfg.entity_name].data
        velocity = data.root_link_lin_vel_b
        gravity = data.projected_gravity_b
        pitch, roll = gravity[:, :1], -gravity[:, 1:2]
        roll_rate = data.root_link_ang_vel_b[:, :1]

        phase = self._clock.phase.unsqueeze(1)
        height = torch.cat((torch.sin(phase), -torch.sin(phase)), dim=1)
        swings = height > 0.0
        s = (torch.remainder(phase, torch.pi) * (2.0 / torch.pi)).clamp(max=1.0)
        x = s * s * (3.0 - 2.0 * s)

        q = data.joint_pos
        alpha = -q[:, self._joints["hip_pitch"]] - 0.5 * q[:, self._joints["knee"]]
        beta = q[:, self._joints["hip_roll"]]
        forward = g.lead + g.step_forward * velocity[:, :1]
        sideways = g.step_sideways * velocity[:, 1:2]
        alpha = torch.where(swings, torch.lerp(alpha, forward.expand_as(alpha), x), alpha)
        beta = torch.where(swings, torch.lerp(beta, sideways.expand_as(beta), x), beta)
        bend = g.bend + g.lift * height.clamp(min=0.0) * self._clock.amplitude.unsqueeze(1)
        stands = ~swings

        upright = stands * g.trunk_pitch * pitch
        leveled = stands * (g.trunk_roll * roll + g.trunk_roll_rate * roll_rate)
        targets = data.default_joint_pos[:, self._term.target_ids].clone()
        targets[:, self._columns["hip_pitch"]] = upright - alpha - bend
        targets[:, self._columns["knee"]] = 2.0 * bend
        targets[:, self._columns["hip_roll"]] = beta + leveled
        targets[:, self._columns["ankle_pitch"]] = (
            alpha - bend + torch.where(swings, -pitch, g.ankle_forward * velocity[:, :1])
        )
        targets[:, self._columns["ankle_roll"]] = (
            torch.where(swings, -roll, -g.ankle_sideways * velocity[:, 1:2]) - beta
        )
        actions = ((targets - self._term.offset) / self._term.scale).clamp_(-_LARGEST, _LARGEST)
        actions[:, self._columns["hip_yaw"]] = 2.0
        return actions
