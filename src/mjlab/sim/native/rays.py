"""Rays of the native engine: `Batch.ray`, culled as `Engine.raycast` promises, and a ground table.

`mj_ray` tries every geom of the model for every ray, and generated terrain has hundreds. Rays that
point straight down at boxes, height fields and planes are looked up in `GroundTable` instead.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import SimulationError

logger = logging.getLogger(__name__)

Array = np.ndarray
Passed = Callable[[Array, Array, Array, "Hits"], Array]
"""Predicate of hits to ignore: rows, their origins, directions and hits to (n, R) bool."""

_T = mujoco.mjtGeom
_PLANE, _HFIELD, _BOX, _MESH = (
    int(kind) for kind in (_T.mjGEOM_PLANE, _T.mjGEOM_HFIELD, _T.mjGEOM_BOX, _T.mjGEOM_MESH)
)

_UP = np.array((0.0, 0.0, 1.0), dtype=np.float32)
# Ignored surfaces that one ray passes; the next one ends it.
_MAX_PASSES = 8
# A ray starts again so far behind an ignored surface (m), and relative to its coordinates, which
# are single precision.
_BEHIND, _BEHIND_RELATIVE = 1e-5, 1e-6
# A hit so close (m) to the bottom of a height field's elevations may be on its base, and is if the
# surface is so far (m) above it.
_BASE_TOLERANCE, _SURFACE_TOLERANCE = 1e-5, 1e-4
# The cosine below which a face of a height field is one of its sides or its base.
_SIDE = 1e-9
# Edge of a ground cell (m), unless there would be more cells than this.
_CELL, _MAX_CELLS = 0.1, 1_000_000
# Beside other visible geoms, fewer ground geoms than this are tried faster than looked up.
_MIN_GEOMS = 12


class NativeRays:
    """Casts the rays of a native engine."""

    def __init__(
        self,
        model: mujoco.MjModel,
        batch: Any,
        data_field: Callable[[str], torch.Tensor],
        expanded: Mapping[str, torch.Tensor],
    ) -> None:
        """Cast in `batch`, simulations of `model`.

        `data_field` returns a field of `MjData` by name, (N, ...); `expanded` holds the fields of
        `MjModel` that differ between environments, (N, ...).
        """
        self._model, self._batch = model, batch
        self._data_field, self._expanded = data_field, expanded
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._pos, self._mat = data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()
        self._rule = CullingRule(model, np.arange(model.ngeom))
        roots = model.body_rootid[model.geom_bodyid]
        # MuJoCo counts what a mocap body carries as static.
        self._is_carried = model.body_mocapid[roots] >= 0
        self._fields_are_carried = self._is_carried[model.geom_type == _HFIELD].any()
        self._tables: dict[Any, tuple[GroundTable | None, bool]] = {}

    def cast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None,
        exclude_body_ids: torch.Tensor | None,
        max_distances: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Cast rays (N, R); see `Engine.raycast`."""
        excluded = np.array([-1]) if exclude_body_ids is None else exclude_body_ids.numpy()
        starts, along = np.ascontiguousarray(origins.numpy()), directions.numpy()
        hits = Hits.empty(*starts.shape[:2])
        table, has_others = None, True
        # Rows are compared with rows: a last dimension of three takes ten times as long.
        if (along == np.tile(-_UP, (along.shape[1], 1))).all():
            key = geom_groups, np.unique(excluded).tobytes()
            if key not in self._tables:
                self._tables[key] = self._ground(geom_groups, excluded)
            table, has_others = self._tables[key]
        if table is None or not table.is_current(self._expanded):
            self._cast_in_batch(starts, along, geom_groups, excluded, hits)
        else:
            table.cast(starts, hits)
            if has_others:
                others = Hits.empty(*starts.shape[:2])
                self._cast_in_batch(starts, along, geom_groups, excluded, others, static=False)
                hits.take_nearer(others)
        if max_distances is not None:
            hits.forget(hits.distances > max_distances.numpy())
        distances, normals, geoms = map(
            torch.from_numpy, (hits.distances, hits.normals, hits.geoms)
        )
        return distances, normals, geoms

    def _ground(
        self, groups: tuple[int, ...] | None, excluded: Array
    ) -> tuple[GroundTable | None, bool]:
        """Return a table of all visible geoms that never move, and whether others are visible.

        There is no table if it would miss some of them, or would not pay.
        """
        model = self._model
        in_groups = _group_mask(groups)[model.geom_group.clip(0, 5)].astype(bool)
        welded = in_groups & (model.body_weldid[model.geom_bodyid] == 0)
        carried = welded & self._is_carried
        others = bool((in_groups & ~welded).any() or model.nflex)
        static = np.flatnonzero(welded & ~carried)
        # The opacity that counts is that of the material if a geom has one.
        material = model.geom_matid[static]
        alpha = np.append(model.mat_rgba[:, 3], 1.0)[material]
        alpha = np.where(material < 0, model.geom_rgba[static, 3], alpha)
        ground = static[alpha != 0.0]
        is_upright = (self._mat[ground] == np.eye(3)).all()
        kinds, bodies = model.geom_type[ground], model.geom_bodyid[ground]
        if (
            carried.any()
            or len(ground) < (_MIN_GEOMS if others else 1)
            or not (is_upright and np.isin(kinds, (_PLANE, _HFIELD, _BOX)).all())
            or np.isin(bodies, excluded).any()
        ):
            return None, True
        return GroundTable(model, ground, self._pos[ground], static), others

    def _cast_in_batch(
        self,
        origins: Array,
        directions: Array,
        groups: tuple[int, ...] | None,
        excluded: Array,
        hits: Hits,
        static: bool = True,
    ) -> None:
        """Cast against the geoms of the model, those that never move only if `static`."""
        n = len(origins)
        pos, mat = (np.broadcast_to(x, (n, *x.shape)) for x in (self._pos, self._mat))
        if self._fields_are_carried:
            pos, mat = (self._data_field(name).numpy() for name in ("geom_xpos", "geom_xmat"))

        def passed(rows: Array, origins: Array, directions: Array, hits: Hits) -> Array:
            return self._rule.passed(origins, directions, hits, hits.geoms, rows, pos, mat)

        cast_through(
            self._batch,
            origins,
            directions,
            hits,
            passed if self._rule.is_needed else None,
            geomgroup=_group_mask(groups),
            bodyexclude=excluded,
            flg_static=static,
        )


