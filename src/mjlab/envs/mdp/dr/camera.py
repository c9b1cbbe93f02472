"""Randomization of cameras."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import mujoco

from mjlab.envs.mdp.dr._core import CAMERA, field_term, rotation_term

if TYPE_CHECKING:
    from mjlab.envs.mdp.dr._core import Selection

__all__ = ["cam_fovy", "cam_intrinsic", "cam_pos", "cam_quat"]

cam_intrinsic = field_term(
    __name__,
    "cam_intrinsic",
    CAMERA,
    "Randomize camera intrinsics: focal lengths x, y and principal point x, y (m).",
)


def _take_to_world(selection: Selection) -> None:
    """Move cameras of the world to its origin, where the default is; the environment places them."""
    env = selection.env
    env.scene.place_cameras(env.sim.model, selection.rows, at_world=True)


cam_pos = field_term(
    __name__,
    "cam_pos",
    CAMERA,
    "Randomize camera positions x, y, z (m) in the body frame; of the world, from the environment's "
    "origin. Affects only cameras of mode fixed.",
    before=_take_to_world,
)
cam_quat = rotation_term(
    __name__, "cam_quat", CAMERA, "Perturb camera orientations in the body frame."
)


def _warn_of_lenses(selection: Selection) -> None:
    """Warn if a selected camera has a sensor size: MuJoCo then ignores fovy."""
    model = selection.env.sim.mj_model
    # Orthographic cameras have no focal length: fovy is the height of the image.
    ignored = [
        name
        for name, camera in zip(selection.names, selection.columns.tolist(), strict=True)
        if model.cam_sensorsize[camera, 1] > 0.0
        and model.cam_projection[camera] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    ]
    if ignored:
        warnings.warn(
            f"cam_fovy: expected cameras without focal and sensorsize, got {ignored}, whose fovy "
            "MuJoCo ignores; use dr.cam_intrinsic, or select other cameras (camera_names of the "
            "SceneEntityCfg).",
            UserWarning,
            stacklevel=2,
        )


cam_fovy = field_term(
    __name__,
    "cam_fovy",
    CAMERA,
    "Randomize vertical fields of view (degrees). Warns of cameras with focal length and sensor "
    "size, because MuJoCo ignores their fovy; use `cam_intrinsic`.",
    before=_warn_of_lenses,
)
