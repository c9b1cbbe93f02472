"""Casting rays on the native engine: what `Engine.raycast` promises, at a speed of its own.

`mj_ray` tries every geom of the model for every ray, and on generated terrain these are hundreds.
So rays are cast against the geoms that never move in further batches, whose simulations hold only
the few geoms that are near (`NearbyRays`). Their numbers are the same, hence the results.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch

logger = logging.getLogger(__name__)

Array = np.ndarray

_T = mujoco.mjtGeom
_PLANE, _HFIELD, _MESH = int(_T.mjGEOM_PLANE), int(_T.mjGEOM_HFIELD), int(_T.mjGEOM_MESH)

Passed = Callable[[Any, Array, Array, "Hits"], Array]
"""Which hits of some rows do not count: rows, their origins, directions and hits to (n, R) bool."""

# So many surfaces that do not count are passed by one ray; the next one ends it.
_MAX_PASSES = 8
# A passed ray starts again so far behind the surface, in metres, and relative to its coordinates,
# which are single precision.
_BEHIND, _BEHIND_RELATIVE = 1e-5, 1e-6


class Hits:
    """What rays met: distances (n, R), normals (n, R, 3), geoms (n, R); -1, 0 and -1 on a miss."""

    def __init__(self, distances: Array, normals: Array, geoms: Array) -> None:
        self.distances, self.normals, self.geoms = distances, normals, geoms

    @classmethod
    def empty(cls, rows: int, rays: int) -> Hits:
        """Allocate results, of any values."""
        return cls(
            np.empty((rows, rays), np.float32),
            np.empty((rows, rays, 3), np.float32),
            np.empty((rows, rays), np.int32),
        )

    def __getitem__(self, rows: Any) -> Hits:
        return Hits(self.distances[rows], self.normals[rows], self.geoms[rows])

    def forget(self, where: Array) -> None:
        """Make the rays `where` (n, R) bool misses."""
        self.distances[where], self.normals[where], self.geoms[where] = -1.0, 0.0, -1

    def take_nearer(self, other: Hits) -> None:
        """Replace the hits that `other` has nearer."""
        nearer = (other.distances >= 0.0) & (
            (other.distances < self.distances) | (self.distances < 0.0)
        )
        if nearer.any():
            self.distances[nearer] = other.distances[nearer]
            self.normals[nearer] = other.normals[nearer]
            self.geoms[nearer] = other.geoms[nearer]


def cast_through(
    batch: Any,
    origins: Array,
    directions: Array,
    hits: Hits,
    passed: Passed | None,
    rows: Array | None = None,
    **options: Any,
) -> None:
    """Cast the rays of `rows` (None: all), through surfaces that do not count, into `hits`.

    Args:
        batch: The simulations, one a row.
        origins: (n, R, 3). directions: (n, R, 3).
        hits: Where the results go.
        passed: Which hits do not count; None if all do.
        rows: Sorted ids of simulations.
        options: Further arguments of `Batch.ray`.
    """
    gone: Array | None = None
    for attempt in range(_MAX_PASSES + 1):
        some = slice(None) if rows is None else rows
        hits.distances[some], hits.geoms[some], hits.normals[some] = batch.ray(
            origins[some], directions[some], ids=rows, normal=True, **options
        )
        if passed is None:
            return
        found = hits[some]
        repeat = passed(some, origins[some], directions[some], found)
        chosen = repeat.any(axis=1)
        if not chosen.any():
            break
        if gone is None:
            origins, gone = origins.copy(), np.zeros_like(hits.distances)
        rows = np.flatnonzero(chosen) if rows is None else rows[chosen]
        repeat = repeat[chosen]
        if attempt == _MAX_PASSES:
            last = hits[rows]
            last.forget(repeat)
            hits.distances[rows], hits.normals[rows] = last.distances, last.normals
            hits.geoms[rows] = last.geoms
            break
        behind = _BEHIND + _BEHIND_RELATIVE * np.abs(origins[rows]).max(axis=-1)
        step = np.where(repeat, hits.distances[rows] + behind, 0.0).astype(np.float32)
        origins[rows] += step[..., None] * directions[rows]
        gone[rows] += step
    if gone is not None:
        hits.distances += np.where(hits.distances >= 0.0, gone, 0.0)


# A hit so close (metres) to the bottom of a height field's elevations may be on its base.
_BASE_TOLERANCE = 1e-5
# A surface so far (metres) above a hit on the base shows that the ray began below it.
_SURFACE_TOLERANCE = 1e-4
# The cosine below which a face of a height field is one of its sides or its base.
_SIDE = 1e-9


class CullingRule:
    """Says which hits on the geoms of a model do not count."""

    def __init__(self, model: mujoco.MjModel, pos: Array, mat: Array) -> None:
        """Take the poses of geoms that do not move, (ngeom, 3) and (ngeom, 9).

        They count for height fields, which move only where a mocap body carries them.
        """
        self._model = model
        roots = model.body_rootid[model.geom_bodyid[model.geom_type == _HFIELD]]
        self.fields_are_carried = bool((model.body_mocapid[roots] >= 0).any())
        """Whether each environment places a height field for itself."""
        # One entry more, so that the geom -1 of a miss finds an entry of its own.
        self._is_field = np.append(model.geom_type == _HFIELD, False)
        self._is_one_sided = self._is_field | np.append(model.geom_type == _MESH, False)
        self._pos = np.append(pos, np.zeros((1, 3)), axis=0)
        self._mat = np.append(mat.reshape(-1, 3, 3), np.zeros((1, 3, 3)), axis=0)
        self._is_upright = bool((self._mat[self._is_field, 2, 2] > 1.0 - 1e-12).all())
        elevation = np.zeros(model.ngeom + 1)
        elevation[self._is_field] = model.hfield_size[model.geom_dataid[self._is_field[:-1]], 2]
        self._elevation = elevation
        self._base = np.where(self._is_field, self._pos[:, 2], np.nan)

    def concerns(self, geoms: Array) -> bool:
        """Return whether one of the geoms `geoms` (ngeom,) bool is not seen from everywhere."""
        return bool((self._is_one_sided[:-1] & geoms).any())

    def passed(
        self,
        origins: Array,
        directions: Array,
        distances: Array,
        normals: Array,
        geoms: Array,
        poses: tuple[Any, Any] | None = None,
    ) -> Array:
        """Return which hits (n, R) do not count; vectors are (n, R, 3), geoms -1 for a miss.

        `poses` are the positions (n, ngeom, 3) and orientations (n, ngeom, 3, 3) of the geoms,
        where height fields are carried.
        """
        facing = np.einsum("...k,...k", normals, directions)
        passed = self._is_one_sided[geoms] & (facing >= 0.0)
        is_field = self._is_field[geoms]
        if not is_field.any():
            return passed
        if self._is_upright and poses is None:
            up = normals[..., 2]
            height = origins[..., 2] + directions[..., 2] * distances - self._base[geoms]
        else:
            pos, mat = self._poses_of(geoms, poses)
            axis = mat[..., :, 2]
            up = np.einsum("...k,...k", normals, axis)
            hit = origins + directions * distances[..., None] - pos
            height = np.where(is_field, np.einsum("...k,...k", hit, axis), np.nan)
        passed |= is_field & (up <= _SIDE)
        # Rays from below the surface end on the base, which looks like flat ground.
        index = np.nonzero((np.abs(height) < _BASE_TOLERANCE) & ~passed)
        if len(index[0]):
            if poses is not None:
                poses = (poses[0][index[0]], poses[1][index[0]])
            at = (array[index] for array in (origins, directions, distances, geoms))
            passed[index] = self._begins_below(*at, poses)
        return passed

    def _poses_of(self, geoms: Array, poses: tuple[Any, Any] | None) -> tuple[Array, Array]:
        """Return positions (..., 3) and orientations (..., 3, 3) of geoms (...,)."""
        if poses is None:
            return self._pos[geoms], self._mat[geoms]
        rows = np.arange(len(geoms)).reshape(-1, *[1] * (geoms.ndim - 1))
        return poses[0][rows, geoms], poses[1][rows, geoms]

    def _begins_below(
        self,
        origins: Array,
        directions: Array,
        distances: Array,
        geoms: Array,
        poses: tuple[Any, Any] | None,
    ) -> Array:
        """Return for hits (M,) at the height of the base whether the surface is above them."""
        pos, mat = self._poses_of(geoms, poses)
        climb = -np.einsum("mk,mk->m", directions, mat[:, :, 2]) * distances
        below = climb < self._elevation[geoms]
        if below.any():
            hits = origins[below] + directions[below] * distances[below, None]
            local = np.einsum("mkj,mk->mj", mat[below], hits - pos[below])
            below[below] = self._surface(local, geoms[below]) > _SURFACE_TOLERANCE
        return below

    def _surface(self, local: Array, geoms: Array) -> Array:
        """Return the height of height fields (M,) at local positions (M, 3), above their base.

        Each cell is two triangles, cut from its first to its last corner.
        """
        m = self._model
        fields = m.geom_dataid[geoms]
        cells = np.stack((m.hfield_ncol[fields] - 1, m.hfield_nrow[fields] - 1), axis=-1)
        scaled = (local[:, :2] / m.hfield_size[fields, :2] + 1.0) / 2.0 * cells
        scaled = np.clip(scaled, 0.0, cells)
        corner = np.minimum(scaled.astype(int), cells - 1)
        x, y = (scaled - corner).T
        columns = m.hfield_ncol[fields]
        first = m.hfield_adr[fields] + corner[:, 1] * columns + corner[:, 0]
        h00, h01 = m.hfield_data[first], m.hfield_data[first + 1]
        h10, h11 = m.hfield_data[first + columns], m.hfield_data[first + columns + 1]
        lower = h00 + x * (h01 - h00) + y * (h11 - h01)
        upper = h00 + y * (h10 - h00) + x * (h11 - h10)
        return m.hfield_size[fields, 2] * np.where(x >= y, lower, upper)


# Geoms that a slot can stand for.
_KINDS = tuple(
    int(kind)
    for kind in (
        _T.mjGEOM_PLANE,
        _T.mjGEOM_HFIELD,
        _T.mjGEOM_SPHERE,
        _T.mjGEOM_CAPSULE,
        _T.mjGEOM_ELLIPSOID,
        _T.mjGEOM_CYLINDER,
        _T.mjGEOM_BOX,
        _T.mjGEOM_MESH,
    )
)
_MAX_TILES = 250_000


@dataclass(frozen=True)
class StaticGeoms:
    """Geoms of some groups that never move, and what a ray needs to know of them."""

    ids: Array
    """(G,) ids in the model, ascending."""
    type: Array
    """(G,) types."""
    pos: Array
    """(G, 3) world positions."""
    quat: Array
    """(G, 4) world orientations."""
    size: Array
    """(G, 3) sizes."""
    dataid: Array
    """(G,) height field or mesh, or -1."""
    low: Array
    """(G, 2) lower corner of what they cover of the ground; -inf for planes."""
    high: Array
    """(G, 2) upper corner."""


def in_groups(model: mujoco.MjModel, groups: tuple[int, ...] | None) -> Array:
    """Return which geoms are of these groups (None: any), (ngeom,) bool."""
    if groups is None:
        return np.ones(model.ngeom, dtype=bool)
    return np.isin(model.geom_group.clip(0, 5), groups)


def visible_geoms(model: mujoco.MjModel, groups: tuple[int, ...] | None) -> Array:
    """Return which geoms rays of these groups can meet at all, (ngeom,) bool."""
    visible = in_groups(model, groups)
    alpha = model.geom_rgba[:, 3].copy()
    has_material = model.geom_matid >= 0
    alpha[has_material] = model.mat_rgba[model.geom_matid[has_material], 3]
    return visible & (alpha != 0.0)


def is_welded(model: mujoco.MjModel) -> Array:
    """Return which geoms MuJoCo counts as static, (ngeom,) bool; mocap bodies may carry them."""
    return model.body_weldid[model.geom_bodyid] == 0


def is_static(model: mujoco.MjModel) -> Array:
    """Return which geoms never move, (ngeom,) bool."""
    return is_welded(model) & (model.body_mocapid[model.body_rootid[model.geom_bodyid]] < 0)


def movable_kind(model: mujoco.MjModel) -> Array:
    """Return which geoms a slot of the ray model can stand for, (ngeom,) bool."""
    movable = np.isin(model.geom_type, _KINDS)
    is_mesh = model.geom_type == _MESH
    if is_mesh.any():
        try:
            slot_model(model, [_MESH])
        except ValueError:
            # The compiler refuses these meshes, or makes something else of them.
            movable &= ~is_mesh
    return movable


def static_geoms(model: mujoco.MjModel, data: mujoco.MjData, chosen: Array) -> StaticGeoms:
    """Gather the geoms `chosen` (ngeom,) bool at the poses of `data`."""
    ids = np.flatnonzero(chosen)
    kind, pos = model.geom_type[ids], data.geom_xpos[ids].copy()
    mat = data.geom_xmat[ids].reshape(-1, 3, 3)
    # Where the body is not turned, the geom's own orientation is its world orientation, to the bit.
    quat = model.geom_quat[ids].copy()
    is_turned = (data.xquat[model.geom_bodyid[ids]] != (1.0, 0.0, 0.0, 0.0)).any(axis=1)
    for i in np.flatnonzero(is_turned):
        mujoco.mju_mat2Quat(quat[i], mat[i].reshape(9))
    # Boxes around the geoms in their own frames; a height field reaches from its base to its top.
    centre, half = model.geom_aabb[ids, :3].copy(), model.geom_aabb[ids, 3:].copy()
    fields = kind == _HFIELD
    sizes = model.hfield_size[model.geom_dataid[ids[fields]]]
    centre[fields] = np.stack([np.zeros(len(sizes))] * 2 + [(sizes[:, 2] - sizes[:, 3]) / 2], -1)
    half[fields] = np.stack((sizes[:, 0], sizes[:, 1], (sizes[:, 2] + sizes[:, 3]) / 2), -1)
    middle = pos + (mat @ centre[..., None])[..., 0]
    reach = (np.abs(mat) @ half[..., None])[..., 0]
    reach[kind == _PLANE] = np.inf
    low, high = (middle - reach)[:, :2], (middle + reach)[:, :2]
    return StaticGeoms(
        ids, kind, pos, quat, model.geom_size[ids].copy(), model.geom_dataid[ids], low, high
    )


class TileTable:
    """For each square tile, the geoms that a window around it may touch.

    `entries` is (tiles + 1, slots): the index of a geom or -1. Each slot is for one type of geom,
    and the last row is for the world outside of the tiles, where there is nothing but planes.
    """

    def __init__(self, geoms: StaticGeoms, margin: float) -> None:
        """Sort `geoms` into tiles; the window of a tile reaches `margin` beyond it."""
        finite = np.isfinite(geoms.low).all(axis=1)
        low = geoms.low[finite].min(axis=0) if finite.any() else np.zeros(2)
        high = geoms.high[finite].max(axis=0) if finite.any() else np.zeros(2)
        # Beyond the tiles, a window reaches no geom.
        self.origin = low - 2.0 * margin
        extent = high + 2.0 * margin - self.origin
        self.pitch = max(1.0 * margin, 0.1, math.sqrt(float(extent.prod()) / _MAX_TILES))
        self.shape = np.maximum(np.ceil(extent / self.pitch).astype(int), 1)
        self.margin = margin
        kinds = [kind for kind in _KINDS if (geoms.type == kind).any()]
        tables = [self._of_kind(geoms, np.flatnonzero(geoms.type == kind)) for kind in kinds]
        self.slot_types = [k for k, t in zip(kinds, tables, strict=True) for _ in range(t.shape[1])]
        self.entries = np.concatenate(tables, axis=1)

    def _of_kind(self, geoms: StaticGeoms, members: Array) -> Array:
        """Return the part of the table that is for one type of geom."""
        nx, ny = self.shape
        reach = self.margin + 1e-6
        first = (geoms.low[members] - reach - self.origin) / self.pitch
        last = (geoms.high[members] + reach - self.origin) / self.pitch
        first = np.clip(np.floor(first), 0, self.shape - 1).astype(int)
        last = np.clip(np.floor(last), 0, self.shape - 1).astype(int)
        ranges = [np.s_[a : c + 1, b : d + 1] for (a, b), (c, d) in zip(first, last, strict=True)]
        count = np.zeros((nx, ny), dtype=np.int64)
        for tiles in ranges:
            count[tiles] += 1
        infinite = members[~np.isfinite(geoms.low[members]).all(axis=1)]
        width = max(int(count.max()), len(infinite))
        table = np.full((nx * ny + 1, width), -1, dtype=np.int32)
        table[-1, : len(infinite)] = infinite
        by_tile = table[:-1].reshape(nx, ny, width)
        count[:] = 0
        for member, tiles in zip(members, ranges, strict=True):
            np.put_along_axis(by_tile[tiles], count[tiles][..., None], member, axis=2)
            count[tiles] += 1
        return table

    def find(self, centre: Array) -> Array:
        """Return the tiles (M,) of positions (M, 2); the last row's number outside of all tiles."""
        place = np.floor((centre - self.origin) / self.pitch)
        inside = ((place >= 0) & (place < self.shape)).all(axis=-1)
        index = np.where(inside[..., None], place, 0.0).astype(np.int64)
        return np.where(
            inside, index[..., 0] * self.shape[1] + index[..., 1], len(self.entries) - 1
        )


