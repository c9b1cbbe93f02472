"""Casting rays against a few geoms for each tile of an image: one small simulation a tile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sim.native.camera_geoms import HFIELD, MESH, SPHERE, GeomTable, PosedGeoms
from mjlab.sim.native.rays import Hits, Passed, cast_through, slot_model

# More slots than are needed now, so that they are still enough when the camera has turned.
_HEADROOM = 1.3
_FIELDS = ("geom_pos", "geom_quat", "geom_size")
_NUMBERS = ("geom_type", "geom_dataid", "geom_group")
# Group of a slot without a geom, which no ray meets.
_EMPTY = 1


class SlotBatch:
    """Simulations, one a tile, whose geoms stand for those in sight of the tile.

    They have no bodies, so that a query costs what its rays cost.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        table: GeomTable,
        make_batch: Callable[[mujoco.MjModel, int], Any],
        rows: int,
        rays: int,
    ) -> None:
        """Prepare `rows` simulations for `rays` rays each, against geoms of `table`.

        `make_batch(model, count)` makes a batch of simulations.
        """
        self._model, self._table, self._make_batch = model, table, make_batch
        self._rows, self._rays = rows, rays
        self._mask = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
        self._kinds = [kind for kind in (HFIELD, MESH) if kind in table.present]
        self._width = 0
        self._values: dict[str, torch.Tensor] = {}
        self.origins = np.zeros((rows, rays, 3), dtype=np.float32)
        """(rows, rays, 3) where rays start; write into it."""
        self.directions = np.zeros((rows, rays, 3), dtype=np.float32)
        """(rows, rays, 3) unit vectors; write into it."""
        self.hits = Hits.empty(rows, rays)
        """What the rays met; geoms are numbers of slots."""

    def load(self, geoms: PosedGeoms, in_sight: torch.Tensor) -> None:
        """Put into each row the geoms that are in its sight: (rows, G) bool, rows by environment.

        There may be fewer rows than simulations; the others keep what they have.
        """
        rows = len(in_sight)
        slot = in_sight.cumsum(dim=1, dtype=torch.int32)
        self._require(int(slot[:, -1].amax()) if slot.numel() else 0)
        if self._width == 0:
            # Nothing has been in sight yet.
            return
        row, column = in_sight.nonzero(as_tuple=True)
        place = row * self._width + slot[row, column] - 1
        env = row.div(rows // len(geoms.pos), rounding_mode="floor")
        flat = env * len(self._table) + column
        self._put("geom_pos", place, geoms.pos, flat, column)
        self._put("geom_quat", place, geoms.quat, flat, column)
        self._put("geom_size", place, geoms.size, flat, column)
        self._put("geom_dataid", place, geoms.dataid, flat, column)
        self._values["geom_type"].view(-1)[place] = self._table.kinds[column]
        group = self._values["geom_group"]
        group[:rows] = _EMPTY
        group.view(-1)[place] = 0
        # The first entry of each row is for the slot -1 of a miss.
        self._columns[:rows] = len(self._table)
        self._columns.view(-1)[place + row + 1] = column

    def _put(
        self,
        name: str,
        place: torch.Tensor,
        values: torch.Tensor,
        flat: torch.Tensor,
        column: torch.Tensor,
    ) -> None:
        """Write values (n, G, ...) of geoms, or (1, G, ...), into slots."""
        chosen = values.flatten(0, 1)[column if len(values) == 1 else flat]
        self._values[name].flatten(0, 1)[place] = chosen.to(self._values[name].dtype)

    def _require(self, slots: int) -> None:
        """Have at least so many slots."""
        if slots <= self._width:
            return
        width = max(min(len(self._table), int(_HEADROOM * slots) + 1), slots, len(self._kinds))
        kinds = [*self._kinds, *[SPHERE] * (width - len(self._kinds))]
        self._batch = self._make_batch(slot_model(self._model, kinds), self._rows)
        for name in _FIELDS:
            self._values[name] = torch.from_numpy(self._batch.expand(name))
        for name in _NUMBERS:
            self._values[name] = torch.from_numpy(self._batch.expand(name))
        self._values["geom_group"].fill_(_EMPTY)
        self._width = width
        self._columns = torch.full((self._rows, width + 1), len(self._table))
        self._first = torch.arange(self._rows)[:, None] * (width + 1) + 1

    def cast(self, rows: int, passed: Passed | None = None, *, normals: bool = True) -> None:
        """Cast the rays of the first `rows` simulations into `hits`.

        `passed` says which hits do not count. Without `normals`, they are not computed.
        """
        if self._width == 0:
            self.hits.distances[:rows], self.hits.normals[:rows] = -1.0, 0.0
            self.hits.geoms[:rows] = -1
            return
        chosen = None if rows == self._rows else np.arange(rows)
        if passed is None and not normals:
            self.hits.distances[:rows], self.hits.geoms[:rows] = self._batch.ray(
                self.origins[:rows], self.directions[:rows], geomgroup=self._mask, ids=chosen
            )
            return
        cast_through(
            self._batch,
            self.origins,
            self.directions,
            self.hits,
            passed,
            chosen,
            geomgroup=self._mask,
        )

    def columns(self, rows: int) -> torch.Tensor:
        """Return for each ray (rows, rays) the index of the geom in the table; G for a miss."""
        if self._width == 0:
            return torch.full((rows, self._rays), len(self._table))
        places = torch.from_numpy(self.hits.geoms[:rows]) + self._first[:rows]
        return torch.take(self._columns, places)

    def columns_of(self, rows: Any, slots: np.ndarray) -> np.ndarray:
        """Return the same for hits `slots` (m, rays) of the simulations `rows`."""
        return np.take_along_axis(self._columns.numpy()[rows], slots + 1, axis=1)
