"""Camera sensors: RGB, depth and segmentation images."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.sensor.sensor import Sensor, SensorCfg
from mjlab.sim.engine import (
    CAMERA_DATA_TYPES,
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

# Vertical field of view of an added camera (deg).
_DEFAULT_FOVY = 45.0


@dataclass
class CameraSensorCfg(SensorCfg):
    """Camera sensor configuration."""

    camera_name: str | None = None
    """Existing camera to use, with entity prefix. None: add a camera named after the sensor."""
    parent_body: str | None = None
    """Parent body of the added camera, with entity prefix. None: the environment. A camera of the
    world, added or existing, stands relative to the origin of each environment."""
    pos: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Position of the added camera in its body's frame, or from the environment's origin (m)."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z) of the added camera, which looks along -z with +y up."""
    fovy: float | None = None
    """Vertical field of view (deg); for orthographic cameras, vertical extent (m). None: unchanged
    for an existing camera, 45 for an added one. A value removes the focal length and the sensor
    size of an existing camera."""
    width: int = 160
    """Image width (pixels)."""
    height: int = 120
    """Image height (pixels)."""
    data_types: tuple[CameraDataType, ...] = ("rgb",)
    """Image types to render, of `rgb`, `depth` and `segmentation`."""
    use_textures: bool = True
    """Render material textures."""
    use_shadows: bool = False
    """Scale the contribution of occluded lights by 0.3."""
    enabled_geom_groups: tuple[int, ...] = (0, 1, 2)
    """Visible geom groups."""
    orthographic: bool = False
    """Use orthographic projection. False leaves an existing camera unchanged."""
    clone_data: bool = False
    """Return copies of the images, which later renderings do not overwrite."""

    def build(self) -> CameraSensor:
        """Build the sensor."""
        return CameraSensor(self)


@dataclass
class CameraSensorData:
    """Images of B environments. Types not in `cfg.data_types` are None.

    Row 0 is the top row, and column 0 is on the left.
    """

    rgb: torch.Tensor | None = None
    """RGB colors, (B, height, width, 3) uint8."""
    depth: torch.Tensor | None = None
    """Distance along the optical axis (m), (B, height, width, 1) float32. Background: 0."""
    segmentation: torch.Tensor | None = None
    """Object id and type (`mjtObj`; 5 for a geom), (B, height, width, 2) int32. Background: -1."""


