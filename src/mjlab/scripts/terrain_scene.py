"""A terrain to look at: rows of rising difficulty, and a robot at the start of each cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from mjlab.scripts.terrain_knobs import RobotName

if TYPE_CHECKING:
    from mjlab.entity import EntityCfg
    from mjlab.terrains import SubTerrainCfg


@dataclass(frozen=True)
class TerrainScene:
    """A compiled terrain with one robot, and where to draw the robot."""

    model: mujoco.MjModel
    """The terrain, and the robot if there is one."""
    origins: np.ndarray
    """(levels, kinds, 3) spawn points."""
    num_polygons: int
    """Triangles of the terrain's surface."""

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, nbody, 3) positions and (n, nbody, 3, 3) rotations, one for each origin."""
        data = mujoco.MjData(self.model)
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, data, 0)
        mujoco.mj_kinematics(self.model, data)
        origins = self.origins.reshape(-1, 3)
        positions = np.repeat(data.xpos[None], len(origins), axis=0)
        # The world and the terrain stay where they are.
        moving = self.model.body_weldid > 0
        positions[:, moving] += origins[:, None]
        return positions, np.repeat(data.xmat.reshape(1, -1, 3, 3), len(origins), axis=0)


def build_terrain_scene(
    kinds: dict[str, SubTerrainCfg], size: float, num_levels: int, seed: int, robot: RobotName
) -> TerrainScene:
    """Build a grid with one column for each kind and rows of rising difficulty.

    Args:
        kinds: Sub-terrains by name.
        size: Extent of each cell, in metres.
        num_levels: Number of rows.
        seed: Seed of the terrain.
        robot: Robot to place.

    Raises:
        ValueError: the terrain cannot be built.
    """
    from mjlab.scene import Scene, SceneCfg
    from mjlab.terrains import TerrainEntityCfg, TerrainGeneratorCfg

    generator = TerrainGeneratorCfg(
        seed=seed,
        curriculum=True,
        size=(size, size),
        num_rows=num_levels,
        border_width=1.0,
        sub_terrains=kinds,
        add_lights=True,
    )
    terrain = TerrainEntityCfg(terrain_type="generator", terrain_generator=generator)
    entities = {} if robot == "none" else {"robot": _robot_cfg(robot)}
    scene = Scene(SceneCfg(terrain=terrain, entities=entities), "cpu")
    model = scene.compile()
    return TerrainScene(model, scene["terrain"].terrain_origins.numpy(), count_polygons(model))


def _robot_cfg(robot: RobotName) -> EntityCfg:
    from mjlab.asset_zoo import robots

    return robots.get_go1_robot_cfg() if robot == "unitree_go1" else robots.get_g1_robot_cfg()


def count_polygons(model: mujoco.MjModel) -> int:
    """Return the number of triangles of the geoms of the body `terrain`."""
    total = 0
    for geom in np.flatnonzero(model.geom_bodyid == model.body("terrain").id):
        kind, shape = model.geom_type[geom], model.geom_dataid[geom]
        if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
            total += 2 * int((model.hfield_nrow[shape] - 1) * (model.hfield_ncol[shape] - 1))
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            total += int(model.mesh_facenum[shape])
        else:
            # A box.
            total += 12
    return total
