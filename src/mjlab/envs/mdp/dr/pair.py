"""Randomization of explicit contact pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.envs.mdp.dr._core import PAIR, ROBOT, FieldRow, model_field, randomize, writes

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.dr._types import Distribution, FieldRanges, Operation
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = ["pair_friction"]

_ROW = FieldRow("pair_friction", "pair_friction", PAIR, default_axes=(0,))


@writes(_ROW)
def pair_friction(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    ranges: FieldRanges,
    asset_cfg: SceneEntityCfg = ROBOT,
    distribution: Distribution | str = "uniform",
    operation: Operation | str = "abs",
    axes: list[int] | None = None,
    shared_random: bool = False,
    isotropic: bool = False,
) -> None:
    """Randomize friction of contact pairs: tangent 1, tangent 2, spin, roll 1, roll 2.

    Arguments as in `dr.geom_friction`, with axes 0 to 4; default axis 0.

    Args:
        isotropic: Use equal friction in both directions: copy tangent 1 to tangent 2, and roll 1 to
            roll 2 if a roll axis was randomized.
    """
    written = randomize(
        _ROW, env, env_ids, ranges, asset_cfg, distribution, operation, axes, shared_random
    )
    if not isotropic:
        return
    field = model_field(env, "pair_friction")
    for selection, targets in written:
        field[(*selection.index, 1)] = field[(*selection.index, 0)]
        if 3 in targets or 4 in targets:
            field[(*selection.index, 4)] = field[(*selection.index, 3)]
