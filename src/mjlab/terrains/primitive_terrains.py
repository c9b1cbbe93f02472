"""Sub-terrains made of boxes (and of convex columns)."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains._box_grids import BoxRandomGridTerrainCfg as BoxRandomGridTerrainCfg
from mjlab.terrains._box_grids import BoxTiltedGridTerrainCfg as BoxTiltedGridTerrainCfg
from mjlab.terrains._box_obstacles import BoxRandomSpreadTerrainCfg as BoxRandomSpreadTerrainCfg
from mjlab.terrains._boxes import Boxes
from mjlab.terrains._over_pit import BoxNarrowBeamsTerrainCfg as BoxNarrowBeamsTerrainCfg
from mjlab.terrains._over_pit import BoxNestedRingsTerrainCfg as BoxNestedRingsTerrainCfg
from mjlab.terrains._over_pit import BoxSteppingStonesTerrainCfg as BoxSteppingStonesTerrainCfg
from mjlab.terrains._stairs import (
    BoxInvertedPyramidStairsTerrainCfg as BoxInvertedPyramidStairsTerrainCfg,
)
from mjlab.terrains._stairs import BoxOpenStairsTerrainCfg as BoxOpenStairsTerrainCfg
from mjlab.terrains._stairs import BoxPyramidStairsTerrainCfg as BoxPyramidStairsTerrainCfg
from mjlab.terrains._stairs import BoxRandomStairsTerrainCfg as BoxRandomStairsTerrainCfg
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput


@dataclass(kw_only=True)
class BoxFlatTerrainCfg(SubTerrainCfg):
    """Flat ground at z = 0, at every difficulty."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        boxes.add_platform(self.size, 0.0, (0.5, 0.5, 0.5, 1.0), bottom=-1.0)
        return boxes.output(0.0)
