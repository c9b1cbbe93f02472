"""Randomization of one model field: select, sample, write; and factories of public functions.

Each public function of `mjlab.envs.mdp.dr` is defined in the module of its object type (`geom`, `joint`,
...), usually as one row: `geom_friction = field_term(__name__, "geom_friction", GEOM, ...)`.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import torch

from mjlab.envs.mdp.dr._types import (
    Distribution,
    FieldRanges,
    Operation,
    draw,
    read_bounds,
    resolve_distribution,
    resolve_operation,
)
from mjlab.managers.event_manager import RecomputeLevel, requires_model_fields
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.utils.indexing import as_ids
from mjlab.utils.lab_api.math import quat_from_euler_xyz, quat_mul
from mjlab.utils.mujoco import dof_width, qpos_width

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

F = TypeVar("F", bound=Callable[..., Any])

ROBOT = SceneEntityCfg("robot")
"""Default selection: all elements of the entity called "robot"."""


@dataclass(frozen=True)
class ObjectKind:
    """MuJoCo object type: location of its ids in configs, entities and the model."""

    name: str
    """Kind in `SceneEntityCfg` and in error messages."""
    entity_names: str
    """Attribute of `Entity` with the names, in the order of those ids."""
    global_ids: str
    """Attribute of `EntityIndexing` with the ids in the model, in the same order."""
    addresses: tuple[str, Callable[[int], int]] | None = None
    """For values stored by address: the `MjModel` field with the first address of a joint, and the
    number of addresses by joint type."""


BODY = ObjectKind("body", "body_names", "body_ids")
GEOM = ObjectKind("geom", "geom_names", "geom_ids")
SITE = ObjectKind("site", "site_names", "site_ids")
JOINT = ObjectKind("joint", "joint_names", "joint_ids")
DOF = ObjectKind("joint", "joint_names", "joint_ids", ("jnt_dofadr", dof_width))
QPOS = ObjectKind("joint", "joint_names", "joint_ids", ("jnt_qposadr", qpos_width))
TENDON = ObjectKind("tendon", "tendon_names", "tendon_ids")
CAMERA = ObjectKind("camera", "camera_names", "cam_ids")
LIGHT = ObjectKind("light", "light_names", "light_ids")
MATERIAL = ObjectKind("material", "material_names", "mat_ids")
TEXTURE = ObjectKind("texture", "texture_names", "tex_ids")
PAIR = ObjectKind("pair", "pair_names", "pair_ids")


# Public functions.


def field_term(
    module: str,
    name: str,
    kind: ObjectKind,
    summary: str,
    *,
    field: str | None = None,
    **options: Any,
) -> FieldTerm:
    """Return a public function that randomizes a model field.

    Args:
        module: Module of the function in configs and pickles.
        name: Name of the function.
        kind: Objects that own the field.
        summary: First paragraph of the docstring, with units.
        field: Field of `MjModel`. None: `name`.
        options: Other fields of `FieldRow`.
    """
    row = FieldRow(name, field or name, kind, **options)

    def term(
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        ranges: FieldRanges,
        asset_cfg: SceneEntityCfg = ROBOT,
        distribution: Distribution | str = "uniform",
        operation: Operation | str = row.operation,
        axes: list[int] | None = None,
        shared_random: bool = False,
    ) -> None:
        randomize(
            row, env, env_ids, ranges, asset_cfg, distribution, operation, axes, shared_random
        )

    default_axes = "all" if row.default_axes is None else str(list(row.default_axes))
    return _published(term, module, row, summary + _FIELD_ARGS.format(axes=default_axes))


def rotation_term(
    module: str, name: str, kind: ObjectKind, summary: str, **options: Any
) -> RotationTerm:
    """Return a public function that perturbs a quaternion field; arguments as of `field_term`."""
    row = FieldRow(name, name, kind, rotation=True, **options)

    def term(
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        roll_range: tuple[float, float] = (0.0, 0.0),
        pitch_range: tuple[float, float] = (0.0, 0.0),
        yaw_range: tuple[float, float] = (0.0, 0.0),
        distribution: Distribution | str = "uniform",
        asset_cfg: SceneEntityCfg = ROBOT,
    ) -> None:
        angles = (roll_range, pitch_range, yaw_range)
        rotate(row, env, env_ids, angles, asset_cfg, distribution)

    return _published(term, module, row, summary + _ROTATION_ARGS)


def writes(row: FieldRow) -> Callable[[F], F]:
    """Decorate a function that randomizes the field of `row`; sets its attribute `row`."""

    def declare(function: F) -> F:
        setattr(function, "row", row)  # noqa: B010
        return requires_model_fields(*row.fields, recompute=row.recompute)(function)

    return declare


class FieldTerm(Protocol):
    """Function that randomizes a field."""

    row: FieldRow

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        ranges: FieldRanges,
        asset_cfg: SceneEntityCfg = ...,
        distribution: Distribution | str = ...,
        operation: Operation | str = ...,
        axes: list[int] | None = ...,
        shared_random: bool = ...,
    ) -> None: ...


class RotationTerm(Protocol):
    """Function that perturbs an orientation."""

    row: FieldRow

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        roll_range: tuple[float, float] = ...,
        pitch_range: tuple[float, float] = ...,
        yaw_range: tuple[float, float] = ...,
        distribution: Distribution | str = ...,
        asset_cfg: SceneEntityCfg = ...,
    ) -> None: ...


_FIELD_ARGS = """

