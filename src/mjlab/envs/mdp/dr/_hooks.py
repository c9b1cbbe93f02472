"""Checks before, and consequences after, the write of particular model fields."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import mujoco
import torch

from mjlab.envs.mdp.dr._core import keep_absent, model_field

if TYPE_CHECKING:
    from mjlab.envs.mdp.dr._core import Selection

_PRIMITIVES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}


def warn_mass_without_inertia(selection: Selection) -> None:
    """Warn that a body whose mass changes keeps its inertia."""
    warnings.warn(
        "dr.body_mass changes masses and leaves inertias as they are. "
        "Use dr.pseudo_inertia with alpha_range to scale both consistently.",
        UserWarning,
        stacklevel=4,
    )


def require_primitive_geoms(selection: Selection) -> None:
    """Raise `ValueError` if a selected geom has no size that could be randomized."""
    types = selection.env.sim.mj_model.geom_type
    refused = {
        name: mujoco.mjtGeom(int(types[geom])).name.removeprefix("mjGEOM_").lower()
        for name, geom in zip(selection.names, selection.columns.tolist(), strict=True)
        if int(types[geom]) not in _PRIMITIVES
    }
    if refused:
        raise ValueError(
            f"geom_size: these geoms are no primitives: {refused}. Select only geoms of type "
            f"{', '.join(_PRIMITIVES.values())} (geom_names of the SceneEntityCfg)."
        )


def require_fovy_cameras(selection: Selection) -> None:
    """Raise `ValueError` if a selected camera has a sensor, because of which fovy is not read."""
    model = selection.env.sim.mj_model
    # Parallel rays have no focal length: there fovy is the height of the image.
    refused = [
        name
        for name, camera in zip(selection.names, selection.columns.tolist(), strict=True)
        if model.cam_sensorsize[camera, 1] > 0.0
        and model.cam_projection[camera] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    ]
    if refused:
        raise ValueError(
            f"cam_fovy: these cameras have a focal length and a sensor size, so that their field "
            f"of view is not read: {refused}. Use dr.cam_intrinsic for them, or select others "
            "(camera_names of the SceneEntityCfg)."
        )


def refresh_geom_bounds(selection: Selection) -> None:
    """Recompute bounding sphere radius and box of the selected geoms from their sizes."""
    env = selection.env
    sizes, radii = model_field(env, "geom_size"), model_field(env, "geom_rbound")
    boxes = model_field(env, "geom_aabb")
    types = torch.as_tensor(env.sim.mj_model.geom_type, device=env.device)[selection.columns]
    new_radii, new_boxes = radii[selection.index], boxes[selection.index]
    for kind in types.unique().tolist():
        index = selection.rows[:, None], selection.columns[types == kind][None, :]
        radius, half = _bounds(kind, sizes[index])
        new_radii[:, types == kind] = radius
        # The box is (centre, half sizes); the centre of a primitive does not move.
        new_boxes[:, types == kind, 1] = half
    radii[selection.index] = keep_absent(selection, new_radii, radii)
    boxes[selection.index] = keep_absent(selection, new_boxes, boxes)


def _bounds(kind: int, size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the bounding radius (...) and half sizes (..., 3) of primitives of one type."""
    a, b, c = size.unbind(-1)
    shape = _PRIMITIVES[kind]
    if shape == "sphere":
        return a, torch.stack((a, a, a), dim=-1)
    if shape == "capsule":
        return a + b, torch.stack((a, a, a + b), dim=-1)
    if shape == "cylinder":
        return torch.sqrt(a * a + b * b), torch.stack((a, a, b), dim=-1)
    radius = size.amax(dim=-1) if shape == "ellipsoid" else size.norm(dim=-1)
    return radius, torch.stack((a, b, c), dim=-1)


def refresh_entity_limits(selection: Selection) -> None:
    """Carry changed joint ranges over to the entity's hard and soft limits.

    Joints that the model does not limit keep their infinite limits.
    """
    env, entity = selection.env, selection.entity
    limited = torch.as_tensor(env.sim.mj_model.jnt_limited, device=env.device).bool()
    chosen = limited[selection.columns]
    columns, joints = selection.columns[chosen], selection.local_ids[chosen]
    rows = selection.rows[:, None]
    limits = model_field(env, "jnt_range")[rows, columns[None, :]]
    articulation = entity.cfg.articulation
    factor = 1.0 if articulation is None else articulation.soft_joint_pos_limit_factor
    middle = limits.mean(dim=-1, keepdim=True)
    entity.data.joint_pos_limits[rows, joints[None, :]] = limits
    entity.data.soft_joint_pos_limits[rows, joints[None, :]] = middle + factor * (limits - middle)


def normalize_ball_joints(selection: Selection) -> None:
    """Bring the reference quaternions of selected ball joints back to length 1."""
    env, model = selection.env, selection.env.sim.mj_model
    qpos0 = model_field(env, "qpos0")
    joints = selection.entity.data.indexing.joint_ids[selection.local_ids].tolist()
    for joint in joints:
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            address = int(model.jnt_qposadr[joint])
            index = selection.rows[:, None], torch.arange(address, address + 4, device=env.device)
            quat = qpos0[index]
            qpos0[index] = quat / quat.norm(dim=-1, keepdim=True)
