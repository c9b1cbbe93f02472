"""Camera sensors: images of the scene, in colours, depths and objects."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.sensor.sensor import Sensor, SensorCfg
from mjlab.sim.engine import (
    CAMERA_DATA_TYPES,
    NUM_GEOM_GROUPS,
    CameraDataType,
    CameraView,
    Images,
    rendered_geoms,
)
from mjlab.utils.errors import WrongStateError, check_count, check_one_of
from mjlab.utils.string import suggest

if TYPE_CHECKING:
    from mjlab.entity import Entity


log = logging.getLogger(__name__)

# Fields of view of perspective cameras, in degrees.
_DEFAULT_FOVY = 45.0
_MAX_FOVY = 180.0


@dataclass
class CameraSensorCfg(SensorCfg):
    """Describes a camera sensor."""

    camera_name: str | None = None
    """Camera of the scene to look through, with the prefix of its entity. None adds a camera, which
    has the name of the sensor."""
    parent_body: str | None = None
    """Body, with the prefix of its entity, that carries the added camera. None: the world."""
    pos: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Position of the added camera in the frame of its body, in metres."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z) of the added camera. It looks along its -z axis, and +y is up."""
    fovy: float | None = None
    """Vertical field of view in degrees; of an orthographic camera, the height of what it sees, in
    metres. None leaves an existing camera as it is, and is 45 for an added one. An existing camera
    that has a focal length and a sensor size loses them if this is set."""
    width: int = 160
    """Columns of the image."""
    height: int = 120
    """Rows of the image."""
    data_types: tuple[CameraDataType, ...] = ("rgb",)
    """What is measured, of `rgb`, `depth` and `segmentation`. The rest is not computed."""
    use_textures: bool = True
    """Whether surfaces show the textures of their materials."""
    use_shadows: bool = False
    """Whether a light that something stands before counts 0.3 times."""
    enabled_geom_groups: tuple[int, ...] = (0, 1, 2)
    """Groups of the geoms that the camera sees."""
    orthographic: bool = False
    """Whether rays of the camera are parallel. False leaves an existing camera as it is."""
    clone_data: bool = False
    """Whether images that were read stay as they are, and the next ones come in new tensors."""

    def build(self) -> CameraSensor:
        """Build the sensor."""
        return CameraSensor(self)


@dataclass
class CameraSensorData:
    """Images of all environments B; None for what the config does not ask for.

    Row 0 is the top row, and column 0 is on the left.
    """

    rgb: torch.Tensor | None = None
    """Colours, (B, height, width, 3) uint8."""
    depth: torch.Tensor | None = None
    """Distances along the optical axis in metres, (B, height, width, 1) float32; 0 where there is
    nothing."""
    segmentation: torch.Tensor | None = None
    """Ids and types (`mjtObj`; 5 for a geom) of objects, (B, height, width, 2) int32; -1 and -1
    where there is nothing."""


