"""Casting rays on the Warp engine, with a tree of bounding boxes over the geoms of each world."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp

# A type checker cannot follow how these two packages annotate their arrays.
mjwarp: Any = mujoco_warp
wp: Any = warp


class WarpRays:
    """Casts the rays of a Warp engine.

    MuJoCo Warp's rays through its render context pass the inside of meshes and height fields, and
    see of a height field the top alone, which is what `Engine.raycast` promises. Its rays without
    one do not, and try every geom for every ray.
    """

    def __init__(
        self,
        host: mujoco.MjModel,
        model: Any,
        data: Any,
        ordered: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """Cast in the worlds of `data`.

        `host` is the model on the host; Warp's work is done within `ordered()`, and torch's is not.
        """
        self._host, self._model, self._data, self._ordered = host, model, data, ordered
        self._contexts: dict[tuple[int, ...] | None, Any] = {}

    def cast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None,
        exclude_body_ids: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return distances (N, R), normals (N, R, 3) and geom ids (N, R) at the current poses."""
        shape, device = tuple(origins.shape[:2]), origins.device
        distances = torch.full(shape, -1.0, device=device)
        normals = torch.zeros((*shape, 3), device=device)
        geom_ids = torch.full(shape, -1, dtype=torch.int32, device=device)
        if exclude_body_ids is None:
            exclude_body_ids = torch.full(shape[1:], -1, device=device)
        excluded = exclude_body_ids.to(torch.int32).contiguous()
        origins, directions = origins.contiguous(), directions.contiguous()
        with self._ordered():
            context = self._context(geom_groups)
            if context is None:
                return distances, normals, geom_ids
            mjwarp.refit_bvh(self._model, self._data, context)
            mjwarp.rays(
                self._model,
                self._data,
                wp.from_torch(origins, dtype=wp.vec3),
                wp.from_torch(directions, dtype=wp.vec3),
                # The context holds the geoms of these groups and no others.
                wp.types.vector(length=6, dtype=float)(*[-1.0] * 6),
                True,
                wp.from_torch(excluded),
                wp.from_torch(distances),
                wp.from_torch(geom_ids),
                wp.from_torch(normals, dtype=wp.vec3),
                context,
            )
        return distances, normals, geom_ids

    def _context(self, groups: tuple[int, ...] | None) -> Any:
        """Return the render context of some groups, made on first use; None if nothing is in it."""
        key = None if groups is None else tuple(sorted(set(groups)))
        if key not in self._contexts:
            self._contexts[key] = self._make_context(key)
        return self._contexts[key]

    def _make_context(self, groups: tuple[int, ...] | None) -> Any:
        # MuJoCo counts a group beyond 0 to 5 as the nearest of these.
        present = np.unique(self._host.geom_group)
        if groups is not None:
            present = present[np.isin(present.clip(0, 5), groups)]
        if not len(present):
            return None
        return mjwarp.create_render_context(
            self._host,
            self._data.nworld,
            cam_active=[],
            use_textures=False,
            enabled_geom_groups=present.tolist(),
        )
