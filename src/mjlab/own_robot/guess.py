"""A value with its reason, and a question."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

T = TypeVar("T")
Source = Literal["file", "rule", "asked", "set"]


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
class Question:
    """A value that the file cannot give."""

    key: str
    """Setting that answers, such as `armature` or `pose.FL_knee`."""
    text: str
    """Question, with the reason."""
    used: str
    """Value used until the answer."""