Args:
    env_ids: Environments to change. None: all.
    ranges: Pair of numbers (tuple or list) for all target axes; or a dict of axis to pair; or a
        dict of name pattern to either. Patterns are matched in full against object names of the
        entity and replace the selection of `asset_cfg`.
    asset_cfg: Entity and objects.
    distribution: "uniform" (lower, upper), "log_uniform" (lower, upper), "gaussian" (mean,
        standard deviation), or a `Distribution`.
    operation: "abs" sets the sample, `=U(a, b)`; "scale" multiplies the compile-time default by it,
        `*U(a, b)`; "add" adds it to the default, `+U(a, b)`; or an `Operation`.
    axes: Axes of the field to change. Default: the keys of `ranges`, else {axes}.
    shared_random: Sample one value per environment and axis for all objects.

Raises:
    ValueError: unknown name, pattern without match, invalid range, or invalid axis.
"""
_ROTATION_ARGS = """

Roll, pitch and yaw (rad) are rotations about the fixed x, y and z axes of the orientation's
reference frame, applied to the default: repetitions do not accumulate.

Args:
    env_ids: Environments to change. None: all.
    roll_range, pitch_range, yaw_range: Pairs of numbers (rad), sampled per environment and object.
    distribution: "uniform", "log_uniform", "gaussian", or a `Distribution`.
    asset_cfg: Entity and objects.

Raises:
    ValueError: unknown distribution or invalid range.
