"""Action manager: splits the policy's output among terms that write actuator targets."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.actuator.actuator import is_constant_within_step
from mjlab.managers.manager_base import BuiltTermsManager, ManagerTermBase
from mjlab.utils.errors import UnsupportedError
from mjlab.utils.indexing import as_index
from mjlab.utils.spaces import Box, Space, batch_space
from mjlab.utils.tables import Table, settings_of

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

# Number of environments listed in an error about non-finite actions.
_MAX_SHOWN = 10


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

    The config is kept by reference.
    """

    _transient = {"_action", "_prev_action", "_prev_prev_action", "_action_parts"}
    _title = "actions"
    _cfg_type = ActionTermCfg
    _term_type = ActionTerm

    def __init__(self, cfg: Mapping[str, ActionTermCfg | None], env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        size = (3, self.num_envs, self.total_action_dim)
        # Newest first. One tensor lets a reset clear all three at once.
        self._history = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._action, self._prev_action, self._prev_prev_action = self._history
        self._action_parts = self._action.split(self.action_term_dim, dim=1)
        self._check_finite = check_now
        if torch.device(self.device).type == "cuda":
            event = torch.cuda.Event()
            self._check_finite = DeferredCheck(*self._action.shape, self.device, event)

    def tables(self) -> list[Table]:
        """Return the table of the active terms; `targets` are the driven joints, tendons or sites."""
        columns = ("term", "type", "size", "targets", "scale", "settings")
        rows = [
            (
                name,
                type(term).__name__,
                term.action_dim,
                getattr(term, "target_names", None),
                getattr(term.cfg, "scale", None),
                settings_of(term.cfg, "actuator_names", "scale", "transmission_type"),
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
        return any(term.needs_substep for term in self._terms.values())

    def process_action(self, action: torch.Tensor) -> None:
        """Split the action of this step, (num_envs, total_action_dim), among the terms.

        Arrays and lists are converted by `as_action`.

        Raises `ValueError` for a wrong shape, and for NaN or infinite values: on a CPU immediately,
        before any state changes; on a GPU at the next step, after the bad action has acted for one
        step, because checking immediately would synchronize with the GPU.
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
        self._check_finite(action)
        self._prev_prev_action.copy_(self._prev_action)
        self._prev_action.copy_(self._action)
        self._action.copy_(action)
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
    """Return an action as a tensor on `device`; arrays and lists of numbers become float32.

    Raises:
        ValueError: `action` is neither a tensor nor an array of numbers.
    """
    if isinstance(action, torch.Tensor):
        return action.detach().to(device)
    try:
        # Copied, because torch warns about read-only arrays.
        return torch.as_tensor(np.array(action), dtype=torch.float32, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"action: expected a float tensor, array or list of shape (environments, components), "
            f"got {type(action).__name__} ({error})."
        ) from error


def check_now(action: torch.Tensor) -> None:
    """Raise `ValueError`, listing environments and values, if `action` (N, A) is not finite."""
    # A finite sum proves that all values are finite; large finite values may overflow the sum.
    if math.isfinite(action.sum().item()):
        return
    bad = ~torch.isfinite(action).all(dim=1)
    if bad.any():
        raise ValueError(_message(bad, action))


class DeferredCheck:
    """Checks actions on a GPU without synchronizing: each call raises for earlier actions.

    A flag is copied to the host asynchronously; the first call after the copy raises if the flag is
    set. Bad values stay on the device until then.

    Args:
        num_envs: Number of environments N.
        action_dim: Number of action components A.
        device: Device of the actions.
        event: Completion of the copy, with `record()` and `query()` of `torch.cuda.Event`.
    """

    def __init__(self, num_envs: int, action_dim: int, device: str, event: Any) -> None:
        self._event = event
        self._bad = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._values = torch.zeros(num_envs, action_dim, dtype=torch.float32, device=device)
        pinned = torch.device(device).type == "cuda"
        self._flag = torch.zeros((), dtype=torch.bool, pin_memory=pinned)
        self._pending = False

    def __call__(self, action: torch.Tensor) -> None:
        """Raise `ValueError` if an earlier action was not finite, then check `action`."""
        if self._pending and self._event.query():
            self._pending = False
            if self._flag:
                message = _message(self._bad, self._values)
                self._bad.zero_()
                raise ValueError(f"In the previous step: {message}")
        bad = ~torch.isfinite(action).all(dim=1)
        torch.where(bad.unsqueeze(1), action.to(self._values), self._values, out=self._values)
        self._bad.logical_or_(bad)
        if not self._pending:
            self._flag.copy_(self._bad.any(), non_blocking=True)
            self._event.record()
            self._pending = True


def _message(bad: torch.Tensor, action: torch.Tensor) -> str:
    ids = bad.nonzero().flatten()
    rows = [f"env {i}: {action[i].tolist()}" for i in ids[:_MAX_SHOWN].tolist()]
    more = f", and {len(ids) - _MAX_SHOWN} more" if len(ids) > _MAX_SHOWN else ""
    return (
        f"action: expected finite numbers, got NaN or infinite values in {len(ids)} of {len(bad)} "
        f"environments ({'; '.join(rows)}{more}); check the policy's input and output."
    )
