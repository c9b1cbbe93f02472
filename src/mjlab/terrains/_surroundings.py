"""What surrounds the grid of sub-terrains: the frame, the light, and names for all geoms."""

from __future__ import annotations

import mujoco
import numpy as np

from mjlab.terrains.utils import make_border

_DARK_GREY = (0.2, 0.2, 0.2)


def add_border(
    body: mujoco.MjsBody,
    extent: tuple[float, float],
    width: float,
    height: float,
    color: np.ndarray | None,
) -> None:
    """Add a frame around the grid.

    Args:
        body: The body of the terrain.
        extent: Extent of the grid along x and y, in metres; it is centred on the origin.
        width: Width of the frame, in metres.
        height: Thickness of the frame below z = 0, or, negative, height of a wall above it.
        color: (3,) red, green and blue; None is a dark grey.
    """
    outer = (extent[0] + 2.0 * width, extent[1] + 2.0 * width)
    for geom in make_border(body, outer, extent, abs(height), (0.0, 0.0, -height / 2)):
        geom.rgba = (*(_DARK_GREY if color is None else color), 1.0)


def add_light(body: mujoco.MjsBody, extent: tuple[float, float]) -> None:
    """Add a light that shines straight down on the grid, from a height that suits its extent."""
    body.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0.0, 0.0, 0.6 * max(extent)),
        dir=(0.0, 0.0, -1.0),
    )


def finish_geoms(body: mujoco.MjsBody) -> None:
    """Name the geoms that have no name `terrain_<k>`, k counting all, and make all weightless.

    The ground's mass would be most of the model's, whose mean mass scales what viewers draw.
    """
    for index, geom in enumerate(body.geoms):
        geom.mass = 0.0
        if not geom.name:
            geom.name = f"terrain_{index}"
