"""Ray casting on the Warp engine, with a bounding volume hierarchy per world.

With a render context, MuJoCo Warp's rays hit meshes from outside and height fields on their top
only, as `Engine.raycast` requires. Without a context, rays do not, and every ray tests every geom.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mujoco
import mujoco_warp as mjwarp
import torch
import warp as wp

from mjlab.sim.engine import NUM_GEOM_GROUPS, rendered_geoms

if TYPE_CHECKING:
    from mjlab.sim.engine import RayHits, RayQuery


class WarpRays:
    """Ray caster of a Warp engine. One graph per number of rays and set of geom groups."""

    def __init__(
        self, host: mujoco.MjModel, model: Any, data: Any, launch: Callable[..., None]
    ) -> None:
        """Cast rays in `data`, worlds of `model`, put from the `host` model.

        `launch` is `WarpEngine.launch`.
        """
        self._host, self._model, self._data, self._launch = host, model, data, launch
        self._buffers: dict[Any, _Buffers] = {}

    def cast(self, query: RayQuery) -> RayHits:
        """Cast rays; see `Engine.raycast`."""
        key = (query.geom_groups, query.origins.shape[1])
        if key not in self._buffers:
            groups = range(NUM_GEOM_GROUPS) if query.geom_groups is None else query.geom_groups
            present = {
                int(self._host.geom_group[geom]) for geom in rendered_geoms(self._host, groups)
            }
            self._buffers[key] = _Buffers(query.origins, sorted(present))
        buffers = self._buffers[key]
        buffers.origins.copy_(query.origins)
        buffers.directions.copy_(query.directions)
        buffers.excluded[:] = -1 if query.exclude_body_ids is None else query.exclude_body_ids
        if buffers.groups:
            self._launch(f"rays {key}", lambda: self._run(buffers), on_cpu=False)
        missed = buffers.distances < 0.0
        if query.max_distances is not None:
            missed = missed | (buffers.distances > query.max_distances)
        # Copies: the next call overwrites the buffers.
        return (
            buffers.distances.masked_fill(missed, -1.0),
            buffers.normals.masked_fill(missed[..., None], 0.0),
            buffers.geom_ids.masked_fill(missed, -1),
        )

    def _run(self, buffers: _Buffers) -> None:
        model, data = self._model, self._data
        if buffers.context is None:
            buffers.context = mjwarp.create_render_context(
                self._host,
                data.nworld,
                cam_active=[],
                use_textures=False,
                enabled_geom_groups=buffers.groups,
            )
        mjwarp.refit_bvh(model, data, buffers.context)
        mjwarp.rays(
            model,
            data,
            wp.from_torch(buffers.origins, dtype=wp.vec3),
            wp.from_torch(buffers.directions, dtype=wp.vec3),
            # The context has only geoms of the selected groups.
            wp.types.vector(length=6, dtype=float)(*[-1.0] * 6),
            True,
            wp.from_torch(buffers.excluded),
            wp.from_torch(buffers.distances),
            wp.from_torch(buffers.geom_ids),
            wp.from_torch(buffers.normals, dtype=wp.vec3),
            buffers.context,
        )


class _Buffers:
    """Buffers of R rays in each of N worlds, at the addresses used by a captured graph."""

    @torch.inference_mode(False)
    def __init__(self, origins: torch.Tensor, groups: list[int]) -> None:
        self.groups = groups
        self.context: Any = None
        self.origins = torch.zeros_like(origins, dtype=torch.float32).contiguous()
        self.directions, self.normals = self.origins.clone(), self.origins.clone()
        self.distances = torch.full_like(self.origins[..., 0], -1.0)
        self.geom_ids = torch.full_like(self.distances, -1, dtype=torch.int32)
        self.excluded = torch.zeros_like(self.geom_ids[0])
