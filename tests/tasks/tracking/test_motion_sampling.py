"""Start frame sampling: uniform and adaptive."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.tasks.tracking.mdp.motion_sampling import HardSegmentSampler, draw_uniform
from mjlab.utils.state import capture_state, restore_state


def library(*lengths: int) -> SimpleNamespace:
    """Return a stand-in with the attributes of motions that sampling reads."""
    tensor = torch.tensor(lengths)
    return SimpleNamespace(lengths=tensor, starts=torch.cumsum(tensor, 0) - tensor)


def sampler(*lengths: int, kernel_size=1, decay=0.8, ratio=0.1, alpha=0.001) -> HardSegmentSampler:
    return HardSegmentSampler(lengths, 0.02, kernel_size, decay, ratio, alpha, "cpu")


def test_a_motion_has_a_bin_for_each_second_begun_and_one_more():
    # T / (1 / dt) + 1, rounded down: 2.98 s, 3.0 s and 3.02 s.
    assert [sampler(n).num_bins for n in (149, 150, 151)] == [3, 4, 4]
    assert sampler(149, 150).num_bins == 7


def test_without_failures_all_bins_are_as_likely():
    probabilities = sampler(200, 100).probabilities()
    torch.testing.assert_close(probabilities, torch.full((8,), 1 / 8))


def test_failures_make_their_bin_likelier_by_the_formula():
    one = sampler(200)
    one.count_failures(library(200), torch.tensor([0, 0, 0]), torch.tensor([0, 45, 199]))
    assert one.current_failed.tolist() == [1, 1, 0, 0, 1]
    one.end_step()
    weights = 0.001 * torch.tensor([1.0, 1.0, 0.0, 0.0, 1.0]) + 0.1 / 5
    torch.testing.assert_close(one.probabilities(), weights / weights.sum())
    assert one.current_failed.sum() == 0
    one.end_step()
    torch.testing.assert_close(one.failed[0], torch.tensor(0.001 * 0.999))


def test_failures_of_a_step_replace_earlier_ones_of_the_step():
    one = sampler(200)
    one.count_failures(library(200), torch.tensor([0, 0]), torch.tensor([10, 20]))
    one.count_failures(library(200), torch.tensor([0]), torch.tensor([190]))
    assert one.current_failed.tolist() == [0, 0, 0, 0, 1]


def test_the_kernel_looks_ahead_and_not_into_the_next_motion():
    one = sampler(100, 100, kernel_size=2, decay=0.5)
    one.failed[3] = 1.0
    kernel = torch.tensor([1.0, 0.5]) / 1.5
    base = 0.1 / 6
    expected = torch.full((6,), base)
    # Bin 3 is the first of the second motion: bin 2, the last of the first, does not see it.
    expected[3] += kernel[0]
    assert one.probabilities()[2] == one.probabilities()[0]
    torch.testing.assert_close(one.probabilities(), expected / expected.sum())
    one.failed[:] = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    expected = torch.full((6,), base)
    # Beyond the end, the last bin counts again.
    expected[1] += kernel[1]
    expected[2] += kernel.sum()
    torch.testing.assert_close(one.probabilities(), expected / expected.sum())


@settings(max_examples=30, deadline=None)
@given(
    lengths=st.lists(st.integers(2, 400), min_size=1, max_size=3),
    seed=st.integers(0, 10_000),
    adaptive=st.booleans(),
)
def test_drawn_frames_are_followed_by_another_frame(lengths, seed, adaptive):
    torch.manual_seed(seed)
    motions = library(*lengths)
    if adaptive:
        one = sampler(*lengths)
        ids, frames = one.draw(motions, 200, one.probabilities())
    else:
        ids, frames = draw_uniform(motions, 200)
    assert (frames >= 0).all()
    assert (frames <= motions.lengths[ids] - 2).all()
    assert ids.dtype == frames.dtype == torch.long


def test_uniform_draws_reach_every_frame_of_every_motion_alike():
    torch.manual_seed(0)
    ids, frames = draw_uniform(library(4, 3), 6000)
    counts = torch.bincount(3 * ids + frames)
    assert len(counts) == 5
    assert ((counts - 1200).abs() < 150).all()


def test_adaptive_draws_come_from_the_likely_bin():
    torch.manual_seed(0)
    one = sampler(201)
    p = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0])
    _, frames = one.draw(library(201), 500, p)
    # Bin 2 of 5, of frames 0 to 200: 80 to 119.
    assert frames.min() >= 80
    assert frames.max() <= 119
    assert frames.unique().numel() > 30


def test_figures_tell_how_even_the_probabilities_are():
    one = sampler(200)
    even = torch.full((5,), 0.2)
    entropy, top, _ = one.statistics(even)
    assert entropy.item() == pytest.approx(1.0, abs=1e-6)
    assert top.item() == pytest.approx(0.2)
    uneven = torch.tensor([0.0, 0.5, 0.0, 0.5, 0.0])
    entropy, top, where = one.statistics(uneven)
    assert entropy.item() == pytest.approx(math.log(2) / math.log(5), abs=1e-6)
    assert where.item() in (pytest.approx(0.2), pytest.approx(0.6))
    assert sampler(20).statistics(torch.ones(1))[0].item() == 1.0


def test_statistics_are_run_time_state():
    one, other = sampler(200), sampler(200)
    one.failed.copy_(torch.rand(5))
    restore_state(other, capture_state(one))
    assert torch.equal(other.failed, one.failed)
