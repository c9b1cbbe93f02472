"""Reset on the native engine, and defaults of model fields."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.sim import Simulation, SimulationCfg

NUM_ENVS = 3

# Each DC motor has two activations, current and temperature, so there are more activations than
# actuators. The plain motor, listed first, has none, so indices of the two never coincide.
MOTORS = """
<mujoco>
  <worldbody>
    <body name="arm">
      <joint name="turn" type="hinge" axis="0 0 1"/>
      <geom type="box" size="0.2 0.1 0.1" mass="1"/>
      <body name="head" pos="0 0 0.5">
        <joint name="lift" type="slide" axis="1 0 0"/>
        <geom type="sphere" size="0.1" mass="2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="turn"/>
    <dcmotor joint="turn" motorconst="0.05" resistance="1" inductance="0.01" thermal="1 1 1 1 1 25"/>
    <dcmotor joint="lift" motorconst="0.05" resistance="2" inductance="0.02" thermal="1 1 1 1 1 25"/>
    <general joint="lift" dyntype="filter" dynprm="0.1"/>
    <general joint="lift" dyntype="integrator" biastype="affine"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def sim() -> Simulation:
    spec = mujoco.MjSpec.from_string(MOTORS)
    sim = Simulation(NUM_ENVS, SimulationCfg(engine="native"), spec=spec, device="cpu")
    assert sim.mj_model.na > sim.mj_model.nu, "the model must have activations beyond nu"
    assert sim.mj_model.actuator_actnum.max() == 2
    return sim


def drive(sim: Simulation, env_ids: slice | torch.Tensor = slice(None), steps: int = 20) -> None:
    """Step with a different control in each actuator of `env_ids`, so that no activation is 0."""
    sim.data.ctrl[env_ids] = torch.linspace(1.0, 2.0, sim.mj_model.nu)
    sim.step(steps)


@pytest.mark.parametrize(
    "ids", [torch.tensor([1]), torch.tensor([False, True, False]), slice(1, 2)]
)
def test_a_reset_clears_every_activation_of_the_chosen_environment_only(sim, ids):
    drive(sim)
    moved = sim.data.act.clone()
    assert (moved != 0).all()
    sim.reset(ids)
    for _ in range(2):
        assert (sim.data.act[1] == 0).all()
        assert torch.equal(sim.data.act[[0, 2]], moved[[0, 2]])
        # Writes must reach the engine, not only the tensor.
        sim.forward()


def test_rates_of_activations_are_cleared_with_them(sim):
    rates = sim.data.act_dot
    drive(sim)
    kept = rates.clone()
    assert (kept != 0).any(dim=1).all()
    sim.reset(torch.tensor([1]))
    assert (rates[1] == 0).all()
    assert torch.equal(rates[[0, 2]], kept[[0, 2]])


def test_an_environment_that_was_reset_moves_as_a_new_one(sim):
    new = Simulation(
        NUM_ENVS,
        SimulationCfg(engine="native"),
        spec=mujoco.MjSpec.from_string(MOTORS),
        device="cpu",
    )
    drive(sim, steps=40)
    sim.reset(torch.tensor([1]))
    for each in (sim, new):
        drive(each, steps=10)
    for field in ("qpos", "qvel", "act", "time"):
        assert torch.equal(getattr(sim.data, field)[1], getattr(new.data, field)[1]), field
    assert not torch.equal(sim.data.act[0], new.data.act[0])


@pytest.mark.parametrize("field", ["body_mass", "actuator_gainprm", "gravity"])
def test_defaults_are_those_of_construction(sim, field):
    # Viewers write per-environment values there, before the first read of the default.
    owner = sim.mj_model.opt if field == "gravity" else sim.mj_model
    expected = np.array(getattr(owner, field), dtype=np.float32)
    assert field not in sim.default_model_fields
    getattr(owner, field)[:] = 7.0
    np.testing.assert_array_equal(sim.get_default_field(field).numpy(), expected)
    sim.expand_model_fields([field])
    np.testing.assert_array_equal(getattr(sim.model, field)[1].numpy(), expected)
