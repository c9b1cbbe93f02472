"""A group of observation terms: one tensor, or one dict of tensors, for one consumer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from mjlab.managers.nan_policy import NAN_POLICIES, apply_nan_policy
from mjlab.managers.observation_term import ObservationTerm, ObservationTermCfg
from mjlab.utils.state import stateful


@dataclass
class ObservationGroupCfg:
    """A named group of observation terms, such as "actor" or "critic"."""

    terms: dict[str, ObservationTermCfg | None]
    """Terms by name, in order. None switches a term off."""

    concatenate_terms: bool = True
    """True joins the terms into one tensor, False returns a dict of name to tensor."""

    concatenate_dim: int = -1
    """Dimension to join along. From 0 on it is counted without the environment dimension; negative
    values count from the end."""

    enable_corruption: bool = False
    """Whether the noise of the terms is applied."""

    history_length: int | None = None
    """If given, replaces `history_length` and `flatten_history_dim` of every term; 0 switches
    history off."""

    flatten_history_dim: bool = True
    """How terms return their history where `history_length` is given here."""

    nan_policy: Literal["disabled", "warn", "sanitize", "error"] = "disabled"
    """What to do with NaN and infinite values: nothing, warn and replace by 0, replace by 0, or
    raise."""

    nan_check_per_term: bool = True
    """True checks each term before delay and history, False the group's result."""


def check_group(name: str, cfg: ObservationGroupCfg) -> None:
    """Raise `ValueError` if a setting of the group has no meaning."""
    if cfg.nan_policy not in NAN_POLICIES:
        raise ValueError(
            f"Observation group {name!r}: nan_policy is {cfg.nan_policy!r}, but must be one of "
            f"{NAN_POLICIES}."
        )
    if cfg.history_length is not None and cfg.history_length < 0:
        raise ValueError(
            f"Observation group {name!r}: history_length is {cfg.history_length}, but must be 0 or "
            "more, or None to leave it to the terms."
        )


@stateful
class ObservationGroup:
    """The terms of one group, and how they are joined.

    Args:
        name: Name of the group.
        cfg: Its config.
        terms: Its terms by name; at least one.

    Attributes:
        shape: Shape of the joined tensor without the environment dimension, or None for a dict.

    Raises `ValueError` if the terms cannot be joined.
    """

    _transient = {"name", "shape", "_dim", "_checks_result"}

    def __init__(
        self, name: str, cfg: ObservationGroupCfg, terms: dict[str, ObservationTerm]
    ) -> None:
        self.name = name
        self.cfg = cfg
        self.terms = terms
        dim = cfg.concatenate_dim
        self._dim = dim + 1 if dim >= 0 else dim
        self._checks_result = cfg.nan_policy != "disabled" and not cfg.nan_check_per_term
        self.shape = self._joined_shape() if cfg.concatenate_terms else None

    def compute(
        self, update_history: bool, env_ids: torch.Tensor | None
    ) -> torch.Tensor | dict[str, torch.Tensor]:
        """Return the group's observation in memory of its own."""
        values = [term.compute(update_history, env_ids) for term in self.terms.values()]
        if self.cfg.concatenate_terms:
            # Joining copies, also a single tensor.
            return self._checked(torch.cat(values, dim=self._dim), self.name)
        return {
            name: self._checked(value.clone(), f"{self.name}/{name}")
            for name, value in zip(self.terms, values, strict=True)
        }

    def split(self, observation: torch.Tensor | dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the parts of a result of `compute` by term."""
        if isinstance(observation, dict):
            return observation
        dim = self._axis() + 1
        parts = observation.split([term.shape[dim - 1] for term in self.terms.values()], dim=dim)
        return dict(zip(self.terms, parts, strict=True))

    def _checked(self, value: torch.Tensor, label: str) -> torch.Tensor:
        if not self._checks_result:
            return value
        return apply_nan_policy(value, self.cfg.nan_policy, label)

    def _axis(self) -> int:
        """Return the dimension to join along, counted without the environment dimension."""
        dim = self.cfg.concatenate_dim
        return dim if dim >= 0 else dim + len(next(iter(self.terms.values())).shape)

    def _joined_shape(self) -> tuple[int, ...]:
        shapes = {name: term.shape for name, term in self.terms.items()}
        first, axis = next(iter(shapes.values())), self._axis()
        for shape in shapes.values():
            others_agree = (
                len(shape) == len(first)
                and 0 <= axis < len(first)
                and shape[:axis] + shape[axis + 1 :] == first[:axis] + first[axis + 1 :]
            )
            if not others_agree:
                raise ValueError(
                    f"Observation group {self.name!r}: terms of shapes {shapes} (without the "
                    f"environment dimension) cannot be joined along concatenate_dim="
                    f"{self.cfg.concatenate_dim}. Flatten the terms, or set concatenate_terms="
                    "False."
                )
        return (*first[:axis], sum(shape[axis] for shape in shapes.values()), *first[axis + 1 :])
