"""Model fields that were not expanded: the first write, by any torch operation, expands them."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import mujoco
import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers import EventTermCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.sim.engine import CameraView
from mjlab.tasks.registry import load_env_cfg

FALLING = """
<mujoco>
  <option density="1.2"/>
  <asset><hfield name="bumps" nrow="4" ncol="4" size="2 2 1 .1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .01"/>
    <geom name="bumps" type="hfield" hfield="bumps" pos="9 0 0"/>
    <body name="ball" pos="0 0 5">
      <freejoint/>
      <geom name="ball" size=".1" mass="1"/>
    </body>
    <body name="cart" pos="3 0 5">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom name="cart" type="box" size=".1 .1 .1" mass="2"/>
    </body>
  </worldbody>
  <actuator><motor joint="slide"/></actuator>
</mujoco>
"""
BALL, CART = 1, 2


def make_sim(engine: str, num_envs: int) -> Simulation:
    spec = mujoco.MjSpec.from_string(FALLING)
    return Simulation(num_envs, SimulationCfg(engine=engine), spec=spec, device="cpu")  # ty: ignore


@pytest.fixture(params=["native", "warp"])
def engine(request: pytest.FixtureRequest) -> str:
    return request.param


def falling_speeds(sim: Simulation) -> torch.Tensor:
    """Speeds after 0.1 s of fall (m/s), (N,)."""
    sim.reset()
    sim.step(50)
    return -sim.data.qvel[:, 2]


# Writes of gravity z = -1 in the last environment, keeping -9.81 in the others.
HALF = torch.tensor([[1.0, 1.0, 0.5]])
ONE_ROW: dict[str, Callable[[torch.Tensor], object]] = {
    "item": lambda field: field.__setitem__(-1, torch.tensor([0.0, 0.0, -1.0])),
    "element": lambda field: field.__setitem__((-1, 2), -1.0),
    "ids": lambda field: field.__setitem__((torch.tensor([len(field) - 1]), 2), -1.0),
    "mask": lambda field: field.__setitem__(torch.arange(len(field)) == len(field) - 1, -1.0),
    "slice": lambda field: field[-1:].__setitem__((slice(None), 2), -1.0),
    "view": lambda field: field[-1].fill_(-1.0),
    "view of a view": lambda field: field.T[2][-1:].fill_(-1.0),
    "row": lambda field: [*field][-1].fill_(-1.0),
    "column": lambda field: field.unbind(1)[2][-1:].fill_(-1.0),
    "data": lambda field: field.data[-1].fill_(-1.0),
    "augmented": lambda field: field[-1].__iadd__(8.81),
    "out of a view": lambda field: torch.add(field[-1], 8.81, out=field[-1]),
    "index_put_": lambda field: field.index_put_(
        (torch.tensor([len(field) - 1]),), torch.tensor([[0.0, 0.0, -1.0]])
    ),
}
ALL_ROWS: dict[str, Callable[[torch.Tensor], object]] = {
    "mul_": lambda field: field.mul_(0.5),
    "copy_": lambda field: field.copy_(field * HALF),
    "augmented": lambda field: field.__imul__(0.5),
    "out": lambda field: torch.mul(field, 0.5, out=field),
    "all items": lambda field: field.__setitem__(slice(None), field * 0.5),
    "list": lambda field: torch._foreach_mul_([field], 0.5),
}


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("write", ONE_ROW.values(), ids=ONE_ROW)
def test_a_write_acts_in_its_environment(engine, write, num_envs, caplog):
    sim = make_sim(engine, num_envs)
    sim.step(2)
    write(sim.model.opt.gravity)
    speeds = falling_speeds(sim)
    torch.testing.assert_close(speeds[-1].item(), 0.1, atol=1e-4, rtol=0)
    torch.testing.assert_close(speeds[:-1], torch.full((num_envs - 1,), 0.981), atol=2e-3, rtol=0)
    warned = [record for record in caplog.records if "'gravity'" in record.getMessage()]
    assert len(warned) == (1 if num_envs > 1 else 0)
    assert all("expand_model_fields(('gravity',))" in record.getMessage() for record in warned)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("write", ALL_ROWS.values(), ids=ALL_ROWS)
def test_a_write_of_all_rows_acts(engine, write, num_envs):
    sim = make_sim(engine, num_envs)
    write(sim.model.opt.gravity)
    expected = torch.full((num_envs,), 0.4905)
    torch.testing.assert_close(falling_speeds(sim), expected, atol=1e-3, rtol=0)


def test_augmented_assignment_of_an_option(engine):
    sim = make_sim(engine, 2)
    sim.model.opt.gravity *= 0.5
    sim.model.opt.timestep[1] *= 2
    speeds = falling_speeds(sim)
    torch.testing.assert_close(speeds, torch.tensor([0.4905, 0.981]), atol=4e-3, rtol=0)


def test_a_mass_acts_in_its_environment(engine, caplog):
    sim = make_sim(engine, 3)
    sim.model.body_mass[1, CART] += 2.0
    assert "recompute_constants" in caplog.text
    sim.data.ctrl[:] = 1.0
    sim.step(10)
    displacement = sim.data.qpos[:, 7]
    torch.testing.assert_close(displacement[0], 2 * displacement[1], rtol=1e-4, atol=0)
    assert displacement[0] == displacement[2]
    assert sim.get_default_field("body_mass")[CART] == 2.0
    assert sim.model.body_subtreemass[1, CART] == 2.0
    sim.recompute_constants(3)
    assert sim.model.body_subtreemass[:, CART].tolist() == [2.0, 4.0, 2.0]


def test_references_taken_before_follow_the_field(engine):
    sim = make_sim(engine, 2)
    friction = sim.model.geom_friction
    slides = friction[:, :, 0]
    sim.model.geom_friction[1, :, 0] = 0.3
    assert torch.equal(slides, sim.model.geom_friction[:, :, 0])
    assert slides[1].tolist() == pytest.approx([0.3] * sim.model.ngeom)
    slides[0] = 0.6
    friction.mul_(2.0)
    assert sim.model.geom_friction[:, 0, 0].tolist() == pytest.approx([1.2, 0.6])
    torch.testing.assert_close(friction + 0.0, sim.model.geom_friction)
    assert torch.stack([friction]).shape == (1, 2, sim.model.ngeom, 3)


def test_a_reference_follows_an_explicit_expansion(engine, caplog):
    sim = make_sim(engine, 2)
    gravity = sim.model.opt.gravity
    sim.expand_model_fields(("gravity",))
    gravity[1] = 0.0
    assert falling_speeds(sim)[1] == 0.0
    assert sim.model.opt.gravity[:, 2].tolist() == pytest.approx([-9.81, 0.0])
    assert "gravity" not in caplog.text


def test_reading_expands_nothing(engine):
    sim = make_sim(engine, 3)
    field = sim.model.geom_friction
    target = torch.zeros(3, sim.model.ngeom, 3)
    torch.mul(field, 2.0, out=target)
    target.copy_(field)
    field.clone().mul_(2.0)
    field[torch.tensor([0])].mul_(2.0)
    assert not sim.expanded_fields
    assert type(field + 1) is torch.Tensor
    torch.testing.assert_close(target[0], sim.get_default_field("geom_friction"))


def test_shared_values_print_copy_and_pickle(engine):
    field = make_sim(engine, 2).model.body_mass
    assert f"{field[0, BALL]:.2f}" == "1.00"
    assert "SharedField" not in repr(field)
    for copied in (copy.deepcopy(field), pickle.loads(pickle.dumps(field[0])).expand(2, -1)):
        assert type(copied) is torch.Tensor
        assert torch.equal(copied, field)
    with pytest.raises(ValueError, match="read-only"):
        field.numpy()[0] = 1.0
    assert field.max(dim=1).values.tolist() == [2.0, 2.0]


def test_results_without_elements_are_plain_tensors(engine):
    # E.g. limits of tendons in a model without any: no memory, so all addresses are equal.
    limits = make_sim(engine, 3).model.tendon_range.clone()
    assert type(limits) is torch.Tensor
    limits[..., 0].masked_fill_(torch.ones(3, 0, dtype=torch.bool), -torch.inf)


def test_a_written_field_survives_reset_and_resume(engine):
    sim = make_sim(engine, 2)
    sim.model.opt.gravity[1] = 0.0
    sim.step(3)
    resumed = make_sim(engine, 2)
    gravity = resumed.model.opt.gravity
    resumed.load_state_dict(sim.state_dict())
    assert gravity[:, 2].tolist() == pytest.approx([-9.81, 0.0])
    assert torch.equal(resumed.data.qvel, sim.data.qvel)
    assert falling_speeds(resumed).tolist() == falling_speeds(sim).tolist()


# Fields without environment dimension.


def test_writing_compiled_structure_only_warns(engine, caplog):
    sim = make_sim(engine, 2)
    contype = sim.model.geom_contype
    sim.model.geom_contype[:] = 0
    sim.model.geom_contype[0] = 4
    assert contype.tolist() == [4, 0, 0, 0]
    assert caplog.text.count("'geom_contype'") == 1
    assert "no effect" in caplog.text
    assert sim.mj_model.geom_contype.tolist() == [1, 1, 1, 1]


@pytest.mark.parametrize("num_envs", [1, 2])
def test_writing_a_shared_flag_changes_all_environments(engine, num_envs, caplog):
    sim = make_sim(engine, num_envs)
    sim.model.geom_condim[:] = 1
    assert sim.model.geom_condim.tolist() == [1] * sim.model.ngeom
    assert caplog.text.count("'geom_condim'") == 1
    sim.data.qpos[:, 2] = 0.099
    sim.data.qvel[:, 0] = 1.0
    sim.step(100)
    torch.testing.assert_close(sim.data.qvel[:, 0], torch.ones(num_envs), atol=5e-2, rtol=0)
    assert sim.data.qvel[:, 4].abs().max() < 1e-3


def test_height_fields_are_written_on_warp(engine):
    sim = make_sim(engine, 2)
    sim.model.opt.gravity[:] = 0.0
    sim.data.qpos[:, 0] = 9.0
    sim.data.qpos[:, 2] = 0.3
    if engine == "native":
        with pytest.raises(RuntimeError, match="'hfield_data'.*--engine warp"):
            sim.model.hfield_data[:] = 0.5
        return
    sim.model.hfield_data[:] = 0.5
    sim.step(20)
    assert (sim.data.qvel[:, 2] > 0.1).all()


# Environments.


def set_gravity(env: ManagerBasedRlEnv, env_ids: torch.Tensor | None) -> None:
    rows = torch.arange(env.num_envs) if env_ids is None else env_ids
    env.sim.model.opt.gravity[rows, 2] = -1.0 - rows.float()


def cartpole(engine: str, mode: str, num_envs: int) -> ManagerBasedRlEnvCfg:
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs = num_envs
    cfg.sim.engine = engine  # ty: ignore
    interval = {"interval_range_s": (0.0, 0.0)} if mode == "interval" else {}
    cfg.events["gravity"] = EventTermCfg(func=set_gravity, mode=mode, **interval)  # ty: ignore
    return cfg


@pytest.mark.parametrize(
    "num_envs",
    [
        pytest.param(1, marks=pytest.mark.slow),
        3,
    ],
)
@pytest.mark.parametrize("mode", ["startup", "reset", "interval", "step"])
def test_an_event_of_any_mode_writes_an_option(engine, mode, num_envs, caplog):
    env = ManagerBasedRlEnv(cartpole(engine, mode, num_envs), device="cpu")
    env.reset()
    for _ in range(2):
        env.step(torch.zeros(num_envs, 1))
    expected = -1.0 - torch.arange(num_envs)
    assert torch.equal(env.sim.model.opt.gravity[:, 2], expected)
    assert caplog.text.count("Model field 'gravity'") == (1 if num_envs > 1 else 0)
    env.reset(env_ids=torch.tensor([0]))
    assert torch.equal(env.sim.model.opt.gravity[:, 2], expected)
    # At rest nothing but gravity acts on the pole: its bias force is in proportion to it.
    env.sim.data.qpos[:, 1] = 0.5
    env.sim.data.qvel[:] = 0.0
    env.sim.forward()
    bias = env.sim.data.qfrc_bias[:, 1]
    torch.testing.assert_close(bias / bias[0], -expected)
    env.close()


# What rays and cameras see.

BLOCK = """
<mujoco>
  <worldbody>
    <light pos="0 0 5"/>
    <camera name="down" pos="0 0 4"/>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <geom name="block" type="box" size=".3 .3 .1" pos="0 0 .1"/>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("num_envs", [1, 3])
