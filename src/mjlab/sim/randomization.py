"""Per-environment model fields, derived constants and values of variants.

`Simulation.expand_model_fields` expands fields on both engines. `expand_model_fields` and
`put_variant_model` are for packages that hold a MuJoCo Warp model themselves.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import mujoco
import numpy as np


class RecomputeLevel(IntEnum):
    """Model constants to recompute after other fields changed.

    `set_const_0` does not include `set_const_fixed`; `set_const` is both.
    """

    none = 0
    """None."""
    set_const_fixed = 1
    """Constants that do not depend on a configuration (`body_subtreemass`)."""
    set_const_0 = 2
    """Constants evaluated at `qpos0` (inverse weights, tendon lengths, actuator acc0)."""
    set_const = 3
    """Both."""


BASES_OF_CONSTANTS = frozenset(
    {"body_mass", "body_ipos", "body_inertia", "body_iquat", "body_gravcomp", "body_pos"}
    | {"body_quat", "dof_armature", "qpos0", "geom_size"}
)
"""Model fields from which MuJoCo derives constants, see `RecomputeLevel`."""

VARIANT_DEPENDENT_FIELDS = (
    *("geom_size", "geom_rbound", "geom_aabb", "geom_pos", "geom_quat"),
    *("body_mass", "body_subtreemass", "body_inertia", "body_invweight0", "body_ipos"),
    "body_iquat",
)
"""Model fields that are per-environment if an entity has variants.

Other fields are too if the variants differ in them."""

# Integers and flags that every engine can hold per environment. All others are structure.
_PER_ENV_INTEGERS = frozenset(
    {"geom_dataid", "geom_matid", "mat_texid", "mat_texuniform"}
    | {"light_active", "light_castshadow", "light_type"}
)
# Floats that MuJoCo Warp shares: assets, keyframes, flexes, and single fields.
_SHARED_KINDS = frozenset(
    {"bvh", "efm0", "flex", "flexedge", "hfield", "key", "mesh", "numeric", "oct", "skin", "tuple"}
    | {"wrap"}
)
_SHARED_FIELDS = frozenset(
    {"cam_sensorsize", "dof_length", "geom_fluid", "sensor_cutoff", "site_size"}
)


def is_structure(field: str, value: np.ndarray) -> bool:
    """Return True if a model field has an environment dimension only when expanded.

    Both engines follow the rule of MuJoCo Warp's model.
    """
    if value.dtype.kind != "f":
        return field not in _PER_ENV_INTEGERS
    return field in _SHARED_FIELDS or field.partition("_")[0] in _SHARED_KINDS


# MuJoCo Warp models.


def expand_model_fields(model: Any, nworld: int, fields_to_expand: list[str]) -> None:
    """Expand fields of a `mujoco_warp.Model` to one row per world, in place.

    Rows start as copies of the shared row; per-world fields keep their values. CUDA graphs captured
    before must be recaptured (`sim.create_graph()`).

    Raises:
        ValueError: unknown field, or one that MuJoCo Warp cannot hold per world.
    """
    from mjlab.sim.warp.engine import expand_arrays

    expand_arrays(getattr(model, "struct", model), nworld, list(fields_to_expand))


def put_variant_model(model: mujoco.MjModel, nworld: int, values: VariantValues) -> Any:
    """Return a `mujoco_warp.Model` with per-world values, on Warp's current device."""
    from mjlab.sim.warp.engine import put_variant_model

    fields = {name: values.get(name) for name in values.fields}
    return put_variant_model(model, nworld, fields, values.absent_geoms)


# Variants.


@dataclass(frozen=True)
class VariantColumns:
    """Model values of one variant of an entity."""

    fields: dict[str, tuple[np.ndarray, np.ndarray]]
    """Element ids and values by model field."""
    absent_geoms: np.ndarray
    """Ids of geoms absent from this variant."""


class VariantInfo(Protocol):
    """Interface to the variants of an entity."""

    def assign_worlds(self, num_envs: int) -> np.ndarray:
        """Return the variant index of each environment, (num_envs,) int."""

    def columns(self, model: mujoco.MjModel) -> list[VariantColumns]:
        """Return the values of each variant in `model`; all variants list the same elements."""


class VariantValues:
    """Per-environment values of model fields for assigned variants.

    The scene's model is compiled once, with room for all variants. Each environment gets the values
    of a model compiled with only the environment's variants.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        info: list[tuple[str, VariantInfo]],
        derived: tuple[str, ...],
    ) -> None:
        """Compute the values once per combination of variants in use.

        Args:
            model: Compiled model of the scene.
            num_envs: Number of environments.
            info: Name and variants of each entity with variants.
            derived: Fields that the engine recomputes when others change.
        """
        assigned = [np.asarray(variants.assign_worlds(num_envs)) for _, variants in info]
        self.world_to_variant = {name: ids for (name, _), ids in zip(info, assigned, strict=True)}
        """Variant index of each environment by entity, (N,)."""
        columns = {name: variants.columns(model) for name, variants in info}
        combinations, row = np.unique(np.stack(assigned, axis=1), axis=0, return_inverse=True)
        self._row = row.reshape(-1)
        chosen = [
            [columns[name][k] for (name, _), k in zip(info, combination, strict=True)]
            for combination in combinations
        ]
        self._values = _compute_values(model, chosen, derived)
        absent = [np.concatenate([part.absent_geoms for part in parts]) for parts in chosen]
        masks = [np.isin(np.arange(model.ngeom), geoms) for geoms in absent]
        self.absent_geoms = np.stack(masks)[self._row]
        """Geoms absent from each environment, (N, ngeom) bool."""

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields whose values differ between environments."""
        return tuple(self._values)

    def drop(self, field: str) -> None:
        """Remove one of `fields`. It has the compiled value in all environments."""
        del self._values[field]

    def get(self, field: str) -> np.ndarray:
        """Return the values of one of `fields` in MuJoCo's dtype, (N, ...)."""
        return self._values[field][self._row]


def _compute_values(
    model: mujoco.MjModel, combinations: list[list[VariantColumns]], derived: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Return values of fields that differ between environments, one row per combination."""
    written = {name for parts in combinations for part in parts for name in part.fields}
    names = list(dict.fromkeys((*VARIANT_DEPENDENT_FIELDS, *sorted(written), *derived)))
    # Each combination writes the same elements, so one copy is enough.
    scratch = copy.copy(model)
    data = mujoco.MjData(scratch)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for parts in combinations:
        for part in parts:
            for name, (ids, values) in part.fields.items():
                getattr(scratch, name)[ids] = values
        for mark in ("body_sameframe", "geom_sameframe", "site_sameframe"):
            # Frames that coincide in the compiled model may differ in this combination.
            getattr(scratch, mark)[:] = 0
        mujoco.mj_setConst(scratch, data)
        for name in names:
            rows[name].append(np.array(getattr(scratch, name)))
    values = {name: np.stack(arrays) for name, arrays in rows.items()}
    # Differences below float32 precision do not count.
    return {
        name: array
        for name, array in values.items()
        if name in VARIANT_DEPENDENT_FIELDS
        or not np.allclose(array, getattr(model, name)[None], rtol=1e-6, atol=1e-12)
    }
