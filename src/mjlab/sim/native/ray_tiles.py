"""Which static geoms are near: the world in square tiles, each with a list of the geoms around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

_T = mujoco.mjtGeom
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
_PLANE, _HFIELD, _MESH = int(_T.mjGEOM_PLANE), int(_T.mjGEOM_HFIELD), int(_T.mjGEOM_MESH)
_MAX_TILES = 250_000

Array = np.ndarray


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
