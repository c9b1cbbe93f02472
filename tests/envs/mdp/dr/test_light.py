"""Randomization of lights."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.envs.mdp import dr

ENGINES = ("native", "warp")


@pytest.mark.parametrize("engine", ENGINES)
def test_light_directions_have_length_one(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine)
    for _ in range(3):
        world.apply(dr.light_dir, ranges={0: (2.0, 3.0)})
        direction = world.sim.model.light_dir
        torch.testing.assert_close(direction.norm(dim=-1), torch.ones(4, 1))
        # Starting from the default (0, 0, -1) each time, x / z stays in the range.
        ratio = -direction[..., 0] / direction[..., 2]
        assert bool(((ratio >= 1.999) & (ratio <= 3.001)).all())


def test_a_zero_light_direction_is_refused(make_world: Any) -> None:
    with pytest.raises(ValueError, match="light_dir: .*zero vector"):
        make_world().apply(dr.light_dir, ranges=(0.0, 0.0))
