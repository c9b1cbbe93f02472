"""The ring of frames, against a model that keeps plain lists."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.utils.buffers import CircularBuffer
from mjlab.utils.state import capture_state, restore_state

ROWS = 3


class ListBuffer:
    """The definition: each row holds `max_len` frames, oldest first."""

    def __init__(self, max_len: int) -> None:
        self.max_len = max_len
        self.rows = [[0.0] * max_len for _ in range(ROWS)]
        self.counts = [0] * ROWS

    def append(self, values: list[float]) -> None:
        for row, value in enumerate(values):
            if self.counts[row] == 0:
                self.rows[row] = [value] * self.max_len
            self.rows[row] = [*self.rows[row][1:], value]
            self.counts[row] += 1

    def reset(self, ids: list[int]) -> None:
        for row in ids:
            self.rows[row], self.counts[row] = [0.0] * self.max_len, 0

    def backfill(self, values: list[float], ids: list[int]) -> None:
        for row in ids:
            self.rows[row], self.counts[row] = [values[row]] * self.max_len, 1

    def frame(self, lags: list[int]) -> list[float]:
        chosen = []
        for row, lag in enumerate(lags):
            length = min(self.counts[row], self.max_len)
            chosen.append(self.rows[row][-1 - max(0, min(lag, length - 1))])
        return chosen


values = st.lists(st.integers(1, 99), min_size=ROWS, max_size=ROWS)
row_ids = st.lists(st.integers(0, ROWS - 1), unique=True)
operations = st.lists(
    st.tuples(st.just("append"), values)
    | st.tuples(st.just("reset"), row_ids)
    | st.tuples(st.just("backfill"), st.tuples(values, row_ids)),
    max_size=12,
)
lags = st.lists(st.integers(-2, 6), min_size=ROWS, max_size=ROWS)


@settings(deadline=None)
@given(st.integers(1, 4), values, operations, lags)
def test_it_holds_what_lists_would(max_len, first, operations, lags):
    ring, model = CircularBuffer(max_len, ROWS, "cpu"), ListBuffer(max_len)
    for name, argument in [("append", first), *operations]:
        if name == "append":
            ring.append(torch.tensor(argument, dtype=torch.float32))
            model.append(argument)
        elif name == "reset":
            ring.reset(argument)
            model.reset(argument)
        else:
            ring.backfill(
                torch.tensor(argument[0], dtype=torch.float32),
                torch.tensor(argument[1], dtype=torch.int64),
            )
            model.backfill(*argument)
        assert ring.buffer.tolist() == model.rows
        assert ring.current_length.tolist() == [min(c, max_len) for c in model.counts]
        assert ring[torch.tensor(lags)].tolist() == model.frame(lags)
        assert ring[lags[0]].tolist() == model.frame([lags[0]] * ROWS)


def test_frames_of_any_shape_and_type_are_kept():
    ring = CircularBuffer(2, ROWS, "cpu")
    frame = torch.arange(ROWS * 4).view(ROWS, 2, 2)
    ring.append(frame)
    ring.append(frame + 1)
    assert ring.buffer.shape == (ROWS, 2, 2, 2)
    assert ring.buffer.dtype == torch.int64
    assert torch.equal(ring.buffer[:, 1], frame + 1)
    lags = torch.tensor([0, 1, 0])
    assert torch.equal(ring[lags], torch.stack((frame[0] + 1, frame[1], frame[2] + 1)))


def test_what_is_read_does_not_change_later():
    ring = CircularBuffer(2, ROWS, "cpu")
    ring.append(torch.ones(ROWS, 1))
    reads = (ring.buffer, ring[0], ring[torch.zeros(ROWS, dtype=torch.int64)])
    ring.append(torch.full((ROWS, 1), 2.0))
    ring.append(torch.full((ROWS, 1), 3.0))
    assert all((read == 1).all() for read in reads)


@pytest.mark.parametrize(
    "rows", [slice(0, 2), [0, 1], torch.tensor([0, 1]), torch.tensor([True, True, False])]
)
def test_rows_can_be_named_in_several_ways(rows):
    ring = CircularBuffer(2, ROWS, "cpu")
    ring.append(torch.ones(ROWS))
    ring.reset(rows)
    assert ring.current_length.tolist() == [0, 0, 1]
    assert ring.buffer.sum(1).tolist() == [0, 0, 2]
    ring.backfill(torch.full((ROWS,), 4.0), rows)
    assert ring.buffer.sum(1).tolist() == [8, 8, 2]


def test_properties():
    ring = CircularBuffer(2, ROWS, "cpu")
    assert (ring.max_length, ring.batch_size, ring.device) == (2, ROWS, "cpu")
    assert not ring.is_initialized
    ring.append(torch.ones(ROWS))
    assert ring.is_initialized


def test_later_frames_are_broadcast():
    ring = CircularBuffer(2, ROWS, "cpu")
    ring.append(torch.ones(ROWS, 2))
    ring.append(torch.full((ROWS, 1), 2.0))
    assert ring.buffer.tolist() == [[[1.0, 1.0], [2.0, 2.0]]] * ROWS
    ring.reset(torch.tensor([0]))
    ring.append(torch.full((ROWS, 1), 3.0))
    assert ring.buffer[0].tolist() == [[3.0, 3.0]] * 2


def test_misuse_is_refused():
    with pytest.raises(ValueError, match="max_len.*0"):
        CircularBuffer(0, ROWS, "cpu")
    ring = CircularBuffer(2, ROWS, "cpu")
    for use in (
        lambda: ring.buffer,
        lambda: ring[0],
        lambda: ring.backfill(torch.ones(ROWS), torch.tensor([0])),
    ):
        with pytest.raises(RuntimeError, match="empty buffer"):
            use()
    with pytest.raises(ValueError, match=r"size 3 .*got shape \(4, 1\)"):
        ring.append(torch.ones(4, 1))
    ring.append(torch.ones(ROWS, 1))
    with pytest.raises(RuntimeError):
        ring.append(torch.ones(ROWS, 2))
    with pytest.raises(ValueError, match=r"lags: .*got shape \(2,\)"):
        ring[torch.tensor([0, 1])]


def test_its_state_can_be_saved_and_restored():
    ring, other = CircularBuffer(3, ROWS, "cpu"), CircularBuffer(3, ROWS, "cpu")
    for step in range(4):
        ring.append(torch.full((ROWS, 2), float(step)))
    ring.reset([1])
    restore_state(other, capture_state(ring))
    for buffer in (ring, other):
        buffer.append(torch.full((ROWS, 2), 9.0))
    assert torch.equal(ring.buffer, other.buffer)
    assert torch.equal(ring.current_length, other.current_length)


def test_frames_follow_those_of_inference_mode() -> None:
    buffer = CircularBuffer(2, 3, "cpu")
    with torch.inference_mode():
        buffer.append(torch.ones(3, 2))
    buffer.append(torch.zeros(3, 2))
    buffer.reset(torch.tensor([1]))
    assert not buffer.buffer.is_inference()
