"""Variant entities: per-environment meshes, primitives and model parameters.

All variants have the same bodies and joints, so states, actions and observations have the same
shapes. The scene holds one merged spec with slots for the geoms of every variant; each environment
gets the compiled values of its variant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import mujoco
import numpy as np

from mjlab.entity.building import copy_spec
from mjlab.entity.entity import Entity, EntityCfg
from mjlab.entity.indexing import element_ids
from mjlab.entity.variant_merge import (
    OPTIONAL_KINDS,
    Shared,
    Slot,
    VariantGeomSpec,
    check_references,
    merge_specs,
    split_geoms,
    walk_bodies,
)
from mjlab.entity.variant_merge import RESERVED_NAME_PREFIXES as RESERVED_NAME_PREFIXES
from mjlab.entity.variant_merge import BodySignature as BodySignature
from mjlab.entity.variant_merge import GeomRole as GeomRole
from mjlab.entity.variant_merge import GeomSignature as GeomSignature
from mjlab.entity.variant_merge import JointSignature as JointSignature
from mjlab.entity.variant_merge import SlotKey as SlotKey
from mjlab.entity.variant_merge import VariantSlot as VariantSlot
from mjlab.entity.variant_merge import validate_variant_specs as validate_variant_specs
from mjlab.sim.engine import CONSTANTS_AT_QPOS0, FIXED_CONSTANTS
from mjlab.sim.randomization import VARIANT_DEPENDENT_FIELDS as VARIANT_DEPENDENT_FIELDS
from mjlab.sim.randomization import (
    VariantColumns,
    VariantInfo,
    VariantValues,
    put_variant_model,
)
from mjlab.utils.errors import check_exists
from mjlab.utils.mujoco import control_columns, dof_width, force_columns, qpos_width
from mjlab.utils.spec import compile_composed, compile_spec

Assignment = dict[str, float] | Callable[[int], Sequence[int]] | None

InertialMode = Literal["mesh-derived", "diagonal", "fullinertia"]
"""Source of a body's inertia: geoms, `diaginertia` or `fullinertia`."""


def _variant_spec_fn_unset() -> mujoco.MjSpec:
    raise ValueError(
        "VariantEntityCfg.spec_fn is not used, because specs come from `variants`; build the entity "
        "with cfg.build()."
    )


@dataclass
class VariantEntityCfg(EntityCfg):
    """Configuration of a floating entity with one of several variants per environment.

    Variants must have the same bodies, joints, actuators, sensors, tendons and equalities, by name
    and order. They may differ in number and types of meshes and primitives, in materials, and in all
    model parameters (masses, sizes, friction, ...) that the engine can hold per environment; for
    others, building the simulation raises an error that names them. All other settings of the config
    (collisions, actuators, ...) are applied to each variant, by the names in the variant's spec.
    """

    spec_fn: Callable[[], mujoco.MjSpec] = _variant_spec_fn_unset
    """Not used. Must stay unset."""
    variants: dict[str, Callable[[], mujoco.MjSpec]] = field(default_factory=dict)
    """Functions that return a new MuJoCo spec per call, by variant name."""
    assignment: dict[str, float] | Callable[[int], Sequence[int]] | None = None
    """Assignment of variants to environments, fixed for the simulation: None for equal shares;
    weights by name (default 1), rounded by largest remainders; or a function from the number of
    environments to the variant index of each environment."""

    def build(self) -> Entity:
        """Build the entity.

        Raises:
            ValueError: `variants` is empty, the variants differ in structure, or the assignment is
                invalid. The message names the variant and a fix.
        """
        return VariantEntity(self)


