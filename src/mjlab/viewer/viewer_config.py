"""Where a viewer's camera stands, and what it draws."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class OriginType(enum.Enum):
    """What the camera looks at."""

    AUTO = 1
    """The first body that can move; the fixed point `lookat` where nothing moves."""
    WORLD = 2
    """The fixed point `lookat`."""
    ASSET_ROOT = 3
    """The root body of `entity_name`, followed as it moves."""
    ASSET_BODY = 4
    """The body `body_name` of `entity_name`, followed as it moves."""


@dataclass(kw_only=True)
class ViewerConfig:
    """Camera, image size and visibility, shared by all viewers."""

    OriginType = OriginType

    origin_type: OriginType = OriginType.AUTO
    """What the camera looks at."""
    height: int = 240
    """Height of offscreen images, in pixels."""
    width: int = 320
    """Width of offscreen images, in pixels."""
    enable_reflections: bool = True
    """Whether shiny surfaces mirror the scene."""
    enable_shadows: bool = True
    """Whether lights cast shadows."""
    geom_group: tuple[int, int, int, int, int, int] = (1, 1, 1, 0, 0, 0)
    """Which of the six geom groups are drawn."""
    site_group: tuple[int, int, int, int, int, int] = (1, 1, 1, 0, 0, 0)
    """Which of the six site groups are drawn."""
    env_idx: int = 0
    """The environment in view; clamped to those that exist."""
    max_extra_envs: int = 2
    """How many neighbouring environments are drawn around it."""
    reward_bar_max_terms: int = 20
    """How many reward terms the browser viewer shows as bars."""
    distance: float = 5.0
    """Distance from the camera to what it looks at, in metres."""
    elevation: float = -45.0
    """Pitch of the view in degrees; negative looks down from above."""
    azimuth: float = 90.0
    """Heading of the view in degrees; 0 looks along +x, 90 along +y."""
    fovy: float | None = None
    """Vertical field of view in degrees; None keeps the viewer's own."""
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World point to look at, where no body is followed."""
    entity_name: str | None = None
    """Entity to follow; may be left out where the scene has exactly one."""
    body_name: str | None = None
    """Body to follow, without the entity's prefix."""
    camera: str | None = None
    """Camera of the model whose view to take instead, by its name in the scene
    (`<entity>/<camera>`); None takes the view that the fields above describe."""
