"""Simulated limbs obey the servo law, and delays shift targets."""

from __future__ import annotations

import numpy as np
import pytest
from swing import PERIOD, TRUE, chirp, link_spec, plant_of

from mjlab.identification.plant import held_targets, mean_targets


def test_mean_targets_are_those_held() -> None:
    log = plant_of(link_spec(), chirp(3.0)).logs[0]
    times = np.arange(500) * 0.001
    fine = np.arange(499 * 50) * 0.001 / 50
    for delay in (0.0, 0.0037, 0.0123):
        held = held_targets(log, fine - delay + 1e-7).reshape(499, 50, 1).mean(axis=1)
        assert mean_targets(log, times - delay) == pytest.approx(held, abs=1e-3)


def test_a_delay_of_a_row_shifts_the_response() -> None:
    plant = plant_of(link_spec(), chirp(3.0))
    both = np.stack([TRUE, TRUE])
    both[:, -1] = 0.002, 0.002 + PERIOD
    first, second = plant.simulate(both)[0].position
    assert np.abs(first[:-1] - second[1:]).max() < 1e-3 * np.ptp(first)
    assert np.abs(first - second).max() > 0.03


def test_torque_is_limited() -> None:
    plant = plant_of(link_spec(), chirp(3.0))
    limited = plant_of(link_spec(), chirp(3.0), effort_limit=3.0)
    assert np.abs(plant.simulate(TRUE[None])[0].torque).max() > 3.0
    assert np.abs(limited.simulate(TRUE[None])[0].torque).max() == 3.0


def test_still_target_is_held_up_to_gravity_and_friction() -> None:
    plant = plant_of(link_spec(), np.zeros((250, 1)))
    position = plant.simulate(TRUE[None])[0].position
    assert np.abs(position).max() < 1e-6


def test_batch_is_one_by_one() -> None:
    plant = plant_of(link_spec(), chirp(1.0))
    batch = TRUE * np.linspace(0.8, 1.2, 4)[:, None]
    together = plant.simulate(batch)[0].position
    apart = [plant.simulate(x[None])[0].position[0] for x in batch]
    assert (together == np.stack(apart)).all()
