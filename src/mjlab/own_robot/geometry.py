"""Links, chains of joints, and extents of geoms of a compiled model.

A link is a body with all bodies welded to it, named by its top body (`MjModel.body_weldid`).
"""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)

_GEOM = mujoco.mjtGeom


def links(model: mujoco.MjModel) -> list[int]:
    """Return the moving links, parents first."""
    return [body for body in range(1, model.nbody) if model.body_weldid[body] == body]


def parent_link(model: mujoco.MjModel, link: int) -> int:
    """Return the link that `link` moves against; 0 for the world."""
    return int(model.body_weldid[model.body_parentid[link]])


def leaf_links(model: mujoco.MjModel) -> list[int]:
    """Return the links that no other link hangs on."""
    parents = {parent_link(model, link) for link in links(model)}
    return [link for link in links(model) if link not in parents]


def link_joints(model: mujoco.MjModel, link: int) -> list[int]:
    """Return the joints of a link."""
    first = int(model.body_jntadr[link])
    return list(range(first, first + int(model.body_jntnum[link]))) if first >= 0 else []


def chain(model: mujoco.MjModel, link: int, root: int = 0) -> list[int]:
    """Return the links from below `root` to `link`; to the top where `root` is no ancestor."""
    found = []
    while link not in (0, root):
        found.append(link)
        link = parent_link(model, link)
    return found[::-1]


def chain_joints(model: mujoco.MjModel, link: int, root: int = 0) -> list[int]:
    """Return the hinges and slides from below `root` to `link`."""
    return [
        joint
        for member in chain(model, link, root)
        for joint in link_joints(model, member)
        if model.jnt_type[joint] in (HINGE, SLIDE)
    ]


def joint_ids(model: mujoco.MjModel) -> list[int]:
    """Return the hinges and slides."""
    return [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]


def free_joint(model: mujoco.MjModel) -> int | None:
    """Return the free joint of the heaviest tree with other joints; None without one, as for objects."""
    roots = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in joint_ids(model)}
    found = [
        j
        for j in range(model.njnt)
        if model.jnt_type[j] == FREE and int(model.body_rootid[model.jnt_bodyid[j]]) in roots
    ]
    return max(found, key=lambda j: model.body_subtreemass[model.jnt_bodyid[j]], default=None)


def colliding_geoms(model: mujoco.MjModel) -> list[int]:
    """Return the geoms of the robot that collide.

    These are the geoms with contype or conaffinity. If no geom has them, those of contact pairs; if there
    are no pairs, those of the highest group, where files keep the geoms that a scene lets collide. A robot
    with a free joint has the geoms of its tree; one with a fixed base, those of all bodies.
    """
    free = free_joint(model)
    root = 0 if free is None else model.body_rootid[model.jnt_bodyid[free]]
    bodies = {b for b in range(1, model.nbody) if root in (0, model.body_rootid[b])}
    moving = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
    by_itself = [g for g in moving if model.geom_contype[g] or model.geom_conaffinity[g]]
    paired = set(model.pair_geom1[: model.npair]) | set(model.pair_geom2[: model.npair])
    in_pairs = [g for g in moving if g in paired]
    highest = max((int(model.geom_group[g]) for g in moving), default=0)
    return by_itself or in_pairs or [g for g in moving if model.geom_group[g] == highest]


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Return the lowest point of a geom in the world, (3,); of a level face, its middle."""
    return support_point(model, data, geom, np.array([0.0, 0.0, -1.0]))


def support_point(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, direction: np.ndarray
) -> np.ndarray:
    """Return the point of a geom farthest along a unit vector of the world, (3,)."""
    rotation = data.geom_xmat[geom].reshape(3, 3)
    toward = rotation.T @ direction
    size, kind = model.geom_size[geom], int(model.geom_type[geom])
    sign = np.where(np.abs(toward) < 1e-3, 0.0, np.sign(toward))
    if kind == _GEOM.mjGEOM_MESH:
        vertices = mesh_vertices(model, geom)
        reach = vertices @ toward
        local = vertices[reach > reach.max() - 1e-4].mean(axis=0)
    elif kind == _GEOM.mjGEOM_SPHERE:
        local = size[0] * toward
    elif kind == _GEOM.mjGEOM_CAPSULE:
        local = size[0] * toward + np.array([0.0, 0.0, size[1] * sign[2]])
    elif kind == _GEOM.mjGEOM_ELLIPSOID:
        local = size**2 * toward / np.linalg.norm(size * toward)
    elif kind == _GEOM.mjGEOM_CYLINDER:
        radial = np.array([toward[0], toward[1], 0.0])
        length = np.linalg.norm(radial)
        radial = size[0] * radial / length if length > 1e-3 else 0.0 * radial
        local = radial + np.array([0.0, 0.0, size[1] * sign[2]])
    elif kind == _GEOM.mjGEOM_BOX:
        local = size * sign
    else:
        local = np.zeros(3)
    return data.geom_xpos[geom] + rotation @ local


def mesh_vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the vertices of the mesh of a geom, (V, 3), in the geom's frame."""
    mesh = int(model.geom_dataid[geom])
    start = int(model.mesh_vertadr[mesh])
    return model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])]


def ground_points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Return the lowest point of a geom, and those when the ground tilts by 0.2 to each side, (5, 3)."""
    directions = np.array(
        [(0, 0, -1), (0.2, 0.2, -1), (0.2, -0.2, -1), (-0.2, 0.2, -1), (-0.2, -0.2, -1)]
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.array([support_point(model, data, geom, direction) for direction in directions])


def lowest_height(model: mujoco.MjModel, data: mujoco.MjData, geoms: Iterable[int]) -> float:
    """Return the height of the lowest point of geoms; infinity without geoms."""
    return min((float(lowest_point(model, data, g)[2]) for g in geoms), default=float("inf"))


def set_pose(
    model: mujoco.MjModel, data: mujoco.MjData, joint_pos: dict[str, float], height: float = 0.0
) -> None:
    """Put the trunk level at a height, joints at `joint_pos` (others at `qpos0`), and compute positions."""
    data.qpos[:] = model.qpos0
    data.qvel[:] = 0.0
    free = free_joint(model)
    if free is not None:
        start = model.jnt_qposadr[free]
        data.qpos[start : start + 7] = (0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0)
    data.qpos[qpos_addresses(model, joint_pos)] = list(joint_pos.values())
    update(model, data)


def qpos_addresses(model: mujoco.MjModel, joints: Iterable[str]) -> list[int]:
    """Return the index in `qpos` of each hinge or slide."""
    return [int(model.jnt_qposadr[model.joint(name).id]) for name in joints]


def update(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Compute poses, centers of mass and lengths of tendons from `qpos`."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)


def tendon_excess(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the lengths of tendons beyond their ranges, (T,), from the pose of `data`."""
    low, high = model.tendon_range.T
    beyond = np.maximum(low - data.ten_length, data.ten_length - high)
    return np.where(model.tendon_limited, np.maximum(beyond, 0.0), 0.0)


def joint_range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Return the range of a joint (rad, m); of an unlimited one, a turn or a meter around `qpos0`."""
    if model.jnt_limited[joint]:
        low, high = model.jnt_range[joint]
        return float(low), float(high)
    middle = float(model.qpos0[model.jnt_qposadr[joint]])
    half = np.pi if model.jnt_type[joint] == HINGE else 1.0
    return middle - half, middle + half
