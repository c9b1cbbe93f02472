"""Faults of a robot's model that MuJoCo accepts and that training would meet later.

`find_faults` applies every rule to a `Subject`: a compiled model with its initial state and gains. A
finding says what, where in the file, why it matters, and the cure. Nothing is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot import measures
from mjlab.own_robot.anatomy import Anatomy, finger_joints
from mjlab.own_robot.finding import Finding as Finding
from mjlab.own_robot.finding import listed
from mjlab.own_robot.gains import (
    MAX_SAG,
    STABLE,
    joint_inertias,
)
from mjlab.own_robot.posture import over_soles
from mjlab.own_robot.subject import Subject
from mjlab.utils.string import counted

MAX_DEPTH = 0.001
"""Largest depth of contacts of the robot with itself (m)."""
MAX_SUNK = 0.02
"""Largest depth below the ground of the initial pose (m). The Go1 starts 1.6 cm below."""
MAX_GAP = 0.05
"""Largest height above the ground of the initial pose (m)."""
MAX_OUTSIDE = 0.005
"""Largest distance from the range of a joint in the initial pose (rad, m)."""
MIN_DIFFERENCE = 0.15
"""Smallest relative difference of left and right that is reported. CAD models differ by up to 0.1."""
MIN_RANGE_DIFFERENCE = 0.05
"""Smallest difference of the ranges of left and right that is reported (rad, m)."""

SOFT_SOLE = 0.5
"""Contact impedance at zero depth (first value of `solimp`) below which soles slide: at impratio 1, a
robot of 50 kg on soles of 0.5 moved by 1.4 cm in a second under a push of 0.3 times its weight, on soles
of 0.9 by 0.15 cm, of 0.015 by 5 cm."""
# Friction of soft soles holds from this ratio of frictional to normal impedance on.
_HOLDING_IMPRATIO = 10.0

# Hinge ranges below 2 pi degrees were meant in radians.
_TINY_RANGE = np.radians(2.0 * np.pi)
# Radius of gyration over the reach of a link. The bound above is exact; the other leaves out inertias
# in wrong units (1e-3 and 1e-6 of the true ones).
_MIN_GYRATION, _MAX_GYRATION = 1 / 30, 1.5
# Mass over the volume of the geoms' boxes (kg/m^3): air, and more than tungsten.
_MIN_DENSITY, _MAX_DENSITY = 1.2, 20_000.0
_GROUND = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


def find_faults(subject: Subject) -> list[Finding]:
    """Return the findings of all rules."""
    return [finding for rule in RULES for finding in rule(subject)]


# Physics.


def _zero_gravity(subject: Subject) -> Iterator[Finding]:
    if not measures.has_gravity(subject):
        option = subject.model.opt
        is_off = bool(option.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        vector = " ".join(f"{value:g}" for value in option.gravity)
        yield Finding(
            "zero gravity",
            "gravity is disabled" if is_off else f"gravity {vector} m/s² does not point down",
            (subject.tag_place("flag" if is_off else "option", "gravity"),),
            "Every robot stands without gravity: no gain and no effort limit shows.",
            'Delete gravity="disable".' if is_off else 'Write gravity="0 0 -9.81".',
        )


def _stiff_gains(subject: Subject) -> Iterator[Finding]:
    step = float(subject.model.opt.timestep)
    armature = measures.by_joint(subject, subject.model.dof_armature)
    inertia = joint_inertias(subject.model, subject.joint_pos, armature)
    products = {
        name: step * np.sqrt(kp / max(inertia[name], 1e-12))
        for name, kp in subject.stiffness.items()
        if kp > 0.0
    }
    found = [name for name, product in products.items() if product > STABLE]
    if found:
        worst = max(found, key=lambda name: products[name])
        stable_kp = inertia[worst] * (STABLE / step) ** 2
        stable_step = step * STABLE / products[worst]
        armed = (
            "Give the rotor's inertia (armature), which is 0, or use"
            if not armature[worst]
            else "Use"
        )
        yield Finding(
            "gains too stiff for the time step",
            f"{_joints(found)}: sqrt(kp / inertia) dt up to {products[worst]:.2f} (joint {worst!r}: kp "
            f"{subject.stiffness[worst]:.4g}, inertia {inertia[worst]:.2g}, dt {step:g} s); at most {STABLE}",
            tuple(subject.gain_place(name) for name in found),
            "The joint swings through a period in less than 12 steps: it jitters, and diverges above 2.",
            f"{armed} kp of at most {stable_kp:.3g}, or a time step of {stable_step:.1g} s.",
        )


def _zero_armature(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    armature = measures.by_joint(subject, model.dof_armature)
    candidates = armature if subject.is_urdf and not model.nu else subject.driven
    found = [
        name
        for name in armature
        if name in candidates and armature[name] == 0.0 and measures.is_hinge(model, name)
    ]
    if found:
        where = "in the actuator's config" + ("" if subject.is_urdf else " or in <joint>")
        yield Finding(
            "zero armature",
            f"{_joints(found)} without rotor inertia",
            subject.joint_places(found),
            "The rotor of a geared motor often has more inertia at the joint than the link: without it, "
            "light links need a smaller time step, and the policy learns on another robot.",
            f"Write armature = rotor inertia x gear ratio² (kg m²), {where}.",
        )


def _soft_gains(subject: Subject) -> Iterator[Finding]:
    sags = measures.sags(subject) if measures.has_gravity(subject) and subject.is_upright else {}
    found = [name for name, sag in sags.items() if sag > MAX_SAG]
    if found:
        worst = max(found, key=lambda name: sags[name])
        kp = subject.stiffness[worst]
        yield Finding(
            "gains too soft for the weight",
            f"{_joints(found)}: sag of up to {sags[worst]:.2f} rad (joint {worst!r} with kp {kp:.4g}); at most "
            f"{MAX_SAG} rad",
            tuple(subject.gain_place(name) for name in found),
            "The robot sinks below its pose by this angle, and the policy has to learn to hold it up before "
            "it can walk or reach.",
            f"Use kp of about {kp * sags[worst] / MAX_SAG:.3g} or more at {worst!r}.",
        )


def _weak_effort(subject: Subject) -> Iterator[Finding]:
    if not (measures.has_gravity(subject) and subject.is_upright):
        return
    torques = measures.holding_torques(subject)
    found = [
        name
        for name, limit in subject.effort.items()
        if name in subject.driven and abs(torques[name]) > limit
    ]
    if found:
        worst = max(found, key=lambda name: abs(torques[name]) / max(subject.effort[name], 1e-9))
        yield Finding(
            "effort that cannot hold the weight",
            f"{_joints(found)} (joint {worst!r}: limit {subject.effort[worst]:.3g}, needed to stand still "
            f"{abs(torques[worst]):.3g} N m)",
            tuple(subject.gain_place(name) for name in found),
            "No policy can hold the initial pose.",
            "Check the limit (forcerange, actuatorfrcrange, ctrlrange x gear), and the masses.",
        )


# Masses.


def _absurd_inertias(subject: Subject) -> Iterator[Finding]:
    found: dict[int, tuple[float, float]] = {}
    for link in geo.links(subject.model):
        mass, center, inertia = measures.link_inertia(subject, link)
        points, _ = measures.extent(subject, link)
        if mass > 0.0 and len(points):
            reach = float(np.linalg.norm(points - center, axis=1).max())
            gyration = float(np.sqrt(np.linalg.eigvalsh(inertia)[-1] / mass))
            if not _MIN_GYRATION * reach < gyration < _MAX_GYRATION * reach + 0.01:
                found[link] = gyration, reach
    if found:
        worst = max(found, key=lambda link: abs(np.log(found[link][0] / found[link][1])))
        gyration, reach = found[worst]
        yield Finding(
            "absurd inertia",
            f"{_bodies(subject, found)}: radius of gyration sqrt(I / m) {gyration:.3g} m at "
            f"{_body(subject, worst)}, which reaches {reach:.2g} m from its center of mass",
            tuple(subject.body_place(link) for link in found),
            "No mass within the link has this inertia: the joint moves too slowly, or jitters.",
            "Check units (kg m²; CAD exports g mm² and kg mm²), or delete <inertial>: MuJoCo then computes it "
            "from the geoms.",
        )


def _absurd_masses(subject: Subject) -> Iterator[Finding]:
    found: dict[int, tuple[float, float]] = {}
    for link in geo.links(subject.model):
        mass, _, _ = measures.link_inertia(subject, link)
        _, volume = measures.extent(subject, link)
        if volume > 0.0 and not _MIN_DENSITY < mass / volume < _MAX_DENSITY:
            found[link] = mass, volume
    if found:
        worst = max(
            found, key=lambda link: abs(np.log10(found[link][0] / found[link][1] / 300 + 1e-12))
        )
        mass, volume = found[worst]
        yield Finding(
            "absurd mass",
            f"{_bodies(subject, found)}: {mass:.3g} kg at {_body(subject, worst)}, in geoms with boxes of "
            f"{1e3 * volume:.2g} liters",
            tuple(subject.body_place(link) for link in found),
            "A link lighter than air or heavier than any metal is a wrong unit, and makes the solver "
            "ill-conditioned.",
            "Check units (kg), or delete <inertial>: MuJoCo then computes it from the geoms.",
        )


def _asymmetry(subject: Subject) -> Iterator[Finding]:
    mirror = subject.anatomy.mirror.value if subject.is_upright else {}
    # Fingers of one gripper are alike, and have partners of many kinds.
    fingers = {subject.model.joint(j).name for j in finger_joints(subject.model)}
    pairs = [
        (name, partner)
        for name, (partner, _) in mirror.items()
        if name < partner and not {name, partner} & fingers
    ]
    for quantity, values in _of_joints(subject).items():
        found = {
            (a, b): (values[a], values[b])
            for a, b in pairs
            if abs(values[a] - values[b]) > MIN_DIFFERENCE * max(abs(values[a]), abs(values[b]))
        }
        if found:
            (left, right), (one, other) = max(
                found.items(), key=lambda item: abs(np.subtract(*item[1])) / max(map(abs, item[1]))
            )
            yield _asymmetric(
                subject,
                f"{quantity} of {counted(len(found), 'pair')} ({left!r} {one:.4g}, {right!r} {other:.4g})",
                [name for pair in found for name in pair],
            )
    uneven = [pair for pair in pairs if not _mirrors(subject, *pair, mirror[pair[0]][1])]
    if uneven:
        ranges = [subject.model.joint(name).range for name in uneven[0]]
        low_high = [
            f"{name!r} {low:.3g} to {high:.3g}"
            for name, (low, high) in zip(uneven[0], ranges, strict=True)
        ]
        yield _asymmetric(
            subject,
            f"range of {counted(len(uneven), 'pair')} ({', '.join(low_high)})",
            [name for pair in uneven for name in pair],
        )
    alone = [
        name
        for name in subject.joint_pos
        if name not in mirror and name not in fingers and _is_lateral(subject, name)
    ]
    if alone and len(alone) < len(mirror) / 2:
        yield _asymmetric(subject, f"{_joints(alone)} without a partner on the other side", alone)


def _asymmetric(subject: Subject, what: str, joints: list[str]) -> Finding:
    return Finding(
        "asymmetric left and right",
        what,
        subject.joint_places(joints),
        "Mirror images of transitions, and a symmetric gait, assume equal sides.",
        "Correct the side that is wrong. Keep identified values if the robot is so, or average them.",
    )


def _of_joints(subject: Subject) -> dict[str, dict[str, float]]:
    """Return quantities of joints, and of the links that they move, by joint."""
    model = subject.model
    links = {
        name: measures.link_inertia(subject, int(model.joint(name).bodyid[0]))
        for name in subject.joint_pos
    }
    return {
        "mass": {name: mass for name, (mass, _, _) in links.items()},
        "inertia": {name: float(np.trace(inertia)) for name, (_, _, inertia) in links.items()},
        "armature": measures.by_joint(subject, model.dof_armature),
        "damping": measures.by_joint(
            subject, model.dof_damping[:, 0] if model.dof_damping.ndim > 1 else model.dof_damping
        ),
        "friction loss": measures.by_joint(subject, model.dof_frictionloss),
        "kp": {name: subject.stiffness.get(name, 0.0) for name in subject.joint_pos},
        "effort limit": {name: subject.effort.get(name, 0.0) for name in subject.joint_pos},
    }


def _is_lateral(subject: Subject, joint: str) -> bool:
    """Return True for a joint beside the mirror plane, not one near it such as a neck (OP3, iCub: 0.22)."""
    model, data = subject.model, mujoco.MjData(subject.model)
    mujoco.mj_kinematics(model, data)
    trunk = (
        int(model.body(subject.anatomy.trunk.value).id) if geo.free_joint(model) is not None else 0
    )
    across = (data.xanchor - data.xpos[trunk]) @ data.xmat[trunk].reshape(3, 3)[:, 1]
    return bool(abs(across[model.joint(joint).id]) > 0.3 * np.abs(across).max())


def _mirrors(subject: Subject, joint: str, partner: str, sign: float) -> bool:
    """Return True if the range of a joint is the mirror image of its partner's, from `qpos0`."""
    model = subject.model
    if not (model.joint(joint).limited and model.joint(partner).limited):
        return True
    ends, other = (
        model.joint(name).range - model.qpos0[model.joint(name).qposadr[0]]
        for name in (joint, partner)
    )
    return bool(np.abs(np.sort(sign * ends) - other).max() <= MIN_RANGE_DIFFERENCE)


