"""Mesh conversions of releases 1.1 and 1.2, now done by mjviser."""

from __future__ import annotations

import mujoco
import numpy as np
import trimesh
from mjviser import conversions

from mjlab.compat import older_names


def merge_geoms_global(
    mj_model: mujoco.MjModel, mj_data: mujoco.MjData, geom_ids: list[int]
) -> trimesh.Trimesh:
    """Return one mesh of the geoms in the world frame, at the body poses of `mj_data`."""
    merged: list[trimesh.Trimesh] = []
    for geom_id in geom_ids:
        body_id = mj_model.geom_bodyid[geom_id]
        pose = np.eye(4)
        pose[:3, :3] = mj_data.xmat[body_id].reshape(3, 3)
        pose[:3, 3] = mj_data.xpos[body_id]
        merged.append(conversions.merge_geoms(mj_model, [geom_id]).apply_transform(pose))
    mesh = trimesh.util.concatenate(merged)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def mujoco_mesh_to_trimesh(
    mj_model: mujoco.MjModel, geom_idx: int, verbose: bool = False
) -> trimesh.Trimesh:
    """Return the mesh of a mesh geom, in the geom's frame; `verbose` has no effect."""
    return conversions.mujoco_mesh_to_trimesh(mj_model, geom_idx)


__getattr__ = older_names(__name__)
