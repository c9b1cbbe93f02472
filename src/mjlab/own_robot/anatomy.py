"""Parts of a robot: trunk, feet, legs, hands, IMU and actuators, from its compiled model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.guess import Guess
from mjlab.utils.mirror import mirror_pairs

Kind = Literal["legged", "arm", "other"]
Drive = Literal["motor", "position", "other", "none"]

SOLE_RULE = "geoms within 1 cm of the lowest point of a foot"
"""Reason of the soles."""
SOLE_DEPTH = 0.01
"""Distance above the lowest point of a foot within which a geom is part of the sole (m)."""
FOOT_BAND = 0.05
"""Height of the lowest points of feet above the lowest of them, as a share of the trunk's height."""
ROW_GAP = 0.25
"""Distance of two rows of feet, front to rear, as a share of that of the first and the last row."""
ANKLE_SHARE = 0.15
"""Distance of an ankle's joint to the foot, as a share of the leg's length."""


@dataclass(frozen=True)
class Foot:
    """A foot."""

    link: str
    """Body of the foot."""
    sole: tuple[str, ...]
    """Geoms that touch the ground."""
    position: tuple[float, float, float]
    """Middle of the sole in the frame of the body (m)."""
    normal: tuple[float, float, float]
    """Direction away from the ground, in the frame of the body, when the sole is level."""
    size: tuple[float, float]
    """Length and width of the sole (m)."""


@dataclass(frozen=True)
class Leg:
    """Joints of a leg."""

    foot: str
    """Body of the foot."""
    joints: tuple[str, ...]
    """Joints from the trunk to the foot, without those that carry several feet, such as a waist's."""


@dataclass(frozen=True)
class Hand:
    """End of an arm."""

    link: str
    """Last body before the gripper."""
    site: str | None
    """Site at the grasp; None if there is none."""
    joints: tuple[str, ...]
    """Joints of the arm, without the gripper."""
    gripper: tuple[str, ...]
    """Joints of the fingers."""
    position: tuple[float, float, float]
    """Grasp in the frame of the body (m)."""


@dataclass(frozen=True)
class Anatomy:
    """Parts of a robot, by the names of the model's elements."""

    kind: Guess[Kind]
    trunk: Guess[str]
    feet: Guess[tuple[Foot, ...]]
    legs: Guess[tuple[Leg, ...]]
    """Legs in the order of the feet: front before rear, left before right."""
    front: Guess[float]
    """Sign of the trunk's x axis in the direction of the robot's front: 1 or -1."""
    upright: Guess[str]
    """Body that a task keeps upright."""
    hands: Guess[tuple[Hand, ...]]
    mirror: Guess[dict[str, tuple[str, float]]]
    """Partner of each joint and sign of its motion; empty for a robot without left and right."""
    imu_site: Guess[str | None]
    """Site of the IMU; None: the trunk's origin."""
    drives: Guess[dict[str, Drive]]
    """Actuator of each joint in the file."""
    colliding: Guess[tuple[str, ...]]
    """Geoms that collide."""
    fall_bodies: Guess[tuple[str, ...]]
    """Bodies whose contact with the ground is a fall: all that collide but feet and ankles."""

    @property
    def leg_joints(self) -> tuple[str, ...]:
        """Joints of all legs, leg after leg."""
        return tuple(joint for leg in self.legs.value for joint in leg.joints)


