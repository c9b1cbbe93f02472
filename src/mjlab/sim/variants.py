"""Compile-time values of model fields that differ between environments.

An entity may be another thing in each environment (`mjlab.entity.variants`). The model of the scene
is compiled once, with room for all variants, and every environment gets the values that it would
have if it had been compiled with its own variants alone.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

VARIANT_DEPENDENT_FIELDS = (
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "geom_pos",
    "geom_quat",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "body_ipos",
    "body_iquat",
)
"""Model fields that every environment has for itself wherever an entity has variants.

Others are per environment too where the variants differ in them."""

_FRAME_MARKS = ("body_sameframe", "geom_sameframe", "site_sameframe")


@dataclass(frozen=True)
class VariantColumns:
    """What one variant of an entity puts into a model."""

    fields: dict[str, tuple[np.ndarray, np.ndarray]]
    """By model field: ids of elements, and their values."""
    absent_geoms: np.ndarray
    """Ids of geoms that this variant does not have."""


class VariantInfo(Protocol):
    """What a simulation has to know of an entity with variants."""

    def assign_worlds(self, num_envs: int) -> np.ndarray:
        """Return the variant of each environment, (num_envs,) int."""
        ...

    def columns(self, model: mujoco.MjModel) -> list[VariantColumns]:
        """Return what each variant puts into `model`; all variants name the same elements."""
        ...


class VariantValues:
    """The values of model fields in each environment, from the variants that it holds."""

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        info: list[tuple[str, VariantInfo]],
        derived: tuple[str, ...],
    ) -> None:
        """Compute them, once for each combination of variants that occurs.

        Args:
            model: The compiled model of the scene.
            num_envs: Number of environments.
            info: Name and variants of each entity that has some.
            derived: The fields that the engine recomputes when others have changed.
        """
        assigned = [np.asarray(variants.assign_worlds(num_envs)) for _, variants in info]
        self.world_to_variant = {name: ids for (name, _), ids in zip(info, assigned, strict=True)}
        """Variant of each environment, (N,), by entity."""
        columns = {name: variants.columns(model) for name, variants in info}
        combinations, row = np.unique(np.stack(assigned, axis=1), axis=0, return_inverse=True)
        self._row = row.reshape(-1)
        chosen = [
            [columns[name][k] for (name, _), k in zip(info, combination, strict=True)]
            for combination in combinations
        ]
        self._values = _values_of(model, chosen, derived)
        absent = np.zeros((len(chosen), model.ngeom), dtype=bool)
        for mask, parts in zip(absent, chosen, strict=True):
            for part in parts:
                mask[part.absent_geoms] = True
        self.absent_geoms = absent[self._row]
        """(N, ngeom) bool: geoms that are not there in an environment."""
        self._owners = {
            field: name for name in columns for part in columns[name] for field in part.fields
        }

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields whose values differ between environments."""
        return tuple(self._values)

    def get(self, field: str) -> np.ndarray:
        """Return the values (N, ...) of one of `fields`, in MuJoCo's own type."""
        return self._values[field][self._row]

    def refusal(self, field: str, reason: object) -> str:
        """Return a message for a field that an engine cannot hold per environment."""
        entity = self._owners.get(field)
        where = f"The variants of entity {entity!r}" if entity else "Environments with variants"
        return (
            f"{where} differ in the model field {field!r}, which this engine cannot hold per "
            f"environment: {reason} Give all variants the same value, or use another engine."
        )


def _values_of(
    model: mujoco.MjModel, combinations: list[list[VariantColumns]], derived: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Return the fields that are not the same everywhere, one row for each combination."""
    written = {name for parts in combinations for part in parts for name in part.fields}
    names = list(dict.fromkeys((*VARIANT_DEPENDENT_FIELDS, *sorted(written), *derived)))
    # Each combination writes the same elements, so that one copy serves them all.
    scratch = copy.copy(model)
    data = mujoco.MjData(scratch)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for parts in combinations:
        for part in parts:
            for name, (ids, values) in part.fields.items():
                getattr(scratch, name)[ids] = values
        for mark in _FRAME_MARKS:
            # What the compiler found to coincide need not coincide in this combination.
            getattr(scratch, mark)[:] = 0
        mujoco.mj_setConst(scratch, data)
        for name in names:
            rows[name].append(np.array(getattr(scratch, name)))
    values = {name: np.stack(arrays) for name, arrays in rows.items()}
    return {
        name: array
        for name, array in values.items()
        if name in VARIANT_DEPENDENT_FIELDS or _differs(array, getattr(model, name))
    }


def _differs(values: np.ndarray, compiled: np.ndarray) -> bool:
    """Return whether some row of `values` is not what was compiled, beyond single precision."""
    return not np.allclose(values, compiled[None], rtol=1e-6, atol=1e-12)
