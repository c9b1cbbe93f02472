"""Editors of an MjSpec: textures, materials, meshes, geoms, collisions, lights and cameras.

Names are matched by regular expressions at their START (see `mjlab.utils.string`). Geoms that
share a name, unnamed ones among them, are matched together.
"""

from mjlab.utils.spec_editors.assets import MaterialCfg, MeshCfg, TextureCfg
from mjlab.utils.spec_editors.base import SpecCfg
from mjlab.utils.spec_editors.geoms import (
    CollisionCfg,
    GeomCfg,
    warn_overlapping_geom_edits,
)
from mjlab.utils.spec_editors.views import CameraCfg, LightCfg

__all__ = [
    "CameraCfg",
    "CollisionCfg",
    "GeomCfg",
    "LightCfg",
    "MaterialCfg",
    "MeshCfg",
    "SpecCfg",
    "TextureCfg",
    "warn_overlapping_geom_edits",
]
