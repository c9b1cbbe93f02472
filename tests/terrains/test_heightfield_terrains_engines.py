"""Height fields on both engines."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.sim.config import MujocoCfg, SimulationCfg
from mjlab.sim.simulation import Simulation

from .heightfields import build, perlin, slope

RADIUS = 0.2
# A ball that is still bouncing differs by more than rounding.
FALLING_STEPS = 300


def spec_with_ball(x: float, y: float, z: float) -> mujoco.MjSpec:
    """A hill, and a ball above it that slides and rolls as little as possible."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="terrain")
    slope(slope_range=(0.0, 0.3)).function(1.0, spec, np.random.default_rng(0))
    ball = spec.worldbody.add_body(name="ball", pos=(x, y, z))
    ball.add_joint(name="fall", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0.0, 0.0, 1.0), damping=5.0)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(RADIUS, 0.0, 0.0), mass=1.0)
    return spec


@pytest.mark.parametrize(("x", "y"), [(4.0, 4.0), (2.03, 3.51)], ids=["platform", "slope"])
def test_a_ball_lands_at_the_same_height_on_both_engines(x, y):
    """On flat ground it lies one radius above it, and on a slope it touches the side."""
    landed = {}
    for engine in ("native", "warp"):
        cfg = SimulationCfg(
            engine=engine, mujoco=MujocoCfg(timestep=0.004), num_threads=1, nconmax=30, njmax=120
        )
        sim = Simulation(1, cfg, spec=spec_with_ball(x, y, 1.5), device="cpu")
        for _ in range(FALLING_STEPS // 50):
            sim.step(nstep=50)
        assert sim.data.qvel.abs().max() < 1e-3, "at rest"
        landed[engine] = 1.5 + sim.data.qpos[0, 0].item()
    assert landed["warp"] == pytest.approx(landed["native"], abs=1e-4)
    ground = build(slope(slope_range=(0.0, 0.3))).height_at(x, y)
    # The slope's plane is one radius away from the center: more than one radius vertically.
    above = landed["native"] - ground
    assert RADIUS - 0.003 < above < RADIUS * 1.1


def test_rays_meet_the_same_ground_on_both_engines():
    cfg = perlin()
    built = build(cfg, 0.8, seed=4)
    rng = np.random.default_rng(0)
    points = rng.uniform(0.3, 7.7, size=(50, 2))
    expected = torch.tensor([20.0 - built.height_at(*point) for point in points])
    origins = torch.tensor(np.column_stack([points, np.full(50, 20.0)]), dtype=torch.float32)
    down = torch.tensor([0.0, 0.0, -1.0]).expand(1, 50, 3).contiguous()
    for engine in ("native", "warp"):
        sim_cfg = SimulationCfg(engine=engine, mujoco=MujocoCfg(), num_threads=1)
        sim = Simulation(1, sim_cfg, model=built.model, device="cpu")
        sim.forward()
        distance = sim.raycast(origins[None], down)[0]
        torch.testing.assert_close(distance[0], expected, atol=2e-4, rtol=0.0)
