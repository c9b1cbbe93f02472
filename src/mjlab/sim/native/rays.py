"""Ray casting on the native engine: `Batch.ray` with the culling of `Engine.raycast`, ground table.

`mj_ray` tests every geom of the model for every ray, and generated terrain has hundreds of geoms.
Vertical downward rays onto boxes, height fields and planes use `GroundTable` instead.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError

from mjlab.sim.engine import NUM_GEOM_GROUPS

if TYPE_CHECKING:
    from mjlab.sim.engine import Engine, RayHits, RayQuery

logger = logging.getLogger(__name__)

Array = np.ndarray
Passed = Callable[[Array, Array, Array, "Hits"], Array]
"""Predicate of hits to ignore: (rows, origins, directions, hits) -> (n, R) bool."""

_T = mujoco.mjtGeom
_PLANE, _HFIELD, _BOX, _MESH = (
    int(kind) for kind in (_T.mjGEOM_PLANE, _T.mjGEOM_HFIELD, _T.mjGEOM_BOX, _T.mjGEOM_MESH)
)

_UP = np.array((0.0, 0.0, 1.0), dtype=np.float32)
# Maximum number of ignored surfaces per ray; the next one ends the ray.
_MAX_PASSES = 8
# Restart offset of rays behind an ignored surface: absolute (m), relative to float32 coordinates.
_BEHIND, _BEHIND_RELATIVE = 1e-5, 1e-6
# A hit within this distance (m) of zero elevation may be on the base of a height field. The hit is
# on the base if the surface is at least this far (m) above.
_BASE_TOLERANCE, _SURFACE_TOLERANCE = 1e-5, 1e-4
# Cosine below which a face of a height field is a side or the base.
_SIDE = 1e-9
# Edge of a ground cell (m), and maximum number of cells.
_CELL, _MAX_CELLS = 0.1, 1_000_000
# With other visible geoms present, testing fewer ground geoms than this is faster than the table.
_MIN_GEOMS = 12


class NativeRays:
    """Ray caster of a native engine."""

    def __init__(self, engine: Engine, model: mujoco.MjModel, batch: Batch) -> None:
        """Cast rays in `batch`, the simulations of `model` run by `engine`."""
        self._engine, self._model, self._batch = engine, model, batch
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._pos, self._mat = data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()
        self._rule = CullingRule(model, np.arange(model.ngeom))
        roots = model.body_rootid[model.geom_bodyid]
        # MuJoCo treats geoms of mocap bodies as static.
        self._is_carried = model.body_mocapid[roots] >= 0
        self._fields_are_carried = self._is_carried[model.geom_type == _HFIELD].any()
        self._tables: dict[Any, tuple[GroundTable | None, bool]] = {}

    def cast(self, query: RayQuery) -> RayHits:
        """Cast rays; see `Engine.raycast`."""
        if query.env_ids is None:
            hits = self._hits(query, None)
        else:
            ids = query.env_ids
            rows = replace(query, origins=query.origins[ids], directions=query.directions[ids])
            hits = Hits.misses(*query.origins.shape[:2])
            hits[ids.numpy()] = self._hits(rows, ids.numpy())
        distances, normals = torch.from_numpy(hits.distances), torch.from_numpy(hits.normals)
        return distances, normals, torch.from_numpy(hits.geoms)

    def _hits(self, query: RayQuery, env_ids: Array | None) -> Hits:
        """Cast rays. Row i belongs to environment `env_ids[i]`; None: i."""
        directions, table, has_others = query.directions.numpy(), None, True
        groups = range(NUM_GEOM_GROUPS) if query.geom_groups is None else query.geom_groups
        mask = np.isin(np.arange(NUM_GEOM_GROUPS), groups).astype(np.uint8)
        ids = query.exclude_body_ids
        excluded = np.array([-1]) if ids is None else ids.numpy()
        options = {"geomgroup": mask, "bodyexclude": excluded}
        # Compare whole rows: broadcasting over a last dimension of 3 takes ten times as long.
        if (directions == np.tile(-_UP, (directions.shape[1], 1))).all():
            bodies = np.unique(excluded)
            key = query.geom_groups, bodies.tobytes()
            if key not in self._tables:
                self._tables[key] = self._ground(mask, bodies)
            table, has_others = self._tables[key]
        if table is None or not table.is_current(self._engine.model_fields):
            hits = self._cast_in_batch(query, env_ids, flg_static=True, **options)
        else:
            hits = table.cast(query.origins.numpy())
            if has_others:
                others = self._cast_in_batch(query, env_ids, flg_static=False, **options)
                hits.take_nearer(others)
        if query.max_distances is not None:
            hits.forget(hits.distances > query.max_distances.numpy())
        return hits

    def _ground(self, groups: Array, excluded: Array) -> tuple[GroundTable | None, bool]:
        """Return a table of all visible static geoms, and True if other geoms are visible.

        `groups` is the mask of visible groups, (6,), `excluded` are the ids of bodies to ignore. The
        table is None if it cannot hold all these geoms, or would not be faster.
        """
        model = self._model
        in_groups = groups[model.geom_group.clip(0, 5)].astype(bool)
        welded = in_groups & (model.body_weldid[model.geom_bodyid] == 0)
        carried = welded & self._is_carried
        others = bool((in_groups & ~welded).any() or model.nflex)
        static = np.flatnonzero(welded & ~carried)
        # As in MuJoCo, alpha of a material takes precedence over that of its geoms.
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

    def _cast_in_batch(self, query: RayQuery, env_ids: Array | None, **options: Any) -> Hits:
        """Cast against the geoms of the model. `options` are arguments of `Batch.ray`."""
        origins, directions = query.origins.numpy(), query.directions.numpy()
        pos, mat = (np.broadcast_to(x, (len(origins), *x.shape)) for x in (self._pos, self._mat))
        if self._fields_are_carried:
            field = self._engine.data_field
            rows = slice(None) if env_ids is None else env_ids
            pos, mat = field("geom_xpos").numpy()[rows], field("geom_xmat").numpy()[rows]

        def passed(rows: Array, origins: Array, directions: Array, hits: Hits) -> Array:
            return self._rule.passed(origins, directions, hits, hits.geoms, rows, pos, mat)

        rule = passed if self._rule.is_needed else None
        return cast_through(self._batch, origins, directions, rule, env_ids, **options)


@dataclass
class Hits:
    """Ray hits: distances (n, R), normals (n, R, 3), geom ids (n, R); -1, 0 and -1 on a miss."""

    distances: Array
    normals: Array
    geoms: Array

    @classmethod
    def misses(cls, rows: int, rays: int) -> Hits:
        """Return misses."""
        normals = np.zeros((rows, rays, 3), np.float32)
        misses = np.full((rows, rays), -1, np.int32)
        return cls(misses.astype(np.float32), normals, misses)

    def __getitem__(self, rows: Any) -> Hits:
        return Hits(self.distances[rows], self.normals[rows], self.geoms[rows])

    def __setitem__(self, rows: Any, other: Hits) -> None:
        self.distances[rows], self.normals[rows] = other.distances, other.normals
        self.geoms[rows] = other.geoms

    def forget(self, where: Array) -> None:
        """Set the rays in the mask `where`, (n, R) bool, to misses."""
        if where.any():
            self.distances[where], self.normals[where], self.geoms[where] = -1.0, 0.0, -1

    def take_nearer(self, other: Hits) -> None:
        """Replace hits with those of `other` that are nearer."""
        is_nearer = (other.distances < self.distances) | (self.distances < 0.0)
        is_nearer &= other.distances >= 0.0
        self[is_nearer] = other[is_nearer]


def cast_through(
    batch: Batch,
    origins: Array,
    directions: Array,
    passed: Passed | None,
    env_ids: Array | None = None,
    **options: Any,
) -> Hits:
    """Cast rays in n simulations, passing through ignored surfaces.

    Rays of simulations in which MuJoCo raises are misses.

    Args:
        batch: Simulations.
        origins: World positions (m), (n, R, 3).
        directions: Unit vectors, (n, R, 3).
        passed: Predicate of hits to ignore. None: ignore none.
        env_ids: Simulation of each row, (n,). None: the first n.
        options: Further arguments of `Batch.ray`.
    """
    rows = np.arange(len(origins))
    ids = rows if env_ids is None else env_ids
    hits = found = _cast(batch, ids, origins, directions, options)
    if passed is None:
        return hits
    gone = np.zeros_like(hits.distances)
    for passes in range(_MAX_PASSES + 1):
        repeat = passed(rows, origins, directions, found)
        chosen = repeat.any(axis=1)
        if not chosen.any():
            break
        rows, origins, directions = rows[chosen], origins[chosen], directions[chosen]
        repeat, found, gone = repeat[chosen], found[chosen], gone[chosen]
        if passes == _MAX_PASSES:
            found.forget(repeat)
        else:
            behind = _BEHIND + _BEHIND_RELATIVE * np.abs(origins).max(axis=-1)
            step = np.where(repeat, found.distances + behind, 0.0).astype(np.float32)
            origins, gone = origins + step[..., None] * directions, gone + step
            found = _cast(batch, ids[rows], origins, directions, options)
        hits[rows] = found
        hits.distances[rows] += np.where(found.distances >= 0.0, gone, 0.0)
    return hits


def _cast(
    batch: Batch, rows: Array, origins: Array, directions: Array, options: dict[str, Any]
) -> Hits:
    """Cast rays, (n, R, 3), in the simulations `rows`, (n,)."""
    try:
        distances, geoms, normals = batch.ray(origins, directions, ids=rows, normal=True, **options)
    except SimulationError as error:
        # MuJoCo's error discards the results of all simulations, so cast the good ones again.
        good = ~np.isin(rows, error.ids)
        hits = Hits.misses(*origins.shape[:2])
        hits[good] = _cast(batch, rows[good], origins[good], directions[good], options)
        return hits
    return Hits(distances.astype(np.float32), normals.astype(np.float32), geoms)


class CullingRule:
    """Rule to cull surfaces that MuJoCo's C code hits and MuJoCo Warp does not.

    Meshes and height fields are hit from outside only, and height fields on their top only: sides
    and base are ignored.
    """

    def __init__(self, model: mujoco.MjModel, ids: Array) -> None:
        """Cull hits on the geoms `ids`, (G,), given as indices into `ids`; -1 and G are misses."""
        self._model, self._ids = model, ids
        self.is_field = np.append(model.geom_type[ids] == _HFIELD, False)
        self._is_one_sided = self.is_field | np.append(model.geom_type[ids] == _MESH, False)
        self.is_needed = bool(self._is_one_sided.any())
        """True if any geom is a mesh or a height field."""

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
        """Return hits to ignore, (n, R) bool.

        Args:
            origins: World positions (m), (n, R, 3).
            directions: Unit vectors, (n, R, 3).
            hits: Ray hits.
            geoms: Indices of the hit geoms, (n, R).
            envs: Environment of each row, (n,).
            pos: Geom positions, (N, G, 3). Only those of height fields are read.
            mat: Geom orientations, (N, G, 3, 3).
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
        # Rays from below the surface hit the base, whose normal is that of flat ground.
        is_low = np.abs(local[2]) < _BASE_TOLERANCE
        surface, _ = _elevation(self._model, self._ids[fields[is_low]], local[:2, is_low])
        is_low[is_low] = surface > _SURFACE_TOLERANCE
        passed[at] = (up <= _SIDE) | is_low
        return passed


