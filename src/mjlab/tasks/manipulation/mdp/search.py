"""Correction of a teacher that knows where the object is, for students that must see it first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import torch

from mjlab.envs.mdp.actions import JointPositionAction
from mjlab.managers import ObservationTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.sensor import CameraSensor
from mjlab.tasks.manipulation.mdp.observations import goal_command, site_pos
from mjlab.utils.string import resolve_expr

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

__all__ = ["search_action"]

# Fraction of the image, from its center, in which an object counts as seen.
_INNER = 0.93


class search_action:
    """Action towards joint positions from which the object can be seen, and if it is needed, (N, A + 1).

    The last column is 1 if the object of the command is out of sight: outside of the image or beyond
    `max_depth`, and further than `near` from the hand, where fingers hide it. Imitation of a teacher that
    reaches for objects out of sight has no answer but the mean of all places, where the arm stops.

    Params:
        command_name: Command of the object.
        sensor_name: Camera sensor.
        joint_pos: Joint targets by name pattern (rad, or m).
        max_depth: Largest depth in the images (m).
        near: Distance of the object from the hand (m).
        asset_cfg: Site of the hand.
        action_name: Joint position action of the arm.

    Raises `TypeError`, when built, for an action of another type.
    """

    # Derived from config and model; not checkpointed.
    _transient = {"_camera", "_tangent", "_aspect", "_action"}

    def __init__(self, cfg: ObservationTermCfg, env: ManagerBasedRlEnv) -> None:
        name = cfg.params.get("action_name", "joint_pos")
        action = env.action_manager.get_term(name)
        if not isinstance(action, JointPositionAction):
            raise TypeError(
                f"action_name: expected a JointPositionAction, got {name!r} of type "
                f"{type(action).__name__}."
            )
        joints = env.scene[action.cfg.entity_name].joint_names
        names = tuple(joints[i] for i in torch.arange(len(joints))[action.target_ids].tolist())
        targets = resolve_expr(cfg.params["joint_pos"], names, 0.0)
        positions = torch.tensor(targets, device=env.device, dtype=torch.float32)
        self._action = (positions - action.offset) / action.scale
        sensor = env.scene[cfg.params["sensor_name"]]
        assert isinstance(sensor, CameraSensor)
        self._camera = sensor.camera_idx
        self._tangent = _half_height(env.sim.mj_model, self._camera)
        self._aspect = sensor.cfg.width / sensor.cfg.height

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        command_name: str,
        sensor_name: str,
        joint_pos: dict[str, float],
        max_depth: float,
        near: float,
        asset_cfg: SceneEntityCfg,
        action_name: str = "joint_pos",
    ) -> torch.Tensor:
        """Return the action and the flag."""
        position = goal_command(env, command_name).object_pos()
        offset = position - env.sim.data.cam_xpos[:, self._camera]
        # Cameras look along -z.
        right, up, back = torch.einsum(
            "ni,nij->jn", offset, env.sim.data.cam_xmat[:, self._camera].view(-1, 3, 3)
        )
        side = _INNER * self._tangent * -back
        is_seen = (up.abs() < side) & (right.abs() < self._aspect * side) & (-back < max_depth)
        is_near = (position - site_pos(env, asset_cfg)).norm(dim=1) < near
        needed = ~(is_seen | is_near)
        return torch.cat((self._action.expand(env.num_envs, -1), needed[:, None].float()), dim=1)


def _half_height(model: mujoco.MjModel, camera: int) -> float:
    """Return the tangent of half of the vertical field of view."""
    if model.cam_sensorsize[camera].any():
        return float(model.cam_sensorsize[camera, 1] / model.cam_intrinsic[camera, 1] / 2.0)
    return float(torch.tensor(model.cam_fovy[camera] / 2.0).deg2rad().tan())
