"""Sites that show where environments start, spawn points, and flat patches."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import torch

_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_GREEN = (0.2, 0.6, 0.2, 0.3)
_BLUE = (0.2, 0.2, 0.6, 0.3)
_YELLOW = (0.6, 0.6, 0.2, 0.3)
# Half the height of the box that shows a flat patch, in metres.
_PATCH_HALF_HEIGHT = 0.02


def add_debug_sites(
    body: mujoco.MjsBody,
    env_origins: torch.Tensor,
    terrain_origins: torch.Tensor | None,
    flat_patches: Mapping[str, torch.Tensor],
    flat_patch_radii: Mapping[str, float],
) -> None:
    """Add sites that show the initial state.

    Args:
        body: The body of the terrain.
        env_origins: (N, 3) origins of environments: `env_origin_<i>`, group 4.
        terrain_origins: (R, C, 3) spawn points, if any: `terrain_origin_<r>_<c>`, group 5.
        flat_patches: (R, C, number, 3) positions by name: `flat_patch_<name>_<r>_<c>_<k>`, group 3.
        flat_patch_radii: Radius of the flat patches by name, in metres.
    """
    for index, place in enumerate(env_origins.tolist()):
        body.add_site(
            name=f"env_origin_{index}", type=_SPHERE, size=(0.3, 0.0, 0.0), pos=place, group=4,
            rgba=_GREEN,
        )  # fmt: skip
    for row, places in enumerate([] if terrain_origins is None else terrain_origins.tolist()):
        for col, place in enumerate(places):
            body.add_site(
                name=f"terrain_origin_{row}_{col}", type=_SPHERE, size=(0.5, 0.0, 0.0), pos=place,
                group=5, rgba=_BLUE,
            )  # fmt: skip
    for name, patches in flat_patches.items():
        radius = flat_patch_radii[name]
        # MuJoCo refuses sites without extent, and a patch may be a single point.
        size = (
            max(radius, _PATCH_HALF_HEIGHT),
            max(radius, _PATCH_HALF_HEIGHT),
            _PATCH_HALF_HEIGHT,
        )
        for index in torch.cartesian_prod(*(torch.arange(n) for n in patches.shape[:3])).tolist():
            row, col, k = index
            body.add_site(
                name=f"flat_patch_{name}_{row}_{col}_{k}", type=_BOX, size=size,
                pos=patches[row, col, k].tolist(), group=3, rgba=_YELLOW,
            )  # fmt: skip
