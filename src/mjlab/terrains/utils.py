"""Helpers shared by sub-terrains and the generator."""

from __future__ import annotations

import mujoco

from mjlab.terrains._flat_patches import (
    find_flat_patches_from_heightfield as find_flat_patches_from_heightfield,
)

# MuJoCo refuses geoms without extent.
_MIN_HALF_SIZE = 1e-6


def make_plane(
    body: mujoco.MjsBody,
    size: tuple[float, float],
    height: float,
    center_zero: bool = True,
    plane_thickness: float = 1.0,
) -> list[mujoco.MjsGeom]:
    """Add one box with a flat top to `body` and return it in a list.

    Args:
        body: The body that gets the box.
        size: Extent along x and y, in metres.
        height: Height of the top, in metres.
        center_zero: Whether the box is centred on the body's origin, or starts there and extends
            along +x and +y.
        plane_thickness: Extent of the box below its top, in metres.
    """
    x, y = (0.0, 0.0) if center_zero else (size[0] / 2, size[1] / 2)
    return [
        add_box(body, (x, y, height - plane_thickness / 2), (size[0], size[1], plane_thickness))
    ]


def make_border(
    body: mujoco.MjsBody,
    size: tuple[float, float],
    inner_size: tuple[float, float],
    height: float,
    position: tuple[float, float, float],
) -> list[mujoco.MjsGeom]:
    """Add a rectangular frame of four boxes to `body` and return them: +y, -y, -x, +x.

    The first two span the whole length along x, the others lie between them.

    Args:
        body: The body that gets the boxes.
        size: Outer extent of the frame along x and y, in metres.
        inner_size: Extent of the hole.
        height: Extent of the boxes along z.
        position: Centre of the frame.
    """
    x, y, z = position
    thick_x, thick_y = (size[0] - inner_size[0]) / 2, (size[1] - inner_size[1]) / 2
    off_x, off_y = (inner_size[0] + thick_x) / 2, (inner_size[1] + thick_y) / 2
    along_x = (size[0], thick_y, height)
    along_y = (thick_x, inner_size[1], height)
    return [
        add_box(body, (x, y + off_y, z), along_x),
        add_box(body, (x, y - off_y, z), along_x),
        add_box(body, (x - off_x, y, z), along_y),
        add_box(body, (x + off_x, y, z), along_y),
    ]


def add_box(
    body: mujoco.MjsBody,
    center: tuple[float, float, float],
    extent: tuple[float, float, float],
) -> mujoco.MjsGeom:
    """Add a box to `body`, from its centre and its full extent along x, y and z, in metres."""
    half = [max(length / 2, _MIN_HALF_SIZE) for length in extent]
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=half)
