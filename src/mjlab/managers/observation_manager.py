"""Observations: what the policy, the critic and others see, in named groups."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import offers_older_attributes
from mjlab.managers.env_ids import is_empty
from mjlab.managers.manager_base import ManagerBase
from mjlab.managers.observation_checks import check_noise
from mjlab.managers.observation_group import ObservationGroup as ObservationGroup
from mjlab.managers.observation_group import ObservationGroupCfg as ObservationGroupCfg
from mjlab.managers.observation_group import check_group
from mjlab.managers.observation_term import ObservationTerm as ObservationTerm
from mjlab.managers.observation_term import ObservationTermCfg as ObservationTermCfg
from mjlab.utils.random import preserved_rng
from mjlab.utils.state import capture_state, is_stateful, restore_state

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

Observation = torch.Tensor | dict[str, torch.Tensor]


@offers_older_attributes
class ObservationManager(ManagerBase):
    """Computes all observation groups; groups that are None or without terms are skipped.

    Every term's function is called once while the manager is built, to learn its shape.
    """

    _transient = {"_stateful_terms"}

    def __init__(
        self, cfg: Mapping[str, ObservationGroupCfg | None], env: ManagerBasedRlEnv
    ) -> None:
        self.cfg = {name: _copy_group(group) for name, group in cfg.items()}
        self._groups: dict[str, ObservationGroup] = {}
        self._obs_buffer: dict[str, Observation] | None = None
        super().__init__(env)
        terms = (term for group in self._groups.values() for term in group.terms.values())
        self._stateful_terms = [term for term in terms if term.has_state]

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the terms of each group."""
        return {name: list(group.terms) for name, group in self._groups.items()}

    @property
    def group_obs_dim(self) -> dict[str, tuple[int, ...] | list[tuple[int, ...]]]:
        """For each group its shape, or the list of its terms' shapes if they are not joined.

        Shapes are without the environment dimension.
        """
        return {
            name: self.group_obs_term_dim[name] if group.shape is None else group.shape
            for name, group in self._groups.items()
        }

    @property
    def group_obs_term_dim(self) -> dict[str, list[tuple[int, ...]]]:
        """For each group the shapes of its terms, without the environment dimension."""
        return {
            name: [term.shape for term in group.terms.values()]
            for name, group in self._groups.items()
        }

    @property
    def group_obs_concatenate(self) -> dict[str, bool]:
        """For each group whether its terms are joined into one tensor."""
        return {name: group.cfg.concatenate_terms for name, group in self._groups.items()}

    def compute(
        self, update_history: bool = False, env_ids: torch.Tensor | None = None
    ) -> dict[str, Observation]:
        """Return the observation of every group, each in memory of its own.

        Args:
            update_history: Whether values enter the histories. If not, a result computed since
                the last reset is returned as it is.
            env_ids: Environments that start an episode, if only their delays and histories are to
                be filled. All environments are observed either way.

        Raises `ValueError` for `env_ids` without `update_history`.
        """
        if env_ids is not None and not update_history:
            raise ValueError(
                "ObservationManager.compute(env_ids=...) fills histories, so it needs "
                "update_history=True."
            )
        if update_history or self._obs_buffer is None:
            self._obs_buffer = {
                name: group.compute(update_history, env_ids) for name, group in self._groups.items()
            }
        return self._obs_buffer

    def preview(self) -> dict[str, Observation]:
        """Return what `compute(update_history=True)` would return.

        Delays, histories, noise models, terms that are classes, and random number generators stay
        where they are.
        """
        terms = [term for term in self._class_terms.values() if is_stateful(term)]
        parts = [*self._stateful_terms, *terms]
        before = [capture_state(part) for part in parts]
        with preserved_rng():
            previewed = {name: group.compute(True, None) for name, group in self._groups.items()}
        for part, state in zip(parts, before, strict=True):
            restore_state(part, state)
        return previewed

    def compute_group(
        self,
        group_name: str,
        update_history: bool = False,
        env_ids: torch.Tensor | None = None,
    ) -> Observation:
        """Return the observation of one group, computed now; `compute` explains the arguments.

        Raises `ValueError`, with the valid names, if there is no such group.
        """
        return self._group(group_name).compute(update_history, env_ids)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, float]:
        """Reset terms, delays, histories and noise models of these environments; logs nothing."""
        self._obs_buffer = None
        self._reset_class_terms(env_ids)
        if not is_empty(env_ids):
            for term in self._stateful_terms:
                term.reset(env_ids)
        return {}

    def get_term_cfg(self, group_name: str, term_name: str) -> ObservationTermCfg:
        """Return the live config of a term: noise, clip, scale and params may be changed in it.

        Raises `ValueError`, with the valid names, if there is no such group or term.
        """
        terms = self._group(group_name).terms
        if term_name not in terms:
            raise ValueError(
                f"Observation group {group_name!r} has no term {term_name!r}. "
                f"Its terms: {list(terms)}."
            )
        return terms[term_name].cfg

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return ("group-term", values) of the last observation for one environment."""
        observations = self.compute()
        return [
            (f"{group_name}-{term_name}", value[env_idx].flatten().tolist())
            for group_name, group in self._groups.items()
            for term_name, value in group.split(observations[group_name]).items()
        ]

    def _prepare_terms(self) -> None:
        for name, group_cfg in self._enabled(self.cfg, ObservationGroupCfg):
            check_group(name, group_cfg)
            terms = {
                term_name: self._build_term(name, group_cfg, term_name, term_cfg)
                for term_name, term_cfg in self._enabled(group_cfg.terms, ObservationTermCfg)
            }
            if terms:
                self._groups[name] = ObservationGroup(name, group_cfg, terms)

    def _build_term(
        self,
        group_name: str,
        group_cfg: ObservationGroupCfg,
        term_name: str,
        term_cfg: ObservationTermCfg,
    ) -> ObservationTerm:
        label = f"{group_name}/{term_name}"
        # Also where there is no corruption, which would hide a mistake until someone turns it on.
        check_noise(label, term_cfg.noise)
        if not group_cfg.enable_corruption:
            term_cfg.noise = None
        if group_cfg.history_length is not None:
            term_cfg.history_length = group_cfg.history_length
            term_cfg.flatten_history_dim = group_cfg.flatten_history_dim
        self._resolve_term(label, term_cfg, ("env",))
        policy = group_cfg.nan_policy if group_cfg.nan_check_per_term else "disabled"
        return ObservationTerm(label, term_cfg, self._env, policy)

    def _group(self, name: str) -> ObservationGroup:
        if name not in self._groups:
            raise ValueError(
                f"ObservationManager has no group {name!r}. Its groups: {list(self._groups)}."
            )
        return self._groups[name]

    def _live_cfgs(self) -> dict[str, Any]:
        return {
            term.label: term.cfg for group in self._groups.values() for term in group.terms.values()
        }

    def _table(self) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
        return ["group", "name", "shape"], list(self._rows())

    def _rows(self) -> Iterator[Sequence[Any]]:
        for group_name, group in self._groups.items():
            for term_name, term in group.terms.items():
                yield group_name, term_name, term.shape


def _copy_group(group: ObservationGroupCfg | None) -> ObservationGroupCfg | None:
    """Copy a group and each of its terms, so that groups that share terms do not share state."""
    if not isinstance(group, ObservationGroupCfg):
        return group
    terms = {name: copy.deepcopy(term) for name, term in group.terms.items()}
    return dataclasses.replace(group, terms=terms)
