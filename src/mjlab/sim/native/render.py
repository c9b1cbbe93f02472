"""Rendering on the native engine: rays through the pixels, and a simple shading of what they meet.

No OpenGL and no display are needed. An image is cut into tiles, and the rays of each are cast
against the geoms that are in its sight, in the frame of the camera; so the rays are the same from
call to call, and it does not matter how many geoms there are elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sim.native.camera_colours import MetSurfaces, Shading
from mjlab.sim.native.camera_culling import SurfaceCulling
from mjlab.sim.native.camera_geoms import (
    RENDERED_KINDS,
    CameraPose,
    GeomTable,
    PosedGeoms,
    ReadField,
)
from mjlab.sim.native.camera_lights import Shadow
from mjlab.sim.native.camera_pixels import Lens, PixelGrid, PixelRays
from mjlab.sim.native.camera_slots import SlotBatch
from mjlab.sim.rendering import BACKGROUND, LENS_FIELDS, CameraView, Images, far_limit

# So many rays are cast and shaded at a time: what they need stays in the caches of the CPU.
_RAYS_AT_A_TIME = 131_072
_GEOM_TYPE = int(mujoco.mjtObj.mjOBJ_GEOM)

# Fields of MjData that are read, and those that are read where there are lights.
_POSES = ("xpos", "xquat", "cam_xpos", "cam_xmat")
_LIGHT_POSES = ("light_xpos", "light_xdir")

Field = Callable[[str], torch.Tensor]
MakeBatch = Callable[[mujoco.MjModel, int, int], Any]


class NativeRenderer:
    """Renders the views of a native engine, on several threads that share out environments."""

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        num_threads: int,
        make_batch: MakeBatch,
        data_field: Field,
        expanded: Mapping[str, torch.Tensor],
    ) -> None:
        """Render `num_envs` environments.

        Args:
            model: The compiled model.
            num_envs: Number of environments N.
            num_threads: Number of threads. Images do not depend on it.
            make_batch: `make_batch(model, count, num_threads)` makes a batch of simulations.
            data_field: Returns a field of `MjData` by name, (N, ...).
            expanded: The fields of `MjModel` that differ between environments, (N, ...).
        """
        self._model, self._num_envs, self._make_batch = model, num_envs, make_batch
        self._num_workers = min(num_threads, num_envs)
        self._threads_each = num_threads // self._num_workers
        self._data_field, self._expanded = data_field, expanded
        self._shared: dict[str, torch.Tensor] = {}
        self._plans: dict[CameraView, list[_ViewPlan]] = {}
        self._pool: ThreadPoolExecutor | None = None

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render views at the poses that derived fields have; see `Engine.render`."""
        # A field that is bound for the first time makes the engine compute it, here and now.
        for name in _POSES + (_LIGHT_POSES if self._model.nlight else ()):
            self._data_field(name)
        plans = [self._plans_of(view) for view in views]
        if self._num_workers == 1:
            with _one_torch_thread():
                for workers in plans:
                    self._work(workers[0], 0)
        elif plans:
            # Threads of torch, which wait for each other by spinning, would be in the way.
            with _one_torch_thread():
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(
                        self._num_workers,
                        "render",
                        initializer=torch.set_num_threads,
                        initargs=(1,),
                    )
                jobs = [
                    self._pool.submit(self._work, plan, i)
                    for workers in plans
                    for i, plan in enumerate(workers)
                ]
                for job in jobs:
                    job.result()
        return [workers[0].images for workers in plans]

    def _plans_of(self, view: CameraView) -> list[_ViewPlan]:
        """Return a plan for each worker; they write into the same images."""
        if view not in self._plans:
            with torch.inference_mode(False):
                images = Images.empty(view, self._num_envs, "cpu")
            share = -(-self._num_envs // self._num_workers)
            self._plans[view] = [
                _ViewPlan(
                    self._model,
                    view,
                    images,
                    share,
                    lambda model, count: self._make_batch(model, count, self._threads_each),
                )
                for _ in range(self._num_workers)
            ]
        return self._plans[view]

    def _work(self, plan: _ViewPlan, worker: int) -> None:
        """Render the share of one worker."""
        step = plan.envs_at_a_time
        lens_varies = not LENS_FIELDS.isdisjoint(self._expanded)
        # Tensors that are made here are written into in later calls, in whatever mode.
        with torch.inference_mode(False), torch.no_grad():
            for start in range(worker * step, self._num_envs, self._num_workers * step):
                envs = slice(start, min(start + step, self._num_envs))
                plan.render(envs, self._read_data(envs), self._read_model(envs), lens_varies)

    def _read_data(self, envs: slice) -> ReadField:
        return lambda name: self._data_field(name)[envs]

    def _read_model(self, envs: slice) -> ReadField:
        def read(name: str) -> torch.Tensor:
            if name in self._expanded:
                return self._expanded[name][envs]
            if name not in self._shared:
                values = np.array(getattr(self._model, name))[None]
                is_real = values.dtype == np.float64
                self._shared[name] = torch.from_numpy(
                    values.astype(np.float32) if is_real else values
                )
            return self._shared[name]

        return read


@contextmanager
def _one_torch_thread() -> Generator[None]:
    """Have torch use one thread; the arrays are small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def render_problem(model: mujoco.MjModel) -> str | None:
    """Return why cameras do not work in a model on this engine, and what to do; None if they do."""
    kinds = set(model.geom_type.tolist()) - set(RENDERED_KINDS)
    names = sorted(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in kinds)
    if model.nflex:
        names.append("flexes")
    if not names:
        return None
    return (
        f"The cameras of the native engine do not see {', '.join(names)}, which this model has. "
        "Leave out the camera sensors or these, or use --engine warp (SimulationCfg.engine='warp')."
    )


class _ViewPlan:
    """What one thread needs for one view, from call to call."""

    def __init__(
        self,
        model: mujoco.MjModel,
        view: CameraView,
        images: Images,
        num_envs: int,
        make_batch: Callable[[mujoco.MjModel, int], Any],
    ) -> None:
        """Prepare to render into `images`, some of `num_envs` environments at a time."""
        self._model, self._view, self._make_batch = model, view, make_batch
        self.images = images
        """Where results go."""
        self._grid = PixelGrid(view.width, view.height)
        self._lens = Lens(model, view.camera_id, self._grid)
        self._table = GeomTable(model, view.geom_groups)
        self._far = far_limit(model)
        self.envs_at_a_time = min(num_envs, max(1, _RAYS_AT_A_TIME // self._grid.num_rays))
        """Number of environments that `render` can take."""
        rows = self.envs_at_a_time * self._grid.num_tiles
        self._slots = SlotBatch(model, self._table, make_batch, rows, self._grid.rays)
        self._shadow_slots: SlotBatch | None = None
        self._shading = Shading(model, self._table, view.use_textures)
        self._no_columns = torch.zeros(0, dtype=torch.int64)
        self._aimed: PixelRays | None = None
        self._culling = SurfaceCulling(model, self._table, self._lens)

    def render(self, envs: slice, data: ReadField, model: ReadField, lens_varies: bool) -> None:
        """Render the environments `envs`, whose fields `data` and `model` return.

        `lens_varies` says whether rays differ between environments.
        """
        view = self._view
        camera = CameraPose(
            data("cam_xpos")[:, view.camera_id], data("cam_xmat")[:, view.camera_id]
        )
        rays = self._lens.rays_of(model) if lens_varies else self._lens.rays
        geoms = self._table.pose(data, model, camera)
        rows = len(camera.pos) * self._grid.num_tiles
        in_sight = self._table.in_sight(geoms, rays, self._grid)
        self._slots.load(geoms, in_sight.reshape(rows, -1))
        self._aim(rays)
        passed = self._culling.rule_for(geoms, self._slots, self._grid.num_tiles)
        self._slots.cast(rows, passed, normals="rgb" in view.data_types)
        met = self._met(envs, rays)
        if self.images.rgb is not None:
            shadow = self._shadow_of(geoms) if view.use_shadows else None
            rgb = self._shading.shade(met, geoms, camera, data, model, shadow)
            self._grid.copy_to_image(rgb, self.images.rgb[envs])

    def _aim(self, rays: PixelRays) -> None:
        """Give the simulations their rays, unless they have them."""
        if self._aimed is rays:
            return
        self._aimed = rays
        for target, source in (
            (self._slots.directions, rays.directions),
            (self._slots.origins, rays.offsets),
        ):
            if source is not None:
                by_env = torch.from_numpy(target).view(self.envs_at_a_time, -1, 3)
                by_env[: len(source)] = source
                if len(source) == 1:
                    by_env[1:] = source

    def _met(self, envs: slice, rays: PixelRays) -> MetSurfaces:
        """Return what the rays met, and write it into the images of depth and segmentation."""
        grid, images = self._grid, self.images
        shape = (envs.stop - envs.start, grid.num_rays)
        rows = shape[0] * grid.num_tiles
        distances = torch.from_numpy(self._slots.hits.distances)[:rows].view(shape)
        depth = distances * rays.cosines
        missed = depth < 0.0
        if self._far > 0.0:
            missed |= depth > self._far
        if images.depth is not None:
            grid.copy_to_image(depth.masked_fill(missed, 0.0)[..., None], images.depth[envs])
        if self._view.data_types == ("depth",):
            columns = self._no_columns
        else:
            columns = self._slots.columns(rows).view(shape)
            columns.masked_fill_(missed, len(self._table))
        if images.segmentation is not None:
            ids = self._table.ids[columns]
            kinds = torch.where(ids == BACKGROUND, BACKGROUND, _GEOM_TYPE)
            pairs = torch.stack((ids, kinds.to(torch.int32)), dim=-1)
            grid.copy_to_image(pairs, images.segmentation[envs])
        normals = torch.from_numpy(self._slots.hits.normals)[:rows].view(*shape, 3)
        return MetSurfaces(rays, distances, normals, columns)

    def _shadow_of(self, geoms: PosedGeoms) -> Shadow:
        """Return what casts shadow rays, which go past all geoms."""
        if self._shadow_slots is None:
            self._shadow_slots = SlotBatch(
                self._model,
                self._table,
                self._make_batch,
                self.envs_at_a_time,
                self._grid.num_rays,
            )
        slots = self._shadow_slots
        rows = len(geoms.pos)
        slots.load(geoms, geoms.exists)
        passed = self._culling.shadow_rule_for(geoms, slots)

        def shadow(
            origins: torch.Tensor, directions: torch.Tensor, limit: torch.Tensor
        ) -> torch.Tensor:
            torch.from_numpy(slots.origins)[:rows] = origins
            torch.from_numpy(slots.directions)[:rows] = directions
            slots.cast(rows, passed, normals=False)
            distances = torch.from_numpy(slots.hits.distances)[:rows]
            return (distances >= 0.0) & (distances < limit)

        return shadow
