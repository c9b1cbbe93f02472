"""Left-right partners of the joints, bodies, sites and geoms of a robot, found by geometry.

The mirror plane is the x-z plane of the robot's root, and poses are those at `qpos0`. Two joints of the
same depth in the tree are partners if the axis of one, mirrored, is the axis of the other: the same line,
in either direction. The direction of a hinge is an axial vector, with the image (-a_x, a_y, -a_z); that of
a slide is a polar vector, with the image (a_x, -a_y, a_z). Left legs thus find right legs however they are
called, and a joint on the plane is its own partner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import mujoco
import numpy as np

DIRECTION = (1.0, -1.0, 1.0)
"""Signs of the mirror image of a polar vector."""
ROTATION = (-1.0, 1.0, -1.0)
"""Signs of the mirror image of an axial vector."""

# Distance of axes, as a share of the size of the robot.
_DISTANCE = 0.01
# The same for the centers of mass of what joints move. A left leg is 20 % and more away from its own image;
# arms whose positions at qpos0 differ are up to 15 % apart.
_OWN_CENTER_DISTANCE, _CENTER_DISTANCE = 0.1, 0.2
# Cosine of the angle between axes.
_COSINE = 1.0 - 1e-3
_RANGE = 0.02  # rad or m


class Partner(NamedTuple):
    """Mirror image of a joint."""

    joint: int
    """Id of the partner; the joint's own for a joint on the mirror plane."""
    sign: float
    """1.0 or -1.0: position of the mirrored joint over that of its partner."""


class _Joints(NamedTuple):
    """Hinges and slides below a root, in its frame at `qpos0`."""

    ids: list[int]
    depths: np.ndarray
    """Numbers of hinges and slides above, (n,)."""
    anchors: np.ndarray  # (n, 3)
    centers: np.ndarray
    """Centers of mass of all that each joint moves, (n, 3)."""
    signs: np.ndarray
    """Cosines between the image of the axis of one joint and the axis of another, (n, n)."""
    distances: np.ndarray
    """Distances of the image of the anchor of one joint from the axis of another (m), (n, n)."""

    @property
    def size(self) -> float:
        """Distance of the farthest anchor or center of mass from the root (m)."""
        points = np.concatenate([self.anchors, self.centers])
        return max(1e-3, float(np.linalg.norm(points, axis=-1).max(initial=0.0)))


def mirror_pairs(
    model: mujoco.MjModel, root: int | None = None, pairs: Mapping[str, str] | None = None
) -> dict[int, Partner]:
    """Find the mirror image of each hinge and slide joint of a robot.

    Candidates have the same depth, a parallel axis at a distance of at most 1 % of the robot's size, and
    move a center of mass at a distance of at most 20 % (10 % for a joint that is its own partner). The one
    closest in axis and center of mass is taken; among equals, one of the same range, then one whose name
    differs by left and right (`left`/`right`, `FL`/`FR`, `l_`/`r_`, ...). Partners are mutual: the partner
    of a joint's partner is the joint.

    Args:
        model: Model.
        root: Body id of the robot's root. None: the body of the first free joint, else the one child of the
            world body that moves; the world body if several do, as with two arms.
        pairs: Names of joints and of their partners, in either direction, with or without the prefix of
            an entity. They replace what geometry would find.

    Returns:
        Partners by joint id. Joints without mirror image are absent.

    Raises:
        ValueError: a joint of `pairs` is unknown, or its axis is not parallel to the image of its partner's.
    """
    if root is None:
        root = root_body(model)
    joints = _joints_below(model, root)
    names = [model.joint(joint).name for joint in joints.ids]
    chosen = _chosen_partners(names, joints.signs, pairs or {})
    if not joints.ids:
        return {}
    size = joints.size
    tolerance = _DISTANCE * size
    center_distances = _distances(joints.centers)
    costs = joints.distances + center_distances
    nearness = np.full_like(costs, _CENTER_DISTANCE * size)
    np.fill_diagonal(nearness, _OWN_CENTER_DISTANCE * size)
    is_candidate = (
        (joints.distances <= tolerance)
        & (center_distances <= nearness)
        & (np.abs(joints.signs) >= _COSINE)
        & (joints.depths[:, None] == joints.depths)
    )
    ranked = sorted(
        (
            # Distances below the tolerance do not tell candidates apart.
            int(costs[i, j] / tolerance),
            not _same_range(model, joints.ids[i], joints.ids[j], joints.signs[i, j]),
            _name_rank(names[i], names[j]),
            float(costs[i, j]),
            i,
            j,
        )
        for i, j in zip(*np.nonzero(np.triu(is_candidate & is_candidate.T)), strict=True)
    )
    found = dict(chosen)
    for *_, i, j in ranked:
        if i not in found and j not in found:
            found[i], found[j] = j, i
    return {
        joints.ids[i]: Partner(joints.ids[found[i]], float(np.sign(joints.signs[i, found[i]])))
        for i in sorted(found)
    }


