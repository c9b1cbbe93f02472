"""Metrics manager: per-episode values that are logged but not rewarded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch

from mjlab.compat import offers_older_attributes
from mjlab.managers.manager_base import ManagerTermBaseCfg, NullManager, TermListManager
from mjlab.managers.nonfinite import finite_mean
from mjlab.utils.errors import check_one_of
from mjlab.utils.indexing import as_index, is_empty

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

REDUCE_OPTIONS = ("last", "max", "mean", "sum")


@dataclass(kw_only=True)
class MetricsTermCfg(ManagerTermBaseCfg):
    """Metric term configuration: `func(env, **params)` returns one value per environment."""

    per_substep: bool = False
    """Evaluate after every physics substep; the value of a step is the mean over its substeps."""

    reduce: Literal["last", "max", "mean", "sum"] = "mean"
    """Reduction of the step values of an episode."""


@offers_older_attributes
class MetricsManager(TermListManager):
    """Accumulates metrics per episode. Values are not weighted, and NaN is not replaced.

    Raises `ValueError` for an unknown `reduce`.
    """

    _cfg_type = MetricsTermCfg
    _title = "metrics"
    _shown = {"reduction": "reduce", "per substep": "per_substep"}
    _transient = {"_rows", "_substep_rows", "_terms_by_reduce"}

    def __init__(self, cfg: Mapping[str, MetricsTermCfg | None], env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        size = (len(self._term_names), self.num_envs)
        self._last = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._sum = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._max = torch.full(size, -torch.inf, dtype=torch.float32, device=self.device)
        self._steps = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self._rows = list(self._last)
        substep_terms = [k for k, c in enumerate(self._term_cfgs) if c.per_substep]
        self._substep_sums = torch.zeros(
            len(substep_terms), self.num_envs, dtype=torch.float32, device=self.device
        )
        self._substep_rows = dict(zip(substep_terms, self._substep_sums, strict=True))
        self._substeps = 0
        self._terms_by_reduce: dict[str, list[int]] = {}
        for k, (name, term) in enumerate(zip(self._term_names, self._term_cfgs, strict=True)):
            check_one_of(f"{self._label(name)} reduce", term.reduce, REDUCE_OPTIONS)
            self._terms_by_reduce.setdefault(term.reduce, []).append(k)

    @property
    def needs_substep(self) -> bool:
        """True if `compute_substep` must be called after every physics substep."""
        return bool(self._substep_rows)

    def compute_substep(self) -> None:
        """Evaluate the `per_substep` terms. Called after every physics substep."""
        if not self._substep_rows:
            return
        self._substeps += 1
        for k, row in self._substep_rows.items():
            row.add_(self._evaluate(self._term_names[k], self._term_cfgs[k]))

    def compute(self) -> None:
        """Evaluate the other terms and accumulate the values of the step. Called after rewards.

        Raises `ValueError` if a term returns a shape other than (num_envs,).
        """
        if not self._rows:
            return
        for k, row in enumerate(self._rows):
            if k in self._substep_rows:
                torch.div(self._substep_rows[k], max(self._substeps, 1), out=row)
            else:
                row.copy_(self._evaluate(self._term_names[k], self._term_cfgs[k]))
        if self._substep_rows:
            self._substep_sums.zero_()
            self._substeps = 0
        # Means leave out NaN.
        self._last.masked_fill_(self._env.diverged, torch.nan)
        self._sum.add_(self._last)
        if "max" in self._terms_by_reduce:
            torch.maximum(self._max, self._last, out=self._max)
        self._steps.add_(1.0)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, torch.Tensor]:
        """Return mean `Episode_Metrics/<term>` over `env_ids` and clear their accumulators.

        The mean of a term leaves out environments with a NaN or infinite value; the mean of a
        maximum also leaves out environments without a step. 0 if no environment remains.
        """
        super().reset(env_ids)
        if is_empty(env_ids) or not self._term_names:
            return {}
        index = as_index(env_ids)
        values: dict[int, torch.Tensor] = {}
        for reduce, terms in self._terms_by_reduce.items():
            if reduce == "mean":
                reduced = self._sum[:, index] / self._steps[index].clamp(min=1.0)
            else:
                # Without a step the maximum is -inf, and `finite_mean` leaves it out.
                reduced = {"sum": self._sum, "last": self._last, "max": self._max}[reduce][:, index]
            means = finite_mean(reduced)
            values |= {k: means[k] for k in terms}
        self._sum[:, index] = 0.0
        self._max[:, index] = -torch.inf
        self._steps[index] = 0.0
        return {f"Episode_Metrics/{name}": values[k] for k, name in enumerate(self._term_names)}

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return the value of each term in the last step of one environment."""
        values = self._last[:, env_idx].tolist()
        return [(name, [value]) for name, value in zip(self._term_names, values, strict=True)]


class NullMetricsManager(NullManager, MetricsManager):
    """Metrics manager without terms."""