def _elevation(model: mujoco.MjModel, geoms: Array, local: Array) -> tuple[Array, Array]:
    """Return heights (m,) and slopes (2, m) of height fields `geoms` at local x, y (2, m).

    Each cell is two triangles, split from first to last corner.
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
    """Spatial grid of static, upright boxes, height fields and planes for vertical downward rays.

    The xy plane is divided into square cells, each with a list of geoms, highest first. Results
    equal those of `mj_ray` except for the last bit of distances. On generated terrain (Go1 rough,
    1,024 environments) a lookup takes a hundredth of the CPU time of `Batch.ray`.
    """

    def __init__(self, model: mujoco.MjModel, geoms: Array, pos: Array, static: Array) -> None:
        """Sort `geoms` at `pos`, (G, 3), into cells.

        The table is valid while the geoms `static`, visible or not, are as compiled.
        """
        self._model = model
        self._compiled = _static_fields(model, static)
        self._seen: dict[str, int] = {}
        self._is_current, self._has_warned = True, False
        kind, size = model.geom_type[geoms], model.geom_size[geoms].copy()
        is_field, is_plane = kind == _HFIELD, kind == _PLANE
        size[is_field] = model.hfield_size[model.geom_dataid[geoms[is_field]], :3]
        size[is_plane, 2] = 0.0
        # Planes of size 0 are infinite.
        size[:, :2][size[:, :2] == 0.0] = np.inf
        # Ground height if the ground is one infinite plane.
        self._level = pos[0, 2] if len(geoms) == 1 and np.isinf(size[0, :2]).all() else None
        order = np.argsort(-(pos + size)[:, 2], kind="stable")
        geoms, pos, size, is_field = geoms[order], pos[order], size[order], is_field[order]
        low, high = (pos - size)[:, :2], (pos + size)[:, :2]
        origin = low.min(axis=0, initial=0.0, where=np.isfinite(low))
        extent = high.max(axis=0, initial=0.0, where=np.isfinite(high)) - origin
        self._edge = max(_CELL, math.sqrt(extent.prod() / _MAX_CELLS))
        # Border cells include everything beyond the border.
        self._origin = origin - self._edge
        self._shape = np.ceil(extent / self._edge).astype(int) + 2

        low, high = (low - self._origin) / self._edge, (high - self._origin) / self._edge
        # Cell ranges of geoms, [start, end) along x and y.
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
        # Lists end with a sentinel of NaN values, so rays miss it.
        self._entries = np.insert(entries, ends, len(geoms)).astype(np.int32)
        self._first = ends - count + cells
        # Boxes are sorted by their top surface, height fields by their highest possible point.
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

    def cast(self, origins: Array) -> Hits:
        """Cast downward rays from `origins`, (n, R, 3)."""
        shape, normals = origins.shape[:2], np.zeros(origins.shape, np.float32)
        normals[..., 2] = 1.0
        if self._level is not None:
            # Reduces the time of `sim.sense` to 0.5 to 0.7 (G1 and Go1 on flat ground).
            gaps = origins[..., 2].astype(np.float64) - self._level
            hits = Hits(gaps.astype(np.float32), normals, np.full(shape, self._geoms[0]))
            hits.forget(~((gaps >= 0.0) & (gaps < np.inf)))
            return hits
        points = np.ascontiguousarray(origins.reshape(-1, 3).T, dtype=np.float64)
        x, y = (points[:2] - self._origin[:, None]) / self._edge
        # NaN positions go to a border cell.
        x = np.fmin(np.fmax(x, 0.0), self._shape[0] - 1).astype(np.int64)
        y = np.fmin(np.fmax(y, 0.0), self._shape[1] - 1).astype(np.int64)
        cell = x * self._shape[1] + y
        met = self._covering.take(cell)
        by_ray = normals.reshape(-1, 3)
        # Most rays start above a geom that covers their cell. Without this, a lookup takes twice as
        # long (Go1 rough).
        distance = self._gaps(met, points, by_ray)
        rays = np.flatnonzero(~(distance >= 0.0))
        distance[rays], met[rays], by_ray[rays] = np.inf, -1, _UP
        entry = self._first[cell[rays]]
        while len(rays):
            geom, starts = self._entries[entry], points.take(rays, axis=1)
            normal = np.tile(_UP, (len(rays), 1))
            gap = self._gaps(geom, starts, normal)
            # Rays from inside a box hit its bottom.
            is_below = gap < 0.0
            gap[is_below] = (starts[2] - self._bottom[geom])[is_below]
            normal[is_below] *= -1.0
            local = (starts - self._pos.take(geom, axis=1))[:2]
            is_nearer = (np.abs(local) <= self._size.take(geom, axis=1)[:2]).all(axis=0)
            is_nearer &= (gap >= 0.0) & (gap < distance[rays])
            chosen = rays[is_nearer]
            distance[chosen], met[chosen] = gap[is_nearer], geom[is_nearer]
            by_ray[chosen] = normal[is_nearer]
            entry += 1
            goes_on = starts[2] - self._top[self._entries[entry]] < distance[rays]
            rays, entry = rays[goes_on], entry[goes_on]
        distances = distance.astype(np.float32).reshape(shape)
        hits = Hits(distances, normals, self._geoms.take(met).reshape(shape))
        hits.forget(~np.isfinite(distances))
        return hits

    def _gaps(self, geom: Array, points: Array, normals: Array) -> Array:
        """Return heights (m,) of `points` (3, m) above `geom`; set normals of height fields."""
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
        """Return True if static geoms are as compiled in every environment.

        `fields` are the per-environment model fields, (N, ...), compared only after a write. Other
        fields, and values of other geoms, may differ. Of colors, only transparency is compared.
        """
        versions = {name: fields[name]._version for name in self._compiled if name in fields}
        if versions != self._seen:
            self._seen = versions
            differing = []
            for name in versions:
                ids, compiled = self._compiled[name]
                own = fields[name][:, ids].numpy()
                if name.endswith("rgba"):
                    own, compiled = own[..., 3] == 0.0, compiled[:, 3] == 0.0
                if (own != compiled.astype(own.dtype)).any():
                    differing.append(name)
            self._is_current = not differing
            if differing and not self._has_warned:
                self._has_warned = True
                logger.warning(
                    "Ray casting now tests every geom of the model and is much slower: field %r of "
                    "static geoms, such as the ground, differs between environments or from the "
                    "compiled model. Randomize this field for moving entities only (asset_cfg).",
                    differing[0],
                )
        return self._is_current


def _static_fields(model: mujoco.MjModel, geoms: Array) -> dict[str, tuple[Array, Array]]:
    """Return ids and compiled values of the fields that place and color static `geoms`."""
    chain = [model.geom_bodyid[geoms]]
    while chain[-1].any():
        chain.append(model.body_parentid[chain[-1]])
    bodies, materials = np.unique(chain), model.geom_matid[geoms]
    ids = dict.fromkeys(("geom_pos", "geom_quat", "geom_size", "geom_dataid", "geom_matid"), geoms)
    ids |= {"body_pos": bodies, "body_quat": bodies, "geom_rgba": geoms[materials < 0]}
    ids |= {"mat_rgba": np.unique(materials[materials >= 0])}
    return {name: (index, getattr(model, name)[index]) for name, index in ids.items()}