def describe_unpaired(
    model: mujoco.MjModel, root: int | None = None, pairs: Mapping[str, str] | None = None
) -> dict[int, str]:
    """Describe each joint without mirror image by id: the closest joint of its depth, and the difference.

    Args:
        model: Model.
        root: Body id of the robot's root, see `mirror_pairs`.
        pairs: Names of joints and of their partners, see `mirror_pairs`.

    Returns:
        Descriptions by joint id; empty for a symmetric robot.
    """
    root = root_body(model) if root is None else root
    joints = _joints_below(model, root)
    found = mirror_pairs(model, root, pairs)
    size, distances = joints.size, joints.distances
    angles = np.degrees(np.arccos(np.minimum(1.0, np.abs(joints.signs))))
    centers = _distances(joints.centers)
    # An axis off by 30 deg counts as a distance of the size of the robot.
    gaps = (distances + centers) / size + angles / 30.0
    gaps[joints.depths[:, None] != joints.depths] = np.inf
    described = {}
    for i, joint in enumerate(joints.ids):
        if joint in found:
            continue
        j = int(gaps[i].argmin())
        closest = "itself" if i == j else model.joint(joints.ids[j]).name
        described[joint] = (
            f"{model.joint(joint).name} (closest {closest}: axis off by {1000 * distances[i, j]:.3g} mm "
            f"and {angles[i, j]:.3g} deg, center of mass by {1000 * centers[i, j]:.3g} mm)"
        )
    return described


def mirror_elements(
    model: mujoco.MjModel,
    kind: Literal["body", "site", "geom"],
    ids: Sequence[int],
    root: int | None = None,
    pairs: Mapping[str, str] | None = None,
) -> dict[int, int]:
    """Find the mirror images of bodies, sites or geoms among `ids`.

    The partner moves with the partner of the joint that moves the element, and lies closest to its
    mirrored position; among equals, names decide as in `mirror_pairs`.

    Args:
        model: Model.
        kind: Type of the elements.
        ids: Ids of the elements, all of the robot with this `root`.
        root: Body id of the robot's root, see `mirror_pairs`.
        pairs: Names of elements or joints and of their partners, which geometry need not find.

    Returns:
        Ids of partners by id. Elements without mirror image are absent.
    """
    if root is None:
        root = root_body(model)
    pairs = pairs or {}
    of_joints = mirror_pairs(model, root, pairs)
    data, origin, rotation = reference_pose(model, root)
    points = {"body": data.xpos, "site": data.site_xpos, "geom": data.geom_xpos}[kind]
    bodies = {"body": range(model.nbody), "site": model.site_bodyid, "geom": model.geom_bodyid}[
        kind
    ]
    distances = _distances((points[ids] - origin) @ rotation)
    tolerance = _DISTANCE * _joints_below(model, root).size
    names = [getattr(model, kind)(i).name for i in ids]
    movers = [joint_that_moves(model, int(bodies[i])) for i in ids]
    images = [of_joints[mover].joint if mover in of_joints else mover for mover in movers]
    by_name = {_local(name): index for index, name in enumerate(names)}
    found = {}
    for left, right in pairs.items():
        if left in by_name and right in by_name:
            found[by_name[left]], found[by_name[right]] = by_name[right], by_name[left]
    ranked = sorted(
        (
            int(distances[i, j] / tolerance),
            _name_rank(names[i], names[j]),
            float(distances[i, j]),
            i,
            j,
        )
        for i in range(len(ids))
        for j in range(i, len(ids))
        # Soles and sites are drawn less exactly than joints.
        if distances[i, j] <= 3 * tolerance and images[i] == movers[j]
    )
    for *_, i, j in ranked:
        if i not in found and j not in found:
            found[i], found[j] = j, i
    return {ids[i]: ids[j] for i, j in sorted(found.items())}


def root_body(model: mujoco.MjModel) -> int:
    """Return the body of the first free joint, else the one child of the world body that moves, else 0."""
    is_free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    if is_free.any():
        return int(model.jnt_bodyid[is_free.argmax()])
    moving = np.unique(model.body_rootid[model.jnt_bodyid])
    return int(moving[0]) if len(moving) == 1 else 0


