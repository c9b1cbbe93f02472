"""An entity that is another thing in each environment: other meshes, primitives and figures.

All variants have the same bodies and joints, so that states, actions and observations look alike.
The scene holds one spec with room for every variant; each environment then gets the values that
its variant compiles to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import mujoco
import numpy as np

from mjlab.entity._variant_assignment import allocate_worlds as allocate_worlds
from mjlab.entity._variant_assignment import assign_worlds, resolve_assignment
from mjlab.entity._variant_merge import merge_specs, refuse_references
from mjlab.entity._variant_signatures import RESERVED_NAME_PREFIXES as RESERVED_NAME_PREFIXES
from mjlab.entity._variant_signatures import BodySignature as BodySignature
from mjlab.entity._variant_signatures import GeomRole as GeomRole
from mjlab.entity._variant_signatures import GeomSignature as GeomSignature
from mjlab.entity._variant_signatures import JointSignature as JointSignature
from mjlab.entity._variant_signatures import validate_variant_specs as validate_variant_specs
from mjlab.entity._variant_signatures import walk_bodies
from mjlab.entity._variant_slots import Shared, Slot, VariantGeomSpec, split_geoms
from mjlab.entity._variant_slots import SlotKey as SlotKey
from mjlab.entity._variant_slots import VariantSlot as VariantSlot
from mjlab.entity._variant_values import KINDS, VariantTable
from mjlab.entity.entity import Entity, EntityCfg
from mjlab.sim.randomization import (
    CONSTANTS_AT_QPOS0,
    FIXED_CONSTANTS,
    VariantColumns,
    VariantInfo,
    VariantValues,
    put_variant_model,
)
from mjlab.sim.randomization import VARIANT_DEPENDENT_FIELDS as VARIANT_DEPENDENT_FIELDS
from mjlab.utils.spec import compile_composed, compile_spec

InertialMode = Literal["mesh-derived", "diagonal", "fullinertia"]
"""Source of a body's inertia: its geoms, `diaginertia` or `fullinertia`."""


def _variant_spec_fn_unset() -> mujoco.MjSpec:
    raise ValueError(
        "A VariantEntityCfg has no spec_fn; its specs come from `variants`. Build the entity by "
        "cfg.build()."
    )


@dataclass
class VariantEntityCfg(EntityCfg):
    """Describes a floating entity that is one of several things, another in each environment.

    Variants must have the same bodies, joints, actuators, sensors, tendons and equalities, by name
    and order. They may differ in meshes and primitives, also in their number and types, in
    materials, and in all figures (masses, sizes, friction, ...) that the engine can hold per
    environment; others are refused by name when the simulation is built. All other settings of the
    config (collisions, actuators, ...) are applied to each variant, by the names in its own spec.
    """

    spec_fn: Callable[[], mujoco.MjSpec] = _variant_spec_fn_unset
    """Not used: leave it alone."""
    variants: dict[str, Callable[[], mujoco.MjSpec]] = field(default_factory=dict)
    """By name, functions that make the MuJoCo spec of a variant, a new one at each call."""
    assignment: dict[str, float] | Callable[[int], Sequence[int]] | None = None
    """Which variant each environment gets, for the life of the simulation: None for equal shares;
    weights by name (1 where missing), rounded to the largest remainders; or a function from the
    number of environments to the index of each one's variant."""

    def __post_init__(self) -> None:
        self._check()

    def _check(self) -> None:
        if self.spec_fn is not _variant_spec_fn_unset:
            raise ValueError(
                "VariantEntityCfg.spec_fn is set, but the specs come from `variants`. Give the "
                "function there, under a name, or use EntityCfg for an entity that is the same "
                "everywhere."
            )
        if self.variants:
            resolve_assignment(tuple(self.variants), self.assignment)

    def build(self) -> Entity:
        """Build the entity.

        Raises:
            ValueError: there are no variants, they do not have the same structure, or the
                assignment makes no sense; names the variant and says what to do.
        """
        return VariantEntity(self)


