"""Capturing and restoring run-time state."""

from __future__ import annotations

import io

import torch

from mjlab.utils.state import capture_state, restore_state, stateful


@stateful
class Buffer:
    def __init__(self) -> None:
        self.values = torch.arange(4.0)
        self.count = 3


class Owner(Buffer):
    _transient = {"cache"}

    def __init__(self) -> None:
        super().__init__()
        self.buffers = {"a": Buffer(), "b": Buffer()}
        self.sums = {"reward": torch.ones(2)}
        self.cache = torch.zeros(2)
        self.function = print
        self.mixed = [torch.zeros(1), print, 2.5]
        self.nothing: torch.Tensor | None = None
        self.alias = self.buffers["a"]


def changed(owner: Owner) -> Owner:
    owner.values += 1
    owner.count = 9
    owner.buffers["b"].values.zero_()
    owner.sums["reward"] *= 5
    owner.cache += 1
    owner.mixed[0] += 3
    owner.mixed[2] = 7.5
    owner.nothing = torch.ones(2)
    return owner


def test_state_survives_a_safe_save_and_load():
    saved = capture_state(changed(Owner()))
    stream = io.BytesIO()
    torch.save(saved, stream)
    stream.seek(0)
    fresh = Owner()
    restore_state(fresh, torch.load(stream, weights_only=True))
    assert torch.equal(fresh.values, torch.arange(4.0) + 1)
    assert fresh.count == 9
    assert torch.equal(fresh.buffers["b"].values, torch.zeros(4))
    assert torch.equal(fresh.sums["reward"], torch.full((2,), 5.0))
    assert torch.equal(fresh.mixed[0], torch.full((1,), 3.0))
    assert fresh.mixed[1] is print
    assert fresh.mixed[2] == 7.5
    assert torch.equal(fresh.nothing, torch.ones(2))


def test_tensors_are_restored_in_place():
    owner = Owner()
    reference = owner.values
    saved = capture_state(owner)
    owner.values += 10
    restore_state(owner, saved)
    assert owner.values is reference
    assert torch.equal(reference, torch.arange(4.0))


def test_a_capture_does_not_change_with_the_object():
    owner = Owner()
    saved = capture_state(owner)
    owner.values += 10
    assert torch.equal(saved["values"], torch.arange(4.0))


def test_transient_attributes_and_functions_are_left_out():
    saved = capture_state(Owner())
    assert "cache" not in saved
    assert "function" not in saved


def test_an_object_reached_twice_is_saved_once():
    assert "alias" not in capture_state(Owner())


def test_state_of_an_attribute_that_is_gone_is_reported(caplog):
    saved = capture_state(Buffer())
    saved["old_name"] = 3
    restore_state(Buffer(), saved)
    assert "Buffer.old_name" in caplog.text
