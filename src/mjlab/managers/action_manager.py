"""Actions: the policy's output, split among the terms that turn it into targets."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.actuator.actuator import is_constant_within_step
from mjlab.managers.manager_base import BuiltTermsManager, ManagerTermBase
from mjlab.utils.errors import UnsupportedError
from mjlab.utils.indexing import as_index

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

# Environments that a message about bad actions shows.
_SHOWN = 10


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
        raise UnsupportedError(f"{self.name} must define the property action_dim.")

    @property
    def raw_action(self) -> torch.Tensor:
        """The last action as given, (num_envs, action_dim)."""
        raise UnsupportedError(f"{self.name} must define the property raw_action.")

    @property
    def needs_substep(self) -> bool:
        """Whether `apply_actions` must be called before every physics substep.

        It is enough to call it once a step if the method is marked `constant_within_step`.
        """
        return not is_constant_within_step(type(self).apply_actions)

    def process_actions(self, actions: torch.Tensor) -> None:
        """Take the action (num_envs, action_dim) of this step; called once a step."""
        raise UnsupportedError(f"{self.name} must define process_actions.")

    def apply_actions(self) -> None:
        """Write targets to the entity; called before physics substeps."""
        raise UnsupportedError(f"{self.name} must define apply_actions.")


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
        self._check_finite = check_now
        if torch.device(self.device).type == "cuda":
            event = torch.cuda.Event()
            self._check_finite = DeferredCheck(*self._action.shape, self.device, event)

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


def check_now(action: torch.Tensor) -> None:
    """Raise `ValueError`, naming environments and values, if `action` (N, A) is not finite."""
    # One number tells for nearly every action that all is well; large ones may still overflow it.
    if math.isfinite(action.sum().item()):
        return
    bad = ~torch.isfinite(action).all(dim=1)
    if bad.any():
        raise ValueError(_message(bad, action))


class DeferredCheck:
    """Checks actions on a GPU without waiting for it: each call reports about earlier ones.

    A flag is copied to the host in the background; when the next call finds it there and set, that
    call raises. What was wrong is kept on the device until then.

    Args:
        num_envs: Number of environments N.
        action_dim: Number of action components A.
        device: Device of the actions.
        event: Tells when the copy is done; has `record()` and `query()` as `torch.cuda.Event`.
    """

    def __init__(self, num_envs: int, action_dim: int, device: str, event: Any) -> None:
        self._event = event
        self._bad = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._values = torch.zeros(num_envs, action_dim, dtype=torch.float32, device=device)
        pinned = torch.device(device).type == "cuda"
        self._flag = torch.zeros((), dtype=torch.bool, pin_memory=pinned)
        self._pending = False

    def __call__(self, action: torch.Tensor) -> None:
        """Raise `ValueError` if an earlier action was not finite, then look at this one."""
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
    rows = [f"env {i}: {action[i].tolist()}" for i in ids[:_SHOWN].tolist()]
    more = f", and {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else ""
    return (
        f"Actions are NaN or infinite in {len(ids)} of {len(bad)} environments ({'; '.join(rows)}"
        f"{more}). Every action must be a finite number: check what the policy gets and returns."
    )
