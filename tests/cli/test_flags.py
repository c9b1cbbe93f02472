"""Flags: values, switches, mistakes."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from mjlab.cli.flags import parse_flags


@dataclass
class Inner:
    """Things."""

    rate: float = 1.0
    """A rate."""
    switch: bool = False
    """A switch below the top."""


@dataclass
class Flags:
    """Flags of a command."""

    fast_mode: bool = False
    """A switch."""
    count: int | None = None
    """A number."""
    inner: Inner = field(default_factory=Inner)
    """More."""


def parsed(*flags: str) -> Flags:
    return parse_flags(Flags, Flags(), list(flags), "try")


def test_flags_replace_fields_and_leave_the_others():
    flags = parsed("--inner.rate", "3e-4", "--count", "5")
    assert flags == Flags(count=5, inner=Inner(rate=3e-4))
    assert parsed("--count", "None") == Flags()


@pytest.mark.parametrize("flag", ["--fast-mode", "--fast_mode"])
def test_a_switch_needs_no_value_and_takes_one(flag):
    assert parsed(flag) == Flags(fast_mode=True)
    assert parsed(flag, "--count", "2") == Flags(fast_mode=True, count=2)
    assert parsed(flag, "True") == Flags(fast_mode=True)
    assert parsed(flag, "False") == Flags()


@pytest.mark.parametrize(
    ("flags", "named"),
    [(["--cuont", "3"], "--cuont"), (["--count", "many"], "many"), (["stray"], "stray")],
)
def test_a_flag_that_is_not_there_or_not_of_its_kind_ends_with_status_2(flags, named, capsys):
    with pytest.raises(SystemExit) as caught:
        parsed(*flags)
    assert caught.value.code == 2
    assert named in capsys.readouterr().err


def test_a_mistyped_flag_is_answered_with_the_nearest(capsys):
    with pytest.raises(SystemExit):
        parsed("--inner.ratee", "3")
    assert "--inner.rate" in capsys.readouterr().err


def test_parsing_leaves_the_default_as_it_was():
    default = Flags()
    parse_flags(Flags, default, ["--inner.rate", "9", "--fast-mode"], "try")
    assert default == Flags()