def slot_model(model: mujoco.MjModel, slot_types: list[int]) -> mujoco.MjModel:
    """Compile a world of one placeholder geom for each slot, with the surfaces of `model`.

    Raises:
        ValueError: a mesh of `model` cannot be compiled again.
    """
    spec = mujoco.MjSpec()
    if _HFIELD in slot_types:
        _add_hfields(spec, model)
    if _MESH in slot_types:
        _add_meshes(spec, model)
    for kind in slot_types:
        geom = spec.worldbody.add_geom(type=_T(kind), size=[0.1, 0.1, 0.1])
        if kind == _HFIELD:
            geom.hfieldname = "field0"
        elif kind == _MESH:
            geom.meshname = "mesh0"
    compiled = spec.compile()
    # What the compiler centres and stretches is centred and stretched already; to the bit.
    if _HFIELD in slot_types:
        compiled.hfield_data[:] = model.hfield_data
    if _MESH in slot_types:
        _copy_meshes(model, compiled)
    compiled.geom_sameframe[:] = 0
    return compiled


def _add_hfields(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for i in range(model.nhfield):
        start, count = model.hfield_adr[i], model.hfield_nrow[i] * model.hfield_ncol[i]
        spec.add_hfield(
            name=f"field{i}",
            nrow=int(model.hfield_nrow[i]),
            ncol=int(model.hfield_ncol[i]),
            size=model.hfield_size[i],
            userdata=model.hfield_data[start : start + count],
        )


def _add_meshes(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for i in range(model.nmesh):
        vertices, faces = model.mesh_vertadr[i], model.mesh_faceadr[i]
        spec.add_mesh(
            name=f"mesh{i}",
            uservert=model.mesh_vert[vertices : vertices + model.mesh_vertnum[i]].ravel(),
            userface=model.mesh_face[faces : faces + model.mesh_facenum[i]].ravel(),
            # An open mesh has no volume.
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )


def _copy_meshes(source: mujoco.MjModel, target: mujoco.MjModel) -> None:
    """Copy what rays read of meshes; ValueError if the two models have not the same meshes."""
    for name in ("mesh_vertadr", "mesh_vertnum", "mesh_face", "mesh_bvhnum"):
        if not np.array_equal(getattr(source, name), getattr(target, name)):
            raise ValueError(f"{name} of a mesh has changed.")
    target.mesh_vert[:] = source.mesh_vert
    # The trees over the faces of each mesh stand between others.
    for start, end, count in zip(
        source.mesh_bvhadr, target.mesh_bvhadr, source.mesh_bvhnum, strict=True
    ):
        for name in ("bvh_child", "bvh_nodeid", "bvh_depth", "bvh_aabb"):
            getattr(target, name)[end : end + count] = getattr(source, name)[start : start + count]


# MuJoCo's mjMINVAL: rays that come down on a plane more slowly than that miss it.
_MIN_SLOPE = 1e-15


class StaticPlanes:
    """Planes that never move. Distances are those of `mj_ray`, in the same double precision."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, ids: Array) -> None:
        """Take the planes `ids` at the poses of `data`."""
        self._pos = data.geom_xpos[ids].copy()
        self._axes = data.geom_xmat[ids].reshape(-1, 3, 3).transpose(0, 2, 1).copy()
        # A plane of size 0 has no end.
        self._extent = np.where(model.geom_size[ids, :2] > 0.0, model.geom_size[ids, :2], np.inf)
        # What a ray reports of the plane that it meets. The last row is for none.
        self._ids = np.append(ids, -1).astype(np.int32)
        self._normals = np.vstack((self._axes[:, 2], np.zeros(3))).astype(np.float32)

    @classmethod
    def alone(
        cls, model: mujoco.MjModel, data: mujoco.MjData, visible: Array, excluded: Array | None
    ) -> StaticPlanes | None:
        """Return the planes, if all geoms `visible` (ngeom,) bool are such; else None.

        `excluded` are bodies that some of the rays do not see.
        """
        ids = np.flatnonzero(visible)
        others = (model.geom_type[ids] != _PLANE) | ~is_static(model)[ids]
        if excluded is not None:
            others |= np.isin(model.geom_bodyid[ids], excluded)
        return None if others.any() or not len(ids) else cls(model, data, ids)

    def cast(self, origins: Array, directions: Array, hits: Hits) -> None:
        """Cast the rays (n, R, 3) of all environments into `hits`."""
        nearest = np.full(origins.shape[:2], np.inf)
        which = np.full(origins.shape[:2], -1)
        for i in range(len(self._pos)):
            distance = self._distance(i, origins, directions)
            nearer = distance < nearest
            nearest = np.where(nearer, distance, nearest)
            which[nearer] = i
        hits.distances[:] = np.where(which < 0, -1.0, nearest)
        # Of all modes this one does not copy twice; -1 is the last row in it too.
        np.take(self._normals, which, axis=0, out=hits.normals, mode="wrap")
        np.take(self._ids, which, out=hits.geoms, mode="wrap")

    def _distance(self, i: int, origins: Array, directions: Array) -> Array:
        """Return how far rays go to plane `i`, (n, R); infinite for a miss."""
        x, y, z = self._axes[i]
        slope = _along(z, directions)
        # Those that do not come down divide by something harmless. NaN is no hit.
        comes_down = slope <= -_MIN_SLOPE
        height = _along(z, origins, self._pos[i])
        distance = height / np.where(comes_down, -slope, 1.0)
        is_hit = comes_down & (distance >= 0.0)
        for axis, extent in zip((x, y), self._extent[i], strict=True):
            if np.isfinite(extent):
                start = _along(axis, origins, self._pos[i])
                is_hit &= np.abs(start + distance * _along(axis, directions)) <= extent
        return np.where(is_hit, distance, np.inf)


def _along(axis: Array, vectors: Array, origin: Array | None = None) -> Array:
    """Return coordinates along `axis` (3,) of vectors (n, R, 3), from `origin` if there is one."""
    total = np.zeros(vectors.shape[:2])
    for k in range(3):
        part = vectors[..., k].astype(np.float64)
        if origin is not None:
            part -= origin[k]
        total += axis[k] * part
    return total


_GEOM_FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_dataid", "geom_matid")
_BODY_FIELDS = ("body_pos", "body_quat")


class SharedGeoms:
    """Some static geoms; compares what environments have for themselves with what was compiled.

    Rays that look for these geoms where they were compiled to be rely on it. Other fields, and
    other columns of these fields (those of a robot), may differ. Of colours it is transparency
    alone that matters.
    """

    def __init__(self, model: mujoco.MjModel, geoms: Array) -> None:
        """Hold what was compiled of the geoms with the ids `geoms`."""
        bodies = set(model.geom_bodyid[geoms].tolist())
        for body in tuple(bodies):
            while body > 0:
                body = int(model.body_parentid[body])
                bodies.add(body)
        columns = dict.fromkeys(_GEOM_FIELDS, geoms)
        columns |= {name: np.array(sorted(bodies), dtype=int) for name in _BODY_FIELDS}
        self._columns = {name: torch.from_numpy(np.array(ids)) for name, ids in columns.items()}
        self._compiled = {
            name: torch.from_numpy(np.array(getattr(model, name)[ids]))
            for name, ids in columns.items()
        }
        materials = model.geom_matid[geoms]
        self._alphas = {
            "geom_rgba": torch.from_numpy(np.array(geoms[materials < 0])),
            "mat_rgba": torch.from_numpy(np.unique(materials[materials >= 0]).astype(int)),
        }
        self._names = (*self._columns, *self._alphas)
        self._seen: dict[str, int] = {}
        self._differing: str | None = None

    def differing_field(self, fields: Mapping[str, torch.Tensor]) -> str | None:
        """Return a field in which an environment differs from what was compiled, or None.

        `fields` are those that environments have for themselves, (N, ...). They are compared only
        after they were written.
        """
        versions = {name: fields[name]._version for name in self._names if name in fields}
        if versions != self._seen:
            self._seen = versions
            differing = (name for name in versions if self._differs(name, fields[name]))
            self._differing = next(differing, None)
        return self._differing

    def _differs(self, name: str, field: torch.Tensor) -> bool:
        if name in self._alphas:
            return bool((field[:, self._alphas[name], 3] == 0.0).any())
        own = field[:, self._columns[name]]
        return not torch.equal(own, self._compiled[name].to(own.dtype).expand_as(own))


# Clusters are split until they have no more rays than this and are no longer than that (metres).
_MAX_RAYS = 40
_MAX_LENGTH = 0.75
# Clusters of similar numbers of rays are cast together.
_SIMILAR = 0.6


def cluster_rays(positions: Array, sources: Array) -> list[list[Array]]:
    """Split rays into clusters of neighbours, and these into classes of similar numbers.

    Args:
        positions: (R, 3) where the rays start in some environment.
        sources: (R,) rays of different sources are not neighbours.

    Returns:
        For each class, the ray indices of its clusters.
    """
    pending = [np.flatnonzero(sources == source) for source in np.unique(sources)]
    clusters: list[Array] = []
    while pending:
        rays = pending.pop()
        extent = np.ptp(positions[rays], axis=0)
        if len(rays) <= _MAX_RAYS and extent.max() <= _MAX_LENGTH:
            clusters.append(np.sort(rays))
            continue
        if len(rays) == 1:
            clusters.append(rays)
            continue
        order = rays[np.argsort(positions[rays, extent.argmax()], kind="stable")]
        pending += [order[: len(rays) // 2], order[len(rays) // 2 :]]
    clusters.sort(key=lambda rays: -len(rays))
    classes: list[list[Array]] = []
    for cluster in clusters:
        if classes and len(cluster) >= _SIMILAR * len(classes[-1][0]):
            classes[-1].append(cluster)
        else:
            classes.append([cluster])
    return classes


class NearbyRays:
    """Casts clusters of rays, of one class, against static geoms.

    Each environment and cluster has a simulation of its own in a second batch, whose geoms are
    those of the tile that the cluster is in. They are replaced when it comes into another tile.
    """

    def __init__(
        self,
        clusters: list[Array],
        num_envs: int,
        geoms: StaticGeoms,
        margin: float,
        make_batch: Callable[..., Any],
        model: Any,
        rule: CullingRule | None,
    ) -> None:
        """Build the tiles and the batch for `clusters` of rays whose windows reach `margin`."""
        self.num_clusters, self.margin = len(clusters), margin
        width = max(map(len, clusters))
        # Short clusters repeat their last ray.
        padded = [np.append(c, np.repeat(c[-1], width - len(c))) for c in clusters]
        self._columns = torch.from_numpy(np.concatenate(padded))
        filled = np.concatenate([np.arange(width) < len(c) for c in clusters])
        self._filled = torch.from_numpy(np.flatnonzero(filled))
        self._targets = self._columns[self._filled]
        self._num_envs, self._width = num_envs, width
        self._geoms, self._rule = geoms, rule
        self._table = TileTable(geoms, margin)
        small = slot_model(model, self._table.slot_types)
        rows = num_envs * self.num_clusters
        self._batch = make_batch(small, rows)
        self._expand(small.ngeom, rows)
        self._tiles = np.full(rows, -1)
        self._hits = Hits.empty(rows, width)
        self._mask = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
        self._given: tuple[torch.Tensor | None, int, torch.Tensor | None] = (None, 0, None)
        self._along, self._sideways = np.empty(0), None

    def _expand(self, slots: int, rows: int) -> None:
        """Bind what differs between simulations, and append what a slot without a geom holds."""
        geoms = self._geoms
        # Slots without a geom are in a group that no ray sees.
        self._fields = {"geom_group": self._batch.expand("geom_group")}
        self._values: dict[str, Array] = {"geom_group": np.zeros(len(geoms.ids) + 1, np.int32)}
        self._values["geom_group"][-1] = 1
        for name, value in (
            ("geom_pos", geoms.pos),
            ("geom_quat", geoms.quat),
            ("geom_size", geoms.size),
            ("geom_dataid", geoms.dataid),
        ):
            if name == "geom_dataid" and (value < 0).all():
                continue
            if name == "geom_quat" and (value == value[:1]).all():
                # All turned alike, as they are where nothing is turned.
                value = value[:1]
            self._fields[name] = self._batch.expand(name)
            self._values[name] = np.append(value, value[-1:], axis=0)
        if len(self._values["geom_quat"]) == 2:
            self._fields.pop("geom_quat")[:] = self._values.pop("geom_quat")[0]
        # The geom of each slot; the last column is for the slot -1 of a miss.
        self._ids = np.full((rows, slots + 1), -1, dtype=np.int32)

    def cast(
        self, origins: torch.Tensor, directions: torch.Tensor, reach: torch.Tensor | None, out: Hits
    ) -> Array:
        """Cast into `out`; return where (num_envs,) some rays have left their window.

        What is in `out` for those environments is not to be used.
        """
        shape = (self._num_envs * self.num_clusters, self._width)
        start = origins.index_select(1, self._columns).view(*shape, 3)
        along, sideways = self._gather_directions(directions, reach, shape)
        centre, half = self._bounds(start, sideways)
        strays = (half > self.margin).any(axis=1)
        self._load(centre)
        cast_through(
            self._batch,
            start.numpy(),
            along,
            self._hits,
            None if self._rule is None else self._passed,
            geomgroup=self._mask,
        )
        self._scatter(out)
        return np.asarray(strays.reshape(self._num_envs, -1).any(axis=1))

    def _gather_directions(
        self, directions: torch.Tensor, reach: torch.Tensor | None, shape: tuple[int, int]
    ) -> tuple[Array, torch.Tensor | None]:
        """Return directions by row, and how far rays go sideways, (rows, width, 2); None: nowhere.

        Most often the directions are the same from call to call, which torch's count of writes to
        a tensor tells.
        """
        if not self._are_as_given(directions, reach):
            along = directions.index_select(1, self._columns).view(*shape, 3)
            self._sideways = None
            if (along[..., :2] != 0.0).any():
                limit = torch.full((directions.shape[1],), torch.inf) if reach is None else reach
                limit = limit[self._columns].view(-1, self._width, 1).repeat(self._num_envs, 1, 1)
                self._sideways = (along[..., :2] * limit).nan_to_num()
            self._along = along.numpy()
            # Tensors made under `inference_mode` do not count writes, so they are never the same.
            version = -1 if directions.is_inference() else directions._version
            self._given = (directions, version, None if reach is None else reach.clone())
        return self._along, self._sideways

    def _are_as_given(self, directions: torch.Tensor, reach: torch.Tensor | None) -> bool:
        """Return whether these are the directions and the reach of the last call."""
        last, version, last_reach = self._given
        if last is not directions or directions.is_inference() or version != directions._version:
            return False
        if reach is None or last_reach is None:
            return reach is last_reach
        return torch.equal(reach, last_reach)

    def _bounds(self, start: torch.Tensor, sideways: torch.Tensor | None) -> tuple[Array, Array]:
        """Return the centres and half extents (rows, 2) of what the rays cross on the ground."""
        flat = start[..., :2]
        low, high = flat.amin(dim=1), flat.amax(dim=1)
        if sideways is not None:
            ends = flat + sideways
            low, high = low.minimum(ends.amin(dim=1)), high.maximum(ends.amax(dim=1))
        return ((low + high) / 2).double().numpy(), ((high - low) / 2).numpy()

    def _load(self, centre: Array) -> None:
        """Give the clusters that have come into another tile its geoms."""
        tiles = self._table.find(centre)
        rows = np.flatnonzero(tiles != self._tiles)
        if len(rows) == 0:
            return
        self._tiles[rows] = tiles[rows]
        slots = self._table.entries[tiles[rows]]
        for name, field in self._fields.items():
            field[rows] = self._values[name][slots]
        self._ids[rows, :-1] = np.append(self._geoms.ids, -1)[slots]

    def _geom_ids(self, rows: Any, slots: Array) -> Array:
        return np.take_along_axis(self._ids[rows], slots, axis=1)

    def _passed(self, rows: Any, origins: Array, directions: Array, hits: Hits) -> Array:
        assert self._rule is not None
        geoms = self._geom_ids(rows, hits.geoms)
        return self._rule.passed(origins, directions, hits.distances, hits.normals, geoms)

    def _scatter(self, out: Hits) -> None:
        """Write the results to the columns of their rays."""
        geoms = self._geom_ids(slice(None), self._hits.geoms)
        results = (self._hits.distances, self._hits.normals, geoms)
        for result, target in zip(results, (out.distances, out.normals, out.geoms), strict=True):
            by_env = torch.from_numpy(result).view(self._num_envs, -1, *result.shape[2:])
            torch.from_numpy(target).index_copy_(
                1, self._targets, by_env.index_select(1, self._filled)
            )


MakeBatch = Callable[[mujoco.MjModel, int], Any]
Poses = Callable[[], tuple[Array, Array]]

# Fewer static geoms than this are tried faster than they are looked up.
_MIN_GEOMS = 12
# A first query of fewer trials (rays times geoms) is not worth a plan: it may be the only one.
_MIN_TRIALS = 5_000_000
# Windows that reach farther (metres) hold most of the geoms anyway. So many calls later, the rays
# may be closer together.
_MAX_MARGIN = 4.0
_PAUSE = 100
# If more of the environments than this have rays that left their window, windows are made larger.
_MAX_STRAYS = 0.02

# Where one of these differs between environments, geoms may become visible.
_LOOKS = frozenset({"geom_rgba", "geom_matid", "mat_rgba"})


class NativeRays:
    """Casts the rays of a native engine."""

    def __init__(
        self, model: mujoco.MjModel, batch: Any, make_batch: MakeBatch, poses: Poses
    ) -> None:
        """Cast in `batch`.

        `make_batch(model, count)` makes further batches, and `poses()` returns the current
        positions (N, ngeom, 3) and orientations (N, ngeom, 3, 3) of the geoms.
        """
        self._poses = poses
        self._model, self._batch, self._make_batch = model, batch, make_batch
        self._host = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._host)
        self._rule = CullingRule(model, self._host.geom_xpos, self._host.geom_xmat)
        self._plans: dict[Any, _Plan] = {}
        self._has_warned = False

    def cast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None,
        exclude_body_ids: torch.Tensor | None,
        max_distances: torch.Tensor | None,
        fields: Mapping[str, torch.Tensor],
    ) -> Hits:
        """Cast rays (N, R); see `Engine.raycast`.

        `fields` are the model fields that environments have for themselves, (N, ...).
        """
        excluded = None
        if exclude_body_ids is not None:
            excluded = np.ascontiguousarray(exclude_body_ids.numpy().astype(np.int32))
        rays = origins.shape[1]
        looks_vary = not _LOOKS.isdisjoint(fields)
        key = (geom_groups, rays, None if excluded is None else excluded.tobytes(), looks_vary)
        if key not in self._plans:
            self._plans[key] = self._plan(geom_groups, excluded, looks_vary)
        plan = self._plans[key]
        hits = Hits.empty(len(origins), rays)
        trials = origins.shape[0] * rays * self._model.ngeom
        is_first, plan.is_new = plan.is_new and trials < _MIN_TRIALS, False
        is_shared = self._is_shared(plan, fields)
        if plan.planes is not None and is_shared:
            plan.planes.cast(origins.numpy(), directions.numpy(), hits)
        elif is_first or plan.nearby is None or not is_shared:
            self._cast_all(plan, origins, directions, hits)
        else:
            self._cast_nearby(plan, origins, directions, max_distances, hits)
        if max_distances is not None:
            too_far = hits.distances > max_distances.numpy()
            if too_far.any():
                hits.forget(too_far)
        return hits

    @cached_property
    def _movable(self) -> Array:
        return movable_kind(self._model)

    def _is_shared(self, plan: _Plan, fields: Mapping[str, torch.Tensor]) -> bool:
        """Return whether the geoms that are not looked for in the model are as compiled."""
        if plan.shared is None:
            return True
        field = plan.shared.differing_field(fields)
        if field is not None and not self._has_warned:
            self._has_warned = True
            logger.warning(
                "Rays try every geom of the model from now on, which is much slower: the field %r "
                "of geoms that never move, such as the ground, differs between environments or "
                "from the compiled model. Randomize it for things that move only (asset_cfg).",
                field,
            )
        return field is None

    def _plan(
        self, groups: tuple[int, ...] | None, excluded: Array | None, looks_vary: bool
    ) -> _Plan:
        """Find out which geoms the rays can meet, and which of these are looked up by place."""
        model = self._model
        visible = visible_geoms(model, groups)
        if looks_vary:
            # What moves may have been compiled transparent, and be seen in some environment.
            visible |= in_groups(model, groups) & ~is_static(model)
        plan = _Plan(groups, excluded, is_one_sided=self._rule.concerns(visible))
        plan.planes = StaticPlanes.alone(model, self._host, visible, excluded)
        if plan.planes is not None:
            plan.shared = SharedGeoms(model, np.flatnonzero(visible))
        near = visible & is_static(model)
        if near.sum() < _MIN_GEOMS:
            return plan
        near &= self._movable
        others = visible & ~near
        plan.has_moving = bool(others.any())
        # The others are cast without what MuJoCo counts as static, and no body is left out.
        complete = not (others & is_welded(model)).any()
        kept = excluded is None or not np.isin(model.geom_bodyid[near], excluded).any()
        if complete and kept and near.sum() >= _MIN_GEOMS:
            plan.nearby = static_geoms(model, self._host, near)
            plan.shared = SharedGeoms(model, np.flatnonzero(near))
        return plan

    def _cast_all(
        self,
        plan: _Plan,
        origins: torch.Tensor,
        directions: torch.Tensor,
        hits: Hits,
        envs: Array | None = None,
        static: bool = True,
    ) -> None:
        """Cast against the geoms of the model itself, in the environments `envs` (None: all)."""

        poses = self._poses() if self._rule.fields_are_carried and plan.is_one_sided else None

        def passed(rows: Any, origins: Array, directions: Array, hits: Hits) -> Array:
            return self._rule.passed(
                origins,
                directions,
                hits.distances,
                hits.normals,
                hits.geoms,
                None if poses is None else (poses[0][rows], poses[1][rows]),
            )

        cast_through(
            self._batch,
            np.ascontiguousarray(origins.numpy()),
            np.ascontiguousarray(directions.numpy()),
            hits,
            passed if plan.is_one_sided else None,
            envs,
            geomgroup=plan.mask,
            bodyexclude=-1 if plan.excluded is None else plan.excluded,
            flg_static=static,
        )

    def _cast_nearby(
        self,
        plan: _Plan,
        origins: torch.Tensor,
        directions: torch.Tensor,
        reach: torch.Tensor | None,
        hits: Hits,
    ) -> None:
        """Cast against the static geoms that are near, and then against those that move."""
        if not plan.parts and plan.pause == 0:
            self._build(plan, origins, directions, reach)
        if not plan.parts:
            plan.pause -= 1
            self._cast_all(plan, origins, directions, hits)
            return
        strayed = np.zeros(len(origins), dtype=bool)
        for part in plan.parts:
            strayed |= part.cast(origins, directions, reach, hits)
        if plan.has_moving:
            moving = Hits.empty(*hits.distances.shape)
            self._cast_all(plan, origins, directions, moving, static=False)
            hits.take_nearer(moving)
        if strayed.any():
            self._cast_all(plan, origins, directions, hits, np.flatnonzero(strayed))
            if strayed.mean() > _MAX_STRAYS:
                plan.parts.clear()

    def _build(
        self,
        plan: _Plan,
        origins: torch.Tensor,
        directions: torch.Tensor,
        reach: torch.Tensor | None,
    ) -> None:
        """Sort the rays into clusters, with windows that fit where they are now and some more."""
        limit = np.full(origins.shape[1], np.inf) if reach is None else reach.numpy()
        excluded = np.full(len(limit), -1) if plan.excluded is None else plan.excluded
        _, sources = np.unique(np.stack((limit, excluded)), axis=1, return_inverse=True)
        ends = (origins + (directions * torch.from_numpy(limit)[:, None]).nan_to_num()).numpy()
        # An environment that has diverged says nothing about the others.
        starts, ends = np.nan_to_num(origins.numpy()), np.nan_to_num(ends)
        classes = cluster_rays(starts[0], sources.reshape(-1))
        margins = [_margin(clusters, starts, ends) for clusters in classes]
        if len(margins) == len(plan.margins):
            margins = [max(pair) for pair in zip(margins, plan.margins, strict=True)]
        if not max(margins) < _MAX_MARGIN:
            plan.pause = _PAUSE
            return
        assert plan.nearby is not None
        rule = self._rule if plan.is_one_sided else None
        plan.margins = margins
        plan.parts = [
            NearbyRays(
                clusters, len(starts), plan.nearby, margin, self._make_batch, self._model, rule
            )
            for clusters, margin in zip(classes, margins, strict=True)
        ]


def _margin(clusters: list[Array], starts: Array, ends: Array) -> float:
    """Return how far windows have to reach around clusters, for nearly all environments."""
    extents = []
    for rays in clusters:
        points = np.concatenate((starts[:, rays, :2], ends[:, rays, :2]), axis=1)
        # Half the diagonal, which turning does not change.
        extents.append(np.linalg.norm(np.ptp(points, axis=1) / 2, axis=-1))
    return 1.2 * float(np.quantile(np.max(extents, axis=0), 0.99)) + 0.02


class _Plan:
    """How to cast rays against the geoms of some groups, as far as it is the same in every call."""

    def __init__(
        self, groups: tuple[int, ...] | None, excluded: Array | None, *, is_one_sided: bool
    ) -> None:
        self.mask = None
        if groups is not None:
            self.mask = np.zeros(6, dtype=np.uint8)
            self.mask[list(groups)] = 1
        self.excluded = excluded
        self.is_one_sided = is_one_sided
        self.is_new = True
        self.planes: StaticPlanes | None = None
        self.nearby: StaticGeoms | None = None
        self.shared: SharedGeoms | None = None
        self.has_moving = False
        self.pause = 0
        self.parts: list[NearbyRays] = []
        self.margins: list[float] = []