def _group_mask(groups: tuple[int, ...] | None) -> Array:
    return np.isin(np.arange(6), range(6) if groups is None else groups).astype(np.uint8)


@dataclass
class Hits:
    """Results of rays: distances (n, R), normals (n, R, 3), geoms (n, R); -1, 0 and -1 on a miss."""

    distances: Array
    normals: Array
    geoms: Array

    @classmethod
    def empty(cls, rows: int, rays: int) -> Hits:
        """Allocate results, to be written."""
        shape = (rows, rays)
        return cls(
            np.zeros(shape, np.float32),
            np.zeros((*shape, 3), np.float32),
            np.zeros(shape, np.int32),
        )

    def __getitem__(self, rows: Any) -> Hits:
        return Hits(self.distances[rows], self.normals[rows], self.geoms[rows])

    def __setitem__(self, rows: Any, other: Hits) -> None:
        self.distances[rows], self.normals[rows] = other.distances, other.normals
        self.geoms[rows] = other.geoms

    def forget(self, where: Array) -> None:
        """Make the rays `where` (n, R) bool misses."""
        if where.any():
            self.distances[where], self.normals[where], self.geoms[where] = -1.0, 0.0, -1

    def take_nearer(self, other: Hits) -> None:
        """Replace the hits that `other` has nearer."""
        is_nearer = (other.distances < self.distances) | (self.distances < 0.0)
        is_nearer &= other.distances >= 0.0
        self[is_nearer] = other[is_nearer]


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

    Rays of simulations in which MuJoCo raises are misses.

    Args:
        batch: Simulations, one a row.
        origins: (n, R, 3). directions: (n, R, 3).
        hits: Results, written.
        passed: Predicate of hits to ignore; None to ignore none.
        rows: Sorted ids of simulations.
        options: Further arguments of `Batch.ray`.
    """
    gone: Array | None = None
    passes = 0
    while True:
        some: Any = slice(None) if rows is None else rows
        try:
            distances, geoms, normals = batch.ray(
                origins[some], directions[some], ids=rows, normal=True, **options
            )
        except SimulationError as error:
            # The results of the others are lost with it.
            failed = hits[error.ids]
            failed.forget(np.ones_like(failed.geoms, dtype=bool))
            hits[error.ids] = failed
            rows = np.setdiff1d(np.arange(len(origins)) if rows is None else rows, error.ids)
            continue
        hits[some] = Hits(distances, normals, geoms)
        if passed is None:
            return
        repeat = passed(np.arange(len(origins))[some], origins[some], directions[some], hits[some])
        chosen = repeat.any(axis=1)
        if not chosen.any():
            break
        if gone is None:
            origins, gone = origins.copy(), np.zeros_like(hits.distances)
        rows = np.flatnonzero(chosen) if rows is None else rows[chosen]
        repeat, found = repeat[chosen], hits[rows]
        if passes == _MAX_PASSES:
            found.forget(repeat)
            hits[rows] = found
            break
        passes += 1
        behind = _BEHIND + _BEHIND_RELATIVE * np.abs(origins[rows]).max(axis=-1)
        step = np.where(repeat, found.distances + behind, 0.0).astype(np.float32)
        origins[rows] += step[..., None] * directions[rows]
        gone[rows] += step
    if gone is not None:
        hits.distances += np.where(hits.distances >= 0.0, gone, 0.0)


class CullingRule:
    """Surfaces that rays pass, though MuJoCo's C code reports them (MuJoCo Warp does not).

    Meshes and height fields are seen from outside only, and a height field is its top alone: its
    sides and its base are not there.
    """

    def __init__(self, model: mujoco.MjModel, ids: Array) -> None:
        """Judge hits on the geoms `ids` (G,) of a model, by their number in it; -1 and G miss."""
        self._model, self._ids = model, ids
        self.is_field = np.append(model.geom_type[ids] == _HFIELD, False)
        self._is_one_sided = self.is_field | np.append(model.geom_type[ids] == _MESH, False)
        self.is_needed = bool(self._is_one_sided.any())
        """True if there is a mesh or a height field."""

    def passed(
        self,
        origins: Array,
        directions: Array,
        hits: Hits,
        geoms: Array,
        envs: Array,
        pos: Array,
        mat: Array,
    ) -> Array:
        """Return which hits (n, R) do not count, bool.

        Args:
            origins: (n, R, 3). directions: (n, R, 3).
            hits: What the rays met.
            geoms: Numbers of the geoms that they met, (n, R).
            envs: Environment of each row, (n,).
            pos: Positions of the geoms, (N, G, 3), read of height fields only.
            mat: Orientations, (N, G, 3, 3).
        """
        normals = hits.normals
        passed = self._is_one_sided[geoms]
        passed &= np.einsum("...k,...k", normals, directions) >= 0.0
        at = np.nonzero(self.is_field[geoms] & ~passed)
        if not len(at[0]):
            return passed
        fields = geoms[at]
        pos, mat = (pose[envs[at[0]], fields] for pose in (pos, mat))
        up = np.einsum("mk,mk->m", normals[at], mat[:, :, 2])
        points = origins[at] + directions[at] * hits.distances[at][:, None] - pos
        local = np.einsum("mkj,mk->jm", mat, points)
        # Rays from below the surface end on the base, which looks like flat ground.
        is_low = np.abs(local[2]) < _BASE_TOLERANCE
        surface, _ = _elevation(self._model, self._ids[fields[is_low]], local[:2, is_low])
        is_low[is_low] = surface > _SURFACE_TOLERANCE
        passed[at] = (up <= _SIDE) | is_low
        return passed


def _elevation(model: mujoco.MjModel, geoms: Array, local: Array) -> tuple[Array, Array]:
    """Return heights (m,) and slopes (2, m) of height fields `geoms` at local x, y (2, m).

    Each cell is two triangles, cut from its first to its last corner.
    """
    fields = model.geom_dataid[geoms]
    half, top = model.hfield_size[:, :2].T, model.hfield_size[:, 2].take(fields)
    cells = np.stack((model.hfield_ncol, model.hfield_nrow)) - 1
    scale = (cells / (2.0 * half)).take(fields, axis=1)
    at = (local + half.take(fields, axis=1)) * scale
    corner = np.clip(at.astype(np.int64), 0, (cells - 1).take(fields, axis=1))
    x, y = at - corner
    columns = model.hfield_ncol.take(fields)
    first = model.hfield_adr.take(fields) + corner[1] * columns + corner[0]
    corners = first, first + 1, first + columns, first + columns + 1
    h00, h01, h10, h11 = (model.hfield_data.take(corner).astype(np.float64) for corner in corners)
    is_lower = x >= y
    rise = np.stack(
        (np.where(is_lower, h01 - h00, h11 - h10), np.where(is_lower, h11 - h01, h10 - h00))
    )
    return top * (h00 + x * rise[0] + y * rise[1]), top * rise * scale


class GroundTable:
    """Static, upright boxes, height fields and planes by place, for rays straight down.

    The ground plan is cut into square cells, each with a list of its geoms, highest first. Results
    are those of `mj_ray`, but for the last bit of distances. On generated terrain (Go1 rough, 1,024
    environments) they take a hundredth of the CPU time of `Batch.ray`.
    """

    def __init__(self, model: mujoco.MjModel, geoms: Array, pos: Array, static: Array) -> None:
        """Sort `geoms` at `pos` (G, 3) into cells.

        The table holds where the geoms `static`, visible or not, are as compiled.
        """
        self._model = model
        self._compiled = _static_fields(model, static)
        self._seen: dict[str, int] = {}
        self._is_current, self._has_warned = True, False
        kind, size = model.geom_type[geoms], model.geom_size[geoms].copy()
        is_field, is_plane = kind == _HFIELD, kind == _PLANE
        size[is_field] = model.hfield_size[model.geom_dataid[geoms[is_field]], :3]
        size[is_plane, 2] = 0.0
        # A plane of size 0 has no end.
        size[:, :2][size[:, :2] == 0.0] = np.inf
        # Height of the ground if it is one endless plane.
        self._level = pos[0, 2] if len(geoms) == 1 and np.isinf(size[0, :2]).all() else None
        order = np.argsort(-(pos + size)[:, 2], kind="stable")
        geoms, pos, size, is_field = geoms[order], pos[order], size[order], is_field[order]
        low, high = (pos - size)[:, :2], (pos + size)[:, :2]
        origin = low.min(axis=0, initial=0.0, where=np.isfinite(low))
        extent = high.max(axis=0, initial=0.0, where=np.isfinite(high)) - origin
        self._edge = max(_CELL, math.sqrt(extent.prod() / _MAX_CELLS))
        # The cells along the border stand for everything beyond.
        self._origin = origin - self._edge
        self._shape = np.ceil(extent / self._edge).astype(int) + 2

        low, high = (low - self._origin) / self._edge, (high - self._origin) / self._edge
        # Areas of cells that geoms touch, [start, end) along x and y.
        start = np.clip(np.floor(low - 1e-6), 0, self._shape).astype(int)
        end = np.clip(np.floor(high + 1e-6) + 1, 0, self._shape).astype(int)
        cells = np.arange(self._shape.prod())
        grid = cells.reshape(self._shape)
        touched = [grid[a:c, b:d].ravel() for (a, b), (c, d) in zip(start, end, strict=True)]
        cell = np.concatenate(touched)
        entries = np.repeat(np.arange(len(geoms)), [len(area) for area in touched])
        entries = entries[np.argsort(cell, kind="stable")]
        count = np.bincount(cell, minlength=len(cells))
        ends = count.cumsum()
        # Lists end with an entry for no geom, whose values are NaN, so that nothing is met there.
        self._entries = np.insert(entries, ends, len(geoms)).astype(np.int32)
        self._first = ends - count + cells
        # Boxes are listed by their surface, a field by its summit.
        highest, place = self._entries[self._first], np.stack(np.unravel_index(cells, self._shape))
        covers = np.append(~is_field, False)[highest] | (count == 1)
        covers &= (place >= low.T.take(highest, axis=1, mode="clip")).all(axis=0)
        covers &= (place + 1 <= high.T.take(highest, axis=1, mode="clip")).all(axis=0)
        self._covering = np.where(covers, highest, len(geoms))
        self._geoms = np.append(geoms, -1).astype(np.int32)
        self._is_field = np.append(is_field, False)
        self._pos = np.column_stack((pos.T, [np.nan] * 3))
        self._size = np.column_stack((size.T, [np.nan] * 3))
        is_box = np.append(kind[order] == _BOX, False)
        self._bottom = np.where(is_box, self._pos[2] - self._size[2], np.nan)
        self._top = self._pos[2] + self._size[2]

    def cast(self, origins: Array, hits: Hits) -> None:
        """Cast rays straight down from `origins` (n, R, 3) into `hits`."""
        if self._level is not None:
            # 0.5 to 0.7 of the time that `sim.sense` takes otherwise (G1 and Go1 on flat ground).
            gaps = origins[..., 2].astype(np.float64) - self._level
            hits.distances[:], hits.geoms[:] = gaps, self._geoms[0]
            hits.normals[:] = np.tile(_UP, (origins.shape[1], 1))
            hits.forget(~((gaps >= 0.0) & (gaps < np.inf)))
            return
        points = np.ascontiguousarray(origins.reshape(-1, 3).T, dtype=np.float64)
        x, y = (points[:2] - self._origin[:, None]) / self._edge
        # Positions that are NaN are beyond the border too.
        x = np.fmin(np.fmax(x, 0.0), self._shape[0] - 1).astype(np.int64)
        y = np.fmin(np.fmax(y, 0.0), self._shape[1] - 1).astype(np.int64)
        cell = x * self._shape[1] + y
        met = self._covering.take(cell)
        hits.normals[:] = np.tile(_UP, (origins.shape[1], 1))
        normals = hits.normals.reshape(-1, 3)
        # Most rays start above a geom that covers their cell.
        distance = self._gaps(met, points, normals)
        rays = np.flatnonzero(~(distance >= 0.0))
        distance[rays], met[rays], normals[rays] = np.inf, -1, _UP
        entry = self._first[cell[rays]]
        while len(rays):
            geom, starts = self._entries[entry], points.take(rays, axis=1)
            normal = np.tile(_UP, (len(rays), 1))
            gap = self._gaps(geom, starts, normal)
            # From within a box, rays meet its bottom.
            is_below = gap < 0.0
            gap[is_below] = (starts[2] - self._bottom[geom])[is_below]
            normal[is_below] *= -1.0
            local = (starts - self._pos.take(geom, axis=1))[:2]
            is_nearer = (np.abs(local) <= self._size.take(geom, axis=1)[:2]).all(axis=0)
            is_nearer &= (gap >= 0.0) & (gap < distance[rays])
            chosen = rays[is_nearer]
            distance[chosen], met[chosen] = gap[is_nearer], geom[is_nearer]
            normals[chosen] = normal[is_nearer]
            entry += 1
            goes_on = starts[2] - self._top[self._entries[entry]] < distance[rays]
            rays, entry = rays[goes_on], entry[goes_on]
        hits.distances[:] = distance.reshape(hits.distances.shape)
        hits.geoms[:] = self._geoms.take(met).reshape(hits.geoms.shape)
        hits.forget(~np.isfinite(hits.distances))

    def _gaps(self, geom: Array, points: Array, normals: Array) -> Array:
        """Return heights (m,) of `points` (3, m) above the tops of `geom`; set normals of fields."""
        gaps = (points[2] - self._pos[2].take(geom)) - self._size[2].take(geom)
        on_field = np.flatnonzero(self._is_field.take(geom))
        if len(on_field):
            geom = geom[on_field]
            local = points.take(on_field, axis=1) - self._pos.take(geom, axis=1)
            height, (slope_x, slope_y) = _elevation(self._model, self._geoms.take(geom), local[:2])
            gaps[on_field] = local[2] - height
            up = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
            normals[on_field] = np.column_stack((-slope_x * up, -slope_y * up, up))
        return gaps

    def is_current(self, fields: Mapping[str, torch.Tensor]) -> bool:
        """Return whether static geoms are as compiled in every environment.

        `fields` are the per-environment model fields, (N, ...), compared only after a write. Other
        fields, and what these hold of other geoms, may differ; of colors only transparency counts.
        """
        versions = {name: fields[name]._version for name in self._compiled if name in fields}
        if versions != self._seen:
            self._seen = versions
            differing = [name for name in versions if self._differs(name, fields[name])]
            self._is_current = not differing
            if differing and not self._has_warned:
                self._has_warned = True
                logger.warning(
                    "Rays try every geom of the model from now on, which is much slower: the field "
                    "%r of geoms that never move, such as the ground, differs between environments "
                    "or from the compiled model. Randomize it for things that move only "
                    "(asset_cfg).",
                    differing[0],
                )
        return self._is_current

    def _differs(self, name: str, field: torch.Tensor) -> bool:
        ids, compiled = self._compiled[name]
        own = field[:, ids].numpy()
        if name.endswith("rgba"):
            own, compiled = own[..., 3] == 0.0, compiled[:, 3] == 0.0
        return bool((own != compiled.astype(own.dtype)).any())


def _static_fields(model: mujoco.MjModel, geoms: Array) -> dict[str, tuple[Array, Array]]:
    """Return by field the ids on which places and looks of static `geoms` depend, and values."""
    chain = [model.geom_bodyid[geoms]]
    while chain[-1].any():
        chain.append(model.body_parentid[chain[-1]])
    bodies, materials = np.unique(chain), model.geom_matid[geoms]
    ids = dict.fromkeys(("geom_pos", "geom_quat", "geom_size", "geom_dataid", "geom_matid"), geoms)
    ids |= {"body_pos": bodies, "body_quat": bodies, "geom_rgba": geoms[materials < 0]}
    ids |= {"mat_rgba": np.unique(materials[materials >= 0])}
    return {name: (index, getattr(model, name)[index]) for name, index in ids.items()}
