"""Reward manager: weighted sum of reward terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import offers_older_attributes
from mjlab.managers.debug_vis import TermFunctionSwitches
from mjlab.managers.manager_base import ManagerTermBaseCfg, TermListManager
from mjlab.managers.nonfinite import BadValueWatch
from mjlab.utils.indexing import as_index, is_empty
from mjlab.utils.screen import shown

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass(kw_only=True)
class RewardTermCfg(ManagerTermBaseCfg):
    """Reward term configuration: `func(env, **params)` returns one value per environment."""

    weight: float = field(metadata=shown("task", "X"))
    """Weight of the term. With weight 0 the function is not called."""


@offers_older_attributes
class RewardManager(TermFunctionSwitches, TermListManager):
    """Sums weighted reward terms per step and per episode.

    Args:
        cfg: Terms by name.
        env: The environment.
        scale_by_dt: Multiply rewards by the control timestep (s), so that weights are rates.
    """

    _cfg_type = RewardTermCfg
    _title = "rewards"
    _shown = {"weight": "weight"}
    # Views of `_rates`, settings, and a name that state of earlier releases uses.
    _transient = {"_step_reward", "_rows", "_scale_by_dt", "bad_values", "_episode_sums"}

    def __init__(
        self,
        cfg: Mapping[str, RewardTermCfg | None],
        env: ManagerBasedRlEnv,
        *,
        scale_by_dt: bool = True,
    ) -> None:
        self._scale_by_dt = scale_by_dt
        super().__init__(cfg, env)
        size = (len(self._term_names), self.num_envs)
        # Terms first: each term writes to contiguous memory.
        self._rates = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._sums = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._reward_buf = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self._rows = list(self._rates)
        labels = [self._label(name) for name in self._term_names]
        self.bad_values = BadValueWatch(labels, "NaN or infinite", "counts as 0", env)
        # Weighted rates of the last step, not multiplied by dt, (num_envs, terms).
        self._step_reward = self._rates.t()

    def compute(self, dt: float) -> torch.Tensor:
        """Return the reward of a step of `dt` seconds, (num_envs,), in a buffer reused every step.

        NaN and infinite term values count as 0 and are reported by `bad_values`. All terms are 0 in
        environments whose physics diverged. Raises `ValueError` if a term returns a shape other than
        (num_envs,).
        """
        for name, cfg, row in zip(self._term_names, self._term_cfgs, self._rows, strict=True):
            if cfg.weight == 0.0:
                row.zero_()
                continue
            torch.mul(self._evaluate(name, cfg), cfg.weight, out=row)
        self._rates.masked_fill_(self._env.diverged, 0.0)
        bad = self.bad_values.check(self._rates, self._env.common_step_counter)
        if bad is not None:
            self._rates.masked_fill_(bad, 0.0)
        scale = dt if self._scale_by_dt else 1.0
        self._sums.add_(self._rates, alpha=scale)
        # Sequential, so that the sum is bitwise equal for any number of threads.
        self._reward_buf.zero_()
        for row in self._rows:
            self._reward_buf.add_(row, alpha=scale)
        return self._reward_buf

    def episode_sum(self, term_name: str) -> torch.Tensor:
        """Return the contribution of a term to the return of each running episode, (num_envs,).

        Raises `ValueError`, listing the valid names, if the term is unknown.
        """
        self.get_term_cfg(term_name)
        return self._sums[self._term_names.index(term_name)]

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, torch.Tensor]:
        """Return `Episode_Reward/<term>` and zero the sums of `env_ids`.

        The value is the mean of the term's sum over `env_ids`, divided by the maximum episode
        length in seconds (undivided if that length is 0).
        """
        super().reset(env_ids)
        if is_empty(env_ids) or not self._term_names:
            return {}
        index = as_index(env_ids)
        duration = self._env.max_episode_length_s
        means = self._sums[:, index].mean(dim=1)
        if duration > 0.0:
            means /= duration
        self._sums[:, index] = 0.0
        return {
            f"Episode_Reward/{name}": mean
            for name, mean in zip(self._term_names, means, strict=True)
        }

    def _check_call(self, cfg: Any, leading: Sequence[str]) -> None:
        # Terms of weight 0 are not called.
        if cfg.weight != 0.0:
            super()._check_call(cfg, leading)

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return the weighted rate of each term in the last step of one environment."""
        rates = self._step_reward[env_idx].tolist()
        return [(name, [rate]) for name, rate in zip(self._term_names, rates, strict=True)]
