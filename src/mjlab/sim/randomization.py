"""Per-environment model fields: which fields they are, derived constants, values of variants.

`Simulation.expand_model_fields` gives fields to environments on both engines. `expand_model_fields`
and `put_variant_model` are for packages that hold a MuJoCo Warp model themselves.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import mujoco
import numpy as np


class RecomputeLevel(IntEnum):
    """Constants of the model to recompute after a change of other fields.

    `set_const_0` does not include `set_const_fixed`: together they are `set_const`.
    """

    none = 0
    """None."""
    set_const_fixed = 1
    """Those that do not depend on a configuration (body_subtreemass)."""
    set_const_0 = 2
    """Those evaluated at qpos0 (inverse weights, tendon lengths, actuator acc0)."""
    set_const = 3
    """Both."""


# Fields that `mj_setConst` writes: sums over the tree, and what depends on the configuration qpos0.
FIXED_CONSTANTS = ("body_subtreemass",)
CONSTANTS_AT_QPOS0 = (
    *("dof_invweight0", "body_invweight0", "tendon_length0", "tendon_invweight0", "actuator_acc0"),
    *("actuator_biasprm", "eq_data"),
    *("cam_pos0", "cam_poscom0", "cam_mat0", "light_pos0", "light_poscom0", "light_dir0"),
)

VARIANT_DEPENDENT_FIELDS = (
    *("geom_size", "geom_rbound", "geom_aabb", "geom_pos", "geom_quat"),
    *("body_mass", "body_subtreemass", "body_inertia", "body_invweight0", "body_ipos"),
    "body_iquat",
)
"""Model fields that are per environment wherever an entity has variants.

Other fields are per environment too if the variants differ in them."""

# Whole numbers and flags that every engine can hold per environment. All others are structure.
_PER_ENV_INTEGERS = frozenset(
    {"geom_dataid", "geom_matid", "mat_texid", "mat_texuniform"}
    | {"light_active", "light_castshadow", "light_type"}
)
# Real numbers that MuJoCo Warp shares: assets, keyframes, flexes, and single fields.
_SHARED_KINDS = frozenset(
    {"bvh", "efm0", "flex", "flexedge", "hfield", "key", "mesh", "numeric", "oct", "skin", "tuple"}
    | {"wrap"}
)
_SHARED_FIELDS = frozenset(
    {"cam_sensorsize", "dof_length", "geom_fluid", "sensor_cutoff", "site_size"}
)


def is_structure(field: str, value: np.ndarray) -> bool:
    """Return True if a model field has no environment dimension as long as it is not expanded.

    The rule is that of MuJoCo Warp's model, on both engines.
    """
    if value.dtype.kind != "f":
        return field not in _PER_ENV_INTEGERS
    return field in _SHARED_FIELDS or field.partition("_")[0] in _SHARED_KINDS


# MuJoCo Warp's models.


def expand_model_fields(model: Any, nworld: int, fields_to_expand: list[str]) -> None:
    """Give each of `nworld` worlds its own row of fields of a `mujoco_warp.Model`, in place.

    Rows start as the shared one; fields that are per world already are left alone. Capture a CUDA
    graph again (`sim.create_graph()`) that was captured before.

    Raises:
        ValueError: no such field, or one that MuJoCo Warp cannot hold per world.
    """
    from mjlab.sim.warp.engine import expand_arrays

    expand_arrays(getattr(model, "struct", model), nworld, list(fields_to_expand))


def put_variant_model(model: mujoco.MjModel, nworld: int, values: VariantValues) -> Any:
    """Return a `mujoco_warp.Model` on Warp's current device, with the values of each world."""
    from mjlab.sim.warp import engine

    return engine.put_variant_model(model, nworld, values)


# Variants.


@dataclass(frozen=True)
class VariantColumns:
    """Values that one variant of an entity puts into a model."""

    fields: dict[str, tuple[np.ndarray, np.ndarray]]
    """By model field: ids of elements, and their values."""
    absent_geoms: np.ndarray
    """Ids of geoms that this variant does not have."""


class VariantInfo(Protocol):
    """Variants of an entity, as a simulation needs them."""

    def assign_worlds(self, num_envs: int) -> np.ndarray:
        """Return the variant of each environment, (num_envs,) int."""

    def columns(self, model: mujoco.MjModel) -> list[VariantColumns]:
        """Return what each variant puts into `model`; all variants name the same elements."""


class VariantValues:
    """Values of model fields in each environment, according to its variants.

    The model of the scene is compiled once, with room for all variants; every environment gets the
    values that it would have if compiled with its own variants alone.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        info: list[tuple[str, VariantInfo]],
        derived: tuple[str, ...],
    ) -> None:
        """Compute the values once for each combination of variants that occurs.

        Args:
            model: Compiled model of the scene.
            num_envs: Number of environments.
            info: Name and variants of each entity that has some.
            derived: Fields that the engine recomputes after changes of others.
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
        self._values = _compute_values(model, chosen, derived)
        absent = [np.concatenate([part.absent_geoms for part in parts]) for parts in chosen]
        masks = [np.isin(np.arange(model.ngeom), geoms) for geoms in absent]
        self.absent_geoms = np.stack(masks)[self._row]
        """(N, ngeom) bool: geoms that an environment does not have."""

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields whose values differ between environments."""
        return tuple(self._values)

    def get(self, field: str) -> np.ndarray:
        """Return the values (N, ...) of one of `fields`, in MuJoCo's own type."""
        return self._values[field][self._row]


def _compute_values(
    model: mujoco.MjModel, combinations: list[list[VariantColumns]], derived: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Return the fields that differ between environments, one row for each combination."""
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
        for mark in ("body_sameframe", "geom_sameframe", "site_sameframe"):
            # Frames that the compiler found to coincide need not coincide in this combination.
            getattr(scratch, mark)[:] = 0
        mujoco.mj_setConst(scratch, data)
        for name in names:
            rows[name].append(np.array(getattr(scratch, name)))
    values = {name: np.stack(arrays) for name, arrays in rows.items()}
    # Differences within single precision are none.
    return {
        name: array
        for name, array in values.items()
        if name in VARIANT_DEPENDENT_FIELDS
        or not np.allclose(array, getattr(model, name)[None], rtol=1e-6, atol=1e-12)
    }
