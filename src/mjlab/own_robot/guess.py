"""A value with its reason, and a question."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

T = TypeVar("T")
Source = Literal["file", "rule", "asked", "set"]
_DOUBTFUL_FIRST: tuple[Source, ...] = ("asked", "set", "rule", "file")


@dataclass(frozen=True)
class Guess(Generic[T]):
    """A value and its reason."""

    value: T
    rule: str
    """Reason of the value, one short sentence."""
    source: Source = "rule"
    """`file`: read in the model file. `rule`: follows from the model by a rule. `asked`: a stand-in for
    a value that the file does not have, with a question. `set`: an answer of the user."""


@dataclass(frozen=True)
class Reason:
    """Reason of a joint's value; see `Guess`."""

    rule: str
    source: Source = "rule"


@dataclass(frozen=True)
class JointGuess:
    """A value for each joint, each with its reason."""

    value: dict[str, float]
    reasons: dict[str, Reason]

    @classmethod
    def of(cls, value: dict[str, float], rule: str, source: Source = "rule") -> JointGuess:
        """Return values that have the same reason."""
        return cls(value, dict.fromkeys(value, Reason(rule, source)))

    @property
    def source(self) -> Source:
        """Source of the most doubtful value: `asked`, `set`, `rule` or `file`."""
        found = {reason.source for reason in self.reasons.values()}
        return next((source for source in _DOUBTFUL_FIRST if source in found), "file")

    def answered(self, answers: Mapping[str, float]) -> JointGuess:
        """Return the guess with answers of the user, by joint, in place of its values."""
        known = {name: value for name, value in answers.items() if name in self.value}
        reasons = dict.fromkeys(known, Reason("as set", "set"))
        return JointGuess(self.value | known, self.reasons | reasons)

    def alike(self, groups: Iterable[tuple[str, ...]]) -> JointGuess:
        """Return the largest value of each group, with its reason, for all joints of the group.

        Masses and rotor inertias that were identified for each joint separately differ from leg to leg.
        Values have three digits.
        """
        values, reasons = {}, {}
        for group in groups:
            largest = max(group, key=self.value.__getitem__)
            values |= dict.fromkeys(group, float(f"{self.value[largest]:.3g}"))
            reasons |= dict.fromkeys(group, self.reasons[largest])
        return JointGuess(values, reasons)

    def by_reason(self) -> dict[Reason, dict[str, float]]:
        """Return the values by reason, and by joint."""
        found: dict[Reason, dict[str, float]] = {}
        for name, value in self.value.items():
            found.setdefault(self.reasons[name], {})[name] = value
        return found


@dataclass(frozen=True)
class Question:
    """A value that the file cannot give."""

    key: str
    """Setting that answers, such as `armature` or `pose.FL_knee`."""
    text: str
    """Question, with the reason."""
    used: str
    """Value used until the answer."""
