"""Keeping MuJoCo's search for colliding geoms right when geoms or inertial frames are randomized.

The compiler puts the geoms of a body into a tree of boxes, which stands in the frame of the body's
inertia, and MuJoCo only compares geoms whose boxes overlap. The tree is shared by all environments:
where geoms of one of them are larger or elsewhere, or where its centre of mass is, contacts would be
missed. `body_margin`, by which MuJoCo widens the boxes of a body before it compares them, and which
has no other effect, is per environment, so it takes up the difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco
import numpy as np
import torch

FIELDS = (
    *("geom_pos", "geom_quat", "geom_aabb", "geom_margin", "geom_gap"),
    *("body_ipos", "body_iquat"),
)
"""Model fields that the boxes depend on."""

# Boxes are compared in double precision, randomized fields are single.
_ROUNDING = 1e-6


class MidphaseMargins:
    """Widens the boxes of bodies, in each environment by what its own fields need."""

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, expand: Callable[[str], np.ndarray]
    ) -> None:
        """Hold what was compiled.

        Args:
            model: The compiled model.
            num_envs: Number of environments.
            expand: Gives every environment its own values of a model field, and returns them.
        """
        self._default = {name: np.array(getattr(model, name)) for name in FIELDS}
        self._default_margin = np.array(model.body_margin)
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        collides |= np.isin(np.arange(model.ngeom), [model.pair_geom1, model.pair_geom2])
        self._geoms = np.flatnonzero(collides)
        self._bodies = model.geom_bodyid[self._geoms]
        self._num_envs = num_envs
        self._expand = expand
        self._margin: np.ndarray | None = None
        self._seen: dict[str, int] = {}

    def refresh(self, fields: Mapping[str, torch.Tensor]) -> None:
        """Set the margins anew if one of the expanded `fields` was written since the last call."""
        versions = {name: fields[name]._version for name in FIELDS if name in fields}
        if versions == self._seen:
            return
        self._seen = versions
        if self._margin is None:
            self._margin = self._expand("body_margin")
        own = {name: fields[name].numpy() for name in versions}
        differs = self._differs(own)
        self._margin[:] = self._default_margin
        for k in np.flatnonzero(differs.any(axis=0)):
            geom, body, envs = self._geoms[k], self._bodies[k], np.flatnonzero(differs[:, k])
            need = self._needed(own, geom, body, envs)
            self._margin[envs, body] = np.maximum(self._margin[envs, body], need)

    def _differs(self, own: dict[str, np.ndarray]) -> np.ndarray:
        """Return where a geom is not as compiled: environments by geoms."""
        differs = np.zeros((self._num_envs, len(self._geoms)), dtype=bool)
        for name, values in own.items():
            changed = values != self._default[name].astype(values.dtype)
            changed = changed.reshape(*changed.shape[:2], -1).any(axis=2)
            differs |= changed[:, self._geoms if name.startswith("geom_") else self._bodies]
        return differs

    def _needed(
        self, own: dict[str, np.ndarray], geom: int, body: int, envs: np.ndarray
    ) -> np.ndarray:
        """Return the margin (K,) with which the compiled box covers the geom as it is."""

        def current(name: str) -> np.ndarray:
            index = geom if name.startswith("geom_") else body
            values = own[name][envs, index] if name in own else self._default[name][index][None]
            return values.astype(np.float64).reshape(len(values), -1)

        def compiled(name: str) -> np.ndarray:
            index = geom if name.startswith("geom_") else body
            return self._default[name][index].reshape(1, -1)

        centre, half = _box_in_inertial_frame(current)
        default_centre, default_half = _box_in_inertial_frame(compiled)
        excess = np.maximum(np.abs(centre - default_centre) + half - default_half, 0.0)
        margin = current("geom_margin") + np.maximum(current("geom_gap"), 0.0)
        # Boxes are compared along the axes of either. Along a slanted axis the excesses in all
        # three directions count, together at most as much as their norm.
        return margin[:, 0] + np.linalg.norm(excess, axis=1) + _ROUNDING


def _box_in_inertial_frame(get: Callable[[str], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and half sizes, (K, 3) each, of a geom's box along its body's inertial axes."""
    to_inertial = _matrix(get("body_iquat")).transpose(0, 2, 1)
    of_geom = _matrix(get("geom_quat"))
    box = get("geom_aabb")
    centre = get("geom_pos") + np.einsum("kij,kj->ki", of_geom, box[:, :3]) - get("body_ipos")
    turned = np.abs(to_inertial @ of_geom)
    # Planes are unbounded; turning one by whatever angle does not change that.
    half = np.einsum("kij,kj->ki", turned, np.minimum(box[:, 3:], 1e10))
    return np.einsum("kij,kj->ki", to_inertial, centre), half


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (K, 3, 3) of quaternions (K, 4), w first."""
    w, x, y, z = (quat / np.linalg.norm(quat, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
