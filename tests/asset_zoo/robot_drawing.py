"""Comparison of a robot's drawn size with the extents in the table of its parameters."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from robot_figures import VISUAL_GROUP


def drawing_differences(
    spec: mujoco.MjSpec, table: dict[str, Any], beyond: float = 0.03, share: float = 0.4
) -> list[str]:
    """Return, one line each, bodies that are not drawn about as large as the table says.

    The box around what is drawn, in the frame of the body, must not reach more than `beyond`
    meters out of the box around the table's extents, and be at least `share` as long along each
    axis. The table's extents are rough: they are boxes around tilted boxes, and some are mirrored.
    """
    model = spec.compile()
    found = []
    for body in table["bodies"]:
        extents = body.get("visual_extent", [])
        index = model.body(body["name"]).id
        drawn = (model.geom_bodyid == index) & (model.geom_group == VISUAL_GROUP)
        if bool(extents) != bool(drawn.any()):
            found.append(f"{body['name']}: drawn {drawn.any()}, in the table {bool(extents)}")
        if not extents or not drawn.any():
            continue
        centers = np.array([extent["bounding_box_center"] for extent in extents])
        halves = np.array([extent["bounding_box_half_size"] for extent in extents])
        low, high = (centers - halves).min(axis=0), (centers + halves).max(axis=0)
        boxes = [_box_in_body(model, geom) for geom in np.flatnonzero(drawn)]
        lowest = np.min([box[0] for box in boxes], axis=0)
        highest = np.max([box[1] for box in boxes], axis=0)
        outside = np.any(lowest < low - beyond) or np.any(highest > high + beyond)
        if outside or np.any(highest - lowest < share * (high - low)):
            found.append(
                f"{body['name']}: drawn from {lowest.round(4)} to {highest.round(4)}, "
                f"in the table from {low.round(4)} to {high.round(4)}"
            )
    return found


def _box_in_body(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corner of the box around a geom, in its body's frame."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    rotation = rotation.reshape(3, 3)
    size = model.geom_size[geom]
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        half = np.full(3, size[0])
    elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        half = np.sqrt((rotation**2) @ size**2)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        half = size[0] + size[1] * np.abs(rotation[:, 2])
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        axis = rotation[:, 2]
        half = size[1] * np.abs(axis) + size[0] * np.sqrt(np.maximum(1 - axis**2, 0))
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        half = np.abs(rotation) @ size
    else:
        raise ValueError(f"{kind.name} is not a primitive shape; robots are drawn with those.")
    return model.geom_pos[geom] - half, model.geom_pos[geom] + half
