"""Viewer configuration: camera, image size and visibility."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class OriginType(enum.Enum):
    """Camera target."""

    AUTO = 1
    """First body that can move; the fixed point `lookat` if all bodies are fixed."""
    WORLD = 2
    """Fixed point `lookat`."""
    ASSET_ROOT = 3
    """Root body of `entity_name`; the camera follows it."""
    ASSET_BODY = 4
    """Body `body_name` of `entity_name`; the camera follows it."""


@dataclass(kw_only=True)
class ViewerConfig:
    """Camera, image size and visibility, shared by all viewers."""

    OriginType = OriginType

    origin_type: OriginType = OriginType.AUTO
    """Camera target."""
    height: int = 240
    """Height of offscreen images (pixels)."""
    width: int = 320
    """Width of offscreen images (pixels)."""
    enable_reflections: bool = True
    """Render reflections."""
    enable_shadows: bool = True
    """Render shadows."""
    geom_group: tuple[int, int, int, int, int, int] = (1, 1, 1, 0, 0, 0)
    """Visibility of the six geom groups."""
    site_group: tuple[int, int, int, int, int, int] = (1, 1, 1, 0, 0, 0)
    """Visibility of the six site groups."""
    env_idx: int = 0
    """Environment in view, clamped to [0, num_envs - 1]."""
    max_extra_envs: int = 2
    """Number of neighboring environments to draw."""
    reward_bar_max_terms: int = 20
    """Number of reward terms shown as bars in the browser viewer."""
    distance: float = 5.0
    """Distance from the camera to its target (m)."""
    elevation: float = -45.0
    """Elevation of the view (degrees). Negative: looking down."""
    azimuth: float = 90.0
    """Azimuth of the view (degrees). 0 looks along +x, 90 along +y."""
    fovy: float | None = None
    """Vertical field of view (degrees). None: the viewer's default."""
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World point to look at if the camera follows no body."""
    entity_name: str | None = None
    """Entity to follow. Optional if the scene has exactly one."""
    body_name: str | None = None
    """Body to follow, without the entity's prefix."""
    camera: str | None = None
    """Model camera to use instead of the fields above, by its name in the scene
    (`<entity>/<camera>`). None: use the fields above."""
