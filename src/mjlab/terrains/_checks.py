"""Terrain configs that cannot be built are refused here, before anything is built."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mjlab.terrains.terrain_generator import (
        SubTerrainCfg,
        TerrainGeneratorCfg,
        TerrainOutput,
    )

_COLOR_SCHEMES = ("height", "random", "none")


def check_generator(cfg: TerrainGeneratorCfg) -> None:
    """Raise ValueError, with what to change, for a config that cannot be built."""
    if not cfg.sub_terrains:
        raise ValueError(
            "TerrainGeneratorCfg.sub_terrains is empty. Give at least one sub-terrain, such as "
            "{'flat': BoxFlatTerrainCfg()}."
        )
    if len(cfg.size) != 2 or not all(math.isfinite(side) and side > 0.0 for side in cfg.size):
        raise ValueError(
            f"TerrainGeneratorCfg.size is {tuple(cfg.size)}; it must be two positive lengths, in "
            "metres."
        )
    for name in ("num_rows", "num_cols"):
        if getattr(cfg, name) < 1:
            raise ValueError(
                f"TerrainGeneratorCfg.{name} is {getattr(cfg, name)}; it must be at least 1."
            )
    if cfg.color_scheme not in _COLOR_SCHEMES:
        raise ValueError(
            f"TerrainGeneratorCfg.color_scheme is {cfg.color_scheme!r}; it must be one of "
            f"{', '.join(_COLOR_SCHEMES)}."
        )
    _check_difficulties(cfg.difficulty_range)
    _check_proportions({name: sub.proportion for name, sub in cfg.sub_terrains.items()})
    for name, sub in cfg.sub_terrains.items():
        _check_sub_terrain(name, sub, min(cfg.size))


def check_output(output: TerrainOutput, patches: dict[str, np.ndarray]) -> None:
    """Raise ValueError if the function of a sub-terrain returned what cannot be used."""
    origin = np.asarray(output.origin)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise ValueError(f"its origin is {output.origin}; it must be three finite numbers.")
    for name, found in (output.flat_patches or {}).items():
        if name not in patches:
            raise ValueError(
                f"it returned flat patches {name!r}, which SubTerrainCfg.flat_patch_sampling does "
                f"not have; that has {sorted(patches)}."
            )
        room = patches[name].shape[2]
        if np.ndim(found) != 2 or np.shape(found)[1] != 3 or len(found) > room:
            raise ValueError(
                f"its flat patches {name!r} have the shape {np.shape(found)}; it must be (n, 3) "
                f"with at most {room} patches, as configured."
            )


def _check_difficulties(bounds: tuple[float, float]) -> None:
    if not 0.0 <= bounds[0] <= bounds[1] <= 1.0:
        raise ValueError(
            f"TerrainGeneratorCfg.difficulty_range is {tuple(bounds)}; it must be (lowest, "
            "highest), both from 0 to 1."
        )


def _check_proportions(proportions: dict[str, float]) -> None:
    bad = {name: p for name, p in proportions.items() if not (math.isfinite(p) and p >= 0.0)}
    if bad:
        raise ValueError(
            f"SubTerrainCfg.proportion is negative or not finite for {bad}. Use 0 or more; "
            "proportions are relative to each other."
        )
    if sum(proportions.values()) <= 0.0:
        raise ValueError(
            f"SubTerrainCfg.proportion is 0 for all of {sorted(proportions)}. At least one must "
            "be positive."
        )


def _check_sub_terrain(name: str, sub: SubTerrainCfg, side: float) -> None:
    """Check the fields that most sub-terrains have against the shorter side of a cell."""
    where = f"Sub-terrain {name!r} ({type(sub).__name__})"
    platform: Any = getattr(sub, "platform_width", 0.0)
    if not 0.0 <= platform <= side:
        raise ValueError(
            f"{where}: platform_width is {platform}; it must be from 0 to the size of the "
            f"terrain, {side} m."
        )
    border: Any = getattr(sub, "border_width", 0.0)
    if not 0.0 <= border < side / 2:
        raise ValueError(
            f"{where}: border_width is {border}; it must be at least 0 and thinner than half the "
            f"terrain, {side / 2} m."
        )
    for field, patch in (sub.flat_patch_sampling or {}).items():
        if patch.num_patches < 1 or patch.patch_radius < 0.0:
            raise ValueError(
                f"{where}: flat_patch_sampling[{field!r}] asks for {patch.num_patches} patches of "
                f"radius {patch.patch_radius} m; it must be at least 1, of radius 0 or more."
            )
