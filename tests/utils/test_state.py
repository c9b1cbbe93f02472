"""Capture and restore of run-time state."""

from __future__ import annotations

import contextlib
import enum
import io
from collections import defaultdict, deque

import numpy as np
import torch

from mjlab.utils.state import (
    capture_state,
    changes_undone,
    is_stateful,
    mark_stateful,
    restore_state,
    shape_differences,
    stateful,
)


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


def test_an_attribute_made_at_the_first_call_is_made():
    saved = capture_state(Buffer())
    saved["made_later"] = torch.ones(2)
    fresh = Buffer()
    restore_state(fresh, saved)
    assert torch.equal(fresh.made_later, torch.ones(2))  # ty: ignore


def test_an_object_that_does_not_exist_yet_is_reported_and_left(caplog):
    owner = Owner()
    owner.nothing = Buffer()  # ty: ignore
    fresh = Owner()
    restore_state(fresh, capture_state(owner))
    assert fresh.nothing is None
    assert "Owner.nothing not restored: expected a Buffer" in caplog.text


@stateful
class Assorted:
    def __init__(self) -> None:
        self.numpy_number: float = 0.0
        self.array = np.zeros(3, dtype=np.float32)
        self.recent = deque([1, 2], maxlen=3)
        self.counts = defaultdict(int, a=1)
        self.generator = torch.Generator()
        self.shared = torch.ones(3).expand(4, 3)
        self.color = Color.RED
        self.device = "cpu"


class Color(enum.StrEnum):
    RED = "red"


def test_values_of_other_libraries_become_plain_and_come_back():
    one = Assorted()
    one.numpy_number = np.float64(2.5)
    one.array[:] = 4
    one.recent.append(9)
    one.counts["b"] = 7
    torch.rand(5, generator=one.generator)
    saved = capture_state(one)
    assert type(saved["numpy_number"]) is float
    assert not {"shared", "color", "device"} & saved.keys()
    stream = io.BytesIO()
    torch.save(saved, stream)
    stream.seek(0)
    two = Assorted()
    restore_state(two, torch.load(stream, weights_only=True))
    assert two.numpy_number == 2.5
    np.testing.assert_array_equal(two.array, one.array)
    assert two.recent == deque([1, 2, 9], maxlen=3)
    assert two.recent.maxlen == 3
    assert dict(two.counts) == {"a": 1, "b": 7}
    assert torch.equal(
        torch.rand(2, generator=one.generator), torch.rand(2, generator=two.generator)
    )


def test_shapes_that_differ_are_named():
    saved, current = capture_state(Owner()), capture_state(Owner())
    saved["buffers"]["a"]["values"] = torch.zeros(7)
    assert shape_differences(saved, current) == ["buffers.a.values: expected shape (4,), got (7,)"]
    assert shape_differences(current, current) == []


# Changes undone.


@stateful
class Plain:
    def __init__(self) -> None:
        self.values = torch.zeros(3, 2)
        self.array = np.zeros(3)
        self.count = 0
        self.parts: list = [torch.zeros(3), {"a": 1.0}]
        self.numbers = [0.0] * 3
        self.unset: torch.Tensor | None = None
        self.shared = Buffer()


def test_changes_of_a_block_are_undone():
    plain = Plain()
    values, first = plain.values, plain.parts[0]
    with changes_undone([plain]):
        plain.values += 1.0
        plain.array = plain.array + 1.0
        plain.count += 1
        first.fill_(4.0)
        plain.parts[1]["a"] = 3.0
        plain.added = True
        plain.shared.count = 8
    assert plain.values is values
    assert values.tolist() == [[0.0, 0.0]] * 3
    assert plain.array.tolist() == [0.0] * 3
    assert plain.parts == [first, {"a": 1.0}]
    assert first.tolist() == [0.0] * 3
    assert (plain.count, plain.shared.count) == (0, 3)
    assert not hasattr(plain, "added")


def test_rows_keep_their_changes():
    plain = Plain()
    with changes_undone([plain], torch.tensor([1]), 3):
        plain.values = plain.values + 1.0
        plain.array += 1.0
        plain.parts[0] += 1.0
        plain.numbers = [1.0, 2.0, 3.0]
        plain.unset = torch.ones(3)
        plain.count += 1
    assert plain.values.tolist() == [[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]]
    assert plain.array.tolist() == plain.parts[0].tolist() == [0.0, 1.0, 0.0]
    assert plain.numbers == [0.0, 2.0, 0.0]
    assert plain.count == 0
    assert plain.unset is not None


def test_changes_are_undone_after_an_error():
    plain = Plain()
    with contextlib.suppress(ZeroDivisionError), changes_undone([plain]):
        plain.count = 1 // (plain.values.fill_(1.0).sum() * 0).int().item()
    assert plain.values.sum() == 0.0


def test_generators_continue_on_request():
    plain = Plain()
    plain.torch = torch.Generator().manual_seed(1)  # ty: ignore

    def draw(generators: bool) -> float:
        with changes_undone([plain], generators=generators):
            return torch.rand(1, generator=plain.torch).item()  # ty: ignore

    assert draw(True) == draw(True) == draw(False) != draw(True)


def test_helpers_with_rows_are_marked():
    class Filter:
        def __init__(self):
            self.values = torch.zeros(3)

    class Motion:
        def __init__(self):
            self.values = torch.zeros(100, 2)

    class Term:
        def __init__(self):
            self.filters = {"a": Filter()}
            self.motion = Motion()
            self.network = torch.nn.Linear(1, 1)

    term = Term()
    mark_stateful(term, 3)
    assert is_stateful(term)
    assert is_stateful(term.filters["a"])
    assert not is_stateful(term.motion)
    assert not is_stateful(term.network)
