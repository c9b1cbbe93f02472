"""Tracking errors reported by evaluations.

Functions take a motion command, or one of its frames (`MotionCommand.matching_frame`), and return
one value per environment, (N,).

In evaluations every environment plays one motion once, from its first frame. Errors are measured in
all states the policy acts in, including the perturbed start: each state is compared with the frame
of the same time, with relative poses of the same time. No state after a reset is ever compared with
the frame before it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.managers import TerminationTermCfg
from mjlab.tasks.tracking.mdp.commands import MotionCommandCfg, body_columns, motion_command
from mjlab.tasks.tracking.mdp.terminations import motion_ended
from mjlab.utils.errors import check_exists
from mjlab.utils.lab_api.math import quat_error_magnitude

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
    from mjlab.tasks.tracking.mdp.motion_library import MotionFrame, MotionReader

__all__ = [
    "compute_ee_orientation_error",
    "compute_ee_position_error",
    "compute_joint_velocity_error",
    "compute_mpkpe",
    "compute_root_relative_mpkpe",
]

_COMMAND = "motion"
_END_EFFECTORS = "ee_body_pos"
_END = "motion_ended"
_LONGER_THAN_MOTIONS_S = 3600.0


def compute_mpkpe(command: MotionReader) -> torch.Tensor:
    """Return the mean distance of the tracked bodies to the reference in the world (m), (N,)."""
    return (command.body_pos_w - command.robot_body_pos_w).norm(dim=-1).mean(dim=1)


def compute_root_relative_mpkpe(command: MotionReader) -> torch.Tensor:
    """Return the mean distance of the tracked bodies to the relative reference (m), (N,)."""
    return (command.body_pos_relative_w - command.robot_body_pos_w).norm(dim=-1).mean(dim=1)


def compute_joint_velocity_error(command: MotionReader) -> torch.Tensor:
    """Return the root mean square of the joint velocity errors (rad/s), (N,)."""
    return (command.joint_vel - command.robot_joint_vel).square().mean(dim=1).sqrt()


def compute_ee_position_error(
    command: MotionReader, ee_body_names: tuple[str, ...]
) -> torch.Tensor:
    """Return the mean distance of the named bodies to the relative reference (m), (N,).

    0 for an empty `ee_body_names`. Raises `ValueError` for a body that is not tracked.
    """
    distance = (command.body_pos_relative_w - command.robot_body_pos_w).norm(dim=-1)
    return _mean_over(command, ee_body_names, distance)


def compute_ee_orientation_error(
    command: MotionReader, ee_body_names: tuple[str, ...]
) -> torch.Tensor:
    """Return the mean angle of the named bodies to the relative reference (rad), (N,).

    0 for an empty `ee_body_names`. Raises `ValueError` for a body that is not tracked.
    """
    angle = quat_error_magnitude(command.body_quat_relative_w, command.robot_body_quat_w)
    return _mean_over(command, ee_body_names, angle)


def _mean_over(
    command: MotionReader, body_names: tuple[str, ...], errors: torch.Tensor
) -> torch.Tensor:
    """Return the mean of `errors`, (N, K), over the named bodies, (N,); 0 without bodies."""
    if not body_names:
        return torch.zeros_like(errors[:, 0])
    for name in body_names:
        check_exists("tracked body", name, command.body_names)
    return errors[:, body_columns(command, body_names)].mean(dim=1)


# Evaluation metrics, and the config of evaluation environments.


def mpkpe(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the mean distance of the tracked bodies to the reference in the world (m), (N,)."""
    return compute_mpkpe(_frame(env))


def r_mpkpe(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the mean distance of the tracked bodies to the relative reference (m), (N,)."""
    return compute_root_relative_mpkpe(_frame(env))


def joint_vel_error(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the root mean square of the joint velocity errors (rad/s), (N,)."""
    return compute_joint_velocity_error(_frame(env))


def ee_pos_error(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the mean distance of hands and feet to the relative reference (m), (N,)."""
    return compute_ee_position_error(_frame(env), _end_effectors(env))


def ee_ori_error(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the mean angle of hands and feet to the relative reference (rad), (N,)."""
    return compute_ee_orientation_error(_frame(env), _end_effectors(env))


def _frame(env: ManagerBasedRlEnv) -> MotionFrame:
    return motion_command(env, _COMMAND).matching_frame


def _end_effectors(env: ManagerBasedRlEnv) -> tuple[str, ...]:
    manager = env.termination_manager
    if _END_EFFECTORS not in manager.active_terms:
        return ()
    return tuple(manager.get_term_cfg(_END_EFFECTORS).params.get("body_names") or ())


TRACKING_ERRORS = {
    "mpkpe": mpkpe,
    "r_mpkpe": r_mpkpe,
    "joint_vel_error": joint_vel_error,
    "ee_pos_error": ee_pos_error,
    "ee_ori_error": ee_ori_error,
}
"""Evaluation metrics by name."""
UNITS = {
    "mpkpe": "m",
    "r_mpkpe": "m",
    "joint_vel_error": "rad/s",
    "ee_pos_error": "m",
    "ee_ori_error": "rad",
}
"""Units of `TRACKING_ERRORS`."""


def play_motions_once(cfg: ManagerBasedRlEnvCfg) -> None:
    """Edit an environment config so that each episode is one motion from start to end.

    Pushes are removed. Noise, randomization and start perturbations are unchanged. Motions longer
    than one hour are truncated.
    """
    motion = cfg.commands[_COMMAND]
    assert isinstance(motion, MotionCommandCfg)
    motion.sampling_mode = "start"
    cfg.events.pop("push_robot", None)
    cfg.terminations[_END] = TerminationTermCfg(
        func=motion_ended, time_out=True, params={"command_name": _COMMAND}
    )
    # The end of the motion ends the episode, not the time limit. The motion is not yet known here.
    cfg.episode_length_s = max(cfg.episode_length_s, _LONGER_THAN_MOTIONS_S)
