"""Planned lookups return ids only if an immediate lookup would find the same ids."""

from __future__ import annotations

import pytest
import torch

from mjlab.managers.lookup import Lookup, look_up


def planned(timer, dt):
    lookup = Lookup().plan(timer - dt <= 0.0, timer, dt)
    lookup.ids = lookup.mask.nonzero().flatten()
    return lookup


def test_ids_are_given_out_as_long_as_inputs_are_the_same():
    timer = torch.tensor([0.1, 0.3])
    lookup = planned(timer, 0.2)
    for _ in range(2):
        ids = lookup.take(timer, 0.2)
        assert ids is not None
        assert ids.tolist() == [0]


@pytest.mark.parametrize("inference", [False, True])
@pytest.mark.parametrize(
    "write",
    [
        lambda timer: timer.sub_(0.1),
        lambda timer: timer.__setitem__(torch.tensor([1]), 0.0),
        lambda timer: timer[:1].zero_(),
        lambda timer: timer.view(2, 1).detach().add_(1.0),
        lambda timer: torch.zeros(2, out=timer),
    ],
)
def test_ids_are_void_after_any_write(write, inference):
    timer = torch.tensor([0.1, 0.3])
    with torch.inference_mode(inference):
        lookup = planned(timer, 0.2)
        write(timer)
        assert lookup.take(timer, 0.2) is None


def test_ids_are_void_for_other_inputs():
    timer, dt = torch.tensor([0.1, 0.3]), torch.full((2,), 0.2)
    assert planned(timer, 0.2).take(timer, 0.1) is None
    assert planned(timer, 0.2).take(timer.clone(), 0.2) is None
    assert planned(timer, 0.2).take(timer, dt) is None
    assert planned(timer, dt).take(timer, dt.clone()) is None
    lookup = planned(timer, dt)
    assert lookup.take(timer, dt) is not None
    dt.mul_(2.0)
    assert lookup.take(timer, dt) is None


def test_writes_to_inference_tensors_are_not_counted_so_that_ids_are_void():
    with torch.inference_mode():
        timer = torch.tensor([0.1, 0.3])
        assert planned(timer, 0.2).take(timer, 0.2) is None


def test_without_a_look_up_there_are_no_ids():
    timer = torch.tensor([0.1, 0.3])
    look_up([])
    assert Lookup().take(timer, 0.2) is None
    lookup = planned(timer, 0.2)
    lookup.plan(timer <= 0.0, timer, 0.2)
    assert lookup.take(timer, 0.2) is None


def test_ids_of_a_changed_mask_are_found_at_once():
    mask = torch.tensor([True, False, True])
    lookup = Lookup().plan(mask, mask)
    lookup.ids = torch.tensor([7])
    assert lookup.ids_of(mask).tolist() == [7]
    mask[0] = False
    assert lookup.ids_of(mask).tolist() == [2]
