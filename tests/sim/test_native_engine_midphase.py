"""Midphase with randomized geoms: contacts equal those of a model compiled with the values."""

from __future__ import annotations

import mujoco
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.sim import MujocoCfg, Simulation, SimulationCfg

NUM_ENVS = 4
STEPS = "".join(
    f'<geom type="box" size=".2 .2 .1" pos="{0.4 * i} {0.4 * j} {0.02 * (i + j)}"/>'
    for i in range(-2, 3)
    for j in range(-2, 3)
)
SCENE = f"""
<mujoco>
  <worldbody>
    <body name="stairs">{STEPS}</body>
    <body name="walker" pos="0 0 .6">
      <freejoint/>
      <inertial pos="0 0 0" mass="2" diaginertia=".03 .02 .01"/>
      <geom name="trunk" type="box" size=".2 .1 .05"/>
      <geom name="head" type="sphere" size=".06" pos=".25 0 .02"/>
      <geom name="tail" type="capsule" size=".02 .08" pos="-.25 0 0" euler="0 70 0"/>
      <body name="leg" pos=".1 .1 0">
        <joint name="hip" axis="0 1 0"/>
        <geom name="thigh" type="capsule" size=".03" fromto="0 0 0 0 0 -.2"/>
        <geom name="foot" type="sphere" size=".04" pos="0 0 -.25"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "body_ipos",
          "body_iquat", "geom_margin")  # fmt: skip


def build(*disabled: str, fields: tuple[str, ...] = FIELDS) -> Simulation:
    cfg = SimulationCfg(mujoco=MujocoCfg(timestep=0.004, disableflags=disabled), num_threads=1)
    sim = Simulation(NUM_ENVS, cfg, spec=mujoco.MjSpec.from_string(SCENE), device="cpu")
    sim.expand_model_fields(fields)
    _ = sim.data.qacc
    return sim


@pytest.fixture(scope="module")
def sims() -> tuple[Simulation, Simulation]:
    """Default scene, and scene without midphase, so that MuJoCo tests all geom pairs."""
    return build(), build("midphase")


def randomize(sim: Simulation, generator: torch.Generator, size: float) -> None:
    """Set fields of all environments but the first to their defaults plus noise."""
    model = sim.mj_model
    moving = torch.as_tensor(model.geom_bodyid) > 1

    def noise(field: str) -> torch.Tensor:
        values = getattr(sim.model, field)
        values[:] = sim.get_default_field(field)
        drawn = size * (2.0 * torch.rand(values.shape, generator=generator) - 1.0)
        drawn[0] = 0.0
        drawn[:, ~moving if field.startswith("geom_") else slice(0, 2)] = 0.0
        return drawn

    sim.model.geom_pos[:] += noise("geom_pos")
    sim.model.body_ipos[:] += noise("body_ipos")
    for field in ("geom_quat", "body_iquat"):
        values = getattr(sim.model, field)
        values[:] = torch.nn.functional.normalize(values + 5.0 * noise(field), dim=-1)
    sim.model.geom_margin[:] += noise("geom_margin").abs()
    # Spheres only: larger boxes and capsules are equivalent for pair detection.
    growth = noise("geom_size")[..., 0].abs()
    for name in ("head", "foot"):
        geom = model.geom(name).id
        sim.model.geom_size[:, geom, 0] += growth[:, geom]
        radius = sim.model.geom_size[:, geom, 0]
        sim.model.geom_rbound[:, geom] = radius
        sim.model.geom_aabb[:, geom].view(NUM_ENVS, -1)[:, 3:] = radius[:, None]


def place(sim: Simulation, generator: torch.Generator) -> None:
    sim.reset()
    pose = torch.rand(NUM_ENVS, sim.mj_model.nq, generator=generator) - 0.5
    sim.data.qpos[:] = pose
    sim.data.qpos[:, 2] = 0.25 + 0.2 * pose[:, 2]
    sim.data.qpos[:, 3:7] = torch.nn.functional.normalize(pose[:, 3:7], dim=-1)
    sim.forward()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), size=st.sampled_from([0.01, 0.05, 0.2]))
def test_randomized_geoms_touch_what_a_search_of_all_pairs_finds(
    sims: tuple[Simulation, Simulation], seed: int, size: float
) -> None:
    for sim in sims:
        generator = torch.Generator().manual_seed(seed)
        randomize(sim, generator, size)
        place(sim, generator)
    found, all_pairs = (sim.data.qacc.clone() for sim in sims)
    assert torch.equal(found, all_pairs)
    for sim in sims:
        sim.step(5)
    assert torch.equal(sims[0].data.qpos, sims[1].data.qpos)


FALLING = -9.81


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("body_ipos", (0.0, 0.0, 0.3)),
        ("geom_pos", (0.0, 0.0, -0.3)),
        ("geom_margin", 0.2),
    ],
)
def test_a_moved_geom_or_centre_of_mass_loses_no_contact(field: str, value: object) -> None:
    touching, other = 1, 2
    sim = build(fields=(field,))
    name = sim.mj_model.body("walker").id
    index = name if field.startswith("body_") else sim.mj_model.geom("trunk").id
    with torch.inference_mode():
        getattr(sim.model, field)[touching, index] = torch.as_tensor(value)
        lowest = 0.14 if field == "body_ipos" else 0.36 if field == "geom_pos" else 0.25
        sim.data.qpos[:, :7] = torch.tensor([0.0, 0.0, lowest, 1.0, 0.0, 0.0, 0.0])
        # Only the trunk is near the ground.
        sim.data.qpos[:, 7] = torch.pi
        sim.forward()
    supported = (sim.data.qacc[:, 2] - FALLING).abs() > 1.0
    assert supported[touching]
    assert supported[other] == (field == "body_ipos")


def test_fine_meshes_need_no_copies() -> None:
    """Volumes of bodies share an array with those of the triangles of meshes."""

    def fine(*disabled: str) -> Simulation:
        spec = mujoco.MjSpec.from_string(SCENE)
        for name in ("shell", "eye", "ear"):
            spec.add_mesh(name=name).make_sphere(subdivision=4)
            spec.body("walker").add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0, mass=0
            )
        cfg = SimulationCfg(mujoco=MujocoCfg(timestep=0.004, disableflags=disabled), num_threads=1)
        sim = Simulation(NUM_ENVS, cfg, spec=spec, device="cpu")
        sim.expand_model_fields(FIELDS)
        return sim

    found, all_pairs = fine(), fine("midphase")
    for sim in (found, all_pairs):
        generator = torch.Generator().manual_seed(1)
        randomize(sim, generator, 0.2)
        place(sim, generator)
        sim.step(20)
    assert torch.equal(found.data.qpos, all_pairs.data.qpos)
    assert found.mj_model.bvh_aabb.nbytes > 10 * found._engine.bytes_each


def test_restored_fields_are_searched_with_their_own_boxes() -> None:
    sim = build(fields=("body_ipos",))
    trunk = sim.mj_model.body("walker").id
    sim.model.body_ipos[1, trunk, 2] = 0.3
    sim.data.qpos[:] = torch.tensor([0.0, 0.0, 0.14, 1.0, 0.0, 0.0, 0.0, torch.pi])
    saved = sim.state_dict()
    sim.forward()
    other = build(fields=())
    other.load_state_dict(saved)
    other.forward()
    assert torch.equal(other.data.qacc, sim.data.qacc)
    assert (other.data.qacc[1, 2] - FALLING).abs() > 1.0


def test_nothing_changes_where_nothing_was_randomized() -> None:
    plain, expanded = build(fields=()), build()
    for sim in (plain, expanded):
        place(sim, torch.Generator().manual_seed(3))
        sim.step(20)
    # Expanded fields are rounded to single precision.
    torch.testing.assert_close(plain.data.qpos, expanded.data.qpos, atol=1e-5, rtol=1e-5)