@dataclass(frozen=True)
class VariantMetadata:
    """What a simulation and a person have to know of an entity's variants."""

    variant_names: tuple[str, ...]
    """Names of the variants, in order."""
    assignment: tuple[float, ...] | Callable[[int], Sequence[int]] = ()
    """The weight of each variant, or the function that assigns them."""
    slots: tuple[VariantSlot, ...] = ()
    """Geoms of the merged spec that differ: by path, visual ones first, by number."""
    variant_slot_specs: tuple[tuple[VariantGeomSpec | None, ...], ...] = ()
    """For each variant what it has in each slot, or None."""
    variant_source_specs: tuple[mujoco.MjSpec, ...] = ()
    """The spec of each variant alone, with the entity's editors and actuators."""
    table: VariantTable | None = field(default=None, repr=False, compare=False)
    """The values that each variant compiles to."""

    @property
    def num_mesh_geoms(self) -> int:
        """Number of slots that hold meshes."""
        return sum(
            any(names[s] is not None for names in self.variant_mesh_names)
            for s in range(len(self.slots))
        )

    @property
    def variant_mesh_names(self) -> tuple[tuple[str | None, ...], ...]:
        """For each variant the name of the mesh in each slot, or None."""
        return tuple(
            tuple(None if geom is None else geom.mesh_name or None for geom in own)
            for own in self.variant_slot_specs
        )

    def assign_worlds(self, num_envs: int) -> np.ndarray:
        """Return the variant of each environment, (num_envs,) int64. `ValueError` if not possible."""
        return assign_worlds(self.assignment, self.variant_names, num_envs)

    def columns(self, model: mujoco.MjModel) -> list[VariantColumns]:
        """Return what each variant puts into a model that was compiled from a spec with this one."""
        if self.table is None:
            raise ValueError(
                "This VariantMetadata has no values. Take the one of a built entity "
                "(`Entity.variant_metadata`) or of `build_merged_variant_spec`."
            )
        return self.table.columns(model)


class VariantEntity(Entity):
    """An entity whose spec has room for all of its variants.

    It is built as its first variant, and the others as entities of their own, by the same config;
    then the first one's spec gets the geoms and assets of all.
    """

    def __init__(self, cfg: VariantEntityCfg) -> None:
        """Build all variants and merge them; raises ValueError as `VariantEntityCfg.build` says."""
        cfg._check()
        names = tuple(cfg.variants)
        if not names:
            raise ValueError(
                "VariantEntityCfg.variants is empty. Give at least one function that makes a spec, "
                "by the name of its variant."
            )
        sources = [_make_spec(name, make) for name, make in cfg.variants.items()]
        validate_variant_specs(list(names), sources)
        self._first = sources[0]
        try:
            super().__init__(cfg)
        except ValueError as error:
            raise ValueError(f"Variant {names[0]!r}: {error}") from error
        others = [
            _built_alone(cfg, name, spec) for name, spec in zip(names[1:], sources[1:], strict=True)
        ]
        weights = resolve_assignment(names, cfg.assignment)
        self._metadata = _merge(list(names), [self._spec, *others], weights)

    def _make_spec(self) -> mujoco.MjSpec:
        return self._first

    @property
    def variant_metadata(self) -> VariantMetadata:
        """What there is in which environment."""
        return self._metadata


def _make_spec(name: str, make: Callable[[], mujoco.MjSpec]) -> mujoco.MjSpec:
    spec = make()
    if not isinstance(spec, mujoco.MjSpec):
        raise ValueError(
            f"VariantEntityCfg.variants[{name!r}] returned {type(spec).__name__}; it must return a "
            "mujoco.MjSpec, such as mujoco.MjSpec.from_file(path)."
        )
    # Editors change it, and a function might return one spec twice.
    return spec.copy()


