"""Rays against the static geoms near them: a small model for each cluster of rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from mjlab.sim.native.ray_casting import Hits, cast_through
from mjlab.sim.native.ray_culling import CullingRule
from mjlab.sim.native.ray_tiles import StaticGeoms, TileTable, slot_model

Array = np.ndarray

# Clusters are split until they have no more rays than this and are no longer than that (metres).
_MAX_RAYS = 40
_MAX_LENGTH = 0.75
# Clusters of similar numbers of rays are cast together.
_SIMILAR = 0.6


def cluster_rays(positions: Array, sources: Array) -> list[list[Array]]:
    """Split rays into clusters of neighbours, and these into classes of similar numbers.

    Args:
        positions: (R, 3) where the rays start in some environment.
        sources: (R,) rays of different sources are not neighbours.

    Returns:
        For each class, the ray indices of its clusters.
    """
    pending = [np.flatnonzero(sources == source) for source in np.unique(sources)]
    clusters: list[Array] = []
    while pending:
        rays = pending.pop()
        extent = np.ptp(positions[rays], axis=0)
        if len(rays) <= _MAX_RAYS and extent.max() <= _MAX_LENGTH:
            clusters.append(np.sort(rays))
            continue
        if len(rays) == 1:
            clusters.append(rays)
            continue
        order = rays[np.argsort(positions[rays, extent.argmax()], kind="stable")]
        pending += [order[: len(rays) // 2], order[len(rays) // 2 :]]
    clusters.sort(key=lambda rays: -len(rays))
    classes: list[list[Array]] = []
    for cluster in clusters:
        if classes and len(cluster) >= _SIMILAR * len(classes[-1][0]):
            classes[-1].append(cluster)
        else:
            classes.append([cluster])
    return classes


class NearbyRays:
    """Casts clusters of rays, of one class, against static geoms.

    Each environment and cluster has a simulation of its own in a second batch, whose geoms are
    those of the tile that the cluster is in. They are replaced when it comes into another tile.
    """

    def __init__(
        self,
        clusters: list[Array],
        num_envs: int,
        geoms: StaticGeoms,
        margin: float,
        make_batch: Callable[..., Any],
        model: Any,
        rule: CullingRule | None,
    ) -> None:
        """Build the tiles and the batch for `clusters` of rays whose windows reach `margin`."""
        self.num_clusters, self.margin = len(clusters), margin
        width = max(map(len, clusters))
        # Short clusters repeat their last ray.
        padded = [np.append(c, np.repeat(c[-1], width - len(c))) for c in clusters]
        self._columns = torch.from_numpy(np.concatenate(padded))
        filled = np.concatenate([np.arange(width) < len(c) for c in clusters])
        self._filled = torch.from_numpy(np.flatnonzero(filled))
        self._targets = self._columns[self._filled]
        self._num_envs, self._width = num_envs, width
        self._geoms, self._rule = geoms, rule
        self._table = TileTable(geoms, margin)
        small = slot_model(model, self._table.slot_types)
        rows = num_envs * self.num_clusters
        self._batch = make_batch(small, rows)
        self._expand(small.ngeom, rows)
        self._tiles = np.full(rows, -1)
        self._hits = Hits.empty(rows, width)
        self._mask = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
        self._given: tuple[torch.Tensor | None, int, torch.Tensor | None] = (None, 0, None)
        self._along, self._sideways = np.empty(0), None

    def _expand(self, slots: int, rows: int) -> None:
        """Bind what differs between simulations, and append what a slot without a geom holds."""
        geoms = self._geoms
        # Slots without a geom are in a group that no ray sees.
        self._fields = {"geom_group": self._batch.expand("geom_group")}
        self._values: dict[str, Array] = {"geom_group": np.zeros(len(geoms.ids) + 1, np.int32)}
        self._values["geom_group"][-1] = 1
        for name, value in (
            ("geom_pos", geoms.pos),
            ("geom_quat", geoms.quat),
            ("geom_size", geoms.size),
            ("geom_dataid", geoms.dataid),
        ):
            if name == "geom_dataid" and (value < 0).all():
                continue
            if name == "geom_quat" and (value == value[:1]).all():
                # All turned alike, as they are where nothing is turned.
                value = value[:1]
            self._fields[name] = self._batch.expand(name)
            self._values[name] = np.append(value, value[-1:], axis=0)
        if len(self._values["geom_quat"]) == 2:
            self._fields.pop("geom_quat")[:] = self._values.pop("geom_quat")[0]
        # The geom of each slot; the last column is for the slot -1 of a miss.
        self._ids = np.full((rows, slots + 1), -1, dtype=np.int32)

    def cast(
        self, origins: torch.Tensor, directions: torch.Tensor, reach: torch.Tensor | None, out: Hits
    ) -> Array:
        """Cast into `out`; return where (num_envs,) some rays have left their window.

        What is in `out` for those environments is not to be used.
        """
        shape = (self._num_envs * self.num_clusters, self._width)
        start = origins.index_select(1, self._columns).view(*shape, 3)
        along, sideways = self._gather_directions(directions, reach, shape)
        centre, half = self._bounds(start, sideways)
        strays = (half > self.margin).any(axis=1)
        self._load(centre)
        cast_through(
            self._batch,
            start.numpy(),
            along,
            self._hits,
            None if self._rule is None else self._passed,
            geomgroup=self._mask,
        )
        self._scatter(out)
        return np.asarray(strays.reshape(self._num_envs, -1).any(axis=1))

    def _gather_directions(
        self, directions: torch.Tensor, reach: torch.Tensor | None, shape: tuple[int, int]
    ) -> tuple[Array, torch.Tensor | None]:
        """Return directions by row, and how far rays go sideways, (rows, width, 2); None: nowhere.

        Most often the directions are the same from call to call, which torch's count of writes to
        a tensor tells.
        """
        if not self._are_as_given(directions, reach):
            along = directions.index_select(1, self._columns).view(*shape, 3)
            self._sideways = None
            if (along[..., :2] != 0.0).any():
                limit = torch.full((directions.shape[1],), torch.inf) if reach is None else reach
                limit = limit[self._columns].view(-1, self._width, 1).repeat(self._num_envs, 1, 1)
                self._sideways = (along[..., :2] * limit).nan_to_num()
            self._along = along.numpy()
            # Tensors made under `inference_mode` do not count writes, so they are never the same.
            version = -1 if directions.is_inference() else directions._version
            self._given = (directions, version, None if reach is None else reach.clone())
        return self._along, self._sideways

    def _are_as_given(self, directions: torch.Tensor, reach: torch.Tensor | None) -> bool:
        """Return whether these are the directions and the reach of the last call."""
        last, version, last_reach = self._given
        if last is not directions or directions.is_inference() or version != directions._version:
            return False
        if reach is None or last_reach is None:
            return reach is last_reach
        return torch.equal(reach, last_reach)

    def _bounds(self, start: torch.Tensor, sideways: torch.Tensor | None) -> tuple[Array, Array]:
        """Return the centres and half extents (rows, 2) of what the rays cross on the ground."""
        flat = start[..., :2]
        low, high = flat.amin(dim=1), flat.amax(dim=1)
        if sideways is not None:
            ends = flat + sideways
            low, high = low.minimum(ends.amin(dim=1)), high.maximum(ends.amax(dim=1))
        return ((low + high) / 2).double().numpy(), ((high - low) / 2).numpy()

    def _load(self, centre: Array) -> None:
        """Give the clusters that have come into another tile its geoms."""
        tiles = self._table.find(centre)
        rows = np.flatnonzero(tiles != self._tiles)
        if len(rows) == 0:
            return
        self._tiles[rows] = tiles[rows]
        slots = self._table.entries[tiles[rows]]
        for name, field in self._fields.items():
            field[rows] = self._values[name][slots]
        self._ids[rows, :-1] = np.append(self._geoms.ids, -1)[slots]

    def _geom_ids(self, rows: Any, slots: Array) -> Array:
        return np.take_along_axis(self._ids[rows], slots, axis=1)

    def _passed(self, rows: Any, origins: Array, directions: Array, hits: Hits) -> Array:
        assert self._rule is not None
        geoms = self._geom_ids(rows, hits.geoms)
        return self._rule.passed(origins, directions, hits.distances, hits.normals, geoms)

    def _scatter(self, out: Hits) -> None:
        """Write the results to the columns of their rays."""
        geoms = self._geom_ids(slice(None), self._hits.geoms)
        results = (self._hits.distances, self._hits.normals, geoms)
        for result, target in zip(results, (out.distances, out.normals, out.geoms), strict=True):
            by_env = torch.from_numpy(result).view(self._num_envs, -1, *result.shape[2:])
            torch.from_numpy(target).index_copy_(
                1, self._targets, by_env.index_select(1, self._filled)
            )