def find_anatomy(model: mujoco.MjModel, *, kind: Kind | None = None) -> Anatomy:
    """Return the parts of a robot with named elements (see `name_elements`).

    Args:
        model: Robot.
        kind: Answer to the question what the robot is; None to find it.
    """
    free = geo.free_joint(model)
    trunk = int(model.jnt_bodyid[free]) if free is not None else 0
    feet = _feet(model, trunk) if free is not None or kind == "legged" else ()
    mirror = {
        model.joint(j).name: (model.joint(p.joint).name, p.sign)
        for j, p in mirror_pairs(model, trunk).items()
    }
    legs = _legs(model, trunk, feet)
    hands = tuple(_hands(model, trunk, {foot.link for foot in feet}))
    has_sides = len(feet) >= 2 or len(hands) >= 2
    found = _kind(model, free, feet, hands) if kind is None else Guess(kind, "as set", "set")
    return Anatomy(
        kind=found,
        trunk=_trunk(model, free, trunk),
        feet=Guess(feet, "end links lowest in a standing pose"),
        legs=Guess(legs, "joints from the trunk to a foot"),
        front=_front(model, legs, feet),
        upright=_upright(model, trunk, legs),
        hands=Guess(
            hands,
            "last link before the finger joints"
            if any(hand.gripper for hand in hands)
            else "last link of the arm",
        ),
        mirror=Guess(
            mirror if has_sides else {}, "axis and moved mass mirrored, same depth and range"
        ),
        imu_site=_imu(model, trunk),
        drives=Guess(drives(model), "bias of the actuator: none, a motor; affine, a servo", "file"),
        colliding=_colliding(model),
        fall_bodies=_fall_bodies(model, legs),
    )


def _kind(
    model: mujoco.MjModel, free: int | None, feet: tuple[Foot, ...], hands: tuple[Hand, ...]
) -> Guess[Kind]:
    if free is not None and len(feet) >= 2:
        return Guess("legged", f"a free joint and {len(feet)} feet")
    if any(_slides_freely(model, base) for base in geo.links(model)):
        return Guess("other", "a base that slides in a plane")
    if free is None and any(len(hand.joints) >= 4 for hand in hands):
        return Guess("arm", "no free joint, at least four joints in a row")
    return Guess("other", "neither feet below a free joint, nor four joints in a row")


def _slides_freely(model: mujoco.MjModel, link: int) -> bool:
    """Return True for a link that two slides of its own move against the world, as of planar walkers."""
    slides = [j for j in geo.link_joints(model, link) if model.jnt_type[j] == geo.SLIDE]
    return geo.parent_link(model, link) == 0 and len(slides) >= 2


def fixed_legs(model: mujoco.MjModel) -> int:
    """Return the number of legs below a fixed base: ends that are lowest in a pose, without fingers."""
    base = model.body(_trunk(model, None, 0).value).id
    if model.body_weldid[base] != 0:
        return 0
    links = [model.body(foot.link).id for foot in _feet(model, base)]
    fingers = finger_joints(model)
    return sum(not fingers & set(geo.chain_joints(model, link, base)) for link in links)


def _trunk(model: mujoco.MjModel, free: int | None, trunk: int) -> Guess[str]:
    if free is not None:
        return Guess(model.body(trunk).name, "body of the free joint")
    bases = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0]
    base = max(bases, key=lambda b: model.body_subtreemass[b], default=0)
    return Guess(model.body(base).name, "first body of the heaviest tree")


# Feet.


def foot_links(model: mujoco.MjModel, data: mujoco.MjData, trunk: int) -> list[int]:
    """Return the end links that are lowest in the pose of `data`: the feet, if it stands."""
    colliding = geo.colliding_geoms(model)
    ends = {}
    for link in geo.leaf_links(model):
        geoms = [g for g in colliding if model.body_weldid[model.geom_bodyid[g]] == link]
        if geoms and geo.chain_joints(model, link, trunk):
            ends[link] = geo.lowest_height(model, data, geoms)
    if not ends:
        return []
    lowest = min(ends.values())
    height = float(data.xpos[trunk][2]) - lowest
    return [link for link, z in ends.items() if z < lowest + FOOT_BAND * max(height, 0.0)]


def candidate_poses(model: mujoco.MjModel) -> Iterator[tuple[str, np.ndarray]]:
    """Yield poses in which a robot may stand: keyframes, then `qpos0` moved into the ranges."""
    for key in range(model.nkey):
        yield f"keyframe {model.key(key).name or key}", model.key_qpos[key].copy()
    qpos = model.qpos0.copy()
    for joint in geo.joint_ids(model):
        low, high = geo.joint_range(model, joint)
        qpos[model.jnt_qposadr[joint]] = np.clip(qpos[model.jnt_qposadr[joint]], low, high)
    yield "zero pose", qpos


