"""Check of terrain scans: ray sensors that measure the height of the ground.

A ray stops at the first geom of the sensor's groups. So the ground must be in these groups, and the
robot must not.
"""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from mjlab.sensor.raycast_sensor import RayCastSensor
from mjlab.sim.engine import NUM_GEOM_GROUPS
from mjlab.utils.string import name_list


def check_terrain_scan(sensor: RayCastSensor, mj_model: mujoco.MjModel) -> None:
    """Warn if rays cannot meet the ground or, in the initial pose, meet their own entity.

    Ground: geoms of entities without joints, and of the world. The initial pose is that of the last
    keyframe. Call after `sensor.initialize`. Later calls for the same sensor do nothing.
    """
    if sensor.is_checked_scan:
        return
    sensor.is_checked_scan = True
    m = mj_model
    root = m.body_rootid[m.geom_bodyid]
    is_moving = np.bincount(m.body_rootid, m.body_dofnum, m.nbody)[root] > 0.0
    is_own = np.array([root == m.body_rootid[body] for body in sensor.frame_bodies])
    ground = ~is_moving & ~is_own.any(axis=0)
    visible = _visible_geoms(m, sensor.include_geom_groups)
    owner = f"Ray sensor {sensor.cfg.name!r} include_geom_groups"
    if ground.any() and not (ground & visible).any() and m.nflex == 0:
        groups = tuple(np.unique(m.geom_group[ground]).tolist())
        warnings.warn(
            f"{owner}: expected a group of the ground, got {sensor.include_geom_groups}; no ray can meet "
            f"the ground, in these groups or with alpha 0. Use include_geom_groups={groups}.",
            UserWarning,
            stacklevel=2,
        )
        return
    seen = is_own & visible & is_moving
    if sensor.cfg.exclude_parent_body:
        seen &= m.geom_bodyid != np.array(sensor.frame_bodies)[:, None]
    if not seen.any():
        return
    met = _geoms_met(sensor, m)
    own_hits = (met >= 0) & np.take_along_axis(seen, met, axis=1)
    if own_hits.any():
        geoms = np.unique(met[own_hits])
        names = [m.geom(g).name or f"a geom of {m.body(m.geom_bodyid[g]).name}" for g in geoms]
        grounds = tuple(np.unique(m.geom_group[ground]).tolist())
        cure = f"Set include_geom_groups={grounds}, the groups of the ground"
        if np.isin(m.geom_group[geoms], grounds).any():
            # Viewers hide groups from 3 on.
            free = min({*range(NUM_GEOM_GROUPS)} - {*grounds}, default=NUM_GEOM_GROUPS - 1)
            cure += (
                f", and move the geoms of the robot to another group: EntityCfg.geoms = "
                f"(GeomCfg(geom_names_expr=('.*',), group={free}),)"
            )
        warnings.warn(
            f"{owner}: expected groups without geoms of the robot below the sensor, got "
            f"{sensor.include_geom_groups}; {own_hits.sum()} of {own_hits.size} rays meet the robot in "
            f"its initial pose, at {name_list(list(dict.fromkeys(names)), near=[])}. {cure}.",
            UserWarning,
            stacklevel=2,
        )


def _visible_geoms(m: mujoco.MjModel, groups: tuple[int, ...] | None) -> np.ndarray:
    """Return the geoms that rays of these groups can meet, (ngeom,) bool."""
    has_material = m.geom_matid >= 0
    alpha = m.geom_rgba[:, 3].copy()
    alpha[has_material] = m.mat_rgba[m.geom_matid[has_material], 3]
    is_included = np.isin(
        m.geom_group.clip(0, NUM_GEOM_GROUPS - 1),
        range(NUM_GEOM_GROUPS) if groups is None else groups,
    )
    return is_included & (alpha > 0.0)


def _geoms_met(sensor: RayCastSensor, m: mujoco.MjModel) -> np.ndarray:
    """Return the moving geom that each ray meets in the initial pose, (F, n). -1: none.

    Static geoms are left out, because a robot whose initial height is 0 stands in the ground.
    """
    d = mujoco.MjData(m)
    if m.nkey:
        mujoco.mj_resetDataKeyframe(m, d, m.nkey - 1)
    mujoco.mj_kinematics(m, d)
    groups = sensor.include_geom_groups
    mask = np.isin(range(NUM_GEOM_GROUPS), range(NUM_GEOM_GROUPS) if groups is None else groups)
    origins, directions = sensor.rays_in_pose(d)
    bodies = np.reshape(sensor.excluded_bodies, origins.shape[:2])
    met = np.full(origins.shape[:2], -1)
    for ray in np.ndindex(met.shape):
        geom = np.zeros(1, dtype=np.int32)
        reach = mujoco.mj_ray(
            m, d, origins[ray], directions[ray], mask.astype(np.uint8), False, bodies[ray], geom
        )
        met[ray] = geom[0] if 0.0 <= reach <= sensor.cfg.max_distance else -1
    return met
