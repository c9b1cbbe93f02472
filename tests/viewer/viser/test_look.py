"""Look of the pages in the browser."""

from __future__ import annotations

import io

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

from mjlab.viewer.viser.look import without_metal


def loaded(glb: bytes) -> trimesh.Trimesh:
    """Return the mesh of a GLB file."""
    (mesh,) = trimesh.load_scene(io.BytesIO(glb), file_type="glb").geometry.values()
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def test_meshes_without_material_become_matte() -> None:
    box = trimesh.creation.box()
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.tile([200, 30, 60, 255], (8, 1)))
    matte = loaded(without_metal(box.export(file_type="glb")))
    assert matte.visual.material.metallicFactor == 0.0
    np.testing.assert_allclose(matte.bounds, box.bounds)


def test_materials_are_kept() -> None:
    box = trimesh.creation.box()
    material = PBRMaterial(metallicFactor=0.25, roughnessFactor=0.5)
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    kept = loaded(without_metal(box.export(file_type="glb")))
    assert kept.visual.material.metallicFactor == 0.25