def _feet(model: mujoco.MjModel, trunk: int) -> tuple[Foot, ...]:
    """Return the feet in the candidate pose in which the trunk is highest above them."""
    data, best, links = mujoco.MjData(model), -np.inf, []
    heights = []
    for _, qpos in candidate_poses(model):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        found = foot_links(model, data, trunk)
        if len(found) not in (2, 4, 6):
            continue
        geoms = geo.colliding_geoms(model)
        height = float(data.xpos[trunk][2]) - geo.lowest_height(model, data, geoms)
        heights.append(height)
        if height > best:
            best, links, pose = height, found, qpos
    if not links:
        return ()
    feet = {link: [] for link in links}
    # At zero, legs are straight; in a keyframe, soles are level.
    for qpos in (pose, model.qpos0):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for link in links:
            feet[link].append(_foot(model, data, link))
    level = [
        straight if np.prod(straight.size) > 1.5 * np.prod(posed.size) else posed
        for posed, straight in feet.values()
    ]
    data.qpos[:] = pose
    mujoco.mj_kinematics(model, data)
    frame, origin = data.xmat[trunk].reshape(3, 3), data.xpos[trunk].copy()
    places = np.array([(data.xpos[link] - origin) @ frame for link in links])
    return tuple(level[foot] for foot in _in_rows(places))


def _in_rows(places: np.ndarray) -> list[int]:
    """Return the order of feet: rows front to rear, left to right in a row.

    Args:
        places: Feet in the frame of the trunk, (F, 3).
    """
    order = np.argsort(-places[:, 0])
    ahead = places[order, 0]
    # A row ends at a gap; two feet are one row.
    gap = max(ROW_GAP * float(np.ptp(ahead)), 0.05)
    ends = np.flatnonzero(-np.diff(ahead) > gap) + 1 if len(places) > 2 else []
    rows = np.split(order, ends)
    return [int(foot) for row in rows for foot in sorted(row, key=lambda f: -places[f, 1])]


def _foot(model: mujoco.MjModel, data: mujoco.MjData, link: int) -> Foot:
    colliding = geo.colliding_geoms(model)
    geoms = [g for g in colliding if model.body_weldid[model.geom_bodyid[g]] == link]
    points = {g: geo.ground_points(model, data, g) for g in geoms}
    lowest = min(float(p[0, 2]) for p in points.values())
    sole = [g for g, p in points.items() if p[0, 2] < lowest + SOLE_DEPTH]
    low, high = (f([f(points[g], axis=0) for g in sole], axis=0) for f in (np.min, np.max))
    middle = np.array([*(0.5 * (low + high))[:2], lowest])
    local = data.xmat[link].reshape(3, 3).T @ (middle - data.xpos[link])
    normal = data.xmat[link].reshape(3, 3)[2]
    return Foot(
        link=model.body(link).name,
        sole=tuple(model.geom(g).name for g in sole),
        position=(float(local[0]), float(local[1]), float(local[2])),
        normal=(float(normal[0]), float(normal[1]), float(normal[2])),
        size=(float(high[0] - low[0]), float(high[1] - low[1])),
    )


def _legs(model: mujoco.MjModel, trunk: int, feet: tuple[Foot, ...]) -> tuple[Leg, ...]:
    chains = [geo.chain_joints(model, model.body(foot.link).id, trunk) for foot in feet]
    carried = Counter(joint for chain in chains for joint in chain)
    return tuple(
        Leg(foot.link, tuple(model.joint(j).name for j in chain if carried[j] == 1))
        for foot, chain in zip(feet, chains, strict=True)
    )


def _front(model: mujoco.MjModel, legs: tuple[Leg, ...], feet: tuple[Foot, ...]) -> Guess[float]:
    """Return the direction that the toes of two feet point in, from the last joints of the legs."""
    if len(feet) != 2:
        return Guess(1.0, "along the trunk's x axis")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ahead = 0.0
    for leg, foot in zip(legs, feet, strict=True):
        link = model.body(foot.link).id
        sole = data.xpos[link] + data.xmat[link].reshape(3, 3) @ np.array(foot.position)
        ahead += float((sole - data.xanchor[model.joint(leg.joints[-1]).id])[0])
    if ahead < -0.01:
        return Guess(-1.0, "toes point along -x from the ankles", "asked")
    return Guess(1.0, "toes point along x from the ankles")


