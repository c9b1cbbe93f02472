"""Seeds."""

from __future__ import annotations

import os
import random

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from mjlab.utils.random import evaluation_seed, process_seed, seed_rng, session_seed


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
    with pytest.raises(ValueError, match=f"seed.*{seed}"):
        seed_rng(seed)


SEEDS = st.integers(0, 2**20 - 1)
RANKS = st.integers(0, 1000)
ITERATIONS = st.integers(1, 100_000)


@given(one=st.tuples(SEEDS, RANKS), other=st.tuples(SEEDS, RANKS))
@example(one=(1, 1), other=(2, 0))
@example(one=(2**20 - 1, 1000), other=(0, 999))
def test_processes_and_seeds_share_no_draws(one, other):
    assert (process_seed(*one) == process_seed(*other)) == (one == other)
    seed_rng(process_seed(*one))
    drawn = _draw()
    seed_rng(process_seed(*other))
    assert (_draw() == drawn) == (one == other)


@given(run=SEEDS, process=st.tuples(SEEDS, RANKS), one=ITERATIONS, other=ITERATIONS)
@example(run=0, process=(2**20 - 1, 1000), one=1, other=2)
def test_evaluations_share_no_draws(run, process, one, other):
    evaluations = {evaluation_seed(run), evaluation_seed(run, one), evaluation_seed(run, other)}
    assert len(evaluations) == (2 if one == other else 3)
    first, resumed = process_seed(*process), session_seed(process_seed(*process), one)
    assert len({*evaluations, first, resumed}) == len(evaluations) + 2
    assert max(*evaluations, first, resumed) < 2**32


@given(SEEDS, st.lists(st.tuples(RANKS, ITERATIONS), min_size=2, max_size=2, unique=True))
def test_sessions_of_a_run_draw_what_none_of_its_processes_drew_before(seed, sessions):
    one, other = (session_seed(process_seed(seed, rank), iteration) for rank, iteration in sessions)
    assert one != other


def test_neighboring_seeds_have_other_episodes():
    # Seeds 0 to 199 lie further apart than any run has iterations.
    bases = sorted(evaluation_seed(seed) for seed in range(200))
    gaps = [after - before for before, after in zip(bases, bases[1:], strict=False)]
    assert min(gaps) > 1_000_000