# Initial pose.


def _angle_units(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    hinges = [j for j in geo.joint_ids(model) if model.jnt_type[j] == geo.HINGE]
    limited = [j for j in hinges if model.jnt_limited[j]]
    if subject.is_urdf or not subject.spec.compiler.degree or len(limited) < 2:
        return
    widest = float(np.abs(model.jnt_range[limited]).max())
    if widest < _TINY_RANGE:
        names = [model.joint(j).name for j in limited]
        yield Finding(
            "ranges in radians, read in degrees",
            f"{_joints(names)}: ranges within ±{np.degrees(widest):.3g} degrees (±{widest:.3g} rad)",
            (*subject.joint_places(names), subject.tag_place("compiler")),
            "MuJoCo reads degrees unless the file says otherwise: the joints can hardly move, and their limits "
            "push against every pose with tens of N m, for ever.",
            'Write <compiler angle="radian"/>.',
        )


def _outside_limits(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    ranges = {
        name: model.jnt_range[model.joint(name).id]
        for name in subject.joint_pos
        if model.jnt_limited[model.joint(name).id]
    }
    outside = {
        name: max(low - subject.joint_pos[name], subject.joint_pos[name] - high)
        for name, (low, high) in ranges.items()
    }
    found = [name for name, distance in outside.items() if distance > MAX_OUTSIDE]
    if found:
        worst = max(found, key=lambda name: outside[name])
        low, high = ranges[worst]
        yield Finding(
            "initial pose outside the limits",
            f"{_joints(found)} in {subject.pose} (joint {worst!r} at {subject.joint_pos[worst]:.3g}, range "
            f"{low:.3g} to {high:.3g})",
            (subject.pose_place, *subject.joint_places(found)),
            "The limits push the joints back with large forces from the first step on.",
            "Use a pose within the ranges, in a keyframe or in `init_state`, and check the unit of the ranges "
            '(<compiler angle="radian"/>).',
        )


def _ground(subject: Subject) -> Iterator[Finding]:
    model, data = subject.model, subject.data
    free = geo.free_joint(model)
    # A URDF has no initial height.
    if free is None or subject.is_urdf:
        return
    root = int(model.jnt_bodyid[free])
    gap = geo.lowest_height(model, data, measures.own_geoms(subject)) - measures.level_of_ground(
        subject
    )
    height = float(data.xpos[root, 2])
    is_sunk = gap < -MAX_SUNK
    # Boxes and height fields may carry the robot above the plane.
    if not np.isfinite(gap) or not (is_sunk or (gap > MAX_GAP and not measures.has_steps(subject))):
        return
    yield Finding(
        "initial pose in the ground" if is_sunk else "initial pose above the ground",
        f"lowest colliding geom {abs(gap):.3f} m {'below' if is_sunk else 'above'} the ground in "
        f"{subject.pose}, with the root at {height:.3f} m",
        (subject.pose_place,),
        "The ground throws the robot up at the first step."
        if is_sunk
        else "Every episode starts with a fall and an impact, before the policy can act.",
        f"Put the root at a height of {height - gap:.3f} m.",
    )


def _falling(subject: Subject) -> Iterator[Finding]:
    feet = subject.anatomy.feet.value
    if subject.anatomy.kind.value != "legged" or subject.pose == "qpos0":
        return
    if feet and not over_soles(subject.model, subject.data, subject.anatomy):
        yield Finding(
            "initial pose falls",
            f"center of mass beside the {len(feet)} soles in {subject.pose}",
            (subject.pose_place,),
            "The robot tips over before the policy can act.",
            "Bend the legs so that the feet are below the center of mass.",
        )


def _self_penetration(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    depths: dict[tuple[int, int], float] = {}
    for contact in subject.data.contact:
        bodies = model.geom_bodyid[contact.geom]
        roots = model.body_rootid[bodies]
        if roots[0] == roots[1] != 0 and contact.dist < -MAX_DEPTH:
            pair = (int(contact.geom[0]), int(contact.geom[1]))
            depths[pair] = max(depths.get(pair, 0.0), -float(contact.dist))
    if depths:
        pairs = sorted(depths, key=lambda pair: -depths[pair])
        first, second = (_body(subject, int(model.geom_bodyid[g])) for g in pairs[0])
        yield Finding(
            "self-penetration in the initial pose",
            f"{counted(len(pairs), 'pair')} of geoms in {subject.pose}, by up to {1e3 * depths[pairs[0]]:.1f} mm "
            f"(bodies {first} and {second})",
            subject.geom_places(g for pair in pairs for g in pair),
            "Contacts push the links apart at the first step of every episode.",
            "Add <exclude body1= body2=/> for links that always touch, change the pose, or shrink the geoms.",
        )


# Floating base.


def _static_bodies(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    if geo.free_joint(model) is None:
        return
    found = []
    for body in range(1, model.nbody):
        geoms = np.flatnonzero(model.geom_bodyid == body)
        is_top = model.body_parentid[body] == 0 and model.body_weldid[body] == 0
        is_ground = len(geoms) > 0 and np.isin(model.geom_type[geoms], _GROUND).all()
        if is_top and model.body_mocapid[body] < 0 and not is_ground:
            found.append(body)
    if found:
        yield Finding(
            "static bodies beside a floating base",
            f"{_bodies(subject, found)} without a joint, beside a robot that moves",
            tuple(subject.body_place(body) for body in found),
            "As part of the robot they stay where they are when an environment places it, and count among its "
            "bodies.",
            "Move them to a separate file and entity, or to the terrain.",
        )


def _seen_by_rays(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    found = [g for g in measures.own_geoms(subject) if model.geom_group[g] in subject.ray_groups]
    if found:
        groups = sorted({int(model.geom_group[g]) for g in found})
        yield Finding(
            "geoms that terrain rays see",
            f"{counted(len(found), 'colliding geom')} in group {', '.join(map(str, groups))}",
            subject.geom_places(found),
            "Height scans and foot heights look for the ground in this group, and meet the robot.",
            'Give colliding geoms group="3", in their default class.',
        )


def _no_contacts(subject: Subject) -> Iterator[Finding]:
    free = geo.free_joint(subject.model)
    if free is not None and not measures.own_geoms(subject):
        body = int(subject.model.jnt_bodyid[free])
        yield Finding(
            "nothing collides",
            f"no geom of {_body(subject, body)} has contype, conaffinity or a contact pair",
            (subject.body_place(body),),
            "The robot falls through the ground.",
            'Give the collision geoms contype="1" and conaffinity="1", or use CollisionCfg.',
        )


def _soles(subject: Subject) -> Iterator[Finding]:
    if not measures.own_geoms(subject):
        return
    model = subject.model
    soles = [model.geom(name).id for foot in subject.anatomy.feet.value for name in foot.sole]
    found = [g for g in soles if model.geom_priority[g] == 0 or model.geom_condim[g] == 1]
    paired = {*model.pair_geom1[: model.npair], *model.pair_geom2[: model.npair]}
    if not found:
        return
    if paired & set(found):
        what = "in contact pairs"
        why = "A contact pair has a friction and condim of its own, and ignores those of its geoms."
        cure = 'Delete the pairs, and give the soles priority="1" and condim="3".'
    else:
        priorities = sorted({int(model.geom_priority[g]) for g in found})
        condims = sorted({int(model.geom_condim[g]) for g in found})
        what = f"priority {listed(priorities)} and condim {listed(condims)}"
        why = (
            "With equal priority, MuJoCo takes the larger friction of foot and ground: a foot of 0.3 on "
            "ground of 1.0 has 1.0. With priority and condim 1, feet have no friction at all."
        )
        where = "by CollisionCfg" if subject.is_urdf else "in the file or by CollisionCfg"
        cure = f'Give the soles priority="1" and condim="3", {where}.'
    yield Finding(
        "soles whose friction cannot be randomized",
        f"{counted(len(found), 'geom')} of the feet, {what}",
        subject.geom_places(found),
        why,
        cure,
    )


def soft_soles(model: mujoco.MjModel, anatomy: Anatomy) -> list[int]:
    """Return the soles with a contact impedance below `SOFT_SOLE`, as geom ids."""
    soles = [model.geom(name).id for foot in anatomy.feet.value for name in foot.sole]
    return [g for g in soles if model.geom_solimp[g, 0] < SOFT_SOLE]


def _soft_soles(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    if model.opt.impratio >= _HOLDING_IMPRATIO:
        return
    found = soft_soles(model, subject.anatomy)
    if found:
        softest = min(float(model.geom_solimp[g, 0]) for g in found)
        yield Finding(
            "soles that slide",
            f"{counted(len(found), 'geom')} of the feet, contact impedance {softest:.2g} (solimp), "
            f"impratio {model.opt.impratio:.3g}",
            subject.geom_places(found),
            "Friction has the same impedance: feet creep under any sideways force, so robots wobble, and "
            "hardly learn to turn.",
            'Use solimp="0.9 0.95 0.001", or cone="elliptic" and impratio="100", which takes longer.',
        )


def _unnamed_feet(subject: Subject) -> Iterator[Finding]:
    spec, found = subject.spec, []
    for foot in subject.anatomy.feet.value:
        if foot.link in subject.unnamed:
            found.append(spec.body(foot.link))
        found += [spec.geom(name) for name in foot.sole if name in subject.unnamed]
    if found:
        yield Finding(
            "unnamed feet",
            f"{counted(len(found), 'part')} of the feet ({listed([e.name for e in found])} here)",
            tuple(subject.place(element) for element in found),
            "Contact sensors, friction and rewards find feet by name patterns.",
            'Name them, such as name="FL_foot_collision".',
        )


def _undriven(subject: Subject) -> Iterator[Finding]:
    model = subject.model
    is_equality = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    in_tendon = model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT
    coupled = {
        *model.eq_obj1id[is_equality],
        *model.eq_obj2id[is_equality],
        *model.wrap_objid[in_tendon],
    }
    roots = {int(model.body_rootid[model.joint(name).bodyid[0]]) for name in subject.driven}
    hanging = [
        name
        for name in subject.joint_pos
        for joint in [model.joint(name)]
        if name not in subject.driven
        and joint.id not in coupled
        and not joint.stiffness.any()
        # Joints of a planar base, and of objects such as a door.
        and model.body_parentid[joint.bodyid[0]] != 0
        and model.body_rootid[joint.bodyid[0]] in roots
    ]
    is_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    # Most joints have an actuator, so that the others were not meant to be passive.
    if hanging and len(hanging) < len(subject.driven) and is_joint.all():
        yield Finding(
            "joints without an actuator",
            f"{_joints(hanging)}, of {len(subject.joint_pos)}",
            subject.joint_places(hanging),
            "They hang loose. A pattern that misses some joints raises no error.",
            "Extend `target_names_expr` of an actuator's config, or add one.",
        )


def missed_joints(
    setting: str, found: Sequence[str], joints: Sequence[str], why: str
) -> Iterator[Finding]:
    """Yield a finding if the patterns of a setting find most of the joints, but not all.

    Args:
        setting: Path of the setting in the task's config.
        found: Joints that the patterns match.
        joints: Joints that they should match.
        why: Consequence.
    """
    missed = [name for name in joints if name not in found]
    if missed and len(missed) < len(joints) / 2:
        yield Finding(
            "joints that a pattern misses",
            f"{_joints(missed)}, of {len(joints)} with an actuator",
            (setting,),
            why,
            "Extend the pattern; it must match whole names.",
        )


# Text.


def _body(subject: Subject, body: int) -> str:
    return repr(subject.model.body(body).name)


def _bodies(subject: Subject, bodies: Iterable[int]) -> str:
    names = [subject.model.body(b).name for b in bodies]
    return f"{counted(len(names), 'link')} ({listed(names)})"


def _joints(names: Sequence[str]) -> str:
    return f"{counted(len(names), 'joint')} ({listed(names)})"


RULES: tuple[Callable[[Subject], Iterator[Finding]], ...] = (
    _zero_gravity,
    _angle_units,
    _outside_limits,
    _ground,
    _falling,
    _self_penetration,
    _stiff_gains,
    _soft_gains,
    _weak_effort,
    _zero_armature,
    _undriven,
    _absurd_masses,
    _absurd_inertias,
    _asymmetry,
    _no_contacts,
    _soles,
    _soft_soles,
    _unnamed_feet,
    _seen_by_rays,
    _static_bodies,
)
"""All rules, in the order of the report."""
