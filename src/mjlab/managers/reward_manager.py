"""Rewards: a weighted sum of terms."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any

import torch

from mjlab.managers.manager_base import (
    ManagerTermBaseCfg,
    TermFunctionSwitches,
    TermListManager,
)
from mjlab.managers.nonfinite import NonFiniteWatch
from mjlab.utils.indexing import as_index, is_empty

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)


@dataclass(kw_only=True)
class RewardTermCfg(ManagerTermBaseCfg):
    """A reward term: `func(env, **params)` returns one number for each environment."""

    weight: float
    """Factor of the term in the sum. With 0 the function is not called at all, and what does not
    fit is told as a warning; it is an error at the first step with another weight."""


class RewardManager(TermFunctionSwitches, TermListManager):
    """Sums the weighted terms of a step, and of each episode.

    Args:
        cfg: Terms by name.
        env: The environment.
        scale_by_dt: Whether rewards are multiplied by the duration of a step, so that weights are
            rates per second.

    Raises `ValueError` if a weight is not a finite number.
    """

    _cfg_type = RewardTermCfg
    _shown = ("weight",)
    # Views of `_rates`.
    _transient = {"_step_reward", "_rows", "_scale_by_dt", "nonfinite"}

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
        # Terms first, so that each term writes to memory without gaps.
        self._rates = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._episode_sums = torch.zeros(size, dtype=torch.float32, device=self.device)
        self._reward_buf = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self._rows = list(self._rates)
        labels = [self._label(name) for name in self._term_names]
        self.nonfinite = NonFiniteWatch(labels, "NaN or infinite", "0", self.num_envs, self.device)
        # Weighted rates (num_envs, terms) of the last step, not multiplied by its duration.
        self._step_reward = self._rates.t()

    def compute(self, dt: float) -> torch.Tensor:
        """Return the reward (num_envs,) of a step of `dt` seconds, in a buffer used every step.

        A term that is NaN or infinite in an environment counts as 0 there, and is logged the first
        time. In environments whose physics diverged (`nonfinite.excluded`), all terms are 0. Raises
        `ValueError` if a term returns another shape than (num_envs,).
        """
        for name, cfg, row in zip(self._term_names, self._term_cfgs, self._rows, strict=True):
            if cfg.weight == 0.0:
                row.zero_()
                continue
            value = cfg.func(self._env, **cfg.params)
            self._check_value(name, value)
            torch.mul(value, cfg.weight, out=row)
        self._rates.masked_fill_(self.nonfinite.excluded, 0.0)
        bad = self.nonfinite.look(self._rates)
        if bad is not None:
            self._rates.masked_fill_(bad, 0.0)
        scale = dt if self._scale_by_dt else 1.0
        self._episode_sums.add_(self._rates, alpha=scale)
        # One after the other: the sum then has the same bits for any number of threads.
        self._reward_buf.zero_()
        for row in self._rows:
            self._reward_buf.add_(row, alpha=scale)
        return self._reward_buf

    def episode_sum(self, term_name: str) -> torch.Tensor:
        """Return what a term has added to the reward of each running episode, (num_envs,).

        Raises `ValueError`, with the valid names, if there is no such term.
        """
        self.get_term_cfg(term_name)
        return self._episode_sums[self._term_names.index(term_name)]

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, torch.Tensor]:
        """Return `Episode_Reward/<term>`, and zero the sums of these environments.

        It is the mean over the environments of a term's sum, divided by the maximum episode length
        in seconds (not divided if episodes have no length).
        """
        self._reset_class_terms(env_ids)
        if is_empty(env_ids) or not self._term_names:
            return {}
        index = as_index(env_ids)
        duration = self._env.max_episode_length_s
        means = self._episode_sums[:, index].mean(dim=1)
        if duration > 0.0:
            means /= duration
        self._episode_sums[:, index] = 0.0
        return {
            f"Episode_Reward/{name}": mean
            for name, mean in zip(self._term_names, means, strict=True)
        }

    def _prepare_terms(self) -> None:
        for name, cfg in self.cfg.items():
            # A weight that is NaN would silently turn the term off: NaN rewards count as 0.
            if isinstance(cfg, RewardTermCfg) and not (
                isinstance(cfg.weight, Real) and math.isfinite(cfg.weight)
            ):
                raise ValueError(
                    f"{self._label(name)}: weight is {cfg.weight!r}, but must be a finite number. "
                    "To switch the term off, set the weight to 0 or the whole term to None."
                )
        super()._prepare_terms()

    def _make_callable(self, name: str, cfg: ManagerTermBaseCfg, leading: Sequence[str]) -> None:
        """Build a term; one of weight 0 may be unfilled until a curriculum gives it a weight."""
        assert isinstance(cfg, RewardTermCfg)
        given, build_now = cfg.func, super()._make_callable
        try:
            build_now(name, cfg, leading)
        except (KeyError, TypeError, ValueError) as error:
            if cfg.weight != 0.0:
                raise
            logger.warning(
                "%s It has weight 0, so it is not needed; with another weight this is an error.",
                error.args[0] if len(error.args) == 1 else error,
            )
        else:
            return

        def build_and_call(env: Any, **params: Any) -> Any:
            cfg.func = given
            try:
                build_now(name, cfg, leading)
            except Exception:
                cfg.func = build_and_call
                raise
            return cfg.func(env, **params)

        cfg.func = build_and_call

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return, for one environment, the weighted rate of each term in the last step."""
        rates = self._step_reward[env_idx].tolist()
        return [(name, [rate]) for name, rate in zip(self._term_names, rates, strict=True)]
