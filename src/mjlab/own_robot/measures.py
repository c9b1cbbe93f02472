"""Quantities of a model to check: torques, sags, inertias and extents of links, the ground below."""

from __future__ import annotations

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.gains import rail_model, settle, static_torques
from mjlab.own_robot.posture import find_posture, ground_height
from mjlab.own_robot.subject import Subject

# Stiffness and effort limit of joints without gains (N m/rad, N m), and 1 / s.
_HELD, _STIFFNESS_OVER_DAMPING = 1e3, 15.0
# Half the size of a marker (m): virtual links of two-axis joints have one.
_MARKER = 2e-3
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


def by_joint(subject: Subject, values: np.ndarray) -> dict[str, float]:
    """Return the values of degrees of freedom, (nv,), by joint."""
    model = subject.model
    return {
        name: float(values[model.jnt_dofadr[model.joint(name).id]]) for name in subject.joint_pos
    }


def has_gravity(subject: Subject) -> bool:
    option = subject.model.opt
    is_off = option.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    return not is_off and option.gravity[2] < 0.0


def is_hinge(model: mujoco.MjModel, joint: str) -> bool:
    return int(model.joint(joint).type[0]) == geo.HINGE


def sags(subject: Subject) -> dict[str, float]:
    """Return the deflection of hinges with gains under the robot's weight (rad), of legs if it has some.

    Legs in simulation, with the trunk kept level. Arms: torque less dry friction, over stiffness.
    """
    model, anatomy = subject.model, subject.anatomy
    if anatomy.kind.value != "legged":
        torques, friction = holding_torques(subject), by_joint(subject, model.dof_frictionloss)
        return {
            name: max(abs(torques[name]) - friction[name], 0.0) / kp
            for name, kp in subject.stiffness.items()
            if kp > 0.0 and is_hinge(model, name)
        }
    if not all(subject.stiffness.get(name, 0.0) > 0.0 for name in anatomy.leg_joints):
        return {}
    joint_pos = standing_pose(subject)
    # Joints without gains are held.
    stiffness = {name: subject.stiffness.get(name, _HELD) for name in joint_pos}
    effort = {name: subject.effort.get(name, _HELD) for name in joint_pos}
    armature = by_joint(subject, model.dof_armature)
    found = settle(
        rail_model(subject.spec, model, anatomy, effort, armature),
        joint_pos,
        ground_height(model, mujoco.MjData(model), anatomy, joint_pos),
        stiffness,
        {name: kp / _STIFFNESS_OVER_DAMPING for name, kp in stiffness.items()},
    )
    return {name: found[name] for name in anatomy.leg_joints}


def standing_pose(subject: Subject) -> dict[str, float]:
    """Return the initial joint positions; those of a standing pose if the file has none."""
    if subject.anatomy.kind.value == "legged" and subject.pose == "qpos0":
        return find_posture(subject.model, subject.anatomy).joint_pos.value
    return subject.joint_pos


def holding_torques(subject: Subject) -> dict[str, float]:
    """Return the torque that holds each joint still (N m, N)."""
    joint_pos = standing_pose(subject)
    torques = static_torques(subject.model, subject.anatomy, joint_pos)
    # Bodies with `gravcomp` carry themselves.
    carried = by_joint(subject, subject.data.qfrc_gravcomp)
    return {name: torque - carried[name] for name, torque in torques.items()}


def link_inertia(subject: Subject, link: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass (kg), center of mass, (3,), and inertia about it, (3, 3), of a link in the world."""
    model, data = subject.model, subject.data
    own = np.flatnonzero(model.body_weldid == link)
    mass = float(model.body_mass[own].sum())
    inertia = np.zeros((3, 3))
    if mass == 0.0:
        return mass, data.xpos[link].copy(), inertia
    center = model.body_mass[own] @ data.xipos[own] / mass
    for body in own:
        rotation, offset = data.ximat[body].reshape(3, 3), data.xipos[body] - center
        inertia += rotation @ np.diag(model.body_inertia[body]) @ rotation.T
        inertia += model.body_mass[body] * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return mass, center, inertia


def extent(subject: Subject, link: int) -> tuple[np.ndarray, float]:
    """Return where a link reaches in the world, (P, 3), and the volume of its geoms' boxes (m^3).

    Points are the corners of the boxes, and the links that hang on it. Geoms of millimeters
    are markers; of a link with these only, both are empty.
    """
    model, data = subject.model, subject.data
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    corners, volume = [], 0.0
    for g in np.flatnonzero(model.body_weldid[model.geom_bodyid] == link):
        center, half = model.geom_aabb[g, :3], model.geom_aabb[g, 3:]
        if half.max() <= _MARKER:
            continue
        local = center + signs * half
        corners.append(data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T)
        volume += float(np.prod(2.0 * half))
    if not corners:
        return np.zeros((0, 3)), 0.0
    below = [b for b in geo.links(model) if geo.parent_link(model, b) == link]
    return np.concatenate([*corners, data.xpos[below]]), volume


def own_geoms(subject: Subject) -> list[int]:
    """Return the geoms in the tree of the free joint that collide, by themselves or in pairs."""
    model, free = subject.model, geo.free_joint(subject.model)
    root = -1 if free is None else int(model.jnt_bodyid[free])
    paired = {*model.pair_geom1[: model.npair], *model.pair_geom2[: model.npair]}
    return [
        g
        for g in np.flatnonzero(model.body_rootid[model.geom_bodyid] == root).tolist()
        if model.geom_contype[g] or model.geom_conaffinity[g] or g in paired
    ]


def level_of_ground(subject: Subject) -> float:
    """Return the height of the highest level static plane; 0 without one."""
    model, data = subject.model, subject.data
    static = (model.geom_type == _PLANE) & (model.body_weldid[model.geom_bodyid] == 0)
    # Others are walls.
    ground = static & (data.geom_xmat[:, 8] > 0.99)
    return float(data.geom_xpos[ground, 2].max()) if ground.any() else 0.0


def has_steps(subject: Subject) -> bool:
    """Return True if static geoms other than planes may carry the robot."""
    model = subject.model
    static = (model.geom_type != _PLANE) & (model.body_weldid[model.geom_bodyid] == 0)
    return bool((static & ((model.geom_contype > 0) | (model.geom_conaffinity > 0))).any())
