"""Randomization of contact pairs."""

from __future__ import annotations

from typing import Any

import torch

from mjlab.envs.mdp import dr


def test_isotropic_pair_friction_mirrors_what_was_written(make_world: Any) -> None:
    world = make_world()
    default = world.sim.get_default_field("pair_friction")
    world.apply(dr.pair_friction, torch.tensor([0, 1]), ranges=(0.3, 0.6), isotropic=True)
    friction = world.sim.model.pair_friction
    assert torch.equal(friction[:2, :, 1], friction[:2, :, 0])
    assert torch.equal(friction[:2, :, 2:], default[:, 2:].expand(2, 1, 3))
    assert torch.equal(friction[2:], default.expand(2, 1, 5))
    # Also where patterns choose the pairs.
    world.apply(dr.pair_friction, ranges={"self": {3: (0.1, 0.2)}}, isotropic=True)
    assert torch.equal(friction[..., 4], friction[..., 3])
