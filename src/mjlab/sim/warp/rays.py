"""Rays on the Warp engine, cast through a tree of bounding boxes over the geoms of each world.

MuJoCo Warp's rays through its render context pass the inside of meshes and height fields, and see
of a height field the top alone, which is what `Engine.raycast` promises. Its rays without one do
not, and try every geom for every ray.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco_warp
import numpy as np
import torch
import warp

if TYPE_CHECKING:
    from mjlab.sim.warp.engine import WarpEngine

# A type checker cannot follow how these two packages annotate their arrays.
mjwarp: Any = mujoco_warp
wp: Any = warp


class WarpRays:
    """Rays of one Warp engine. Each number of rays into some geom groups is one graph."""

    def __init__(self, engine: WarpEngine) -> None:
        self._engine = engine
        self._queries: dict[Any, _Query] = {}

    def cast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None,
        exclude_body_ids: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return distances (N, R), normals (N, R, 3) and geom ids (N, R) at the current poses.

        They are overwritten by the next call with as many rays into the same groups.
        """
        # MuJoCo counts a group beyond 0 to 5 as the nearest of these.
        present = np.unique(self._engine.mj_model.geom_group)
        if geom_groups is not None:
            present = present[np.isin(present.clip(0, 5), geom_groups)]
        groups = tuple(present.tolist())
        key = (groups, origins.shape[1])
        if key not in self._queries:
            self._queries[key] = _Query(*origins.shape[:2], origins.device)
        query = self._queries[key]
        query.origins.copy_(origins)
        query.directions.copy_(directions)
        if exclude_body_ids is None:
            query.excluded.fill_(-1)
        else:
            query.excluded.copy_(exclude_body_ids)
        if groups:
            self._engine.launch(f"rays {key}", lambda: self._run(query, groups), on_cpu=False)
        return query.distances, query.normals, query.geom_ids

    def _run(self, query: _Query, groups: tuple[int, ...]) -> None:
        model, data = self._engine.wp_model, self._engine.wp_data
        if query.context is None:
            query.context = mjwarp.create_render_context(
                self._engine.mj_model,
                data.nworld,
                cam_active=[],
                use_textures=False,
                enabled_geom_groups=list(groups),
            )
        mjwarp.refit_bvh(model, data, query.context)
        mjwarp.rays(
            model,
            data,
            wp.from_torch(query.origins, dtype=wp.vec3),
            wp.from_torch(query.directions, dtype=wp.vec3),
            # The context holds the geoms of these groups and no others.
            wp.types.vector(length=6, dtype=float)(*[-1.0] * 6),
            True,
            wp.from_torch(query.excluded),
            wp.from_torch(query.distances),
            wp.from_torch(query.geom_ids),
            wp.from_torch(query.normals, dtype=wp.vec3),
            query.context,
        )


class _Query:
    """Memory of R rays in each of N worlds, at the addresses that a graph was captured with."""

    @torch.inference_mode(False)
    def __init__(self, num_worlds: int, num_rays: int, device: torch.device) -> None:
        real: Any = {"dtype": torch.float32, "device": device}
        whole: Any = {"dtype": torch.int32, "device": device}
        self.origins = torch.zeros(num_worlds, num_rays, 3, **real)
        self.directions = torch.zeros(num_worlds, num_rays, 3, **real)
        self.excluded = torch.zeros(num_rays, **whole)
        self.distances = torch.full((num_worlds, num_rays), -1.0, **real)
        self.normals = torch.zeros(num_worlds, num_rays, 3, **real)
        self.geom_ids = torch.full((num_worlds, num_rays), -1, **whole)
        self.context: Any = None
