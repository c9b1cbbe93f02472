"""Names of the assets that sub-terrains add to the spec."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar

import mujoco

# A sub-terrain's function is given difficulty, spec and generator, but not the cell that it fills.
_CELL: ContextVar[tuple[int, int] | None] = ContextVar("cell", default=None)


@contextmanager
def naming_cell(row: int, col: int) -> Generator[None]:
    """Let `asset_name` name what is added in this context after the cell."""
    token = _CELL.set((row, col))
    try:
        yield
    finally:
        _CELL.reset(token)


def asset_name(spec: mujoco.MjSpec, kind: str) -> str:
    """Return a name for an asset of a sub-terrain, `<kind>_<row>_<column>` in a generated grid.

    Elsewhere the name ends with the number of assets that the spec has, so that it is new after
    each added asset. The same calls give the same names, in every process.

    Args:
        spec: The spec that will hold the asset.
        kind: What the asset is, `hfield` say. Different for each asset of one sub-terrain.
    """
    cell = _CELL.get()
    if cell is not None:
        return f"{kind}_{cell[0]}_{cell[1]}"
    count = len(spec.hfields) + len(spec.meshes) + len(spec.textures) + len(spec.materials)
    return f"{kind}_{count}"
