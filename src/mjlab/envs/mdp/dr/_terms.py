"""Makes public functions, with real signatures and docstrings, from rows of the table."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Protocol

from mjlab.envs.mdp.dr._core import FieldRow, randomize, rotate
from mjlab.envs.mdp.dr._table import TABLE
from mjlab.envs.mdp.dr._types import Distribution, Operation, Ranges
from mjlab.managers.event_manager import requires_model_fields
from mjlab.managers.scene_entity_config import SceneEntityCfg

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnv

ROBOT = SceneEntityCfg("robot")
"""Default selection of the functions: everything of the entity called "robot"."""

_FIELD_ARGS = """
Args:
    env_ids: Environments to change; None means all.
    ranges: Pair of numbers (tuple or list) for all target axes; or a dict of axis to pair; or a
        dict of name pattern to either, where each pattern must match object names of the entity
        in full and replaces the selection of `asset_cfg`.
    asset_cfg: Entity and objects.
    distribution: "uniform" (lower, upper), "log_uniform" (lower, upper), "gaussian" (mean,
        standard deviation), or a `Distribution`.
    operation: "abs" sets the sample, "scale" multiplies the compile-time default by it, "add"
        adds it to the default; or an `Operation`.
    axes: Axes of the field to change. Default: the keys of `ranges`, else {axes}.
    shared_random: Draw one value per environment and axis for all objects.

Raises:
    ValueError: unknown name, pattern without match, bad range, or axis the field does not have.
"""

_ROTATION_ARGS = """
Roll, pitch and yaw (rad) turn about the fixed x, y and z axes of the frame in which the
orientation is given, starting from the default: repeating does not accumulate.

Args:
    env_ids: Environments to change; None means all.
    roll_range, pitch_range, yaw_range: Pairs of numbers (rad), drawn per environment and object.
    distribution: "uniform", "log_uniform", "gaussian", or a `Distribution`.
    asset_cfg: Entity and objects.

Raises:
    ValueError: unknown distribution or bad range.
"""


class FieldTerm(Protocol):
    """Signature of a function that randomizes a field."""

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        ranges: Ranges,
        asset_cfg: SceneEntityCfg = ...,
        distribution: Distribution | str = ...,
        operation: Operation | str = ...,
        axes: list[int] | None = ...,
        shared_random: bool = ...,
    ) -> None: ...


class RotationTerm(Protocol):
    """Signature of a function that perturbs an orientation."""

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


def field_term(name: str) -> FieldTerm:
    """Return the function for the table's row `name`; call it in the module that publishes it."""
    row = TABLE[name]

    @requires_model_fields(*row.fields, recompute=row.recompute)
    def term(
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        ranges: Ranges,
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
    return _published(term, row, _FIELD_ARGS.format(axes=default_axes))


def rotation_term(name: str) -> RotationTerm:
    """Like `field_term`, for the rows that are quaternions."""
    row = TABLE[name]

    @requires_model_fields(*row.fields, recompute=row.recompute)
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

    return _published(term, row, _ROTATION_ARGS)


def _published(term: Any, row: FieldRow, arguments: str) -> Any:
    """Give a made function the name, home and docstring it would have if written by hand."""
    term.__name__ = term.__qualname__ = row.name
    # Two frames up is the module that publishes the function: its home in configs and pickles.
    term.__module__ = sys._getframe(2).f_globals["__name__"]
    term.__doc__ = f"{row.summary}\n{arguments}"
    return term