@dataclass(frozen=True)
class VariantMetadata:
    """Variants of an entity: names, assignment, slots, specs and compiled values."""

    variant_names: tuple[str, ...]
    """Names of the variants, in order."""
    assignment: tuple[float, ...] | Callable[[int], Sequence[int]] = ()
    """Weight of each variant, or the function that assigns variants."""
    slots: tuple[VariantSlot, ...] = ()
    """Geoms of the merged spec that differ between variants, sorted by path, role (visual first)
    and number."""
    variant_slot_specs: tuple[tuple[VariantGeomSpec | None, ...], ...] = ()
    """Geom in each slot, per variant. None: empty slot."""
    variant_source_specs: tuple[mujoco.MjSpec, ...] = ()
    """Spec of each variant alone, with the entity's editors and actuators applied."""
    table: VariantTable | None = field(default=None, repr=False, compare=False)
    """Compiled values of each variant."""

    @property
    def num_mesh_geoms(self) -> int:
        """Number of slots that hold meshes."""
        return sum(
            any(names[s] is not None for names in self.variant_mesh_names)
            for s in range(len(self.slots))
        )

    @property
    def variant_mesh_names(self) -> tuple[tuple[str | None, ...], ...]:
        """Mesh name in each slot, per variant. None: no mesh."""
        return tuple(
            tuple(None if geom is None else geom.mesh_name or None for geom in own)
            for own in self.variant_slot_specs
        )

    def assign_worlds(self, num_envs: int) -> np.ndarray:
        """Return the variant index of each environment, (num_envs,) int64; see `assign_worlds`."""
        return assign_worlds(self.assignment, self.variant_names, num_envs)

    def columns(self, model: mujoco.MjModel) -> list[VariantColumns]:
        """Return the values of each variant in `model`, compiled from a spec with the merged spec."""
        assert self.table is not None
        return self.table.columns(model)


class VariantEntity(Entity):
    """Entity whose merged spec has slots for all variants.

    The entity is built as its first variant, and the other variants as separate entities with the
    same config. Their geoms and assets are then merged into the first spec.
    """

    def __init__(self, cfg: VariantEntityCfg) -> None:
        """Build and merge all variants. Raises as `VariantEntityCfg.build`."""
        names = tuple(cfg.variants)
        if not names:
            raise ValueError(
                "VariantEntityCfg.variants: expected at least one function that returns a spec, by "
                "variant name, got none."
            )
        sources = [
            copy_spec(make(), f"VariantEntityCfg.variants[{name!r}]")
            for name, make in cfg.variants.items()
        ]
        validate_variant_specs(list(names), sources)
        settings: dict[str, Any] = {f.name: getattr(cfg, f.name) for f in fields(EntityCfg)}
        specs = []
        for name, spec in zip(names, sources, strict=True):
            try:
                settings["spec_fn"] = lambda spec=spec: spec
                single = EntityCfg(**settings)
                if spec is sources[0]:
                    super().__init__(single)
                    specs.append(self._spec)
                else:
                    specs.append(single.build().spec)
            except ValueError as error:
                raise ValueError(f"Variant {name!r}: {error}") from error
        self.cfg = cfg
        weights = resolve_assignment(names, cfg.assignment)
        self._metadata = _merge(list(names), specs, weights)

    @property
    def variant_metadata(self) -> VariantMetadata:
        """Variants and their assignment to environments."""
        return self._metadata


def build_merged_variant_spec(cfg: VariantEntityCfg) -> tuple[mujoco.MjSpec, VariantMetadata]:
    """Return the merged spec of all variants of an entity, and its metadata.

    Raises:
        ValueError: as `VariantEntityCfg.build`.
    """
    entity = VariantEntity(cfg)
    return entity.spec, entity.variant_metadata


@dataclass
class MeshVariantResult:
    """Models of a scene with variant entities."""

    wp_model: Any
    """MuJoCo Warp model, with per-world values of variant fields."""
    mj_model: mujoco.MjModel
    """Compiled model."""
    world_to_variant: dict[str, np.ndarray]
    """Variant index of each world, (nworld,), by entity name."""


def build_variant_model(
    spec: mujoco.MjSpec,
    nworld: int,
    variant_info: list[tuple[str, VariantMetadata]],
    configure_model: Callable[[mujoco.MjModel], None] | None = None,
) -> MeshVariantResult:
    """Compile a scene for MuJoCo Warp, for packages that do not use `Simulation`.

    Args:
        spec: Spec of the scene, with the merged specs of its entities.
        nworld: Number of worlds.
        variant_info: Name and variants of each variant entity.
        configure_model: Edits the compiled model before it is put on the device.

    Raises:
        ValueError: the spec does not compile, with MuJoCo's message.
    """
    model = compile_spec(spec)
    if configure_model is not None:
        configure_model(model)
    info: list[tuple[str, VariantInfo]] = list(variant_info)
    values = VariantValues(model, nworld, info, (*FIXED_CONSTANTS, *CONSTANTS_AT_QPOS0))
    return MeshVariantResult(
        put_variant_model(model, nworld, values), model, values.world_to_variant
    )


# Assignment of variants to environments.