"""


@dataclass(frozen=True)
class FieldRow:
    """Model field and options of the public function that randomizes it."""

    name: str
    """Name of the public function."""
    field: str
    """Field of `MjModel`."""
    kind: ObjectKind
    """Objects that own the field."""
    default_axes: tuple[int, ...] | None = None
    """Default axes of the last dimension to change. None: all."""
    operation: str = "abs"
    """Default operation."""
    recompute: RecomputeLevel = RecomputeLevel.none
    """Constants that depend on the field."""
    rotation: bool = False
    """Label of functions by `rotation_term`, for tables of functions."""
    unit: bool = False
    """Treat the field as a direction of length 1. Untargeted axes start from their defaults,
    because their current values depend on the previous samples."""
    also_writes: tuple[str, ...] = ()
    """Additional fields written by `after`."""
    before: Callable[[Selection], None] | None = None
    """Callback before the write; warns or raises if a selected object is not supported."""
    after: Callable[[Selection], None] | None = None
    """Callback after the write that updates dependent fields."""

    @property
    def fields(self) -> tuple[str, ...]:
        """All model fields written by the function."""
        return (self.field, *self.also_writes)


@dataclass(frozen=True)
class Selection:
    """Rows (environments) and columns (indices into a model field) to write."""

    env: ManagerBasedRlEnv
    entity: Entity
    kind: ObjectKind
    rows: torch.Tensor
    """Environment ids, int64 (R,)."""
    local_ids: torch.Tensor
    """Ids of the objects within the entity, int64 (K,)."""
    columns: torch.Tensor
    """Indices into the second dimension of the model field, int64 (C,). C = K, except for joints
    with several addresses."""

    @property
    def index(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Index of the block of rows and columns: (R, 1) and (1, C)."""
        return self.rows[:, None], self.columns[None, :]

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the block, (R, C)."""
        return len(self.rows), len(self.columns)

    @property
    def names(self) -> list[str]:
        """Names of the selected objects."""
        names = getattr(self.entity, self.kind.entity_names)
        return [names[i] for i in self.local_ids.tolist()]


# Write.

Targets = list[tuple[Selection, tuple[int, ...]]]
"""Written selections, each with its axes (empty for a field without axes)."""


def randomize(
    row: FieldRow,
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    ranges: Any,
    asset_cfg: SceneEntityCfg,
    distribution: Distribution | str,
    operation: Operation | str,
    axes: list[int] | tuple[int, ...] | None = None,
    shared_random: bool = False,
) -> Targets:
    """Randomize the field of `row` and return the written selections.

    Only target axes of the selected objects in `env_ids` change. Raises `ValueError` for unknown
    names, invalid ranges and invalid axes.
    """
    dist, op = resolve_distribution(distribution), resolve_operation(operation)
    shape = model_field(env, row.field).shape
    has_axes = len(shape) > 2
    jobs = []
    for pattern, spec in _by_pattern(ranges):
        selection = select(env, env_ids, asset_cfg, row.kind, pattern)
        jobs.append((selection, _bounds_by_axis(row, spec, axes, shape[-1] if has_axes else 1)))
    for selection, _ in jobs:
        if row.before is not None:
            row.before(selection)
    for selection, bounds in jobs:
        _write(row, selection, bounds, dist, op, shared_random)
        if row.after is not None:
            row.after(selection)
    return [(selection, tuple(bounds) if has_axes else ()) for selection, bounds in jobs]


def rotate(
    row: FieldRow,
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    angle_ranges: tuple[Any, Any, Any],
    asset_cfg: SceneEntityCfg,
    distribution: Distribution | str,
) -> None:
    """Set a quaternion field to `Rz(yaw) Ry(pitch) Rx(roll) * default`.

    Roll, pitch and yaw (rad) are sampled per environment and object, and rotate about the fixed
    axes of the parent frame. Starting from the default, repetitions do not accumulate.
    """
    dist = resolve_distribution(distribution)
    selection = select(env, env_ids, asset_cfg, row.kind)
    angles = [
        draw(dist, read_bounds(bounds, f"{angle}_range"), selection.shape, env.device)
        for angle, bounds in zip(("roll", "pitch", "yaw"), angle_ranges, strict=True)
    ]
    delta = quat_from_euler_xyz(*angles)
    field = model_field(env, row.field)
    new = quat_mul(delta, default_values(selection, row.field))
    field[selection.index] = preserve_absent_geoms(selection, new, field)


# Selection and values, shared with functions that are not rows.


def select(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    asset_cfg: SceneEntityCfg,
    kind: ObjectKind,
    pattern: str | None = None,
) -> Selection:
    """Resolve ids to a `Selection`.

    Args:
        env_ids: Environments. None: all.
        asset_cfg: Entity and, without a pattern, its selected objects.
        pattern: Regular expression, matched in full against object names of the entity. Replaces
            the selection of `asset_cfg`.

    Raises `ValueError` if a pattern matches nothing.
    """
    entity: Entity = env.scene[asset_cfg.name]
    all_ids: torch.Tensor = getattr(entity.data.indexing, kind.global_ids)
    # Names are looked up only for patterns: randomization may run nearly every step.
    if pattern is None:
        chosen = columns_of(asset_cfg, kind.name, env)
        local_ids = torch.arange(len(all_ids), device=env.device)[chosen]
    else:
        names = getattr(entity, kind.entity_names)
        matches = [i for i, name in enumerate(names) if re.fullmatch(pattern, name)]
        if not matches:
            raise ValueError(
                f"ranges: pattern {pattern!r} matches no {kind.name} of entity "
                f"{asset_cfg.name!r}. Available: {list(names)}."
            )
        local_ids = torch.tensor(matches, dtype=torch.long, device=env.device)
    columns = all_ids[local_ids].long()
    if kind.addresses is not None:
        model, (start, width) = env.sim.mj_model, kind.addresses
        starts, types = getattr(model, start), model.jnt_type
        addresses = [starts[j] + k for j in columns.tolist() for k in range(width(types[j]))]
        columns = torch.tensor(addresses, dtype=torch.long, device=env.device)
    return Selection(
        env, entity, kind, as_ids(env_ids, env.num_envs, env.device), local_ids, columns
    )


def model_field(env: ManagerBasedRlEnv, field: str) -> torch.Tensor:
    """Return a model field, (N, objects, ...).

    Writing a field shared by all environments raises `RuntimeError`: the event term must declare it
    with `requires_model_fields`.
    """
    return getattr(env.sim.model, field)


def default_values(selection: Selection, field: str) -> torch.Tensor:
    """Return a new tensor with the compile-time values of the selected block, (R, C, ...)."""
    default = selection.env.sim.get_default_field(field)
    current = getattr(selection.env.sim.model, field)
    # Fields that differ between mesh variants have per-environment defaults.
    if default.ndim == current.ndim:
        return default[selection.index]
    block = default[selection.columns]
    return block.expand(len(selection.rows), *block.shape).clone()


def preserve_absent_geoms(
    selection: Selection, new: torch.Tensor, field: torch.Tensor
) -> torch.Tensor:
    """Return `new`, (R, C, ...), with the current values of absent geoms.

    With entity variants, an environment may lack geoms of the model. Field values of absent geoms
    exclude them from contacts and images.
    """
    absent = selection.env.sim.absent_geoms if selection.kind is GEOM else None
    if absent is None:
        return new
    mask = absent[selection.index]
    return torch.where(mask.view(*mask.shape, *[1] * (new.ndim - 2)), field[selection.index], new)


def choose_ids(targets: Selection, choices: Selection, shared_random: bool) -> torch.Tensor:
    """Sample model ids from `choices` for each environment and target, int32 (R, C).

    Raises `ValueError` if `choices` is empty.
    """
    kind, count = choices.kind.name, len(choices.columns)
    if count == 0:
        raise ValueError(
            f"SceneEntityCfg {kind}_names: expected at least one {kind} of the entity to choose from, "
            "got an empty selection."
        )
    rows, columns = targets.shape
    shape = (rows, 1 if shared_random else columns)
    picks = torch.randint(count, shape, device=targets.env.device).expand(rows, columns)
    return choices.columns[picks].int()


def _published(term: Any, module: str, row: FieldRow, docstring: str) -> Any:
    """Set name, module and docstring of a generated function, as if written by hand."""
    term.__name__ = term.__qualname__ = row.name
    term.__module__ = module
    term.__doc__ = docstring
    return writes(row)(term)


def _by_pattern(ranges: Any) -> Iterator[tuple[str | None, Any]]:
    """Yield (object name pattern, ranges). Pattern None: the selection of the config."""
    if not (isinstance(ranges, dict) and any(isinstance(key, str) for key in ranges)):
        yield None, ranges
        return
    if not all(isinstance(key, str) for key in ranges):
        raise ValueError(
            f"ranges: expected name patterns or axes as keys, got both in {ranges!r}; nest the axes."
        )
    yield from ranges.items()


def _bounds_by_axis(
    row: FieldRow, ranges: Any, axes: list[int] | tuple[int, ...] | None, size: int
) -> dict[int, tuple[float, float]]:
    """Return the bounds of each target axis, in sampling order.

    A field with one number per object has the single axis 0, whatever its name.
    """
    if axes is not None:
        targets = list(axes)
    elif isinstance(ranges, dict):
        targets = list(ranges)
    else:
        targets = list(range(size) if row.default_axes is None else row.default_axes)
    invalid = [axis for axis in targets if axis not in range(size) and size > 1]
    if invalid:
        raise ValueError(f"{row.name} axes: expected axes in {[*range(size)]}, got {invalid}.")
    if not isinstance(ranges, dict):
        return dict.fromkeys(targets, read_bounds(ranges, f"{row.name}: ranges"))
    missing = [axis for axis in targets if axis not in ranges]
    if missing:
        raise ValueError(f"{row.name} ranges: expected axes {missing}, got {ranges!r}.")
    return {axis: read_bounds(ranges[axis], f"{row.name}: ranges[{axis}]") for axis in targets}


def _write(
    row: FieldRow,
    selection: Selection,
    bounds: dict[int, tuple[float, float]],
    dist: Distribution,
    op: Operation,
    shared_random: bool,
) -> None:
    """Sample each axis and write `op.combine(base, samples)`."""
    field = model_field(selection.env, row.field)
    base = default_values(selection, row.field) if op.uses_defaults else field[selection.index]
    rnd = op.initialize(base)
    # `rnd` is written below, but an operation may return the base itself as neutral element.
    rnd = rnd.clone() if rnd is base else rnd
    rows, columns = selection.shape
    shape = (rows, 1 if shared_random else columns)
    has_axes = field.ndim > 2
    for axis, pair in bounds.items():
        sample = draw(dist, pair, shape, selection.env.device).expand(rows, columns)
        if has_axes:
            rnd[..., axis] = sample
        else:
            rnd = sample
    new = preserve_absent_geoms(selection, op.combine(base, rnd), field)
    if row.unit:
        others = [axis for axis in range(field.shape[-1]) if axis not in bounds]
        new[..., others] = default_values(selection, row.field)[..., others]
        norms = new.norm(dim=-1, keepdim=True)
        is_zero = norms < 1e-6
        if bool(is_zero.any()):
            warnings.warn(
                f"{row.name}: expected a nonzero direction, sampled a zero vector; choose ranges "
                "that exclude the origin.",
                UserWarning,
                stacklevel=2,
            )
        field[selection.index] = new / torch.where(is_zero, 1.0, norms)
    elif has_axes:
        for axis in bounds:
            field[(*selection.index, axis)] = new[..., axis]
    else:
        field[selection.index] = new
