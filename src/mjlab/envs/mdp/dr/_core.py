"""Randomization of one model field: the part that all functions of the table share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.envs.mdp.dr._selection import GEOM, ObjectKind, Selection, select
from mjlab.envs.mdp.dr._types import (
    ABS,
    Distribution,
    Operation,
    draw,
    read_bounds,
    resolve_distribution,
    resolve_operation,
)
from mjlab.managers.event_manager import RecomputeLevel
from mjlab.utils.lab_api.math import quat_from_euler_xyz, quat_mul

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg


@dataclass(frozen=True)
class FieldRow:
    """One row of the table: a model field and how it is randomized."""

    name: str
    """Name of the public function."""
    field: str
    """Field of `MjModel`."""
    kind: ObjectKind
    """Objects that own the field."""
    summary: str
    """What the function does, with units: the first paragraph of its docstring."""
    default_axes: tuple[int, ...] | None = None
    """Axes of the last dimension changed when the caller names none; None means all of them."""
    valid_axes: tuple[int, ...] | None = None
    """Axes that may be named; None means all of the last dimension."""
    operation: str = "abs"
    """Default operation."""
    recompute: RecomputeLevel = RecomputeLevel.none
    """Constants that depend on the field."""
    rotation: bool = False
    """Whether the field is a quaternion, perturbed by roll, pitch and yaw."""
    unit: bool = False
    """Whether the field is a direction: kept at length 1, with untargeted axes at their defaults,
    because their current values already depend on the axes drawn last time."""
    also_writes: tuple[str, ...] = ()
    """Further fields that `after` writes."""
    before: Callable[[Selection], None] | None = None
    """Called before anything is written; refuses what cannot be randomized."""
    after: Callable[[Selection], None] | None = None
    """Called after the write, to bring what depends on the field up to date."""

    @property
    def fields(self) -> tuple[str, ...]:
        """All model fields the function writes."""
        return (self.field, *self.also_writes)


Targets = list[tuple[Selection, tuple[int, ...]]]
"""What was written: selections, each with its axes (empty for a field without axes)."""


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
    """Randomize a field as its row says, and return what was written.

    Only the given environments and the selected objects change, and of those only the target
    axes. Raises `ValueError` for unknown names, bad ranges and axes the field does not have.
    """
    dist, op = resolve_distribution(distribution), resolve_operation(operation)
    width = _width(env, row.field)
    jobs = []
    for pattern, spec in _by_pattern(ranges):
        selection = select(env, env_ids, asset_cfg, row.kind, pattern)
        jobs.append((selection, _bounds_by_axis(row, spec, axes, width)))
    for selection, _ in jobs:
        if row.before is not None:
            row.before(selection)
    written: Targets = []
    for selection, bounds in jobs:
        _write(row, selection, bounds, dist, op, shared_random)
        if row.after is not None:
            row.after(selection)
        written.append((selection, tuple(axis for axis in bounds if width is not None)))
    return written


def targets_of(
    env: ManagerBasedRlEnv, ranges: Any, asset_cfg: SceneEntityCfg, kind: ObjectKind
) -> list[Selection]:
    """Return what `randomize` would write with these `ranges`, in all environments."""
    return [select(env, None, asset_cfg, kind, pattern) for pattern, _ in _by_pattern(ranges)]


def rotate(
    row: FieldRow,
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    angle_ranges: tuple[Any, Any, Any],
    asset_cfg: SceneEntityCfg,
    distribution: Distribution | str,
) -> None:
    """Set a quaternion field to `Rz(yaw) Ry(pitch) Rx(roll) * default`.

    Roll, pitch and yaw (rad) are drawn per environment and object; they turn about the fixed
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
    field[selection.index] = keep_absent(selection, new, field)


def model_field(env: ManagerBasedRlEnv, field: str) -> torch.Tensor:
    """Return a model field, (N, objects, ...).

    Writing one that the environments share raises `RuntimeError`: the event term has to declare
    it with `requires_model_fields`.
    """
    return getattr(env.sim.model, field)


