"""Single sub-terrains, and ground heights measured by rays from above, for tests."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains import SubTerrainCfg
from mjlab.terrains.terrain_generator import TerrainOutput

SIZE = (8.0, 8.0)


@dataclass
class Ground:
    """A compiled terrain; of one sub-terrain, the corner of lowest x and y is at the origin."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    data: mujoco.MjData
    output: TerrainOutput | None = None

    @property
    def origin(self) -> np.ndarray:
        assert self.output is not None
        return self.output.origin

    def height(self, x: float, y: float) -> float:
        """Height of what a ray from above hits first; minus infinity if that is nothing."""
        geom, start = np.zeros(1, dtype=np.int32), np.array([x, y, 20.0])
        down = np.array([0.0, 0.0, -1.0])
        distance = mujoco.mj_ray(self.model, self.data, start, down, None, 1, -1, geom, None)
        return 20.0 - distance if distance >= 0.0 else -np.inf

    def heights(self, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
        return np.array([[self.height(x, y) for y in ys] for x in xs])

    def corners(self, geom: int) -> np.ndarray:
        """(n, 3) points in the world whose convex hull holds the geom."""
        if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = self.model.geom_dataid[geom]
            first, count = self.model.mesh_vertadr[mesh], self.model.mesh_vertnum[mesh]
            points = self.model.mesh_vert[first : first + count]
        else:
            center, half = self.model.geom_aabb[geom][:3], self.model.geom_aabb[geom][3:]
            signs = np.array(np.meshgrid(*([[-1, 1]] * 3))).reshape(3, -1).T
            points = center + signs * half
        rotation = self.data.geom_xmat[geom].reshape(3, 3)
        return self.data.geom_xpos[geom] + points @ rotation.T

    def all_corners(self) -> np.ndarray:
        return np.concatenate([self.corners(geom) for geom in range(self.model.ngeom)])


def compiled(spec: mujoco.MjSpec, output: TerrainOutput | None = None) -> Ground:
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Ground(spec, model, data, output)


def ground(cfg: SubTerrainCfg, difficulty: float = 1.0, seed: int = 0) -> Ground:
    """Build a sub-terrain in its own frame, 8 x 8 m unless the config says otherwise."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="terrain")
    output = cfg.function(difficulty, spec, np.random.default_rng(seed))
    return compiled(spec, output)
