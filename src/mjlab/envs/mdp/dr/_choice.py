"""Uniform choice among objects, for fields that hold ids."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from mjlab.envs.mdp.dr._selection import Selection


def choose_ids(targets: Selection, choices: Selection, shared_random: bool) -> torch.Tensor:
    """Return model ids drawn from `choices`, int32, for each environment and target (R, C).

    Raises `ValueError` if there is nothing to choose from.
    """
    kind, count = choices.kind.name, len(choices.columns)
    if count == 0:
        raise ValueError(
            f"No {kind} to choose from: the selection of entity is empty. "
            f"Set {kind}_names in the SceneEntityCfg to {kind}s that the entity has."
        )
    rows, columns = targets.shape
    shape = (rows, 1 if shared_random else columns)
    picks = torch.randint(count, shape, device=targets.env.device).expand(rows, columns)
    return choices.columns[picks].int()