def default_values(selection: Selection, field: str) -> torch.Tensor:
    """Return a new tensor with the compile-time values of the selected block, (R, C, ...)."""
    default = selection.env.sim.get_default_field(field)
    current = getattr(selection.env.sim.model, field)
    # Fields that differ by mesh variant have defaults of their own for each environment.
    if default.ndim == current.ndim:
        return default[selection.index]
    block = default[selection.columns]
    return block.expand(len(selection.rows), *block.shape).clone()


def keep_absent(selection: Selection, new: torch.Tensor, field: torch.Tensor) -> torch.Tensor:
    """Return `new` (R, C, ...), with the present values for geoms that are not there.

    Where an entity has variants, an environment may lack geoms of the model. What keeps them out
    of contacts and pictures stands in their fields.
    """
    absent = selection.env.sim.absent_geoms if selection.kind is GEOM else None
    if absent is None:
        return new
    mask = absent[selection.index]
    return torch.where(mask.view(*mask.shape, *[1] * (new.ndim - 2)), field[selection.index], new)


def _width(env: ManagerBasedRlEnv, field: str) -> int | None:
    """Return the size of the last dimension of a field, or None for one number an object."""
    shape = getattr(env.sim.model, field).shape
    return None if len(shape) == 2 else shape[-1]


def _by_pattern(ranges: Any) -> Iterator[tuple[str | None, Any]]:
    """Yield (pattern of object names, ranges for them); None stands for the config's selection."""
    if not (isinstance(ranges, dict) and any(isinstance(key, str) for key in ranges)):
        yield None, ranges
        return
    if not all(isinstance(key, str) for key in ranges):
        raise ValueError(f"ranges mixes name patterns and axes as keys: {ranges!r}. Nest the axes.")
    yield from ranges.items()


def _bounds_by_axis(
    row: FieldRow, ranges: Any, axes: list[int] | tuple[int, ...] | None, width: int | None
) -> dict[int, tuple[float, float]]:
    """Return the bounds of each target axis, in the order in which they are drawn.

    A field with one number an object counts as having the single axis 0.
    """
    size = 1 if width is None else width
    if axes is not None:
        targets = list(axes)
    elif isinstance(ranges, dict):
        targets = list(ranges)
    elif row.default_axes is not None:
        targets = list(row.default_axes)
    else:
        targets = list(range(size))
    valid = row.valid_axes or tuple(range(size))
    wrong = [axis for axis in targets if axis not in valid]
    if wrong:
        raise ValueError(f"{row.name} has no axes {wrong}; the valid axes are {list(valid)}.")
    if not isinstance(ranges, dict):
        bounds = read_bounds(ranges, f"{row.name}: ranges")
        return dict.fromkeys(targets, bounds)
    missing = [axis for axis in targets if axis not in ranges]
    if missing:
        raise ValueError(f"{row.name}: ranges has no entry for the axes {missing}: {ranges!r}.")
    return {axis: read_bounds(ranges[axis], f"{row.name}: ranges[{axis}]") for axis in targets}


def _write(
    row: FieldRow,
    selection: Selection,
    bounds: dict[int, tuple[float, float]],
    dist: Distribution,
    op: Operation,
    shared_random: bool,
) -> None:
    field = model_field(selection.env, row.field)
    from_default = op.uses_defaults or (row.unit and op is ABS)
    base = default_values(selection, row.field) if from_default else field[selection.index]
    rnd = op.initialize(base)
    # The samples go into `rnd`; an operation may hand back the base itself as neutral element.
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
    new = keep_absent(selection, op.combine(base, rnd), field)
    if row.unit:
        field[selection.index] = _normalized(row, new)
    elif has_axes:
        for axis in bounds:
            field[(*selection.index, axis)] = new[..., axis]
    else:
        field[selection.index] = new


def _normalized(row: FieldRow, vectors: torch.Tensor) -> torch.Tensor:
    norms = vectors.norm(dim=-1, keepdim=True)
    if bool((norms < 1e-6).any()):
        raise ValueError(
            f"{row.name}: a zero vector was drawn, which is no direction. "
            "Choose ranges that exclude the origin."
        )
    return vectors / norms
