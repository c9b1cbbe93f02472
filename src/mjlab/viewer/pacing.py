"""When to step and when to draw, so that the simulation keeps to real time."""

from __future__ import annotations

import math
from collections.abc import Sequence

SPEEDS = tuple(2.0**exponent for exponent in range(-5, 4))
"""Speeds a viewer offers, as multiples of real time: 1/32, 1/16, ... 8."""

_STATS_WINDOW_S = 0.5


def speed_label(multiplier: float) -> str:
    """A speed as people write it: `1/4x`, `1x`, `8x`."""
    if multiplier < 1.0:
        return f"1/{round(1.0 / multiplier)}x"
    return f"{multiplier:g}x"


class RealtimePacer:
    """Turns elapsed wall time into a budget of simulated time to step through.

    Time that could not be used within one frame is dropped except for a single step: a simulation
    that is slower than asked for runs late, and the screen still answers.
    """

    def __init__(self, step_dt: float, frame_period: float, speeds: Sequence[float] = SPEEDS):
        self.step_dt = step_dt
        self.frame_period = frame_period
        self.capped = False
        self._speeds = tuple(speeds)
        self._budget = 0.0
        self.reset_speed()

    @property
    def speed(self) -> float:
        """Target speed as a multiple of real time."""
        return self._speeds[self._speed_index]

    def change_speed(self, steps: int) -> None:
        """Go `steps` up (or down, where negative) in the list of speeds, within its ends."""
        self._speed_index = min(max(self._speed_index + steps, 0), len(self._speeds) - 1)

    def reset_speed(self) -> None:
        """Select real time, or the speed nearest to it."""
        ratios = [abs(math.log(speed)) for speed in self._speeds]
        self._speed_index = ratios.index(min(ratios))

    def add(self, elapsed: float) -> None:
        """Add `elapsed` seconds of wall time to the budget."""
        self._budget += elapsed * self.speed

    def take_step(self) -> bool:
        """Whether there is time for one more step; it is taken off the budget."""
        # Adding many small times leaves rounding errors, which must not cost a whole step.
        if self._budget < self.step_dt * (1.0 - 1e-9):
            return False
        self._budget = max(self._budget - self.step_dt, 0.0)
        return True

    @property
    def time_to_next_step(self) -> float:
        """Wall time in seconds until the budget is enough for a step."""
        return max(self.step_dt - self._budget, 0.0) / self.speed

    def out_of_time(self) -> None:
        """Say that this frame's wall time is used up; what is left is cut to one step."""
        self.capped = self._budget >= self.step_dt
        self._budget = min(self._budget, self.step_dt)

    def clear(self) -> None:
        """Forget the budget: time that passed while paused is not caught up with."""
        self._budget = 0.0
        self.capped = False


class RateMeter:
    """Steps and frames a second, averaged over half a second of wall time."""

    def __init__(self, now: float):
        self.steps_per_second = 0.0
        self.frames_per_second = 0.0
        self._start = now
        self._steps = 0
        self._frames = 0

    def count(self, steps: int = 0, frames: int = 0) -> None:
        self._steps += steps
        self._frames += frames

    def update(self, now: float) -> bool:
        """Close the averaging window if it is full; return whether there are new rates."""
        elapsed = now - self._start
        if elapsed < _STATS_WINDOW_S:
            return False
        self.steps_per_second = self._steps / elapsed
        self.frames_per_second = self._frames / elapsed
        self._start = now
        self._steps = self._frames = 0
        return True

    def restart(self, now: float) -> None:
        """Forget what was counted, as after a pause."""
        self._start = now
        self._steps = self._frames = 0
        self.steps_per_second = self.frames_per_second = 0.0