def reference_pose(
    model: mujoco.MjModel, root: int
) -> tuple[mujoco.MjData, np.ndarray, np.ndarray]:
    """Return the positions at `qpos0`, and position and rotation matrix of the body `root`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data, data.xpos[root], data.xmat[root].reshape(3, 3)


def joint_that_moves(model: mujoco.MjModel, body: int) -> int:
    """Return the id of the last hinge, slide or ball joint at or above `body`; -1: it moves with the root."""
    for ancestor in _bodies_above(model, body):
        first, count = int(model.body_jntadr[ancestor]), int(model.body_jntnum[ancestor])
        if count and model.jnt_type[first] != mujoco.mjtJoint.mjJNT_FREE:
            return first + count - 1
    return -1


def _joints_below(model: mujoco.MjModel, root: int) -> _Joints:
    data, origin, rotation = reference_pose(model, root)
    has_axis = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) | (
        model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    )
    ids = [
        joint
        for joint in np.flatnonzero(has_axis).tolist()
        if root in (0, *_bodies_above(model, int(model.jnt_bodyid[joint])))
    ]
    depths = []
    for joint in ids:
        above = _bodies_above(model, int(model.jnt_bodyid[joint]))
        depths.append(sum(other < joint and model.jnt_bodyid[other] in above for other in ids))
    axes = data.xaxis[ids] @ rotation
    is_slide = model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_SLIDE
    signs = (axes * np.where(is_slide[:, None], DIRECTION, ROTATION)) @ axes.T
    # A hinge is never the mirror image of a slide.
    signs[is_slide[:, None] != is_slide] = 0.0
    anchors = (data.xanchor[ids] - origin) @ rotation
    distances = np.linalg.norm(
        np.cross((anchors * DIRECTION)[:, None] - anchors[None], axes[None]), axis=-1
    )
    # A slide has a direction, but no place.
    distances[is_slide[:, None] & is_slide] = 0.0
    centers = (data.subtree_com[model.jnt_bodyid[ids]] - origin) @ rotation
    return _Joints(ids, np.array(depths, dtype=int), anchors, centers, signs, distances)


def _bodies_above(model: mujoco.MjModel, body: int) -> list[int]:
    """Return `body` and its ancestors, without the world body."""
    above = []
    while body:
        above.append(body)
        body = int(model.body_parentid[body])
    return above


def _distances(points: np.ndarray) -> np.ndarray:
    """Return the distances of points (n, 3) from the images of points, (n, n)."""
    return np.linalg.norm(points[:, None] - points * DIRECTION, axis=-1)


def _chosen_partners(
    names: Sequence[str], signs: np.ndarray, pairs: Mapping[str, str]
) -> dict[int, int]:
    """Return partners given by name, both ways. Names of other elements than joints are passed over."""
    index = {_local(name): i for i, name in enumerate(names)}
    chosen = {}
    for left, right in pairs.items():
        i, j = index.get(_local(left)), index.get(_local(right))
        if i is None and j is None:
            continue
        if i is None or j is None:
            missing = left if i is None else right
            raise ValueError(
                f"mirror pair {left!r}, {right!r}: unknown joint {missing!r}. Available: {', '.join(index)}."
            )
        if abs(signs[i, j]) < _COSINE:
            raise ValueError(
                f"mirror pair {left!r}, {right!r}: expected parallel axes after mirroring, got a cosine of "
                f"{signs[i, j]:.3g}."
            )
        chosen[i], chosen[j] = j, i
    return chosen


def _same_range(model: mujoco.MjModel, joint: int, other: int, sign: float) -> bool:
    """True if the ranges of two joints are mirror images."""
    image = np.sort(np.sign(sign) * model.jnt_range[joint])
    return bool(np.abs(image - model.jnt_range[other]).max() <= _RANGE)


def _name_rank(name: str, other: str) -> int:
    """Return 0 for names that differ by `left` and `right` or by letters l and r, 1 for one name, else 2."""
    if name == other:
        return 1
    a, b = (part.lower().replace("left", "l").replace("right", "r") for part in (name, other))
    differ_by_side = len(a) == len(b) and all(
        x == y or {x, y} == {"l", "r"} for x, y in zip(a, b, strict=True)
    )
    return 0 if differ_by_side else 2


def _local(name: str) -> str:
    """Return `name` without the prefix of an entity."""
    return name.rsplit("/", 1)[-1]
