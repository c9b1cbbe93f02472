"""Whether geoms that never move are, in every environment, what they were compiled to be."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
import torch

Array = np.ndarray

_GEOM_FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_dataid", "geom_matid")
_BODY_FIELDS = ("body_pos", "body_quat")


class SharedGeoms:
    """Some static geoms; compares what environments have for themselves with what was compiled.

    Rays that look for these geoms where they were compiled to be rely on it. Other fields, and
    other columns of these fields (those of a robot), may differ. Of colours it is transparency
    alone that matters.
    """

    def __init__(self, model: mujoco.MjModel, geoms: Array) -> None:
        """Hold what was compiled of the geoms with the ids `geoms`."""
        bodies = set(model.geom_bodyid[geoms].tolist())
        for body in tuple(bodies):
            while body > 0:
                body = int(model.body_parentid[body])
                bodies.add(body)
        columns = dict.fromkeys(_GEOM_FIELDS, geoms)
        columns |= {name: np.array(sorted(bodies), dtype=int) for name in _BODY_FIELDS}
        self._columns = {name: torch.from_numpy(np.array(ids)) for name, ids in columns.items()}
        self._compiled = {
            name: torch.from_numpy(np.array(getattr(model, name)[ids]))
            for name, ids in columns.items()
        }
        materials = model.geom_matid[geoms]
        self._alphas = {
            "geom_rgba": torch.from_numpy(np.array(geoms[materials < 0])),
            "mat_rgba": torch.from_numpy(np.unique(materials[materials >= 0]).astype(int)),
        }
        self._names = (*self._columns, *self._alphas)
        self._seen: dict[str, int] = {}
        self._differing: str | None = None

    def differing_field(self, fields: Mapping[str, torch.Tensor]) -> str | None:
        """Return a field in which an environment differs from what was compiled, or None.

        `fields` are those that environments have for themselves, (N, ...). They are compared only
        after they were written.
        """
        versions = {name: fields[name]._version for name in self._names if name in fields}
        if versions != self._seen:
            self._seen = versions
            differing = (name for name in versions if self._differs(name, fields[name]))
            self._differing = next(differing, None)
        return self._differing

    def _differs(self, name: str, field: torch.Tensor) -> bool:
        if name in self._alphas:
            return bool((field[:, self._alphas[name], 3] == 0.0).any())
        own = field[:, self._columns[name]]
        return not torch.equal(own, self._compiled[name].to(own.dtype).expand_as(own))
