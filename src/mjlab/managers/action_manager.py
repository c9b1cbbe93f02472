"""Actions: the policy's output, split among the terms that turn it into targets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.managers.built_terms import BuiltTermsManager
from mjlab.managers.env_ids import as_index
from mjlab.managers.finite_action import finite_action_check
from mjlab.managers.manager_base import ManagerTermBase
from mjlab.utils.substep import is_constant_within_step

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass(kw_only=True)
class ActionTermCfg(ABC):
    """A part of the action; subclasses say in `build` which term it makes."""

    entity_name: str
    """Entity of the scene that the term acts on."""

    clip: dict[str, tuple] | None = None
    """Bounds of processed actions: pattern of target names to (low, high)."""

    @abstractmethod
    def build(self, env: ManagerBasedRlEnv) -> ActionTerm:
        """Return the term."""


class ActionTerm(ManagerTermBase):
    """Base of action terms: processes its part of the action once a step, and applies it.

    Raises `KeyError`, with what the scene holds, if it has no entity of the config's name.
    """

    def __init__(self, cfg: ActionTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)
        self.cfg = cfg
        self._entity = env.scene[cfg.entity_name]

    @property
    def action_dim(self) -> int:
        """Number of action components that the term takes."""
        raise NotImplementedError(f"{self.name} must define the property action_dim.")

    @property
    def raw_action(self) -> torch.Tensor:
        """The last action as given, (num_envs, action_dim)."""
        raise NotImplementedError(f"{self.name} must define the property raw_action.")

    @property
    def needs_substep(self) -> bool:
        """Whether `apply_actions` must be called before every physics substep.

        It is enough to call it once a step if the method is marked `constant_within_step`.
        """
        return not is_constant_within_step(type(self).apply_actions)

    def process_actions(self, actions: torch.Tensor) -> None:
        """Take the action (num_envs, action_dim) of this step; called once a step."""
        raise NotImplementedError(f"{self.name} must define process_actions.")

    def apply_actions(self) -> None:
        """Write targets to the entity; called before physics substeps."""
        raise NotImplementedError(f"{self.name} must define apply_actions.")


class ActionManager(BuiltTermsManager[ActionTerm]):
    """Splits the action among its terms and remembers the last three actions.

    The config is kept by reference.
    """

    _transient = {"_action", "_prev_action", "_prev_prev_action", "_action_parts"}
    _cfg_type = ActionTermCfg
    _term_type = ActionTerm

    def __init__(self, cfg: Mapping[str, ActionTermCfg | None], env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        size = (3, self.num_envs, self.total_action_dim)
        # Newest first, in one tensor, so that a reset clears all three at once.
        self._history = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._action, self._prev_action, self._prev_prev_action = self._history
        self._action_parts = self._action.split(self.action_term_dim, dim=1)
        self._check_finite = finite_action_check(self.num_envs, self.total_action_dim, self.device)

    @property
    def action_term_dim(self) -> list[int]:
        """Number of action components of each term."""
        return [term.action_dim for term in self._terms.values()]

    @property
    def total_action_dim(self) -> int:
        """Number of action components."""
        return sum(self.action_term_dim)

    @property
    def action(self) -> torch.Tensor:
        """The last action as given to `process_action`, (num_envs, total_action_dim).

        This and the next two are live: the next step overwrites them.
        """
        return self._action

    @property
    def prev_action(self) -> torch.Tensor:
        """The action before `action`."""
        return self._prev_action

    @property
    def prev_prev_action(self) -> torch.Tensor:
        """The action before `prev_action`."""
        return self._prev_prev_action

    @property
    def needs_substep(self) -> bool:
        """Whether `apply_action` must be called before every physics substep."""
        return any(term.needs_substep for term in self._terms.values())

    def process_action(self, action: torch.Tensor) -> None:
        """Take the action (num_envs, total_action_dim) of this step and hand out its parts.

        Raises `ValueError` if the shape is another, or if a number is NaN or infinite: on a CPU at
        once, before anything is changed; on a GPU at the next step (a look at the values now would
        make the CPU wait for the GPU), so that the bad action has acted for one step.
        """
        if action.shape != self._action.shape:
            raise ValueError(
                f"The action has shape {tuple(action.shape)}, expected {tuple(self._action.shape)} "
                f"(environments, components); components by term: "
                f"{dict(zip(self._terms, self.action_term_dim, strict=True))}."
            )
        self._check_finite(action)
        self._prev_prev_action.copy_(self._prev_action)
        self._prev_action.copy_(self._action)
        self._action.copy_(action)
        for term, part in zip(self._terms.values(), self._action_parts, strict=True):
            term.process_actions(part)

    def apply_action(self) -> None:
        """Let every term write its targets; called before physics substeps."""
        for term in self._terms.values():
            term.apply_actions()

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, float]:
        """Zero the remembered actions of these environments and reset the terms; logs nothing."""
        index = as_index(env_ids)
        self._history[:, index] = 0.0
        for term in self._terms.values():
            term.reset(env_ids=index)
        return {}

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return, for one environment, the raw action of each term."""
        return [(name, term.raw_action[env_idx].tolist()) for name, term in self._terms.items()]

    def _table(self) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
        rows = [(name, term.action_dim) for name, term in self._terms.items()]
        return ["name", "dimension"], rows