def allocate_worlds(weights: tuple[float, ...], nworld: int) -> list[int]:
    """Return the variant index of each of `nworld` environments, in contiguous blocks.

    Each variant gets its quota `w_i / sum(w) * nworld`, rounded down. The rest goes to the largest
    remainders; ties go to the earlier variant.

    Raises:
        ValueError: a weight is negative or not finite, or all are zero.
    """
    bad = [weight for weight in weights if not (math.isfinite(weight) and weight >= 0.0)]
    total = sum(weights)
    if bad or not 0.0 < total < math.inf:
        raise ValueError(
            f"Variant weights: expected finite numbers >= 0, not all zero, got {tuple(weights)}; "
            "a weight of 0 omits a variant."
        )
    quotas = [weight / total * nworld for weight in weights]
    # Tolerance for quotas that are integers except for rounding, such as 3 * (1 / 3).
    counts = [math.floor(quota + 1e-9) for quota in quotas]
    remainders = [quota - count for quota, count in zip(quotas, counts, strict=True)]
    order = sorted(range(len(weights)), key=lambda k: (-round(remainders[k], 9), k))
    for k in order[: nworld - sum(counts)]:
        counts[k] += 1
    return [k for k, count in enumerate(counts) for _ in range(count)]


def resolve_assignment(
    names: tuple[str, ...], assignment: Assignment
) -> tuple[float, ...] | Callable[[int], Sequence[int]]:
    """Return one weight per variant, or the callable that assigns variants.

    Raises:
        ValueError: `assignment` names an unknown variant.
    """
    if assignment is not None and not isinstance(assignment, dict):
        return assignment
    weights_by_name: dict[str, float] = {} if assignment is None else assignment
    for name in weights_by_name:
        check_exists("variant in VariantEntityCfg.assignment", name, names)
    return tuple(float(weights_by_name.get(name, 1.0)) for name in names)


def assign_worlds(
    assignment: tuple[float, ...] | Callable[[int], Sequence[int]],
    names: tuple[str, ...],
    nworld: int,
) -> np.ndarray:
    """Return the variant index of each environment, (nworld,) int64.

    Raises:
        ValueError: weights are invalid, or a callable returns a wrong number of indices or an index
            out of range.
    """
    if not callable(assignment):
        return np.array(allocate_worlds(assignment, nworld), dtype=np.int64)
    found = np.asarray(assignment(nworld))
    if found.shape != (nworld,) or not np.array_equal(found, found.astype(np.int64)):
        raise ValueError(
            f"VariantEntityCfg.assignment({nworld}): expected {nworld} integers, the variant index of "
            f"each environment, got an array of shape {found.shape} and type {found.dtype}."
        )
    outside = sorted({int(k) for k in found if not 0 <= k < len(names)})
    if outside:
        raise ValueError(
            f"VariantEntityCfg.assignment: expected indices 0 to {len(names) - 1} of the variants "
            f"{list(names)}, got {outside}."
        )
    return found.astype(np.int64)


# Merged spec.


def _merge(
    names: list[str],
    specs: list[mujoco.MjSpec],
    assignment: tuple[float, ...] | Callable[[int], Sequence[int]],
) -> VariantMetadata:
    """Merge all specs into the first one, in place, and return the metadata."""
    models = []
    for name, spec in zip(names, specs, strict=True):
        # Scenes ignore these settings of attached specs, and they would remove elements here.
        spec.compiler.discardvisual = False
        spec.compiler.fusestatic = False
        try:
            models.append(compile_composed(spec))
        except ValueError as error:
            raise ValueError(f"Variant {name!r} does not compile: {error}") from error
    source_specs = tuple(spec.copy() for spec in specs)
    paths = [path for path, _ in walk_bodies(specs[0])]
    bodies = [
        list(group)
        for group in zip(*([body for _, body in walk_bodies(spec)] for spec in specs), strict=True)
    ]
    split = [split_geoms(path, own, names) for path, own in zip(paths, bodies, strict=True)]
    shared: list[Shared] = [group for own, _ in split for group in own]
    slots = [slot for _, own in split for slot in own]
    for k, (name, spec) in enumerate(zip(names, specs, strict=True)):
        check_references(name, spec, slots, shared, k)
    # Elements shared by all variants, with their id in each variant, by kind.
    groups: dict[str, list[Any]] = {"bodies": bodies, "geoms": shared}
    elements = {}
    for kind in _FIELD_PREFIXES:
        if kind not in groups:
            groups[kind] = _matching(kind, specs)
        elements[kind] = [
            (group[0], [int(element.id) for element in group]) for group in groups[kind]
        ]
    slot_ids = [[-1 if geom is None else int(geom.id) for geom in slot.geoms] for slot in slots]
    described = _describe(slots, len(names))
    assets, geoms = merge_specs(names, specs, bodies, [own for _, own in split])
    merged_geoms = [geom for own in geoms for geom in own]
    elements["geoms"] += list(zip(merged_geoms, slot_ids, strict=True))
    return VariantMetadata(
        tuple(names),
        assignment,
        *described,
        source_specs,
        VariantTable(models, elements, assets),
    )


