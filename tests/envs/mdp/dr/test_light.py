"""Randomization of lights."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.envs.mdp import dr
from mjlab.envs.mdp.dr import Operation

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


def test_zero_light_direction_warns(make_world: Any) -> None:
    world = make_world()
    with pytest.warns(UserWarning, match="light_dir: .*zero vector") as caught:
        world.apply(dr.light_dir, ranges=(0.0, 0.0))
    assert len(caught) == 1
    assert world.sim.model.light_dir.abs().max() == 0.0


@pytest.mark.parametrize("engine", ENGINES)
def test_custom_operation_on_a_light_direction(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine)
    turn = Operation("turn", torch.zeros_like, lambda base, rnd: base + rnd, uses_defaults=False)
    for count in (1, 2):
        world.apply(dr.light_dir, ranges={0: (1.0, 1.0)}, operation=turn)
        # The x axis starts from the current direction, the others from the default (0, 0, -1).
        x = 1.0 if count == 1 else 0.5**0.5 + 1.0
        expected = torch.tensor([x, 0.0, -1.0]) / (x * x + 1.0) ** 0.5
        torch.testing.assert_close(world.sim.model.light_dir[0, 0], expected)