class CameraSensor(Sensor[CameraSensorData]):
    """Sees geoms of some groups, by rays through the centres of pixels.

    Images are rendered by `sim.sense()`: once per environment step, after resets and commands. So
    observations see the current state, and rewards and terminations the images of the step before.

    A camera sees surfaces from outside only, and no geom with an alpha of 0; others are opaque.
    Several sensors may look through one camera, with images of other sizes and of other geom groups.
    """

    _transient = {"_camera_idx", "_view"}

    def __init__(self, cfg: CameraSensorCfg) -> None:
        """Check the config.

        Raises:
            ValueError: an image without pixels; no or unknown data types; no geom groups or such
                as do not exist; a field of view that makes no sense.
        """
        super().__init__()
        self.cfg = cfg
        self._check_cfg()
        self._camera_idx = -1
        self._view: CameraView | None = None
        self._rgb: torch.Tensor | None = None
        self._depth: torch.Tensor | None = None
        self._segmentation: torch.Tensor | None = None

    def _check_cfg(self) -> None:
        cfg, owner = self.cfg, f"Camera sensor {self.cfg.name!r}"
        check_count(f"{owner} width", cfg.width)
        check_count(f"{owner} height", cfg.height)
        if isinstance(cfg.data_types, str) or not cfg.data_types:
            raise ValueError(
                f"{owner} data_types: expected a tuple of {', '.join(CAMERA_DATA_TYPES)}, got "
                f"{cfg.data_types!r}."
            )
        for kind in cfg.data_types:
            check_one_of(f"{owner} data_types", kind, CAMERA_DATA_TYPES)
        if len(set(cfg.data_types)) < len(cfg.data_types):
            raise ValueError(f"{owner} data_types={cfg.data_types!r} names one of them twice.")
        groups = range(NUM_GEOM_GROUPS)
        if not cfg.enabled_geom_groups:
            raise ValueError(
                f"{owner} enabled_geom_groups is empty, so that the camera would see nothing; give "
                f"some of {list(groups)}."
            )
        for group in cfg.enabled_geom_groups:
            check_one_of(f"{owner} enabled_geom_groups", group, groups)
        is_perspective = not cfg.orthographic and cfg.camera_name is None
        limit = _MAX_FOVY if is_perspective else math.inf
        if cfg.fovy is not None and not 0.0 < cfg.fovy < limit:
            raise ValueError(f"{owner} fovy: expected a number in (0, {limit:g}), got {cfg.fovy}.")

    def _error(self, message: str) -> ValueError:
        return ValueError(f"Camera sensor {self.cfg.name!r}: {message}")

    def _unknown_camera(self, name: str, cameras: Iterable[str]) -> ValueError:
        return self._error(
            f"unknown camera {name!r} (names have the prefix of their entity, such as "
            f"'robot/wrist'); {suggest(name, filter(None, cameras))}"
        )

    # Construction.

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add the camera, or change the existing one's projection if the config says so.

        Raises:
            ValueError: there is no such body or camera (with those there are), or the name of an
                added camera is taken.
        """
        cfg = self.cfg
        if cfg.camera_name is None:
            self._add_camera(scene_spec)
            return
        if cfg.parent_body is not None:
            raise self._error(
                f"parent_body={cfg.parent_body!r} is for a camera that the sensor adds, but it looks "
                f"through the existing camera {cfg.camera_name!r}. Leave out one of them."
            )
        if cfg.fovy is not None or cfg.orthographic:
            camera = scene_spec.camera(cfg.camera_name)
            if camera is None:
                names = [camera.name for camera in scene_spec.cameras]
                raise self._unknown_camera(cfg.camera_name, names)
            _set_projection(camera, cfg.fovy, orthographic=cfg.orthographic)

    def _add_camera(self, scene_spec: mujoco.MjSpec) -> None:
        cfg = self.cfg
        body = scene_spec.worldbody
        if cfg.parent_body is not None:
            body = scene_spec.body(cfg.parent_body)
            if body is None:
                names = [body.name for body in scene_spec.bodies]
                raise self._error(
                    f"unknown body {cfg.parent_body!r} (names have the prefix of their entity); "
                    f"{suggest(cfg.parent_body, names)}"
                )
        if scene_spec.camera(cfg.name) is not None:
            raise self._error(
                f"the scene has a camera {cfg.name!r} already. Give the sensor another name, or look "
                f"through that camera by camera_name={cfg.name!r}."
            )
        camera = body.add_camera(name=cfg.name, pos=cfg.pos, quat=cfg.quat)
        camera.resolution = [cfg.width, cfg.height]
        fovy = _DEFAULT_FOVY if cfg.fovy is None else cfg.fovy
        _set_projection(camera, fovy, orthographic=cfg.orthographic)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Find the camera in the compiled model; its images are empty until `sim.sense()`.

        Raises:
            ValueError: there is no such camera; the message lists those there are.
        """
        kind = mujoco.mjtObj.mjOBJ_CAMERA
        self._camera_idx = mujoco.mj_name2id(mj_model, kind, self.camera_name)
        if self._camera_idx < 0:
            names = [mujoco.mj_id2name(mj_model, kind, i) or "" for i in range(mj_model.ncam)]
            raise self._unknown_camera(self.camera_name, names)
        cfg = self.cfg
        groups = tuple(sorted(set(cfg.enabled_geom_groups)))
        if not rendered_geoms(mj_model, groups):
            present = sorted(set(mj_model.geom_group.clip(0, 5).tolist()))
            log.warning(
                "Camera sensor %r sees nothing: no geom of the scene is in enabled_geom_groups=%s. "
                "There are geoms in the groups %s.",
                cfg.name, groups, present,
            )  # fmt: skip
        self._view = CameraView(
            camera_id=self._camera_idx,
            width=cfg.width,
            height=cfg.height,
            data_types=tuple(cfg.data_types),
            geom_groups=groups,
            use_textures=cfg.use_textures,
            use_shadows=cfg.use_shadows,
        )
        self.set_images(Images.empty(self._view, data.qpos.shape[0], device))

    def set_context(self, ctx: object) -> None:
        """Take note of what will evaluate the sensor; the sensor needs nothing of it."""

    # What there is.

    @property
    def camera_idx(self) -> int:
        """Id of the camera in the model, once the sensor is initialized."""
        return self._camera_idx

    @property
    def camera_name(self) -> str:
        """Name of the camera in the model."""
        return self.cfg.name if self.cfg.camera_name is None else self.cfg.camera_name

    @property
    def view(self) -> CameraView:
        """What is asked of the engine.

        Raises:
            RuntimeError: the sensor is not initialized.
        """
        if self._view is None:
            raise WrongStateError(f"Camera sensor {self.cfg.name!r} has not been initialized.")
        return self._view

    # Sensing.

    def update(self, dt: float) -> None:
        """Do nothing: images stay until new ones are rendered."""

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Do nothing, likewise."""

    @property
    def needs_substep(self) -> bool:
        """Whether a subclass does something in `update` after all."""
        return type(self).update is not CameraSensor.update

    def set_images(self, images: Images) -> None:
        """Take what was rendered. The tensors are those that the next rendering overwrites."""
        self._rgb, self._depth = images.rgb, images.depth
        self._segmentation = images.segmentation
        self.invalidate_cache()

    def _compute_data(self) -> CameraSensorData:
        images = (self._rgb, self._depth, self._segmentation)
        if self.cfg.clone_data:
            images = tuple(None if image is None else image.clone() for image in images)
        return CameraSensorData(*images)


def _set_projection(camera: mujoco.MjsCamera, fovy: float | None, *, orthographic: bool) -> None:
    """Change the projection of a camera; None and False leave it as it is."""
    if orthographic:
        camera.proj = mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC
    if fovy is not None:
        camera.fovy = fovy
        # The compiler ignores the field of view of a camera that has a sensor.
        camera.sensor_size = [0.0, 0.0]
        camera.focal_length, camera.focal_pixel = [0.0, 0.0], [0.0, 0.0]
        camera.principal_length, camera.principal_pixel = [0.0, 0.0], [0.0, 0.0]