def _matching(kind: str, specs: list[mujoco.MjSpec]) -> list[Any]:
    """Return the elements of `kind` that all variants have, one per variant, in the first's order."""
    own = [getattr(spec, kind) for spec in specs]
    if kind not in OPTIONAL_KINDS or len({tuple(e.name for e in found) for found in own}) == 1:
        return list(zip(*own, strict=True))
    by_name = [{element.name: element for element in found if element.name} for found in own]
    shared = [name for name in by_name[0] if all(name in found for found in by_name)]
    return [tuple(found[name] for found in by_name) for name in shared]


def _describe(slots: list[Slot], count: int) -> tuple[Any, Any]:
    """Return the slots in metadata order, and the geoms of each variant in them."""
    ordered = sorted(slots, key=lambda s: (s.key.body_path, s.key.role != "visual", s.key.ordinal))
    shown = tuple(
        VariantSlot(
            slot.key,
            slot.key.name,
            tuple(None if geom is None else geom.name or None for geom in slot.geoms),
        )
        for slot in ordered
    )
    specs = tuple(
        tuple(
            None if (geom := slot.geoms[k]) is None else VariantGeomSpec.of(geom)
            for slot in ordered
        )
        for k in range(count)
    )
    return shown, specs


# Compiled values of each variant.

# Prefix of model field names, by kind of element.
_FIELD_PREFIXES = {
    "bodies": "body_",
    "joints": "jnt_",
    "geoms": "geom_",
    "sites": "site_",
    "cameras": "cam_",
    "lights": "light_",
    "tendons": "tendon_",
    "actuators": "actuator_",
    "equalities": "eq_",
    "sensors": "sensor_",
}

# Integer fields that hold parameters; most others hold addresses. Real fields always hold parameters.
_INTEGER_PARAMETERS = frozenset(
    {"jnt_limited", "jnt_actfrclimited", "jnt_actgravcomp", "site_type", "site_group", "cam_mode"}
    | {"cam_projection", "cam_resolution", "light_mode", "light_type", "light_active"}
    | {"light_castshadow", "tendon_limited", "tendon_actfrclimited", "actuator_ctrllimited"}
    | {"actuator_forcelimited", "actuator_actlimited", "actuator_dyntype", "actuator_gaintype"}
    | {"actuator_biastype", "actuator_actearly", "eq_active0"}
)

# Derived fields, recomputed for the whole scene.
_DERIVED = frozenset({"body_margin", "dof_length", "dof_M0", "actuator_length0"}) | (
    frozenset((*FIXED_CONSTANTS, *CONSTANTS_AT_QPOS0)) - {"actuator_biasprm", "eq_data"}
)

# Fields with one row per control or force; an actuator may have several.
_CONTROL_FIELDS = frozenset({"actuator_ctrllimited", "actuator_ctrlrange"})
_FORCE_FIELDS = frozenset({"actuator_gear", "actuator_lengthrange"})
_ASSET_FIELDS = {
    "geom_matid": "materials",
    "site_matid": "materials",
    "tendon_matid": "materials",
    "geom_dataid": "meshes",
}

# Values of absent geoms: no extent, no mesh, no material. Other fields keep the values of
# another variant.
_ABSENT = {"geom_size": 0, "geom_rbound": 0, "geom_aabb": 0, "geom_dataid": -1, "geom_matid": -1}


