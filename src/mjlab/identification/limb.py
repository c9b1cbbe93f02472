"""Limbs of a robot that hangs by its base: joints that move each other, simulated apart from the rest."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from mjlab.utils.errors import UserError, check_exists

TIMESTEP = 0.002
"""Longest physics timestep (s), of the Runge-Kutta method. First-order methods would add half a
timestep times the damping to the armature: 6 % at 0.001 s, and cost as much."""
_PASSIVE = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_SENSOR


def split_into_limbs(
    spec: mujoco.MjSpec, joints: Sequence[str], groups: Sequence[Sequence[str]]
) -> list[tuple[str, ...]]:
    """Return the logged joints in sets that can be fitted apart from each other.

    Joints of one kinematic tree move each other, as soon as the base is fixed; joints of one group
    share their parameters.

    Args:
        spec: Robot; its base is fixed by `hang`.
        joints: Joints of the log.
        groups: Joints that share parameters.

    Raises:
        UserError: the robot has no such joint.
    """
    model = spec.compile()
    names = {model.joint(j).name for j in range(model.njnt)}
    for joint in joints:
        check_exists("joint of the log", joint, sorted(names), UserError)
    limb_of = {name: int(model.dof_treeid[model.joint(name).dofadr[0]]) for name in joints}
    for group in groups:
        merged = {limb_of[name] for name in group}
        limb_of |= {name: min(merged) for name, limb in limb_of.items() if limb in merged}
    return [
        tuple(name for name in joints if limb_of[name] == limb)
        for limb in sorted(set(limb_of.values()))
    ]


def hang(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a copy of a robot's spec that hangs by its base, without actuators and geoms.

    Links keep their masses. Contacts are off: the limbs of a hanging robot touch nothing.
    """
    spec = spec.copy()
    model = spec.compile()
    for joint in list(spec.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    for body in spec.bodies[1:]:
        body.mass, body.ipos = float(model.body_mass[body.id]), model.body_ipos[body.id]
        body.inertia, body.iquat = model.body_inertia[body.id], model.body_iquat[body.id]
        body.explicitinertial = True
    kinds = (spec.actuators, spec.sensors, spec.keys, spec.excludes, spec.pairs, spec.geoms)
    for elements in (*kinds, spec.skins, spec.meshes):
        for element in list(elements):
            spec.delete(element)
    return spec


def build_limb(hung: mujoco.MjSpec, joints: Sequence[str], period: float) -> mujoco.MjModel:
    """Return a limb with a position servo per joint.

    Args:
        hung: Robot as of `hang`.
        joints: Joints of the limb. Others are held where the model has them, and other limbs left out.
        period: Period of the log (s); a multiple of the timestep.
    """
    spec = hung.copy()
    model = spec.compile()
    trees = {int(model.dof_treeid[model.joint(name).dofadr[0]]) for name in joints}
    roots = [
        int(model.dof_bodyid[model.tree_dofadr[tree]]) for tree in set(range(model.ntree)) - trees
    ]
    for body in [body for body in spec.bodies if body.id in roots]:
        spec.delete(body)
    for joint in list(spec.joints):
        if joint.name not in joints:
            spec.delete(joint)
    for name in joints:
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    option = spec.option
    option.timestep = period / np.ceil(period / TIMESTEP - 1e-6)
    option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    option.disableflags |= int(_PASSIVE)
    limb = spec.compile()
    # MuJoCo's dry friction is viscous below a speed that grows with the time constant; 2 timesteps is
    # the smallest time constant that MuJoCo allows.
    limb.dof_solref[:] = 2.0 * option.timestep, 1.0
    limb.dof_solimp[:, :2] = 0.99
    return limb
