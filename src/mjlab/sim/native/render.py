"""Native renderer: ray casting through pixels, with the shading of MuJoCo Warp's renderer.

OpenGL and a display are not required. An image is divided into tiles. Each tile is a small
simulation with copies of the geoms visible in the tile. Coordinates are in the camera frame, with x
right, y up and the camera looking along -z, so rays stay the same between calls.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from mjlab.sim.engine import BACKGROUND, LENS_FIELDS, CameraView, Engine, Images, rendered_geoms
from mjlab.sim.native.rays import CullingRule, Hits, Passed, cast_through
from mjlab.sim.native.shading import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    HFIELD,
    KINDS,
    MESH,
    PLANE,
    SPHERE,
    Geoms,
    ReadField,
    Shading,
    Surfaces,
    of_materials,
)
from mjlab.utils.lab_api.math import matrix_from_quat, quat_conjugate, quat_from_matrix, quat_mul

# Number of rays cast and shaded at a time: their data fits into the CPU caches.
_RAYS_AT_A_TIME = 131_072
_GEOM_TYPE = int(mujoco.mjtObj.mjOBJ_GEOM)

MakeBatch = Callable[..., Batch]
"""Factory `make_batch(model, count, num_threads=...)` of batches; `num_threads` is optional."""


class NativeRenderer:
    """Renderer of a native engine's cameras. Environments are distributed over threads."""

    def __init__(
        self, engine: Engine, model: mujoco.MjModel, num_threads: int, make_batch: MakeBatch
    ) -> None:
        """Create a renderer for the environments of `engine`, a simulation of `model`.

        Images do not depend on `num_threads`.
        """
        self._engine, self._model = engine, model
        self._num_workers = min(num_threads, engine.num_envs)
        self._make_batch = partial(make_batch, num_threads=num_threads // self._num_workers)
        self._shared: dict[str, Tensor] = {}
        self._views: dict[CameraView, list[_View]] = {}
        self._pool = ThreadPoolExecutor(self._num_workers, "render")

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render views at the poses in derived fields; see `Engine.render`."""
        # Bind on this thread: binding a new field runs the engine.
        for name in ("xpos", "xquat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir"):
            self._engine.data_field(name)
        # Torch's threads wait by spinning, and would compete with the render threads.
        threads, default = torch.get_num_threads(), torch.get_default_dtype()
        torch.set_num_threads(1)
        torch.set_default_dtype(torch.float32)
        try:
            by_view = [self._workers(view) for view in views]
            tasks = [task for workers in by_view for task in enumerate(workers)]
            list(self._pool.map(self._work, tasks))
        finally:
            torch.set_num_threads(threads)
            torch.set_default_dtype(default)
        return [workers[0].images for workers in by_view]

    def _workers(self, view: CameraView) -> list[_View]:
        """Return the renderers of a view, one per thread, with shared images."""
        if view not in self._views:
            with torch.inference_mode(False):
                images = Images.empty(view, self._engine.num_envs, "cpu")
            share = -(-self._engine.num_envs // self._num_workers)
            self._views[view] = [
                _View(self._model, view, images, share, self._make_batch)
                for _ in range(self._num_workers)
            ]
        return self._views[view]

    def _work(self, task: tuple[int, _View]) -> None:
        """Render the environments of a worker, `task` = (worker index, view)."""
        number, view = task
        torch.set_num_threads(1)
        lens_varies = not LENS_FIELDS.isdisjoint(self._engine.model_fields)
        num_envs, step = self._engine.num_envs, view.envs_at_a_time
        # Later calls, in any mode, write into tensors created here.
        with torch.inference_mode(False), torch.no_grad():
            for start in range(number * step, num_envs, self._num_workers * step):
                envs = slice(start, min(start + step, num_envs))
                view.render(envs, partial(self._read, envs), lens_varies)

    def _read(self, envs: slice, name: str) -> Tensor:
        if name in self._engine.model_fields:
            return self._engine.model_fields[name][envs]
        if not hasattr(self._model, name):
            return self._engine.data_field(name)[envs]
        if name not in self._shared:
            values = torch.tensor(getattr(self._model, name)[None])
            self._shared[name] = values.float() if values.is_floating_point() else values
        return self._shared[name]


def render_problem(model: mujoco.MjModel) -> str | None:
    """Return an error message if cameras do not support the model; None if they do."""
    kinds = set(model.geom_type.tolist()) - KINDS
    names = sorted(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in kinds)
    if model.nflex:
        names.append("flexes")
    if not names:
        return None
    return (
        f"The cameras of the native engine do not see {', '.join(names)} of this model; remove them "
        "or the camera sensors, or use --engine warp (SimulationCfg.engine='warp')."
    )


class _View:
    """Renderer of one view on one thread."""

    def __init__(
        self,
        model: mujoco.MjModel,
        view: CameraView,
        images: Images,
        num_envs: int,
        make_batch: MakeBatch,
    ) -> None:
        """Allocate buffers to render at most `num_envs` environments at a time into `images`."""
        self.images = images
        self._model, self._view = model, view
        self._lens = _Lens(model, view)
        # Last geom first: among surfaces at equal distance, rays report the first.
        self._ids = torch.tensor([*rendered_geoms(model, view.geom_groups)[::-1], BACKGROUND])
        kinds = torch.tensor(model.geom_type)[self._ids[:-1]]
        self._sight = _Sight(model, self._ids[:-1], kinds, self._lens)
        # Far plane (m). 0: unlimited.
        self._far = float(model.vis.map.zfar * model.stat.extent) or np.inf
        self.envs_at_a_time = min(num_envs, max(1, _RAYS_AT_A_TIME // self._lens.num_rays))
        make_slots, rows = partial(_Slots, model, kinds, make_batch), self.envs_at_a_time
        self._slots = make_slots(rows * self._lens.num_tiles, self._lens.tile_rays)
        # Shadow rays test all geoms, not only those visible in a tile.
        self._shadow_slots = make_slots(rows, self._lens.num_rays) if view.use_shadows else None
        self._shading = Shading(model, kinds, view.use_textures)
        self._aimed: _Rays | None = None
        self._rule = CullingRule(model, self._ids[:-1].numpy())
        self._has_fields = HFIELD in kinds
        self._has_backs = self._rule.is_needed or self._lens.is_orthographic

    def render(self, envs: slice, read: ReadField, lens_varies: bool) -> None:
        """Render the environments `envs`; `read` returns their fields.

        `lens_varies`: rays differ between environments.
        """
        view, lens, images, slots = self._view, self._lens, self.images, self._slots
        pos, mat = read("cam_xpos")[:, view.camera_id], read("cam_xmat")[:, view.camera_id]
        rays = lens.rays_of(read) if lens_varies else lens.rays
        geoms = self._sight.pose(read, pos, mat)
        n = len(pos)
        rows = n * lens.num_tiles
        slots.load(geoms, self._sight.by_tile(geoms, rays).reshape(rows, -1))
        if self._aimed is not rays:
            self._aimed = rays
            slots.aim(rays.directions, rays.origins)
        passed = self._passed(geoms, slots) if self._has_backs else None
        hits = slots.cast(rows, passed)
        distances = torch.from_numpy(hits.distances).view(n, -1)
        depth = -distances * rays.directions[..., 2]
        missed = ~((depth >= 0.0) & (depth <= self._far))
        if images.depth is not None:
            lens.copy_to_image(depth.masked_fill(missed, 0.0)[..., None], images.depth[envs])
        columns = slots.columns(slice(rows), hits.geoms).view(n, -1)
        columns.masked_fill_(missed, len(self._ids) - 1)
        if images.segmentation is not None:
            ids = self._ids[columns].int()
            kinds = torch.where(ids == BACKGROUND, BACKGROUND, _GEOM_TYPE)
            lens.copy_to_image(torch.stack((ids, kinds.int()), dim=-1), images.segmentation[envs])
        if images.rgb is not None:
            directions = rays.directions.permute(2, 0, 1).contiguous()
            points = directions * distances
            if rays.origins is not None:
                points += rays.origins.permute(2, 0, 1)
            normals = torch.from_numpy(hits.normals).view(n, -1, 3).permute(2, 0, 1)
            met = Surfaces(directions, points, normals.contiguous(), columns)
            shadow = self._shadow_slots and self._shadow_of(geoms, self._shadow_slots)
            rgb = self._shading.shade(met, geoms, pos, mat, read, shadow)
            lens.copy_to_image(rgb, images.rgb[envs])

    def _passed(self, geoms: Geoms, slots: _Slots, *, is_shadow: bool = False) -> Passed:
        """Return a predicate of hits to ignore: those on back faces of `geoms`.

        A pinhole camera sees back faces of a convex geom only from inside the geom, and such geoms
        are culled. So back faces are tested per hit for meshes, height fields and parallel rays
        only. For shadow rays, only height fields are culled: only their top casts shadows.
        """
        rows_per_env = slots.num_rows // self.envs_at_a_time
        pos, mat = geoms.pos.numpy(), geoms.mat.numpy()

        def passed(rows: np.ndarray, origins: np.ndarray, directions: np.ndarray, hits: Hits):
            met, envs = slots.columns(rows, hits.geoms).numpy(), rows // rows_per_env
            backs = self._rule.passed(origins, directions, hits, met, envs, pos, mat)
            if is_shadow:
                return backs & self._rule.is_field[met]
            return backs | (np.einsum("...k,...k", hits.normals, directions) > 0.0)

        return passed

    def _shadow_of(self, geoms: Geoms, slots: _Slots) -> Callable[..., Tensor]:
        """Return a function that casts shadow rays."""
        n = len(geoms.pos)
        slots.load(geoms, geoms.exists)
        passed = self._passed(geoms, slots, is_shadow=True) if self._has_fields else None

        def shadow(origins: Tensor, directions: Tensor, limit: Tensor) -> Tensor:
            slots.aim(directions.permute(1, 2, 0), origins.permute(1, 2, 0))
            distances = torch.from_numpy(slots.cast(n, passed).distances)
            return (distances >= 0.0) & (distances < limit)

        return shadow


# Approximate edge of a tile (pixels): smaller tiles see fewer geoms, but each tile has overhead. On
# the YAM task, one tile per image takes 1.4 times as long for depth, 1.3 times for depth and
# segmentation.
_TILE = 8


@dataclass
class _Rays:
    """Rays of a camera, sorted into tiles, (n, P). n is 1 if all environments share them."""

    directions: Tensor
    """Unit vectors, (n, P, 3)."""
    origins: Tensor | None
    """Ray origins of an orthographic projection, (n, P, 3). None: all at the camera."""
    planes: Tensor
    """Inward normals of the F planes that bound tiles, (n, 3, F): left sides of columns, right
    sides, top sides of rows, bottom sides."""
    plane_offsets: Tensor
    """Signed distances of the camera from the planes, (n, 1, F)."""


class _Lens:
    """Rays through the centers of pixels, sorted into `rows` x `columns` tiles."""

    def __init__(self, model: mujoco.MjModel, view: CameraView) -> None:
        """Sort the pixels of a view into tiles. Tiles beyond the image repeat its last pixels."""
        width, height = self._size = view.width, view.height
        # Choose tile sizes that leave few repeated pixels.
        tile_width, tile_height = (-(-k // max(1, round(k / _TILE))) for k in self._size)
        self.columns, self.rows = -(-width // tile_width), -(-height // tile_height)
        self.num_tiles, self.tile_rays = self.rows * self.columns, tile_width * tile_height
        self.num_rays = self.num_tiles * self.tile_rays
        x = torch.arange(self.columns * tile_width).clamp(max=width - 1)
        y = torch.arange(self.rows * tile_height).clamp(max=height - 1)
        # Inward normals of the planes in `_Rays`, x and y: to the right, to the left, down, up.
        self._normals = torch.tensor([[1.0, -1, 0, 0], [0, 0, -1, 1]]).repeat_interleave(
            torch.tensor([self.columns, self.columns, self.rows, self.rows]), dim=1
        )
        shape = (self.rows, tile_height, self.columns, tile_width)
        self._tiles = (-1, self.rows, self.columns, tile_height, tile_width)
        pixels = (y[:, None] * width + x[None, :]).view(shape).transpose(1, 2).reshape(-1)
        self._u, self._v = (pixels % width + 0.5) / width, (pixels // width + 0.5) / height
        # Ray index of each pixel of the image. Repeated pixels use one of several equal rays.
        self._place = torch.empty(width * height, dtype=torch.int64)
        self._place[pixels] = torch.arange(len(pixels))
        self._id = view.camera_id
        projection = int(model.cam_projection[self._id])
        self.is_orthographic = projection == int(mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC)
        self._sensor_size = model.cam_sensorsize[self._id].tolist()
        self.rays = self.rays_of(lambda name: torch.tensor(getattr(model, name)[None]).float())
        """Rays shared by all environments, valid unless `LENS_FIELDS` are expanded."""

    def rays_of(self, read: ReadField) -> _Rays:
        """Compute the rays of n environments; `read` returns their fields."""
        left, right, bottom, top = self._frustum(read)
        x, y = left + (right - left) * self._u, top + (bottom - top) * self._v
        one, none = torch.ones_like(x), torch.zeros_like(x)
        if self.is_orthographic:
            directions = torch.stack((none, none, -one), dim=-1)
            origins = torch.stack((x, y, none), dim=-1)
        else:
            directions, origins = torch.stack((x, y, -one), dim=-1), None
            directions /= directions.norm(dim=-1, keepdim=True)
        # The outermost rays of each column and row of tiles.
        x, y = (values.view(self._tiles)[..., [0, -1], [0, -1]] for values in (x, y))
        edges = torch.cat((x[:, 0].mT.flatten(1), y[:, :, 0].mT.flatten(1)), dim=1)
        edges *= self._normals.sum(dim=0)
        normals, none = self._normals.expand(len(edges), -1, -1), torch.zeros_like(edges[:, None])
        if self.is_orthographic:
            return _Rays(directions, origins, torch.cat((normals, none), dim=1), -edges[:, None])
        return _Rays(directions, origins, torch.cat((normals, edges[:, None]), dim=1), none)

    def _frustum(self, read: ReadField) -> tuple[Tensor, ...]:
        """Return left, right, bottom and top of the image, (n, 1).

        At a distance of 1 m for perspective cameras.
        """
        fovy = read("cam_fovy")[:, self._id, None]
        aspect = self._size[0] / self._size[1]
        width, height = self._sensor_size
        if self.is_orthographic or height == 0.0:
            half = 0.5 * fovy if self.is_orthographic else torch.tan(torch.deg2rad(0.5 * fovy))
            return -half * aspect, half * aspect, -half, half
        # Crop the sensor to the aspect ratio of the image.
        width, height = min(width, height * aspect), min(height, width / aspect)
        fx, fy, cx, cy = read("cam_intrinsic")[:, self._id, :, None].unbind(dim=1)
        return (
            (cx - 0.5 * width) / fx,
            (cx + 0.5 * width) / fx,
            -(cy + 0.5 * height) / fy,
            (0.5 * height - cy) / fy,
        )

    def copy_to_image(self, values: Tensor, out: Tensor) -> None:
        """Copy ray values, (n, P, ...), to an image, (n, height, width, ...)."""
        torch.index_select(values, 1, self._place, out=out.view(len(out), -1, *out.shape[3:]))


# Indices of geom sizes that are the half extents, if not (0, 1, 2).
_AXES = {SPHERE: (0, 0, 0), CAPSULE: (0, 0, 1), CYLINDER: (0, 0, 1)}
# Axes along which a convex geom is round.
_ROUND = {SPHERE: (1, 1, 1), CAPSULE: (1, 1, 1), ELLIPSOID: (1, 1, 1), CYLINDER: (1, 1, 0)}
# Default color of geoms. A geom with this color shows its material's color.
_NO_COLOR = (0.5, 0.5, 0.5, 1.0)
# Half extents of infinite geoms (m). Larger values would lose float32 precision of small ones.
_ENDLESS = 1e8
# Slack for rounding: relative to extents and distance, and absolute (m).
_SLACK, _SLACK_METERS = 1e-5, 1e-6


class _Sight:
    """Geoms visible to a camera, and view-frustum culling per tile."""

    def __init__(self, model: mujoco.MjModel, ids: Tensor, kinds: Tensor, lens: _Lens) -> None:
        """Create culling for the geoms `ids`, (G,), of types `kinds`, (G,)."""
        self._ids, self._lens = ids, lens
        self._bodies = torch.tensor(model.geom_bodyid).long()[ids]
        self._round = torch.tensor([_ROUND.get(k, (0, 0, 0)) for k in kinds.tolist()]).view(-1, 3)
        self._is_convex = torch.isin(kinds, torch.tensor((*_ROUND, BOX)))
        self._is_capsule = kinds == CAPSULE
        self._planes = (kinds == PLANE).nonzero().flatten()
        self._axes = torch.tensor([_AXES.get(k, (0, 1, 2)) for k in kinds.tolist()]).view(-1, 3)
        # Center and half extents. Height fields extend from base to top.
        x, y, top, base = model.hfield_size.T
        fields = np.stack((0 * x, 0 * y, (top - base) / 2, x, y, (top + base) / 2), axis=-1)
        self._boxes = [
            ((kinds == kind).nonzero().flatten(), torch.tensor(boxes).float())
            for kind, boxes in ((MESH, model.bvh_aabb[model.mesh_bvhadr]), (HFIELD, fields))
            if kind in kinds
        ]

    def pose(self, read: ReadField, pos: Tensor, mat: Tensor) -> Geoms:
        """Transform the geoms to the frame of a camera at `pos`, (n, 3), and `mat`, (n, 3, 3)."""
        body_quat = read("xquat")[:, self._bodies]
        to_camera = quat_conjugate(quat_from_matrix(mat))[:, None].expand_as(body_quat)
        in_camera = quat_mul(to_camera, body_quat)
        arm = matrix_from_quat(in_camera) @ read("geom_pos")[:, self._ids, :, None]
        quat = quat_mul(in_camera, read("geom_quat")[:, self._ids].expand_as(body_quat))
        size = read("geom_size")[:, self._ids].expand(len(pos), -1, -1)
        dataid = read("geom_dataid")[:, self._ids].expand(len(pos), -1)
        # Geoms absent from an environment's variant have dataid -1 or size 0.
        exists = size[..., 0] > 0.0
        exists[:, self._planes] = True
        # Boxes are computed from per-environment values; `geom_aabb` may be out of date.
        center, half = torch.zeros_like(size), size.gather(-1, self._axes.expand_as(size))
        half[..., 2] += torch.where(self._is_capsule, size[..., 0], 0.0)
        half[:, self._planes, 2] = 0.0
        for columns, boxes in self._boxes:
            exists[:, columns] = dataid[:, columns] >= 0
            box = boxes[dataid[:, columns].long()]
            center[:, columns], half[:, columns] = box.split(3, dim=-1)
        sides = size[:, self._planes, :2]
        half[:, self._planes, :2] = sides.masked_fill(sides <= 0.0, _ENDLESS)
        rgba, material = read("geom_rgba")[:, self._ids], read("geom_matid")[:, self._ids].long()
        has_none = (rgba == torch.tensor(_NO_COLOR)).all(dim=-1) & (material >= 0)
        of_material = of_materials(read("mat_rgba"), material, 0.0)
        rgba = torch.where(has_none[..., None], of_material, rgba)
        return Geoms(
            pos=(read("xpos")[:, self._bodies] - pos[:, None]) @ mat + arm.squeeze(-1),
            quat=quat,
            mat=matrix_from_quat(quat),
            size=size,
            dataid=dataid,
            material=material,
            rgba=rgba,
            center=center,
            half=half,
            exists=exists & (rgba[..., 3] != 0.0),
        )

    def by_tile(self, geoms: Geoms, rays: _Rays) -> Tensor:
        """Return the geoms visible in each tile, (n, rows, columns, G) bool.

        The bounding box of a visible geom is not entirely outside any side of the tile.
        """
        visible = geoms.exists
        if rays.origins is None:
            visible = visible & ~self._contains_camera(geoms)
        middle = geoms.pos + (geoms.mat @ geoms.center[..., None]).squeeze(-1)
        # With shared planes, all environments are one matrix product.
        planes = rays.planes[0] if len(rays.planes) == 1 else rays.planes
        axes = geoms.mat.transpose(-1, -2).reshape(len(geoms.mat), -1, 3)
        along = (axes @ planes).abs_().unflatten(1, (-1, 3))
        reach = (along * geoms.half[..., None]).sum(dim=2)
        reach *= 1.0 + _SLACK
        reach += middle @ planes + rays.plane_offsets
        reach += _SLACK_METERS + _SLACK * middle.abs().amax(dim=-1, keepdim=True)
        inside = (reach >= 0.0) & visible[..., None]
        columns, rows = self._lens.columns, self._lens.rows
        left, right, top, bottom = inside.transpose(1, 2).split((columns, columns, rows, rows), 1)
        return (top & bottom)[:, :, None] & (left & right)[:, None]

    def _contains_camera(self, geoms: Geoms) -> Tensor:
        """Return convex geoms that contain the camera, (n, G) bool; their back faces are culled.

        Along each axis, x is the camera position relative to the extent beyond the core, a point
        (for capsules, a segment). Inside: |x| < 1 along flat axes, and norm < 1 of round axes.
        """
        local = (geoms.pos[..., None, :] @ geoms.mat).squeeze(-2).abs()
        core = torch.zeros_like(geoms.half)
        core[..., 2] = torch.where(self._is_capsule, geoms.size[..., 1], 0.0)
        x = (local - core).clamp_(min=0.0) / (geoms.half - core)
        norm = (x.square() * self._round).sum(dim=-1)
        return self._is_convex & (x < 1.0).all(dim=-1) & (norm < 1.0)


# Factor of allocated to needed slots, to leave room for other camera poses.
_HEADROOM = 1.3
# Group of empty slots, and mask of the groups that rays hit.
_EMPTY, _MASK = 1, np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)


class _Slots:
    """Simulations with copies of the geoms visible in a tile, one simulation per tile.

    Simulations have no bodies, so a query costs only its rays. On the YAM task (32 x 32 pixels, 27
    of 91 geoms in the camera's groups), `Batch.ray` on the environments takes 3.2 to 3.8 times as
    long as a depth image with slots, and 1.4 times as long as a shaded rgb image.
    """

    def __init__(
        self, model: mujoco.MjModel, kinds: Tensor, make_batch: MakeBatch, rows: int, rays: int
    ) -> None:
        """Allocate `rows` simulations of `rays` rays each, for geoms of types `kinds`, (G,)."""
        self._model, self._kinds, self._make_batch = model, kinds, make_batch
        self.num_rows, self._width = rows, 0
        # The batch takes float64.
        self._origins, self._directions = np.zeros((rows, rays, 3)), np.zeros((rows, rays, 3))

    def load(self, geoms: Geoms, in_sight: Tensor) -> None:
        """Load the visible geoms of each row, (rows, G) bool; rows are ordered by environment.

        With fewer rows than simulations, the remaining simulations are unchanged.
        """
        rows, num_geoms = in_sight.shape
        count = in_sight.cumsum(dim=1, dtype=torch.int32)
        self._require(int(count[:, -1:].sum(dim=1).amax()))
        row, column = in_sight.nonzero(as_tuple=True)
        place = row * self._width + count[row, column] - 1
        flat = row.div(rows // len(geoms.pos), rounding_mode="floor") * num_geoms + column
        for name in ("pos", "quat", "size", "dataid"):
            target = self._values[f"geom_{name}"].flatten(0, 1)
            target[place] = getattr(geoms, name).flatten(0, 1)[flat].to(target.dtype)
        self._values["geom_type"].view(-1)[place] = self._kinds[column]
        self._values["geom_group"][:rows] = _EMPTY
        self._values["geom_group"].view(-1)[place] = 0
        # The first entry of each row is slot -1, a miss.
        self._columns[:rows] = num_geoms
        self._columns.view(-1)[place + row + 1] = column

    def _require(self, slots: int) -> None:
        """Allocate at least `slots` slots."""
        if self._width and slots <= self._width:
            return
        self._width = max(1, min(len(self._kinds), int(_HEADROOM * slots) + 1))
        model = _slot_model(self._model, {*self._kinds.tolist()}, self._width)
        self._batch = self._make_batch(model, self.num_rows)
        names = ("geom_pos", "geom_quat", "geom_size", "geom_dataid", "geom_type", "geom_group")
        self._values = {name: torch.from_numpy(self._batch.expand(name)) for name in names}
        self._values["geom_group"].fill_(_EMPTY)
        self._columns = torch.full((self.num_rows, self._width + 1), len(self._kinds))

    def aim(self, directions: Tensor, origins: Tensor | None) -> None:
        """Set the rays of the first n environments, (n, P, 3); of all environments if n is 1."""
        for target, source in ((self._directions, directions), (self._origins, origins)):
            if source is not None:
                n = len(source)
                by_env = torch.from_numpy(target).view(-1, *source.shape[1:])
                by_env[: n if n > 1 else None] = source

    def cast(self, rows: int, passed: Passed | None) -> Hits:
        """Cast the rays of the first `rows` simulations; geom ids of hits are slots.

        `passed` is a predicate of hits to ignore.
        """
        origins, directions = self._origins[:rows], self._directions[:rows]
        return cast_through(self._batch, origins, directions, passed, geomgroup=_MASK)

    def columns(self, rows: Any, slots: np.ndarray) -> Tensor:
        """Return geom indices of `slots`, (m, rays), of some rows; G for -1."""
        return self._columns[rows].gather(1, torch.from_numpy(slots).long() + 1)


def _slot_model(model: mujoco.MjModel, kinds: set[int], slots: int) -> mujoco.MjModel:
    """Compile a world of placeholder geoms, with the meshes and height fields that `kinds` need.

    Raises:
        ValueError: a mesh of `model` does not compile.
    """
    spec = mujoco.MjSpec()
    for _ in range(slots):
        spec.worldbody.add_geom(size=[0.1, 0.1, 0.1])
    for i in range(model.nhfield if HFIELD in kinds else 0):
        rows, columns = int(model.hfield_nrow[i]), int(model.hfield_ncol[i])
        size, flat = model.hfield_size[i], np.zeros(rows * columns)
        spec.add_hfield(name=f"field{i}", nrow=rows, ncol=columns, size=size, userdata=flat)
    for i in range(model.nmesh if MESH in kinds else 0):
        spec.add_mesh(
            name=f"mesh{i}",
            uservert=model.mesh_vert[model.mesh_vertadr[i] :][: model.mesh_vertnum[i]].ravel(),
            userface=model.mesh_face[model.mesh_faceadr[i] :][: model.mesh_facenum[i]].ravel(),
            # Open meshes have no volume.
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
    compiled = spec.compile()
    if HFIELD in kinds:
        compiled.hfield_data[:] = model.hfield_data
    if MESH in kinds:
        # Restore vertices: the compiler centered and rotated them a second time.
        compiled.mesh_vert[:], compiled.mesh_face[:] = model.mesh_vert, model.mesh_face
        target, source = (
            slice(m.mesh_bvhadr[0], m.mesh_bvhadr[-1] + m.mesh_bvhnum[-1])
            for m in (compiled, model)
        )
        for name in ("bvh_child", "bvh_nodeid", "bvh_depth", "bvh_aabb"):
            getattr(compiled, name)[target] = getattr(model, name)[source]
    compiled.geom_sameframe[:] = 0
    # MuJoCo 4 skips geoms whose bounding sphere a ray misses; 0 disables the check.
    compiled.geom_rbound[:] = 0.0
    return compiled