class VariantTable:
    """Values of all variants, each compiled alone, and the merged elements they apply to."""

    def __init__(
        self,
        models: list[mujoco.MjModel],
        elements: dict[str, list[tuple[Any, list[int]]]],
        assets: dict[str, list[list[Any]]],
    ) -> None:
        """Store compiled variants and merged elements.

        Args:
            models: Each variant compiled alone.
            elements: Elements of the merged spec with their id in every model (-1: absent), by
                kind. The first body is the root.
            assets: Merged element of each mesh and material of each variant, by kind.
        """
        self._models, self._elements, self._assets = models, elements, assets
        self._root = elements["bodies"][0][0]

    def columns(self, model: mujoco.MjModel) -> list[VariantColumns]:
        """Return the values of each variant in `model`, compiled from a spec with the merged spec."""
        ids = {
            kind: np.array(element_ids(model, kind, [e for e, _ in pairs]), dtype=int)
            for kind, pairs in self._elements.items()
        }
        assets = {
            field: [np.array([*element_ids(model, kind, own), -1]) for own in self._assets[kind]]
            for field, kind in _ASSET_FIELDS.items()
        }
        return [self._columns_of(k, model, ids, assets) for k in range(len(self._models))]

    def _columns_of(
        self,
        k: int,
        model: mujoco.MjModel,
        ids: dict[str, np.ndarray],
        assets: dict[str, list[np.ndarray]],
    ) -> VariantColumns:
        fields: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for kind, pairs in self._elements.items():
            # Values of elements absent in this variant come from the first variant that has them.
            sources = [
                (k, own[k]) if own[k] >= 0 else next((j, i) for j, i in enumerate(own) if i >= 0)
                for _, own in pairs
            ]
            for name in self._fields_of(kind):
                values = [getattr(self._models[j], name)[i] for j, i in sources]
                if name in assets:
                    values = [assets[name][j][i] for (j, _), i in zip(sources, values, strict=True)]
                if len(values):
                    fields[name] = ids[kind], np.stack(values)
        fields |= self._by_address(k, model, ids["joints"], ids["actuators"])
        # The root pose is the entity's initial state, the same for all variants.
        for name in ("body_pos", "body_quat"):
            targets, values = fields[name]
            fields[name] = targets[1:], values[1:]
        absent = np.array([own[k] < 0 for _, own in self._elements["geoms"]], dtype=bool)
        if absent.any():
            for name, value in _ABSENT.items():
                fields[name][1][absent] = value
            fields["geom_rgba"][1][absent, 3] = 0.0
        return VariantColumns(fields, ids["geoms"][absent])

    def _fields_of(self, kind: str) -> list[str]:
        """Return the fields that hold parameters, with one row per element of `kind`."""
        prefix, model = _FIELD_PREFIXES[kind], self._models[0]
        names = [name for name in dir(model) if name.startswith(prefix)]
        return [
            name
            for name in names
            if isinstance(array := getattr(model, name), np.ndarray)
            and name not in _DERIVED | _CONTROL_FIELDS | _FORCE_FIELDS
            and (array.dtype.kind == "f" or name in _INTEGER_PARAMETERS or name in _ASSET_FIELDS)
        ]

    def _by_address(
        self, k: int, model: mujoco.MjModel, joints: np.ndarray, actuators: np.ndarray
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return the fields with one row per degree of freedom, position, control or force."""
        own = self._models[k]
        there = [ids[k] for _, ids in self._elements["actuators"]]
        places: dict[str, list[tuple[int, int]]] = {
            kind: list(zip(columns(model, actuators), columns(own, there), strict=True))
            for kind, columns in (("control", control_columns), ("force", force_columns))
        }
        places |= {"dof": [], "qpos": []}
        for joint, (_, ids) in zip(joints, self._elements["joints"], strict=True):
            kind, joint_there = int(model.jnt_type[joint]), ids[k]
            for j in range(dof_width(kind)):
                places["dof"].append((model.jnt_dofadr[joint] + j, own.jnt_dofadr[joint_there] + j))
            if kind != mujoco.mjtJoint.mjJNT_FREE:
                for j in range(qpos_width(kind)):
                    places["qpos"].append(
                        (model.jnt_qposadr[joint] + j, own.jnt_qposadr[joint_there] + j)
                    )
        names = {"qpos0": "qpos", "qpos_spring": "qpos"}
        names |= {name: "dof" for name in dir(own) if name.startswith("dof_")}
        names |= dict.fromkeys(_CONTROL_FIELDS, "control") | dict.fromkeys(_FORCE_FIELDS, "force")
        fields = {}
        for name, kind in names.items():
            array = getattr(own, name)
            is_parameter = array.dtype.kind == "f" or name in _INTEGER_PARAMETERS
            if places[kind] and is_parameter and name not in _DERIVED:
                here, rows = np.array(places[kind], dtype=int).T
                fields[name] = here, array[rows]
        return fields
