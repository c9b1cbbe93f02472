"""Camera resolution shared by the native, browser and offscreen viewers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjlab.utils.errors import check_exists, check_one_of
from mjlab.viewer.viewer_config import OriginType, ViewerConfig


@dataclass(frozen=True)
class CameraView:
    """Resolved camera; angles in degrees with MuJoCo's signs (negative elevation looks down)."""

    body_id: int | None
    """Body to follow. None: the fixed point `lookat`."""
    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float
    fovy: float | None

    def target(self, body_xpos: np.ndarray) -> np.ndarray:
        """Return the world point the camera looks at, (3,), from body positions (nbody, 3)."""
        if self.body_id is None:
            return np.asarray(self.lookat, dtype=float)
        return np.asarray(body_xpos[self.body_id], dtype=float)

    def offset(self) -> np.ndarray:
        """Return the vector from the target to the camera (m), world axes, (3,).

        MuJoCo's camera looks along (cos e cos a, cos e sin a, sin e); the offset is its opposite.
        """
        azimuth, elevation = np.deg2rad([self.azimuth, self.elevation])
        forward = np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
        return -self.distance * forward

    def apply(self, camera: mujoco.MjvCamera, body_xpos: np.ndarray) -> None:
        """Set the pose of a free MuJoCo camera, from body positions (nbody, 3)."""
        camera.lookat[:] = self.target(body_xpos)
        camera.distance = self.distance
        camera.azimuth = self.azimuth
        camera.elevation = self.elevation


def resolve_camera(
    cfg: ViewerConfig, model: mujoco.MjModel, entities: Mapping[str, Any]
) -> CameraView:
    """Resolve the pose of the camera of `cfg` and the body it follows in `model`.

    Args:
        cfg: Viewer configuration.
        model: Compiled scene; bodies of an entity are named `<entity>/<body>`.
        entities: Entities of the scene by name; the camera never follows "terrain".

    Raises:
        ValueError: Unknown camera, entity or body, or a required name is missing.
    """
    if cfg.camera is not None:
        return _view_of_model_camera(model, cfg.camera, cfg.distance)
    return CameraView(
        body_id=_followed_body(cfg, model, entities),
        lookat=cfg.lookat,
        distance=cfg.distance,
        azimuth=cfg.azimuth,
        elevation=cfg.elevation,
        fovy=cfg.fovy,
    )


def whole_model_view(model: mujoco.MjModel) -> CameraView:
    """Return a fixed view of the whole model."""
    x, y, z = (float(value) for value in model.stat.center)
    return CameraView(
        body_id=None,
        lookat=(x, y, z),
        distance=3.0 * float(model.stat.extent),
        azimuth=120.0,
        elevation=-20.0,
        fovy=None,
    )


def first_moving_body(model: mujoco.MjModel) -> int | None:
    """Return the ID of the first body that can move; bodies below a mocap root count as moving."""
    for body_id in range(1, model.nbody):
        welded = model.body_weldid[body_id] == 0
        if not welded or model.body_mocapid[model.body_rootid[body_id]] >= 0:
            return body_id
    return None


def nearest_envs(origins: np.ndarray, env_idx: int, count: int) -> list[int]:
    """Return the `count` environments with origins (num_envs, 3) nearest to that of `env_idx`."""
    distances = np.linalg.norm(origins - origins[env_idx], axis=-1)
    distances[env_idx] = np.inf
    order = np.argsort(distances, kind="stable")
    return [int(i) for i in order[: min(count, len(origins) - 1)]]


def _view_of_model_camera(model: mujoco.MjModel, name: str, distance: float) -> CameraView:
    """Return the view of the camera `name` in the model's initial pose."""
    names = [model.camera(i).name for i in range(model.ncam)]
    check_exists("viewer.camera", name, names)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera_id = names.index(name)
    # A MuJoCo camera looks along its -z axis.
    forward = -data.cam_xmat[camera_id].reshape(3, 3)[:, 2]
    return CameraView(
        body_id=None,
        lookat=tuple(data.cam_xpos[camera_id] + distance * forward),
        distance=distance,
        azimuth=float(np.rad2deg(np.arctan2(forward[1], forward[0]))),
        elevation=float(np.rad2deg(np.arcsin(np.clip(forward[2], -1.0, 1.0)))),
        fovy=float(model.cam_fovy[camera_id]),
    )


def _followed_body(
    cfg: ViewerConfig, model: mujoco.MjModel, entities: Mapping[str, Any]
) -> int | None:
    if cfg.origin_type is OriginType.WORLD:
        return None
    if cfg.origin_type is OriginType.AUTO:
        return first_moving_body(model)
    names = [name for name in entities if name != "terrain"]
    only = names[0] if len(names) == 1 else None
    name: Any = only if cfg.entity_name is None else cfg.entity_name
    use = f"for origin_type {cfg.origin_type.name}"
    check_one_of(f"viewer.entity_name {use}", name, entities)
    entity = entities[name]
    if cfg.origin_type is OriginType.ASSET_ROOT:
        return int(entity.indexing.root_body_id)
    bodies = dict(zip(entity.body_names, entity.indexing.body_ids.tolist(), strict=True))
    # Names of bodies in attached parts may include the prefix of the part.
    bodies |= {model.body(i).name.removeprefix(f"{name}/"): i for i in bodies.values()}
    check_one_of(f"viewer.body_name {use} of {name!r}", cfg.body_name, bodies)
    return bodies[cfg.body_name]