class CameraSensor(Sensor[CameraSensorData]):
    """Camera sensor: renders geoms of the enabled groups by rays through pixel centers.

    `sim.sense()` renders the images once per environment step, after resets and commands. So
    observations read images of the current state, rewards and terminations those of the previous
    step.

    Surfaces are visible from outside only. Geoms with alpha 0 are invisible, all others opaque.
    Several sensors may share one camera, with different image sizes and geom groups.
    """

    _transient = {"_camera_idx", "_view"}

    def __init__(self, cfg: CameraSensorCfg) -> None:
        """Check the config.

        Raises:
            ValueError: negative image size, or unknown data type.
        """
        super().__init__()
        self.cfg = cfg
        owner = f"Camera sensor {cfg.name!r}"
        check_count(f"{owner} width", cfg.width, minimum=0)
        check_count(f"{owner} height", cfg.height, minimum=0)
        for data_type in cfg.data_types:
            check_one_of(f"{owner} data_types", data_type, CAMERA_DATA_TYPES)
        self._camera_idx = -1
        self._view: CameraView | None = None
        self._rgb: torch.Tensor | None = None
        self._depth: torch.Tensor | None = None
        self._segmentation: torch.Tensor | None = None

    # Construction.

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add the camera, or apply `fovy` and `orthographic` to the existing one.

        Raises:
            ValueError: unknown body (with the available names), or duplicate name of an added
                camera.
        """
        cfg = self.cfg
        camera = scene_spec.camera(self.camera_name)
        if cfg.camera_name is None:
            if camera is not None:
                raise ValueError(
                    f"Camera sensor {cfg.name!r}: the scene already has a camera {cfg.name!r}; rename "
                    f"the sensor, or use the existing camera with camera_name={cfg.name!r}."
                )
            camera = self._add_camera(scene_spec)
        if camera is None:
            # Another sensor may add it; `initialize` raises otherwise.
            return
        if cfg.orthographic:
            camera.proj = mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC
        fovy = _DEFAULT_FOVY if cfg.camera_name is None and cfg.fovy is None else cfg.fovy
        if fovy is not None:
            camera.fovy = fovy
            # The compiler ignores the field of view of a camera that has a sensor.
            camera.sensor_size = [0.0, 0.0]
            camera.focal_length, camera.focal_pixel = [0.0, 0.0], [0.0, 0.0]
            camera.principal_length, camera.principal_pixel = [0.0, 0.0], [0.0, 0.0]

    def _add_camera(self, scene_spec: mujoco.MjSpec) -> mujoco.MjsCamera:
        cfg = self.cfg
        parent = "world" if cfg.parent_body is None else cfg.parent_body
        body = scene_spec.body(parent)
        if body is None:
            names = [body.name for body in scene_spec.bodies]
            raise ValueError(
                f"Camera sensor {cfg.name!r}: unknown body {parent!r} (names include the entity "
                f"prefix); {suggest(parent, names)}"
            )
        camera = body.add_camera(name=cfg.name, pos=cfg.pos, quat=cfg.quat)
        # Integers of 32 bits. Larger images exceed the memory, an error of `initialize`.
        camera.resolution = [min(side, 2**31 - 1) for side in (cfg.width, cfg.height)]
        return camera

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Look up the camera in the compiled model. Images are empty until `sim.sense()`.

        Raises:
            ValueError: unknown camera (with the available names).
        """
        kind = mujoco.mjtObj.mjOBJ_CAMERA
        self._camera_idx = mujoco.mj_name2id(mj_model, kind, self.camera_name)
        if self._camera_idx < 0:
            names = [mujoco.mj_id2name(mj_model, kind, i) for i in range(mj_model.ncam)]
            raise ValueError(
                f"Camera sensor {self.cfg.name!r}: unknown camera {self.camera_name!r} (names "
                "include the entity prefix, e.g. 'robot/wrist'); "
                f"{suggest(self.camera_name, filter(None, names))}"
            )
        cfg = self.cfg
        groups = tuple(sorted(set(cfg.enabled_geom_groups)))
        if not rendered_geoms(mj_model, groups):
            present = sorted(set(mj_model.geom_group.clip(0, 5).tolist()))
            log.warning(
                "Camera sensor %r sees nothing: enabled_geom_groups=%s contain no geoms of the "
                "scene. Groups with geoms: %s.",
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
        """Do nothing: the sensor does not use its context."""

    # Properties.

    @property
    def camera_idx(self) -> int:
        """Camera id in the model. -1 before `initialize`."""
        return self._camera_idx

    @property
    def camera_name(self) -> str:
        """Name of the camera in the model."""
        return self.cfg.name if self.cfg.camera_name is None else self.cfg.camera_name

    @property
    def view(self) -> CameraView:
        """Render request for the engine.

        Raises:
            RuntimeError: called before `initialize`.
        """
        if self._view is None:
            raise WrongStateError(f"Camera sensor {self.cfg.name!r} is not initialized.")
        return self._view

    # Sensing.

    def update(self, dt: float) -> None:
        """Do nothing: images stay valid until the next rendering."""

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Do nothing: images stay valid until the next rendering."""

    @property
    def needs_substep(self) -> bool:
        """True if a subclass overrides `update`."""
        return type(self).update is not CameraSensor.update

    def set_images(self, images: Images) -> None:
        """Store rendered images. The next rendering overwrites the same tensors."""
        self._rgb, self._depth = images.rgb, images.depth
        self._segmentation = images.segmentation
        self.invalidate_cache()

    def _compute_data(self) -> CameraSensorData:
        images = (self._rgb, self._depth, self._segmentation)
        if self.cfg.clone_data:
            images = tuple(None if image is None else image.clone() for image in images)
        return CameraSensorData(*images)
