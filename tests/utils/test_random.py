"""Seeding."""

from __future__ import annotations

import os
import random

import numpy as np
import pytest
import torch

from mjlab.utils.random import seed_rng


def _draw() -> tuple[float, float, float]:
    return random.random(), float(np.random.rand()), float(torch.rand(()))


def test_one_seed_repeats_all_generators():
    seed_rng(3)
    first = _draw()
    following = _draw()
    seed_rng(3)
    assert _draw() == first
    assert all(a != b for a, b in zip(first, following, strict=True))
    assert os.environ["PYTHONHASHSEED"] == "3"


def test_deterministic_algorithms_are_switched_on_when_asked():
    before = torch.get_deterministic_debug_mode()
    try:
        torch.set_deterministic_debug_mode("default")
        seed_rng(0)
        assert not torch.are_deterministic_algorithms_enabled()
        seed_rng(0, torch_deterministic=True)
        assert torch.are_deterministic_algorithms_enabled()
        assert torch.is_deterministic_algorithms_warn_only_enabled()
    finally:
        torch.set_deterministic_debug_mode(before)


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_out_of_range_is_refused(seed):
    with pytest.raises(ValueError, match=f"seed is {seed}"):
        seed_rng(seed)
