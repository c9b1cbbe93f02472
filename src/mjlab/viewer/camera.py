"""One camera resolver for the native, the browser and the offscreen viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjlab.viewer.viewer_config import OriginType, ViewerConfig


@dataclass(frozen=True)
class CameraView:
    """A resolved camera; angles in degrees with MuJoCo's signs (negative elevation looks down)."""

    body_id: int | None
    """Body to follow, or None for the fixed point `lookat`."""
    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float
    fovy: float | None

    def target(self, body_xpos: np.ndarray) -> np.ndarray:
        """World point the camera looks at, (3,), given body positions (nbody, 3)."""
        if self.body_id is None:
            return np.asarray(self.lookat, dtype=float)
        return np.asarray(body_xpos[self.body_id], dtype=float)

    def offset(self) -> np.ndarray:
        """Vector from the target to the camera, (3,), world axes, metres.

        MuJoCo's camera looks along (cos e cos a, cos e sin a, sin e), so it stands at the opposite.
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


def resolve_camera(
    cfg: ViewerConfig, model: mujoco.MjModel, entities: Mapping[str, Any]
) -> CameraView:
    """Find where the camera of `cfg` is and what it follows in `model`.

    Args:
        cfg: The viewer's configuration.
        model: The compiled scene; bodies of an entity are named `<entity>/<body>`.
        entities: The scene's entities by name; "terrain" is never followed.

    Raises:
        ValueError: The camera, entity or body does not exist, or is needed and was not named.
    """
    if cfg.camera is not None:
        return _view_of_model_camera(cfg, model)
    return CameraView(
        body_id=_followed_body(cfg, model, entities),
        lookat=cfg.lookat,
        distance=cfg.distance,
        azimuth=cfg.azimuth,
        elevation=cfg.elevation,
        fovy=cfg.fovy,
    )


def _view_of_model_camera(cfg: ViewerConfig, model: mujoco.MjModel) -> CameraView:
    """Return the view of the camera `cfg.camera`, as it stands in the model's initial pose."""
    names = [model.camera(i).name for i in range(model.ncam)]
    if cfg.camera not in names:
        raise ValueError(
            f"The viewer's camera {cfg.camera!r} is not in the scene. Cameras there: {names}."
        )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera_id = names.index(cfg.camera)
    # A MuJoCo camera looks along its own -z axis.
    forward = -data.cam_xmat[camera_id].reshape(3, 3)[:, 2]
    return CameraView(
        body_id=None,
        lookat=tuple(data.cam_xpos[camera_id] + cfg.distance * forward),
        distance=cfg.distance,
        azimuth=float(np.rad2deg(np.arctan2(forward[1], forward[0]))),
        elevation=float(np.rad2deg(np.arcsin(np.clip(forward[2], -1.0, 1.0)))),
        fovy=float(model.cam_fovy[camera_id]),
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
    """Id of the first body that can move; below a mocap root, bodies count as moving."""
    for body_id in range(1, model.nbody):
        welded = model.body_weldid[body_id] == 0
        if not welded or model.body_mocapid[model.body_rootid[body_id]] >= 0:
            return body_id
    return None


def nearest_envs(origins: np.ndarray, env_idx: int, count: int) -> list[int]:
    """The `count` environments whose origins (num_envs, 3) are nearest to that of `env_idx`."""
    distances = np.linalg.norm(origins - origins[env_idx], axis=-1)
    distances[env_idx] = np.inf
    order = np.argsort(distances, kind="stable")
    return [int(i) for i in order[: min(count, len(origins) - 1)]]


def _followed_body(
    cfg: ViewerConfig, model: mujoco.MjModel, entities: Mapping[str, Any]
) -> int | None:
    if cfg.origin_type is OriginType.WORLD:
        return None
    if cfg.origin_type is OriginType.AUTO:
        return first_moving_body(model)
    name = _entity_name(cfg, entities)
    if cfg.origin_type is OriginType.ASSET_ROOT:
        return int(entities[name].indexing.root_body_id)
    return _body_of_entity(cfg, model, entities, name)


def _entity_name(cfg: ViewerConfig, entities: Mapping[str, Any]) -> str:
    names = [name for name in entities if name != "terrain"]
    if cfg.entity_name is None:
        if len(names) == 1:
            return names[0]
        raise ValueError(
            f"The viewer's origin_type {cfg.origin_type.name} needs entity_name, because the scene "
            f"has {len(names)} entities: {names}. Set viewer.entity_name to one of them."
        )
    if cfg.entity_name not in entities:
        raise ValueError(
            f"The viewer's entity_name {cfg.entity_name!r} is not in the scene. "
            f"Entities there: {names}."
        )
    return cfg.entity_name


def _body_of_entity(
    cfg: ViewerConfig, model: mujoco.MjModel, entities: Mapping[str, Any], entity_name: str
) -> int:
    candidates = list(entities[entity_name].body_names)
    if cfg.body_name is None:
        raise ValueError(
            "The viewer's origin_type ASSET_BODY needs body_name. "
            f"Bodies of {entity_name!r}: {candidates}."
        )
    body_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"{entity_name}/{cfg.body_name}")
    if body_id < 0:
        raise ValueError(
            f"The viewer's body_name {cfg.body_name!r} is not a body of entity {entity_name!r}. "
            f"Bodies there: {candidates}."
        )
    return int(body_id)
