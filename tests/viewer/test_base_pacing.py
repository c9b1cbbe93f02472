"""Pacing of simulated time, and step and frame rates."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjlab.viewer.base import SPEEDS, RateMeter, RealtimePacer, speed_label


def steps_taken(pacer: RealtimePacer) -> int:
    count = 0
    while pacer.take_step():
        count += 1
    return count


@given(frames=st.lists(st.floats(0.001, 0.1), max_size=50), speed=st.sampled_from(SPEEDS))
def test_simulated_time_keeps_to_wall_time_times_speed(frames, speed) -> None:
    pacer = RealtimePacer(step_dt=0.02, frame_period=1 / 60)
    pacer.change_speed(SPEEDS.index(speed) - SPEEDS.index(1.0))
    taken = 0
    for elapsed in frames:
        pacer.add(elapsed)
        taken += steps_taken(pacer)
    assert sum(frames) * speed - 0.02 - 1e-6 <= taken * 0.02 <= sum(frames) * speed + 1e-6


def test_what_a_slow_machine_could_not_step_is_dropped_except_for_one_step() -> None:
    pacer = RealtimePacer(step_dt=0.02, frame_period=1 / 60)
    pacer.add(10.0)
    pacer.take_step()
    pacer.out_of_time()
    assert pacer.capped
    assert steps_taken(pacer) == 1


def test_time_in_a_pause_is_not_caught_up_with() -> None:
    pacer = RealtimePacer(step_dt=0.02, frame_period=1 / 60)
    pacer.add(10.0)
    pacer.clear()
    assert not pacer.take_step()


def test_speeds_are_powers_of_two_and_stop_at_their_ends() -> None:
    assert SPEEDS[0] == 1 / 32
    assert SPEEDS[-1] == 8
    pacer = RealtimePacer(0.02, 1 / 60)
    pacer.change_speed(+100)
    assert pacer.speed == 8
    pacer.change_speed(-100)
    assert pacer.speed == 1 / 32
    pacer.reset_speed()
    assert pacer.speed == 1
    assert [speed_label(s) for s in (1 / 32, 0.5, 1, 8)] == ["1/32x", "1/2x", "1x", "8x"]


def test_rates_are_averages_over_half_a_second() -> None:
    meter = RateMeter(now=0.0)
    meter.count(steps=10, frames=5)
    meter.update(0.4)
    assert meter.steps_per_second == 0.0
    meter.update(0.5)
    assert meter.steps_per_second == pytest.approx(20.0)
    assert meter.frames_per_second == pytest.approx(10.0)
    meter.update(1.0)
    assert meter.steps_per_second == 0.0


def test_the_next_step_is_due_when_the_budget_has_grown_to_it() -> None:
    pacer = RealtimePacer(step_dt=0.02, frame_period=0.1)
    pacer.add(0.005)
    assert pacer.time_to_next_step == pytest.approx(0.015)
    pacer.change_speed(+1)
    assert pacer.time_to_next_step == pytest.approx(0.0075)
    pacer.add(1.0)
    assert pacer.time_to_next_step == 0.0