def _built_alone(cfg: VariantEntityCfg, name: str, spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a variant's spec with all that the config adds to it."""
    settings: dict[str, Any] = {f.name: getattr(cfg, f.name) for f in fields(EntityCfg)}
    settings["spec_fn"] = lambda: spec
    try:
        return EntityCfg(**settings).build().spec
    except ValueError as error:
        raise ValueError(f"Variant {name!r}: {error}") from error


def _merge(
    names: list[str],
    specs: list[mujoco.MjSpec],
    assignment: tuple[float, ...] | Callable[[int], Sequence[int]],
) -> VariantMetadata:
    """Turn the first spec into the merged one, and say what is in it."""
    models = [_compiled(name, spec) for name, spec in zip(names, specs, strict=True)]
    source_specs = tuple(spec.copy() for spec in specs)
    paths = [path for path, _ in walk_bodies(specs[0])]
    bodies = [list(group) for group in zip(*(_bodies(spec) for spec in specs), strict=True)]
    split = [split_geoms(path, own, names) for path, own in zip(paths, bodies, strict=True)]
    shared: list[Shared] = [group for own, _ in split for group in own]
    slots = [slot for _, own in split for slot in own]
    for k, (name, spec) in enumerate(zip(names, specs, strict=True)):
        refuse_references(name, spec, slots, shared, k)
    elements = _pairs(specs, bodies, shared)
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


def _bodies(spec: mujoco.MjSpec) -> list[mujoco.MjsBody]:
    return [body for _, body in walk_bodies(spec)]


def _compiled(name: str, spec: mujoco.MjSpec) -> mujoco.MjModel:
    # A scene takes no notice of these settings of a part, and they would change what there is.
    spec.compiler.discardvisual = False
    spec.compiler.fusestatic = False
    try:
        return compile_composed(spec)
    except ValueError as error:
        raise ValueError(f"Variant {name!r} does not compile: {error}") from error


def _pairs(
    specs: list[mujoco.MjSpec], bodies: list[list[mujoco.MjsBody]], shared: list[Shared]
) -> dict[str, list[tuple[Any, list[int]]]]:
    """Return by kind the elements that all variants have, with their id in each."""
    groups: dict[str, list[Any]] = {"bodies": bodies, "geoms": shared}
    for kind in KINDS:
        if kind not in groups:
            groups[kind] = list(zip(*(getattr(spec, kind) for spec in specs), strict=True))
    return {
        kind: [(group[0], [int(element.id) for element in group]) for group in groups[kind]]
        for kind in KINDS
    }


def _describe(slots: list[Slot], count: int) -> tuple[Any, Any]:
    """Return the slots as metadata shows them, and what each variant has in them."""
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


def build_merged_variant_spec(cfg: VariantEntityCfg) -> tuple[mujoco.MjSpec, VariantMetadata]:
    """Return the spec that has room for all variants of an entity, and what is in it.

    Raises:
        ValueError: as `VariantEntityCfg.build`.
    """
    entity = VariantEntity(cfg)
    return entity.spec, entity.variant_metadata


@dataclass
class MeshVariantResult:
    """Models of a scene whose entities have variants."""

    wp_model: Any
    """MuJoCo Warp's model, with the fields of each world's own variants."""
    mj_model: mujoco.MjModel
    """The compiled model."""
    world_to_variant: dict[str, np.ndarray]
    """Variant of each world, (nworld,), by entity."""


def build_variant_model(
    spec: mujoco.MjSpec,
    nworld: int,
    variant_info: list[tuple[str, VariantMetadata]],
    configure_model: Callable[[mujoco.MjModel], None] | None = None,
) -> MeshVariantResult:
    """Compile a scene for MuJoCo Warp, for packages that have no `Simulation`.

    Args:
        spec: The scene's spec, with the merged specs of the entities in it.
        nworld: Number of worlds.
        variant_info: Name and variants of each entity that has some.
        configure_model: Changes the compiled model before it is put on the device.

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
