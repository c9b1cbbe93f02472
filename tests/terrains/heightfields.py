"""Single height fields and their measurement, for tests."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains import (
    HfDiscreteObstaclesTerrainCfg,
    HfPerlinNoiseTerrainCfg,
    HfPyramidSlopedTerrainCfg,
    HfRandomUniformTerrainCfg,
    HfWaveTerrainCfg,
)
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput


@dataclass
class Built:
    """A compiled sub-terrain, which stands alone with its low corner at the origin."""

    model: mujoco.MjModel
    data: mujoco.MjData
    output: TerrainOutput

    @property
    def surface(self) -> np.ndarray:
        """(rows, cols) heights of the vertices as compiled, in the world."""
        shape = (int(self.model.hfield_nrow[0]), int(self.model.hfield_ncol[0]))
        elevation = self.model.hfield_size[0, 2]
        return self.model.hfield_data.reshape(shape) * elevation + self.model.geom_pos[0, 2]

    def vertices(self) -> tuple[np.ndarray, np.ndarray]:
        """x of the columns and y of the rows."""
        rows, cols = self.surface.shape
        size = 2 * self.model.hfield_size[0]
        return np.linspace(0.0, size[0], cols), np.linspace(0.0, size[1], rows)

    def height_at(self, x: float, y: float) -> float:
        """z where a ray from above hits the ground."""
        geom = np.zeros(1, dtype=np.int32)
        start = np.array([x, y, 20.0])
        down = np.array([0.0, 0.0, -1.0])
        distance = mujoco.mj_ray(self.model, self.data, start, down, None, 1, -1, geom, None)
        assert distance >= 0.0, f"nothing under ({x}, {y})"
        return 20.0 - distance


def build(cfg: SubTerrainCfg, difficulty: float = 1.0, seed: int = 0) -> Built:
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="terrain")
    output = cfg.function(difficulty, spec, np.random.default_rng(seed))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Built(model, data, output)


def slope(**fields) -> HfPyramidSlopedTerrainCfg:
    given = {
        "size": (8.0, 8.0),
        "slope_range": (0.0, 0.7),
        "platform_width": 2.0,
        "border_width": 0.25,
    }
    return HfPyramidSlopedTerrainCfg(**(given | fields))


def rough(**fields) -> HfRandomUniformTerrainCfg:
    given = {
        "size": (8.0, 8.0),
        "noise_range": (0.02, 0.10),
        "noise_step": 0.02,
        "border_width": 0.25,
    }
    return HfRandomUniformTerrainCfg(**(given | fields))


def wave(**fields) -> HfWaveTerrainCfg:
    given = {
        "size": (8.0, 8.0),
        "amplitude_range": (0.0, 0.2),
        "num_waves": 4,
        "border_width": 0.25,
    }
    return HfWaveTerrainCfg(**(given | fields))


def obstacles(**fields) -> HfDiscreteObstaclesTerrainCfg:
    given = {
        "size": (8.0, 8.0),
        "obstacle_width_range": (0.3, 1.0),
        "obstacle_height_range": (0.05, 0.3),
        "num_obstacles": 40,
        "border_width": 0.25,
    }
    return HfDiscreteObstaclesTerrainCfg(**(given | fields))


def perlin(**fields) -> HfPerlinNoiseTerrainCfg:
    given = {
        "size": (8.0, 8.0),
        "height_range": (0.0, 1.0),
        "persistence": 0.3,
        "border_width": 0.5,
    }
    return HfPerlinNoiseTerrainCfg(**(given | fields))


ALL = {"slope": slope, "rough": rough, "wave": wave, "obstacles": obstacles, "perlin": perlin}
