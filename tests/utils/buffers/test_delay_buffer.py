"""The delay: which frame is seen, and when lags are drawn."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.utils.buffers import DelayBuffer
from mjlab.utils.state import capture_state, restore_state

ROWS = 64


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _frame(step: float, rows: int = ROWS) -> torch.Tensor:
    return torch.full((rows, 1), float(step))


@settings(deadline=None, max_examples=50)
@given(
    st.integers(0, 2),
    st.integers(0, 3),
    st.booleans(),
    st.sampled_from([0.0, 0.5, 1.0]),
    st.integers(0, 4),
    st.booleans(),
    st.integers(0, 1000),
)
def test_lags_stay_in_range_and_choose_the_frame(
    min_lag, extra, per_env, hold_prob, period, per_env_phase, seed
):
    buffer = DelayBuffer(
        min_lag,
        min_lag + extra,
        8,
        "cpu",
        per_env,
        hold_prob,
        period,
        per_env_phase,
        _generator(seed),
    )
    start = torch.zeros(8)
    for step in range(12):
        if step == 7:
            buffer.reset([1, 4])
            start[[1, 4]] = step
        buffer.append(_frame(step, 8))
        seen = buffer.compute()
        lags = buffer.current_lags
        assert lags.min() >= min_lag
        assert lags.max() <= min_lag + extra
        assert torch.equal(seen[:, 0], torch.maximum(step - lags, start))
        assert torch.equal(seen, buffer.peek())


def test_a_fixed_lag_delays_by_it():
    buffer = DelayBuffer(2, 2, 1)
    seen = []
    for step in range(6):
        buffer.append(_frame(step, 1))
        seen.append(buffer.compute().item())
    assert seen == [0, 0, 0, 1, 2, 3]


def test_all_lags_of_the_range_are_drawn_for_each_row():
    buffer = DelayBuffer(1, 3, ROWS, generator=_generator())
    drawn = []
    for step in range(60):
        buffer.append(_frame(step))
        buffer.compute()
        drawn.append(buffer.current_lags.clone())
    counts = torch.stack([(torch.stack(drawn) == lag).float().mean() for lag in (1, 2, 3)])
    torch.testing.assert_close(counts, torch.full((3,), 1 / 3), atol=0.03, rtol=0)


def test_rows_are_due_once_a_period_at_their_phase():
    buffer = DelayBuffer(0, 30, ROWS, update_period=4, generator=_generator())
    previous, changes = buffer.current_lags.clone(), []
    for step in range(40):
        buffer.append(_frame(step))
        buffer.compute()
        changes.append(buffer.current_lags != previous)
        previous = buffer.current_lags.clone()
    phases = [torch.nonzero(column).flatten() % 4 for column in torch.stack(changes).T]
    assert all(len(set(phase.tolist())) == 1 for phase in phases)
    assert {int(phase[0]) for phase in phases} == {0, 1, 2, 3}


def test_without_phases_all_rows_are_due_together():
    buffer = DelayBuffer(0, 30, ROWS, update_period=3, per_env_phase=False, generator=_generator())
    for step in range(9):
        before = buffer.current_lags.clone()
        buffer.append(_frame(step))
        buffer.compute()
        assert bool((buffer.current_lags != before).float().mean() > 0.5) is (step % 3 == 0)


def test_a_held_lag_is_kept():
    buffer = DelayBuffer(0, 5, ROWS, hold_prob=1.0, generator=_generator())
    lags = buffer.current_lags.clone()
    for step in range(5):
        buffer.append(_frame(step))
        buffer.compute()
    assert torch.equal(buffer.current_lags, lags)


@pytest.mark.parametrize("options", [{"hold_prob": 1.0}, {"update_period": 50}])
def test_a_reset_draws_lags_in_range(options):
    """The defect: lags were 0 after a reset, and stayed so until drawn."""
    buffer = DelayBuffer(2, 4, ROWS, generator=_generator(), **options)
    assert buffer.current_lags.unique().tolist() == [2, 3, 4]
    rows = torch.arange(32)
    before = buffer.current_lags.clone()
    buffer.reset(rows)
    buffer.append(_frame(0))
    buffer.compute()
    assert buffer.current_lags[rows].unique().tolist() == [2, 3, 4]
    assert (buffer.current_lags[:32] != before[:32]).any()
    if "hold_prob" in options:
        assert torch.equal(buffer.current_lags[32:], before[32:])


@pytest.mark.parametrize("options", [{"hold_prob": 0.5}, {"update_period": 3}])
def test_shared_lags_never_drift_apart(options):
    """The defect: holding and phase were drawn for each row."""
    buffer = DelayBuffer(0, 9, ROWS, per_env=False, generator=_generator(), **options)
    seen = set()
    for step in range(40):
        if step in (10, 20):
            buffer.reset(torch.tensor([3, 5]))
        buffer.append(_frame(step))
        buffer.compute()
        assert len(buffer.current_lags.unique()) == 1
        seen.add(int(buffer.current_lags[0]))
    assert len(seen) > 3


@pytest.mark.parametrize("per_env_phase", [True, False])
def test_both_reset_paths_draw_and_stay_in_step(per_env_phase):
    """The defect: the partial-reset path (backfill and peek) left the lag at 0."""
    rows = torch.arange(ROWS)
    buffers = [
        DelayBuffer(
            1, 4, ROWS, update_period=5, per_env_phase=per_env_phase, generator=_generator()
        )
        for _ in range(2)
    ]
    for buffer in buffers:
        buffer.append(_frame(0))
        buffer.compute()
        buffer.reset(rows)
    stepped, refilled = buffers
    stepped.append(_frame(1))
    stepped.compute()
    refilled.backfill(_frame(1), rows)
    assert torch.equal(refilled.peek(), _frame(1))
    for buffer in buffers:
        assert buffer.current_lags.unique().tolist() == [1, 2, 3, 4]
    # Lags are due at the same steps afterwards.
    for step in range(2, 12):
        changed = []
        for buffer in buffers:
            before = buffer.current_lags.clone()
            buffer.append(_frame(step))
            buffer.compute()
            changed.append(buffer.current_lags != before)
        assert bool(changed[0].any()) == bool(changed[1].any())
        if not per_env_phase:
            assert bool(changed[0].any()) is ((step - 1) % 5 == 0)


def test_backfill_touches_only_its_rows():
    buffer = DelayBuffer(0, 2, ROWS, hold_prob=1.0, generator=_generator())
    for step in range(4):
        buffer.append(_frame(step))
        buffer.compute()
    before = buffer.peek()
    lags = buffer.current_lags.clone()
    buffer.reset([0])
    buffer.backfill(_frame(50), torch.tensor([0]))
    assert buffer.peek()[0] == 50
    assert torch.equal(buffer.peek()[1:], before[1:])
    assert torch.equal(buffer.current_lags[1:], lags[1:])


def test_set_lags_clamps_and_lasts_until_the_next_draw():
    buffer = DelayBuffer(1, 3, ROWS, hold_prob=1.0)
    buffer.set_lags(torch.tensor(9))
    assert (buffer.current_lags == 3).all()
    buffer.set_lags(torch.tensor([0, 2]), [4, 5])
    buffer.append(_frame(0))
    buffer.compute()
    assert buffer.current_lags[:7].tolist() == [3, 3, 3, 3, 1, 2, 3]
    every_step = DelayBuffer(0, 50, ROWS, generator=_generator())
    every_step.set_lags(torch.full((ROWS,), 50))
    every_step.append(_frame(0))
    every_step.compute()
    assert len(every_step.current_lags.unique()) > 5


def test_draws_come_from_the_generator():
    def lags(seed: int) -> torch.Tensor:
        buffer = DelayBuffer(0, 9, ROWS, hold_prob=0.5, generator=_generator(seed))
        buffer.append(_frame(0))
        buffer.compute()
        return buffer.current_lags

    torch.manual_seed(0)
    first = lags(5)
    torch.manual_seed(1)
    assert torch.equal(lags(5), first)
    assert not torch.equal(lags(6), first)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_lag": -1}, "min_lag.*-1"),
        ({"min_lag": 3, "max_lag": 2}, "max_lag.*3.*2"),
        ({"hold_prob": 1.5}, "hold_prob.*1.5"),
        ({"update_period": -1}, "update_period.*-1"),
    ],
)
def test_values_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DelayBuffer(**options)


def test_reading_before_the_first_frame_is_refused():
    buffer = DelayBuffer()
    assert not buffer.is_initialized
    with pytest.raises(RuntimeError, match="empty buffer"):
        buffer.compute()


def test_a_restored_buffer_continues_as_the_saved_one():
    kwargs = {"update_period": 3, "hold_prob": 0.3}
    saved = DelayBuffer(0, 5, ROWS, **kwargs)
    for step in range(7):
        saved.append(_frame(step))
        saved.compute()
    other = DelayBuffer(0, 5, ROWS, **kwargs)
    restore_state(other, capture_state(saved))
    outputs = []
    for buffer in (saved, other):
        torch.manual_seed(3)
        for step in range(7, 15):
            buffer.append(_frame(step))
            outputs.append(buffer.compute())
    assert all(torch.equal(a, b) for a, b in zip(outputs[:8], outputs[8:], strict=True))
