"""Tables: cells, left out columns, and values as JSON."""

from __future__ import annotations

import functools
import html
import json
import math
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from mjlab.utils.noise import (
    ConstantNoiseCfg,
    GaussianNoiseCfg,
    UniformNoiseCfg,
)
from mjlab.utils.tables import Table, format_value, json_value, settings_of


def area(width, height):
    return width * height


@dataclass
class Cfg:
    size: tuple[float, ...] = (1.0, 2.0)
    on: bool = True
    off: bool = False
    names: tuple[str, ...] = ()
    ids: slice = field(default_factory=lambda: slice(None))
    value: float | None = None


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, ""),
        (0, "0"),
        (0.0, "0"),
        (1 / 3, "0.3333"),
        (False, "False"),
        ((-0.1, 0.1), "(-0.1, 0.1)"),
        (torch.tensor(0.2), "0.2"),
        (np.array([0.1, 0.2], dtype=np.float32), "(0.1, 0.2)"),
        ({"x": (0, 1)}, "{x: (0, 1)}"),
        (area, "area"),
        (functools.partial(area, 1), "area"),
        (Cfg(), "{size: (1, 2), on: True}"),
        (UniformNoiseCfg(n_min=-0.5, n_max=0.5), "+U(-0.5, 0.5)"),
        (GaussianNoiseCfg(operation="scale", mean=1.0, std=0.1), "*N(1, 0.1)"),
        (ConstantNoiseCfg(operation="abs", bias=0.3), "=const(0.3)"),
        ("é", "\\xe9"),
    ],
)
def test_cells(value, text):
    assert format_value(value) == text


def test_long_lists_are_cut_and_counted():
    names = [f"joint_number_{k}" for k in range(30)]
    text = format_value(names)
    assert len(text) < 90
    assert text.startswith(f"({names[0]}, ")
    assert "30 in all" in text
    # Cutting the last item would save nothing.
    assert format_value([names[0], "x" * 200]) == f"({names[0]}, {'x' * 200})"


def test_settings_leave_out_what_is_unset_but_not_what_was_switched_off():
    assert settings_of(Cfg()) == {"size": (1.0, 2.0), "on": True}
    assert settings_of(Cfg(on=False)) == {"size": (1.0, 2.0), "on": False}
    assert settings_of(Cfg(value=0.0), changed_only=True) == {"value": 0.0}


def test_json_is_valid_for_any_value():
    values = [math.inf, math.nan, {0: (1, -math.inf)}, torch.ones(2), Cfg(), area, slice(1, 2)]
    plain = json_value(values)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain[2] == {"0": [1, "-inf"]}
    assert plain[4] == {"type": "Cfg", "size": [1.0, 2.0], "on": True}


def test_columns_without_values_are_named_below():
    table = Table("rewards", ("term", "weight", "delay", "clip"), [("a", 0.0, None, None)])
    text = table.text()
    assert text.splitlines()[0].split() == ["term", "weight"]
    assert text.splitlines()[2].split() == ["a", "0"]
    assert text.splitlines()[-1] == "Unset: delay, clip."
    assert table.records() == [{"term": "a", "weight": 0.0, "delay": None, "clip": None}]


def test_markup_in_cells_is_escaped():
    table = Table("terms", ("term", "function", "parameters"), [("a", "f", {"b": "(x|y)_<i>[0]"})])
    assert r"`f: b=(x\|y)_<i>[0]`" in table.markdown()
    assert "<i>" not in table.html()
    assert "f: b=(x|y)_<i>[0]" in html.unescape(table.html())
    assert "f: b=(x|y)_<i>[0]" in table.text()


def test_ranges_are_not_broken_and_long_words_are_not_lost():
    parameters = {f"range_{k}": (-0.25, 0.25) for k in range(8)} | {"pattern": "x" * 150}
    lines = Table("terms", ("term", "function", "parameters"), [("a", "f", parameters)]).text(60)
    assert max(map(len, lines.splitlines())) <= 60
    assert lines.count("(-0.25, 0.25)") == 8
    assert lines.count("x") == 150