def test_writes_after_the_first_image_are_seen(engine, num_envs):
    spec = mujoco.MjSpec.from_string(BLOCK)
    sim = Simulation(num_envs, SimulationCfg(engine=engine), spec=spec, device="cpu")
    origins = torch.tensor([0.0, 0.0, 3.0]).repeat(num_envs, 1, 1)
    down = torch.tensor([0.0, 0.0, -1.0]).repeat(num_envs, 1, 1)
    views = (CameraView(0, 5, 5, ("rgb", "depth"), (0, 1, 2)),)

    def look() -> tuple[list[float], list[float]]:
        sim.forward()
        (image,) = sim.render(views)
        assert image.depth is not None
        distances, *_ = sim.raycast(origins, down)
        return distances.flatten().tolist(), image.depth[:, 2, 2].flatten().tolist()

    assert look()[1] == pytest.approx([3.8] * num_envs, abs=1e-5)
    sim.model.geom_pos[-1, 1, 2] += 1.0
    sim.model.geom_rgba[-1, 1] = torch.tensor([1.0, 0.0, 0.0, 1.0])
    distances, depths = look()
    others = [2.8] * (num_envs - 1), [3.8] * (num_envs - 1)
    assert distances == pytest.approx([*others[0], 1.8], abs=1e-5)
    assert depths == pytest.approx([*others[1], 2.8], abs=1e-5)
    (image,) = sim.render(views)
    assert image.rgb is not None
    red, green, _ = image.rgb[-1, 2, 2].tolist()
    assert red > 2 * green
    sim.model.cam_pos[-1, 0, 2] = 6.0
    assert look()[1] == pytest.approx([*others[1], 4.8], abs=1e-5)
