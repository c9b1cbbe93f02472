"""Images and frustum of a camera sensor in the browser."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import viser
import viser.transforms as vtf

from mjlab.sensor import CameraSensor
from mjlab.viewer.model_sync import to_numpy

# Maximum size of enlarged images: the width of the panel.
_PANEL_PIXELS = 384
# Slider of the depth shown white (m): range, step and initial value.
_RANGE, _STEP, _INITIAL_RANGE = (0.1, 10.0), 0.1, 1.0
_FRUSTUM_LENGTH = 0.08
_FRUSTUM_COLOR = (250, 176, 5)
# MuJoCo cameras look along -z with y up; viser's frustums look along z with y down.
_TO_FRUSTUM = vtf.SO3(np.array([0.0, 1.0, 0.0, 0.0]))


class ViserCameraViewer:
    """Images of one camera sensor in a folder of the page, and its frustum in the scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        camera_sensor: CameraSensor,
        mj_model: mujoco.MjModel,
        min_display_size: int = 128,
        *,
        sim_model: Any | None = None,
        request_redraw: Callable[[], None] | None = None,
    ) -> None:
        """Add the folder to the current GUI container.

        Args:
            server: The page's server.
            camera_sensor: Initialized camera sensor.
            mj_model: Compiled model.
            min_display_size: Size that images are enlarged to, if the panel has room (pixels).
            sim_model: Batched model, for per-environment fields of view.
            request_redraw: Called when a control changes.
        """
        self._server, self._sensor = server, camera_sensor
        self._model, self._sim_model = mj_model, sim_model
        self._min_size = min_display_size
        self._images: dict[str, viser.GuiImageHandle] = {}
        self._range: viser.GuiInputHandle[float] | None = None
        self._frustum: viser.CameraFrustumHandle | None = None
        gui, view = server.gui, camera_sensor.view
        blank = enlarged(np.zeros((view.height, view.width, 3), np.uint8), min_display_size)
        self._folder = gui.add_folder(camera_sensor.cfg.name)
        with self._folder:
            for kind in view.data_types:
                self._images[kind] = gui.add_image(blank, label=kind.capitalize(), format="png")
                if kind == "depth":
                    self._range = gui.add_slider(
                        "White at (m)",
                        min=_RANGE[0],
                        max=_RANGE[1],
                        step=_STEP,
                        initial_value=_INITIAL_RANGE,
                        hint="Depths from here on, and pixels without depth, are white.",
                    )
            self._shows_frustum = gui.add_checkbox(
                "Frustum", True, hint="Show the camera's view frustum in the scene."
            )
        if request_redraw is not None:
            for control in (self._range, self._shows_frustum):
                if control is not None:
                    control.on_update(lambda _: request_redraw())

    def update(
        self, sim_data: Any, env_idx: int = 0, scene_offset: np.ndarray | None = None
    ) -> None:
        """Show the latest images of an environment.

        Args:
            sim_data: Batched data of the simulation.
            env_idx: Environment.
            scene_offset: Translation of the drawn scene, (3,). None: zero.
        """
        data = self._sensor.data
        for kind, handle in self._images.items():
            image = to_numpy(getattr(data, kind)[env_idx])
            if kind == "depth":
                assert self._range is not None
                image = depth_colors(image, float(self._range.value))
            elif kind == "segmentation":
                image = segmentation_colors(image)
            handle.image = enlarged(image, self._min_size)
        offset = np.zeros(3) if scene_offset is None else scene_offset
        self._show_frustum(sim_data, env_idx, offset)

    def cleanup(self) -> None:
        """Remove the images and the frustum from the page."""
        self._folder.remove()
        if self._frustum is not None:
            self._frustum.remove()
            self._frustum = None

    def _show_frustum(self, data: Any, env_idx: int, offset: np.ndarray) -> None:
        camera, view = self._sensor.camera_idx, self._sensor.view
        is_orthographic = self._model.cam_projection[camera] != 0
        if is_orthographic or not self._shows_frustum.value:
            if self._frustum is not None:
                self._frustum.visible = False
            return
        aspect = view.width / view.height
        fovy, intrinsic = self._model.cam_fovy[camera], self._model.cam_intrinsic[camera]
        if self._sim_model is not None:
            fovy = self._sim_model.cam_fovy[env_idx, camera]
            intrinsic = to_numpy(self._sim_model.cam_intrinsic[env_idx, camera])
        angle = vertical_angle(
            float(fovy), self._model.cam_sensorsize[camera], intrinsic[1], aspect
        )
        mat = to_numpy(data.cam_xmat[env_idx, camera]).astype(float)
        wxyz = (vtf.SO3.from_matrix(mat) @ _TO_FRUSTUM).wxyz
        position = to_numpy(data.cam_xpos[env_idx, camera]) + offset
        if self._frustum is None:
            self._frustum = self._server.scene.add_camera_frustum(
                f"/cameras/{self._sensor.cfg.name}",
                fov=angle,
                aspect=aspect,
                scale=_FRUSTUM_LENGTH,
                thickness=0.002,
                color=_FRUSTUM_COLOR,
                cast_shadow=False,
                receive_shadow=False,
            )
        self._frustum.fov = angle
        self._frustum.position, self._frustum.wxyz = position, wxyz
        self._frustum.visible = True


def vertical_angle(fovy: float, sensorsize: np.ndarray, focal: float, aspect: float) -> float:
    """Return the vertical field of view of an image with this aspect ratio (rad).

    Args:
        fovy: Vertical field of view of the camera (degrees), used if it has no sensor.
        sensorsize: Width and height of the sensor, cropped to the image's aspect ratio, (2,).
        focal: Vertical focal length.
        aspect: Width / height of the image.
    """
    width, height = (float(side) for side in sensorsize)
    if height == 0.0:
        return math.radians(fovy)
    return 2.0 * math.atan(min(height, width / aspect) / 2.0 / float(focal))


def enlarged(image: np.ndarray, min_size: int = 128) -> np.ndarray:
    """Enlarge an image (H, W, 3) by an integer, to `min_size` pixels or the panel's size."""
    height, width = image.shape[:2]
    factor = -(-min_size // min(height, width))
    factor = max(1, min(factor, _PANEL_PIXELS // max(height, width)))
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def depth_colors(depth: np.ndarray, white: float) -> np.ndarray:
    """Return gray levels (H, W, 3) of depths (m), (H, W, 1): black is near.

    Depths >= `white` are white. Depth 0 (no hit) is white too.
    """
    brightness = np.clip(np.where(depth > 0.0, depth / white, 1.0), 0.0, 1.0)
    return np.repeat((255.0 * brightness).astype(np.uint8), 3, axis=-1)


def segmentation_colors(objects: np.ndarray) -> np.ndarray:
    """Return colors (H, W, 3) of object IDs and types (H, W, 2); background pixels are black.

    An object has the same color in all images, and neighboring IDs have different colors.
    """
    ids, kinds = objects[..., 0].astype(np.uint32), objects[..., 1].astype(np.uint32)
    # Knuth's multiplicative hash: multiplying by a large odd number spreads the bits.
    mixed = ids * np.uint32(2654435761) + kinds * np.uint32(40503)
    mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(2246822519)
    parts = np.stack([(mixed >> np.uint32(shift)) & np.uint32(255) for shift in (24, 14, 4)], -1)
    colors = (64 + parts * 191 // 255).astype(np.uint8)
    colors[objects[..., 0] < 0] = 0
    return colors
