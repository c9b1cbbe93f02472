"""What is asked of an engine's renderer, and what comes back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import mujoco
import torch

CameraDataType = Literal["rgb", "depth", "segmentation"]
"""What a camera can measure."""

CAMERA_DATA_TYPES: tuple[str, ...] = get_args(CameraDataType)
NUM_GEOM_GROUPS = 6

LENS_FIELDS = frozenset({"cam_fovy", "cam_intrinsic"})
"""Model fields: where one of these differs between environments, so do the rays of a camera."""

# What segmentation has where there is nothing.
BACKGROUND = -1


@dataclass(frozen=True)
class CameraView:
    """One camera of the model, and what to render of what it sees."""

    camera_id: int
    """The camera in the model."""
    width: int
    """Columns of the image."""
    height: int
    """Rows of the image."""
    data_types: tuple[str, ...]
    """Some of `CAMERA_DATA_TYPES`; the others are not computed."""
    geom_groups: tuple[int, ...]
    """Groups of the geoms that are seen, ascending."""
    use_textures: bool = True
    """Whether surfaces show the textures of their materials."""
    use_shadows: bool = False
    """Whether a light that something stands before counts 0.3."""


@dataclass
class Images:
    """What a view shows in each of N environments; None where it was not asked for.

    The first row of an image is at its top. The tensors are overwritten by the next rendering.
    """

    rgb: torch.Tensor | None = None
    """(N, height, width, 3) uint8."""
    depth: torch.Tensor | None = None
    """(N, height, width, 1) float32: metres along the optical axis, 0 where there is nothing."""
    segmentation: torch.Tensor | None = None
    """(N, height, width, 2) int32: id and type of the object, -1 and -1 where there is nothing."""

    @classmethod
    def empty(cls, view: CameraView, num_envs: int, device: str | torch.device) -> Images:
        """Allocate images that show nothing."""
        shape = (num_envs, view.height, view.width)
        images = cls()
        if "rgb" in view.data_types:
            images.rgb = torch.zeros(*shape, 3, dtype=torch.uint8, device=device)
        if "depth" in view.data_types:
            images.depth = torch.zeros(*shape, 1, device=device)
        if "segmentation" in view.data_types:
            images.segmentation = torch.full(
                (*shape, 2), BACKGROUND, dtype=torch.int32, device=device
            )
        return images


def rendered_geoms(model: mujoco.MjModel, groups: tuple[int, ...]) -> list[int]:
    """Return the geoms of some groups, ascending.

    MuJoCo counts a group beyond 0 to 5 as the nearest of these.
    """
    return [i for i, group in enumerate(model.geom_group.clip(0, 5)) if group in groups]


def far_limit(model: mujoco.MjModel) -> float:
    """Return the depth in metres beyond which nothing is seen; 0 for no limit."""
    return float(model.vis.map.zfar * model.stat.extent)
