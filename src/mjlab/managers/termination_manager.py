"""Termination manager: ends of episodes, by failure (terminated) or time-out (truncated)."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import offers_older_attributes
from mjlab.managers.manager_base import ManagerTermBaseCfg, TermListManager
from mjlab.managers.nonfinite import BadValueWatch
from mjlab.utils.errors import UnknownNameError, check_exists
from mjlab.utils.indexing import as_index, is_empty

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)


@dataclass
class TerminationTermCfg(ManagerTermBaseCfg):
    """Termination term configuration: `func(env, **params)` returns one bool per environment."""

    time_out: bool = False
    """Truncate instead of terminate: learners bootstrap from the value of the last state."""


@offers_older_attributes
class TerminationManager(TermListManager):
    """Evaluates termination terms. All results are buffers that the next step overwrites."""

    _cfg_type = TerminationTermCfg
    _title = "terminations"
    _shown = {"time-out": "time_out"}
    _transient = {"_rows", "_not_bool", "bad_values"}

    def __init__(
        self, cfg: Mapping[str, TerminationTermCfg | None], env: ManagerBasedRlEnv
    ) -> None:
        super().__init__(cfg, env)

        def falses(*size: int) -> torch.Tensor:
            return torch.zeros(*size, self.num_envs, dtype=torch.bool, device=self.device)

        self._values = falses(len(self._term_names))
        self._rows = list(self._values)
        self._terminated, self._time_outs, self._dones = falses(), falses(), falses()
        labels = [self._label(name) for name in self._term_names]
        self.bad_values = BadValueWatch(labels, "neither 0 nor 1", "counts as true", env)
        # Index of a term that returns floats to its values that are neither 0 nor 1, (num_envs,) bool.
        self._not_bool: dict[int, torch.Tensor] = {}

    @property
    def dones(self) -> torch.Tensor:
        """True where the episode ended for any reason, (num_envs,) bool."""
        return self._dones

    @property
    def terminated(self) -> torch.Tensor:
        """True where a term other than a time-out fired, (num_envs,) bool."""
        return self._terminated

    @property
    def time_outs(self) -> torch.Tensor:
        """True where a time-out fired, (num_envs,) bool. `terminated` may be True as well."""
        return self._time_outs

    def compute(self) -> torch.Tensor:
        """Evaluate all terms and return `dones`.

        Terms that return floats are logged once; nonzero values, NaN included, count as True.
        Raises `ValueError` if a term returns a shape other than (num_envs,).
        """
        self._terminated.zero_()
        self._time_outs.zero_()
        terms = zip(self._term_names, self._term_cfgs, self._rows, strict=True)
        for k, (name, cfg, row) in enumerate(terms):
            value = self._evaluate(name, cfg)
            if value.is_floating_point():
                if k not in self._not_bool:
                    logger.warning(
                        "%s: expected bool, got %s; nonzero counts as true. Compare the value in "
                        "the term.",
                        *(self._label(name), str(value.dtype).removeprefix("torch.")),
                    )
                self._not_bool[k] = (value != 0) & (value != 1)
            row.copy_(value)
            (self._time_outs if cfg.time_out else self._terminated).logical_or_(row)
        if self._not_bool:
            none = torch.zeros_like(self._dones)
            rows = [self._not_bool.get(k, none) for k in range(len(self._term_names))]
            self.bad_values.record(torch.stack(rows), self._env.common_step_counter)
        return torch.logical_or(self._terminated, self._time_outs, out=self._dones)

    def get_term(self, name: str) -> torch.Tensor:
        """Return the last value of a term, (num_envs,) bool.

        Raises `KeyError`, listing the valid names, if the term is unknown.
        """
        check_exists("TerminationManager term", name, self._term_names, UnknownNameError)
        return self._rows[self._term_names.index(name)]

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, Any]:
        """Return `Episode_Termination/<term>`, the number of `env_ids` where the term fired."""
        super().reset(env_ids)
        if is_empty(env_ids) or not self._term_names:
            return {}
        counts = self._values[:, as_index(env_ids)].sum(dim=1).tolist()
        return {
            f"Episode_Termination/{name}": count
            for name, count in zip(self._term_names, counts, strict=True)
        }

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return 1 for each term that fired in the last step of one environment, else 0."""
        values = self._values[:, env_idx].tolist()
        return [(name, [float(v)]) for name, v in zip(self._term_names, values, strict=True)]
