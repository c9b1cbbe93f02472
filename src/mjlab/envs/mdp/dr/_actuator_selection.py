"""Single actuators of an entity, found in the groups that the entity keeps them in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.envs.mdp._indexing import columns
from mjlab.envs.mdp.dr._types import draw

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mjlab.actuator import Actuator
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.dr._types import Distribution
    from mjlab.managers.scene_entity_config import SceneEntityCfg


@dataclass(frozen=True)
class SelectedActuator:
    """The selected targets of one actuator object (one per actuator config)."""

    entity: Entity
    actuator: Actuator
    rows: torch.Tensor
    """Environment ids, (R,)."""
    targets: torch.Tensor
    """Positions of the selected targets inside the actuator, (K,)."""
    elements: torch.Tensor
    """Ids in the model of the MuJoCo actuators of these targets, (E, K); most kinds have E = 1."""

    def draw(
        self, distribution: Distribution, bounds: tuple[float, float], device: str
    ) -> torch.Tensor:
        """Draw one number per environment and target, (R, K)."""
        return draw(distribution, bounds, (len(self.rows), len(self.targets)), device)


def selected_actuators(
    env: ManagerBasedRlEnv, rows: torch.Tensor, asset_cfg: SceneEntityCfg
) -> Iterator[SelectedActuator]:
    """Yield the actuator objects of an entity that own selected actuators.

    `asset_cfg.actuator_ids` counts single actuators, as `actuator_names` does.
    """
    entity: Entity = env.scene[asset_cfg.name]
    chosen = entity.data.indexing.actuator_ids[columns(asset_cfg.actuator_ids, env.device)]
    for actuator in entity.actuators:
        ids, count = actuator.global_element_ids, len(actuator.target_names)
        # Kinds of a user's own may have another layout; who needs single elements refuses them.
        elements = ids.reshape(-1, count) if len(ids) % count == 0 else ids[None, :]
        is_chosen = torch.isin(elements, chosen.to(elements.dtype)).any(dim=0)
        targets = is_chosen.nonzero().flatten()
        if len(targets):
            yield SelectedActuator(entity, actuator, rows, targets, elements[:, targets].long())