def _upright(model: mujoco.MjModel, trunk: int, legs: tuple[Leg, ...]) -> Guess[str]:
    """Return the heaviest link outside the legs for two legs, else the trunk."""
    if len(legs) != 2:
        return Guess(model.body(trunk).name, "the trunk")
    in_legs = {int(model.jnt_bodyid[model.joint(j).id]) for leg in legs for j in leg.joints}
    mass = {
        link: sum(model.body_mass[b] for b in range(model.nbody) if model.body_weldid[b] == link)
        for link in geo.links(model)
        if link not in in_legs and model.body_rootid[link] == model.body_rootid[trunk]
    }
    return Guess(
        model.body(max(mass, key=lambda b: mass[b])).name, "heaviest link outside the legs"
    )


def _fall_bodies(model: mujoco.MjModel, legs: tuple[Leg, ...]) -> Guess[tuple[str, ...]]:
    """Return the bodies that collide, without feet and ankles."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    allowed = set()
    for leg in legs:
        link = model.body(leg.foot).id
        allowed.add(link)
        hip = data.xanchor[model.joint(leg.joints[0]).id]
        length = float(np.linalg.norm(data.xpos[link] - hip))
        while link := geo.parent_link(model, link):
            anchor = data.xanchor[model.body_jntadr[link]]
            if np.linalg.norm(anchor - data.xpos[model.body(leg.foot).id]) > ANKLE_SHARE * length:
                break
            allowed.add(link)
    bodies = {int(model.geom_bodyid[g]) for g in geo.colliding_geoms(model)}
    names = tuple(model.body(b).name for b in sorted(bodies) if model.body_weldid[b] not in allowed)
    return Guess(names, "bodies that collide, without feet and ankles")


# Hands.


def _hands(model: mujoco.MjModel, trunk: int, feet: set[str]) -> Iterator[Hand]:
    fingers = finger_joints(model)
    seen = set()
    for leaf in geo.leaf_links(model):
        links = geo.chain(model, leaf, trunk)
        first = next(
            (n for n, b in enumerate(links) if fingers & set(geo.link_joints(model, b))), len(links)
        )
        if first == 0 or model.body(leaf).name in feet:
            continue
        link = links[first - 1]
        joints = geo.chain_joints(model, link, trunk)
        if link in seen or len(joints) < 3:
            continue
        seen.add(link)
        below = [j for j in fingers if link in geo.chain(model, int(model.jnt_bodyid[j]), trunk)]
        site, position = _grasp(model, link, below)
        yield Hand(
            link=model.body(link).name,
            site=site,
            joints=tuple(model.joint(j).name for j in joints),
            gripper=tuple(model.joint(j).name for j in sorted(below)),
            position=position,
        )


def finger_joints(model: mujoco.MjModel) -> set[int]:
    """Return the joints of grippers: slides at the end of a chain, coupled, or named so."""
    words = ("finger", "grip", "knuckle", "thumb")
    found = set()
    coupled = set()
    for equality in range(model.neq):
        if (
            int(model.eq_type[equality]) == mujoco.mjtEq.mjEQ_JOINT
            and model.eq_obj2id[equality] >= 0
        ):
            coupled |= {int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])}
    leaves = set(geo.leaf_links(model))
    for joint in geo.joint_ids(model):
        body = int(model.jnt_bodyid[joint])
        named = any(
            word in name.lower()
            for word in words
            for name in (model.joint(joint).name, model.body(body).name)
        )
        is_end_slide = model.jnt_type[joint] == geo.SLIDE and body in leaves
        if (named or is_end_slide or joint in coupled) and geo.parent_link(model, body):
            found.add(joint)
    return found


def _grasp(
    model: mujoco.MjModel, link: int, fingers: list[int]
) -> tuple[str | None, tuple[float, float, float]]:
    """Return the site at the grasp, if any, and the grasp in the frame of the hand."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    words = ("grasp", "grip", "tcp", "ee", "end_eff", "pinch", "attachment", "tool", "center")
    sites = [s for s in range(model.nsite) if model.body_weldid[model.site_bodyid[s]] == link]
    ranked = [
        (rank, s)
        for s in sites
        for rank, word in enumerate(words)
        if word in model.site(s).name.lower()
    ]
    if ranked:
        site = min(ranked)[1]
        point, name = data.site_xpos[site], model.site(site).name
    else:
        name = None
        bodies = {int(model.jnt_bodyid[j]) for j in fingers}
        geoms = [
            g
            for g in geo.colliding_geoms(model)
            if model.body_weldid[model.geom_bodyid[g]] in bodies
        ]
        # Without fingers: the flange, the last body welded to the link.
        flange = max(b for b in range(model.nbody) if model.body_weldid[b] == link)
        end = data.xpos[flange] if flange != link else data.xipos[link]
        point = np.mean(data.geom_xpos[geoms], axis=0) if geoms else end
    local = data.xmat[link].reshape(3, 3).T @ (point - data.xpos[link])
    return name, (float(local[0]), float(local[1]), float(local[2]))


