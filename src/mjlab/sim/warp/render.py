"""Warp renderer, built on MuJoCo Warp's batch renderer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import mujoco
import mujoco_warp as mjwarp
import numpy as np
import torch
import warp as wp

from mjlab.sim.engine import LENS_FIELDS, CameraView, Images, rendered_geoms
from mjlab.utils.errors import WrongStateError

# Model fields that a render context depends on when expanded.
_CONTEXT_FIELDS = LENS_FIELDS | {"light_attenuation", "light_type", "geom_dataid"}
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)


class WarpRenderer:
    """Renderer of a Warp engine's views.

    In MuJoCo Warp, geom groups, textures and shadows are settings of a render context, and a
    context renders all its cameras at once. So views with equal settings share a context.
    """

    def __init__(
        self,
        host: mujoco.MjModel,
        model: Any,
        data: Any,
        model_fields: dict[str, torch.Tensor],
        ordered: Callable[[], AbstractContextManager[None]],
        launch: Callable[..., None],
    ) -> None:
        """Render `data`, worlds of `model`, put from the `host` model.

        Args:
            host: Compiled model.
            model: `mujoco_warp.Model`.
            data: `mujoco_warp.Data`.
            model_fields: Expanded model fields (live).
            ordered: `WarpEngine.ordered`.
            launch: `WarpEngine.launch`.
        """
        self._host, self._model, self._data = host, model, data
        self._model_fields, self._ordered, self._launch = model_fields, ordered, launch
        self._scenes: dict[Any, _Scene] = {}

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render views at the poses in derived fields; see `Engine.render`."""
        by_settings: dict[Any, dict[int, CameraView]] = {}
        for i, view in enumerate(views):
            settings = (view.geom_groups, view.use_textures, view.use_shadows)
            by_settings.setdefault(settings, {})[i] = view
        images: dict[int, Images] = {}
        relevant = _CONTEXT_FIELDS & self._model_fields.keys()
        for settings, members in by_settings.items():
            scene = self._scenes.get((views, settings))
            if scene is None or scene.expanded != relevant:
                # Later calls, in any torch mode, write into images created here.
                with self._ordered(), torch.inference_mode(False):
                    scene = _Scene(self._host, self._model, self._data, members, relevant)
                self._scenes[views, settings] = scene
            images |= scene.render(self._launch)
        return [images[i] for i in range(len(views))]

    def context_of(self, views: tuple[CameraView, ...], view: CameraView) -> Any:
        """Return the `mujoco_warp.RenderContext` that last rendered `view`, one of `views`."""
        for key, scene in self._scenes.items():
            if key[0] == views and view in scene.views.values():
                return scene.context
        raise WrongStateError("View not rendered yet; call Simulation.sense() first.")


class _Scene:
    """Render context and the views rendered with it."""

    def __init__(
        self,
        host: mujoco.MjModel,
        model: Any,
        data: Any,
        views: dict[int, CameraView],
        expanded: frozenset[str],
    ) -> None:
        self.views, self.expanded, self._model, self._data = views, expanded, model, data
        cameras = list(views.values())
        first = cameras[0]
        self.context: Any = None
        self._dataid: Any = None
        shown = rendered_geoms(host, first.geom_groups)
        if shown:
            self.context = mjwarp.create_render_context(
                host,
                data.nworld,
                cam_res=[(view.width, view.height) for view in cameras],
                render_rgb=["rgb" in view.data_types for view in cameras],
                render_depth=["depth" in view.data_types for view in cameras],
                render_seg=["segmentation" in view.data_types for view in cameras],
                cam_active=[view.camera_id for view in cameras],
                use_textures=first.use_textures,
                use_shadows=first.use_shadows,
                enabled_geom_groups=np.unique(host.geom_group[shown]).tolist(),
                render_skybox=True,
                use_precomputed_rays=LENS_FIELDS.isdisjoint(expanded),
                # Flat mesh faces on both engines: MuJoCo's rays do not interpolate normals.
                enable_vertex_normals=False,
            )
            # The context skips work based on the model, but environments may differ from the model.
            if "light_attenuation" in expanded:
                self.context.light_attenuation_is_default = False
            if "light_type" in expanded:
                self.context.has_spot_lights = True
            if "geom_dataid" in expanded:
                self._dataid = _without_absent_meshes(host, model, self.context)
        device = wp.device_to_torch(model.geom_pos.device)
        self._images = {i: Images.empty(view, data.nworld, device) for i, view in views.items()}
        # Packed colors and their target images. Other images view the context's memory.
        self._packed: list[tuple[torch.Tensor, torch.Tensor]] = []
        if shown:
            for camera, images in enumerate(self._images.values()):
                self._read_images(camera, cameras[camera], images)

    def _read_images(self, camera: int, view: CameraView, images: Images) -> None:
        """View the buffers of one of the context's cameras as images."""
        rc = self.context

        def pixels(buffer: Any, starts: Any) -> torch.Tensor:
            rows = wp.to_torch(buffer)[:, int(starts.numpy()[camera]) :]
            return rows[:, : view.height * view.width].unflatten(1, (view.height, view.width))

        if images.rgb is not None:
            # Byte order: blue, green, red, alpha.
            packed = pixels(rc.rgb_data, rc.rgb_adr)[..., None].view(torch.uint8)
            self._packed.append((packed[..., :3], images.rgb))
        if images.depth is not None:
            images.depth = pixels(rc.depth_data, rc.depth_adr)[..., None]
        if images.segmentation is not None:
            images.segmentation = pixels(rc.seg_data, rc.seg_adr)

    def render(self, launch: Callable[..., None]) -> dict[int, Images]:
        """Render all views at the current poses, by `WarpEngine.launch`."""
        model, data = self._model, self._data
        if self.context is None:
            return self._images
        if self._dataid is not None:
            model = dataclasses.replace(model, geom_dataid=self._dataid)

        def work() -> None:
            mjwarp.refit_bvh(model, data, self.context)
            mjwarp.render(model, data, self.context)

        launch(self, work, on_cpu=False)
        for packed, rgb in self._packed:
            rgb.copy_(packed.flip(-1))
        return self._images


def _without_absent_meshes(host: mujoco.MjModel, model: Any, context: Any) -> Any:
    """Return `geom_dataid` for `context`, with -1 of mesh geoms replaced by an invisible mesh.

    MuJoCo Warp would look up mesh -1. The invisible mesh, added to the context, is a point.
    """
    is_mesh = torch.as_tensor(host.geom_type == _MESH, device=wp.device_to_torch(wp.get_device()))
    dataid = wp.to_torch(model.geom_dataid)
    own = torch.where(is_mesh & (dataid < 0), host.nmesh, dataid).to(torch.int32).contiguous()
    if not (own == host.nmesh).any():
        return None
    point = wp.Mesh(points=wp.zeros(3, dtype=wp.vec3), indices=wp.array([0, 1, 2], dtype=wp.int32))
    context.mesh_registry[point.id] = point
    ids = [*context.mesh_bvh_id.numpy().tolist(), point.id]
    bounds = [*context.mesh_bounds_size.numpy().tolist(), [0.0, 0.0, 0.0]]
    context.mesh_bvh_id = wp.array(ids, dtype=wp.uint64)
    context.mesh_bounds_size = wp.array(bounds, dtype=wp.vec3)
    shared = wp.from_torch(own, dtype=wp.int32)
    # The array does not hold a reference to its tensor.
    shared.keep = own
    return shared
