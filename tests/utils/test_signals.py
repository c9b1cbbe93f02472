"""Stop signals: exit statuses, and the two stages of a stop request."""

from __future__ import annotations

import signal
import time

import pytest

from mjlab.utils.signals import Interrupted, StopRequest, interrupting_signal


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT, signal.SIGTERM])
def test_statuses_tell_interruptions(number):
    assert interrupting_signal(Interrupted(number).exit_status) is number
    assert interrupting_signal(-number) is number


@pytest.mark.parametrize("status", [0, 1, 2, 3, 128, 137, -9, -11])
def test_other_statuses_are_no_interruptions(status):
    assert interrupting_signal(status) is None


def test_only_a_second_signal_raises_and_only_in_its_blocks():
    with StopRequest() as stop:
        with stop.interruptible():
            signal.raise_signal(signal.SIGTERM)
        assert (stop.requested, stop.number) == (True, signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(Interrupted) as caught, stop.interruptible():
            pytest.fail("not reached")
        with stop.interruptible(False):
            pass
    # Of the first signal.
    assert caught.value.exit_status == 143


def test_the_end_of_the_grace_is_a_second_signal():
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with StopRequest(grace=0.05) as stop, pytest.raises(Interrupted), stop.interruptible():
        signal.raise_signal(signal.SIGINT)
        time.sleep(10.0)
        pytest.fail("not reached")
    # A grace that is not over when the block ends has no effect.
    with StopRequest(grace=0.05):
        signal.raise_signal(signal.SIGINT)
    time.sleep(0.1)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