# Sensors and actuators.


def _imu(model: mujoco.MjModel, trunk: int) -> Guess[str | None]:
    kinds = (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER)
    sites = [
        int(model.sensor_objid[s])
        for kind in kinds
        for s in range(model.nsensor)
        if int(model.sensor_type[s]) == kind
    ]
    # Several IMUs: the one on the trunk, whose velocity is what the task commands.
    on_trunk = [s for s in sites if model.body_weldid[model.site_bodyid[s]] == trunk]
    for site in (*on_trunk, *sites):
        return Guess(model.site(site).name, "site of the gyro", "file")
    named = [s for s in range(model.nsite) if "imu" in model.site(s).name.lower()]
    named.sort(key=lambda s: model.body_weldid[model.site_bodyid[s]] != trunk)
    for site in named:
        return Guess(model.site(site).name, "site named imu", "file")
    return Guess(None, "no gyro and no site named imu: the trunk's origin", "asked")


def drives(model: mujoco.MjModel) -> dict[str, Drive]:
    """Return the kind of the actuator of each joint."""
    found: dict[str, Drive] = {model.joint(j).name: "none" for j in geo.joint_ids(model)}
    for actuator in range(model.nu):
        joint = actuated_joint(model, actuator)
        if joint is None:
            continue
        bias = int(model.actuator_biastype[actuator])
        if bias == mujoco.mjtBias.mjBIAS_NONE:
            kind: Drive = "motor"
        elif bias == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[actuator, 1] < 0:
            kind = "position"
        else:
            kind = "other"
        found[model.joint(joint).name] = kind
    return found


def actuated_joint(model: mujoco.MjModel, actuator: int) -> int | None:
    """Return the joint of an actuator; None for tendons, sites and bodies."""
    # A numpy integer is in no tuple of enum members.
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    if model.actuator_trntype[actuator] not in kinds:
        return None
    return int(model.actuator_trnid[actuator, 0])


def like_joints(
    anatomy: Anatomy, joints: Iterable[str], answers: Mapping[str, object] | None = None
) -> list[tuple[str, ...]]:
    """Return groups of joints that serve alike: those in one place of like legs, and mirror images.

    Joints with different answers of the user are not alike.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    legs = {
        name: (len(leg.joints), index)
        for leg in anatomy.legs.value
        for index, name in enumerate(leg.joints)
    }
    for name in joints:
        partner, _ = anatomy.mirror.value.get(name, (name, 1.0))
        role = legs.get(name, tuple(sorted((name, partner))))
        groups.setdefault((role, (answers or {}).get(name)), []).append(name)
    return [tuple(group) for group in groups.values()]


def _colliding(model: mujoco.MjModel) -> Guess[tuple[str, ...]]:
    geoms = geo.colliding_geoms(model)
    names = tuple(model.geom(g).name for g in geoms)
    if any(model.geom_contype[g] or model.geom_conaffinity[g] for g in geoms):
        return Guess(names, "contype or conaffinity", "file")
    return Guess(names, "nothing collides by itself: geoms of contact pairs, or the highest group")
