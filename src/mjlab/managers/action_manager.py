"""Action manager: splits the policy's output among terms that write actuator targets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.actuator.actuator import is_constant_within_step
from mjlab.managers.manager_base import BuiltTermsManager, ManagerTermBase
from mjlab.managers.nonfinite import BadValueWatch
from mjlab.utils.errors import UnsupportedError
from mjlab.utils.indexing import as_index
from mjlab.utils.spaces import Box, Space, batch_space
from mjlab.utils.tables import Table, settings_of

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass(kw_only=True)
class ActionTermCfg(ABC):
    """Base action term configuration. Subclasses construct the term in `build`."""

    entity_name: str
    """Name of the entity that the term acts on."""

    clip: dict[str, tuple] | None = None
    """Bounds of processed actions: target name pattern to (low, high)."""

    @abstractmethod
    def build(self, env: ManagerBasedRlEnv) -> ActionTerm:
        """Build the term."""


class ActionTerm(ManagerTermBase):
    """Base class of action terms: processes its slice of the action once per step and applies it.

    Raises `KeyError`, listing the available names, if the scene has no entity `cfg.entity_name`.
    """

    def __init__(self, cfg: ActionTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)
        self.cfg = cfg
        self._entity = env.scene[cfg.entity_name]

    @property
    def action_dim(self) -> int:
        """Number of action components of the term."""
        raise UnsupportedError(f"{self.name} must define the property action_dim.")

    @property
    def raw_action(self) -> torch.Tensor:
        """Last unprocessed action, (num_envs, action_dim)."""
        raise UnsupportedError(f"{self.name} must define the property raw_action.")

    @property
    def needs_substep(self) -> bool:
        """True if `apply_actions` must be called before every physics substep.

        One call per step suffices if the method is marked `constant_within_step`.
        """
        return not is_constant_within_step(type(self).apply_actions)

    def process_actions(self, actions: torch.Tensor) -> None:
        """Process the action of this step, (num_envs, action_dim). Called once per step."""
        raise UnsupportedError(f"{self.name} must define process_actions.")

    def apply_actions(self) -> None:
        """Write targets to the entity. Called before physics substeps."""
        raise UnsupportedError(f"{self.name} must define apply_actions.")


class ActionManager(BuiltTermsManager[ActionTerm]):
    """Splits the action among its terms and stores the last three actions.

    Terms may be objects of any class with the methods of `ActionTerm`. The config is kept by
    reference. `bad_values` counts NaN and infinite actions.
    """

    _transient = {"_action", "_prev_action", "_prev_prev_action", "_action_parts", "bad_values"}
    _title = "actions"
    _cfg_type = ActionTermCfg

    def __init__(self, cfg: Mapping[str, ActionTermCfg | None], env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        size = (3, self.num_envs, self.total_action_dim)
        # Newest first. One tensor lets a reset clear all three at once.
        self._history = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._action, self._prev_action, self._prev_prev_action = self._history
        self._action_parts = self._action.split(self.action_term_dim, dim=1)
        self.bad_values = BadValueWatch(["Action"], "NaN or infinite", "reaches the physics", env)

    def tables(self) -> list[Table]:
        """Return the table of the active terms; `targets` are the driven joints, tendons or sites."""
        columns = ("term", "type", "size", "targets", "scale", "settings")
        rows = [
            (
                name,
                type(term).__name__,
                term.action_dim,
                getattr(term, "target_names", None),
                getattr(self._live_cfgs[name], "scale", None),
                settings_of(self._live_cfgs[name], "actuator_names", "scale", "transmission_type"),
            )
            for name, term in self._terms.items()
        ]
        return [Table(self._title, columns, rows, note=f"{self.total_action_dim} in all")]

    @property
    def action_term_dim(self) -> list[int]:
        """Number of action components of each term."""
        return [term.action_dim for term in self._terms.values()]

    @property
    def total_action_dim(self) -> int:
        """Number of action components."""
        return sum(self.action_term_dim)

    @property
    def single_space(self) -> Box:
        """Space of the action of one environment."""
        return Box(shape=(self.total_action_dim,))

    @property
    def space(self) -> Space:
        """Space of the actions of all environments."""
        return batch_space(self.single_space, self.num_envs)

    @property
    def action(self) -> torch.Tensor:
        """Last action passed to `process_action`, (num_envs, total_action_dim).

        `action`, `prev_action` and `prev_prev_action` are live: the next step overwrites them.
        """
        return self._action

    @property
    def prev_action(self) -> torch.Tensor:
        """Action before `action`."""
        return self._prev_action

    @property
    def prev_prev_action(self) -> torch.Tensor:
        """Action before `prev_action`."""
        return self._prev_prev_action

    @property
    def needs_substep(self) -> bool:
        """True if `apply_action` must be called before every physics substep."""
        return any(getattr(term, "needs_substep", True) for term in self._terms.values())

    def process_action(self, action: torch.Tensor) -> None:
        """Split the action of this step, (num_envs, total_action_dim), among the terms.

        Arrays and lists are converted by `as_action`. NaN and infinite values are reported by
        `bad_values`.

        Raises `ValueError` for a wrong shape.
        """
        action = as_action(action, self.device)
        # One action for all environments.
        if action.shape == (1, self._action.shape[1]):
            action = action.expand_as(self._action)
        if action.shape != self._action.shape:
            raise ValueError(
                f"action: expected shape {tuple(self._action.shape)} (environments, components), "
                f"got {tuple(action.shape)}; components by term: "
                f"{dict(zip(self._terms, self.action_term_dim, strict=True))}."
            )
        self._prev_prev_action.copy_(self._prev_action)
        self._prev_action.copy_(self._action)
        self._action.copy_(action)
        # x - x is NaN unless x is finite; a sum of large values may overflow.
        nans = (self._action - self._action).sum(dim=1).unsqueeze(0)
        self.bad_values.check(nans, self._env.common_step_counter + 1)
        for term, part in zip(self._terms.values(), self._action_parts, strict=True):
            term.process_actions(part)

    def apply_action(self) -> None:
        """Write the targets of all terms. Called before physics substeps."""
        for term in self._terms.values():
            term.apply_actions()

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, float]:
        """Zero the stored actions of `env_ids` and reset the terms. Logs nothing."""
        index = as_index(env_ids)
        self._history[:, index] = 0.0
        for term in self._terms.values():
            term.reset(env_ids=index)
        return {}

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return the raw action of each term in one environment."""
        return [(name, term.raw_action[env_idx].tolist()) for name, term in self._terms.items()]


def as_action(action: Any, device: str) -> torch.Tensor:
    """Return an action as a tensor on `device`; arrays and lists of numbers become float32."""
    if isinstance(action, torch.Tensor):
        return action.detach().to(device)
    # Copied, because torch warns about read-only arrays.
    return torch.as_tensor(np.array(action), dtype=torch.float32, device=device)
