"""Randomization of cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.envs.mdp.dr._core import CAMERA, ROBOT, field_term, rotation_term, targets_of
from mjlab.envs.mdp.dr._hooks import require_fovy_cameras
from mjlab.managers.term_checks import checked_when_built

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.dr._types import Ranges
    from mjlab.managers.scene_entity_config import SceneEntityCfg


def _check_cam_fovy(
    env: ManagerBasedRlEnv, ranges: Ranges, asset_cfg: SceneEntityCfg = ROBOT, **_: Any
) -> None:
    for selection in targets_of(env, ranges, asset_cfg, CAMERA):
        require_fovy_cameras(selection)


cam_fovy = checked_when_built(_check_cam_fovy)(field_term("cam_fovy"))
cam_intrinsic = field_term("cam_intrinsic")
cam_pos = field_term("cam_pos")
cam_quat = rotation_term("cam_quat")
