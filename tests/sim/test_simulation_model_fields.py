"""Model fields `sim.model.<field>` used by task packages, on both engines."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from mjlab.sim import Simulation, SimulationCfg

N = 3

# No body is simple: the compiler simplifies bodies whose inertial frame is aligned with a free
# joint or an axis, and models with such bodies cannot move their centers of mass.
SWINGING = """
<mujoco>
  <option density="1.2" wind="1 0 0"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .01"/>
    <light pos="0 0 3"/>
    <camera name="side" pos="0 -2 1" xyaxes="1 0 0 0 .5 1"/>
    <body name="upper" pos="0 0 2">
      <joint name="a" axis="0 1 0" range="-2 2" limited="true"/>
      <geom name="upper" type="capsule" size=".05" fromto="0 0 0 .2 0 -.4"/>
      <body name="lower" pos=".2 0 -.4">
        <joint name="b" axis="0 1 0"/>
        <geom name="lower" type="capsule" size=".04" fromto="0 0 0 -.1 .2 -.3"/>
        <site name="tip" pos="0 0 -.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="a"/></actuator>
  <sensor><jointpos joint="a"/></sensor>
  <keyframe><key qpos=".1 .2"/></keyframe>
</mujoco>
"""


def make_sim(engine: str) -> Simulation:
    model = mujoco.MjModel.from_xml_string(SWINGING)
    return Simulation(N, SimulationCfg(engine=engine), model=model, device="cpu")  # ty: ignore


@pytest.fixture(scope="module", params=["native", "warp"])
def sim(request: pytest.FixtureRequest) -> Simulation:
    """Simulation with shared model fields; do not expand any."""
    return make_sim(request.param)


@pytest.fixture(params=["native", "warp"])
def own_sim(request: pytest.FixtureRequest) -> Simulation:
    """Simulation for expanding fields."""
    return make_sim(request.param)


def test_sizes_are_ints(sim: Simulation) -> None:
    for name in ("nq", "nv", "nu", "na", "nbody", "njnt", "ngeom", "nsite", "nsensordata", "nkey"):
        assert type(getattr(sim.model, name)) is int
        assert getattr(sim.model, name) == getattr(sim.mj_model, name)


@pytest.mark.parametrize(
    "name",
    ["geom_bodyid", "body_parentid", "body_rootid", "body_weldid", "jnt_type", "jnt_dofadr",
     "jnt_qposadr", "jnt_limited", "dof_bodyid", "geom_type", "geom_contype", "geom_condim",
     "geom_sameframe", "body_jntnum", "site_bodyid", "sensor_adr", "sensor_dim", "actuator_trnid",
     "name_geomadr", "key_qpos", "site_size"],
)  # fmt: skip
def test_structure_has_no_environment_dimension(sim: Simulation, name: str) -> None:
    field, compiled = getattr(sim.model, name), getattr(sim.mj_model, name)
    assert field.shape == compiled.shape
    np.testing.assert_allclose(field, compiled, rtol=1e-6)


def test_structure_cannot_be_expanded(own_sim: Simulation) -> None:
    for name in ("geom_bodyid", "jnt_type", "sensor_adr"):
        with pytest.warns(UserWarning, match=f"'{name}'"):
            own_sim.expand_model_fields((name,))
        assert getattr(own_sim.model, name).shape == getattr(own_sim.mj_model, name).shape


def test_other_fields_have_the_environments_first(sim: Simulation) -> None:
    for name in ("body_mass", "geom_friction", "jnt_range", "qpos0", "geom_matid", "light_active"):
        shape = getattr(sim.mj_model, name).shape
        assert getattr(sim.model, name).shape == (N, *shape)


def test_fields_have_an_environment_dimension_where_mujoco_warp_has_worlds(
    sim: Simulation,
) -> None:
    """Shapes are MuJoCo Warp's on both engines, except the addresses of delayed samples."""
    mujoco_warp = pytest.importorskip("mujoco_warp")
    histories = {f"{kind}_history{end}" for kind in ("actuator", "sensor") for end in ("", "adr")}
    compared = 0
    for declared in dataclasses.fields(mujoco_warp.Model):
        shape = getattr(declared.type, "shape", None)
        value = getattr(sim.mj_model, declared.name, None)
        if not shape or not isinstance(value, np.ndarray) or declared.name in histories:
            continue
        leading = (N,) if shape[0] == "*" else ()
        expected = {"cam_mat0": (-1, 3, 3), "geom_aabb": (-1, 2, 3)}.get(declared.name, value.shape)
        expected = (len(value), *expected[1:]) if value.ndim else expected
        assert getattr(sim.model, declared.name).shape == (*leading, *expected), declared.name
        compared += 1
    assert compared > 200


def test_bounding_boxes_are_center_and_half_sizes(own_sim: Simulation) -> None:
    compiled = torch.tensor(own_sim.mj_model.geom_aabb, dtype=torch.float32).view(-1, 2, 3)
    assert own_sim.get_default_field("geom_aabb").shape == compiled.shape
    assert torch.equal(own_sim.model.geom_aabb, compiled.expand(N, -1, -1, -1))
    own_sim.expand_model_fields(("geom_aabb",))
    assert torch.equal(own_sim.model.geom_aabb, compiled.expand(N, -1, -1, -1))
    own_sim.model.geom_aabb[1, :, 1] = 7.0
    resumed = make_sim(own_sim.engine_name)
    resumed.load_state_dict(own_sim.state_dict())
    assert torch.equal(resumed.model.geom_aabb, own_sim.model.geom_aabb)
    assert torch.equal(resumed.model.geom_aabb[1, :, 0], compiled[:, 0])
    assert bool((resumed.model.geom_aabb[1, :, 1] == 7.0).all())


def test_shared_options_read_as_other_fields(sim: Simulation) -> None:
    options = sim.model.opt
    assert options is sim.model.opt
    assert options.timestep.tolist() == pytest.approx([sim.mj_model.opt.timestep] * N)
    assert options.gravity.shape == options.wind.shape == (N, 3)
    assert options.density.tolist() == pytest.approx([1.2] * N)
    for name in ("integrator", "cone", "iterations", "disableflags"):
        assert type(getattr(options, name)) is int
        assert getattr(options, name) == getattr(sim.mj_model.opt, name)
    with pytest.raises(AttributeError, match=r"model\.opt\.timestep cannot be replaced"):
        options.timestep = 0.1
    with pytest.raises(AttributeError, match="'body_mass'"):
        _ = options.body_mass


@pytest.mark.parametrize("name", ["gravity", "opt.gravity"])
def test_an_expanded_option_is_live(own_sim: Simulation, name: str) -> None:
    options = own_sim.model.opt
    assert options.gravity[0, 2] == pytest.approx(-9.81)
    own_sim.expand_model_fields((name,))
    options.gravity[1] = 0.0
    assert options.gravity is own_sim.model.gravity
    assert own_sim.expanded_fields == {"gravity"}
    own_sim.model.opt.wind.sum()
    own_sim.step(20)
    speed = own_sim.data.qvel.abs().sum(dim=1)
    assert speed[0] == speed[2]
    # The wind alone moves it.
    assert speed[1] < 0.2 * speed[0]


def test_a_model_without_simple_bodies_can_move_its_centers_of_mass(own_sim: Simulation) -> None:
    """The world body is always simple and is not checked."""
    assert own_sim.mj_model.body_simple[0]
    assert not own_sim.mj_model.body_simple[1:].any()
    own_sim.expand_model_fields(("body_ipos",))
    own_sim.model.body_ipos[1, 2] = torch.tensor([0.1, 0.0, 0.2])
    own_sim.recompute_constants(3)
    own_sim.step(30)

    expected = []
    for moves in (False, True):
        model = mujoco.MjModel.from_xml_string(SWINGING)
        own_sim.cfg.mujoco.apply(model)
        if moves:
            model.body_ipos[2] = [0.1, 0.0, 0.2]
            model.body_sameframe[2] = 0
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        for _ in range(30):
            mujoco.mj_step(model, data)
        expected.append(data.qpos.copy())
    np.testing.assert_allclose(own_sim.data.qpos[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(own_sim.data.qpos[1], expected[1], atol=1e-5)
    assert np.abs(expected[0] - expected[1]).max() > 1e-3


def test_unknown_fields_and_structs_say_so(sim: Simulation) -> None:
    with pytest.raises(AttributeError, match="MjModel field 'body_masses'"):
        _ = sim.model.body_masses
    with pytest.raises(AttributeError, match=r"MjModel field 'vis'.*sim\.mj_model"):
        _ = sim.model.vis
    with pytest.raises(AttributeError, match="MjOption field 'time_step'"):
        _ = sim.model.opt.time_step


def test_inverse_dynamics_of_mujoco_warp(own_sim: Simulation, caplog) -> None:
    wp = pytest.importorskip("warp")
    mujoco_warp = pytest.importorskip("mujoco_warp")
    own_sim.expand_model_fields(("body_mass",))
    own_sim.model.body_mass[1] *= 2.0
    own_sim.recompute_constants(3)
    own_sim.data.qpos[:, 0] = torch.tensor([0.1, 0.2, 0.3])
    own_sim.data.qfrc_applied[:, 1] = torch.tensor([0.0, 3.0, -2.0])
    own_sim.data.ctrl[2] = 1.0
    own_sim.forward()
    inverse = own_sim.data.qfrc_inverse
    assert own_sim.wp_device == wp.get_device("cpu")
    with wp.ScopedDevice(own_sim.wp_device):
        mujoco_warp.inverse(own_sim.wp_model, own_sim.wp_data)
    expected = own_sim.data.qfrc_actuator + own_sim.data.qfrc_applied
    torch.testing.assert_close(inverse, expected, atol=5e-3, rtol=1e-3)
    assert inverse[2, 0] == pytest.approx(1.0, abs=5e-3)
    assert own_sim.wp_model.nv == own_sim.model.nv
    assert caplog.text.count("--engine warp") == (own_sim.engine_name == "native")


def test_writes_to_the_data_of_mujoco_warp_act(own_sim: Simulation) -> None:
    wp = pytest.importorskip("warp")
    assert own_sim.wp_data.nworld == N
    velocities = wp.to_torch(own_sim.wp_data.qvel)
    velocities[1, 0] = 2.0
    assert own_sim.data.qvel[:, 0].tolist() == [0.0, 2.0, 0.0]
    own_sim.step()
    assert own_sim.data.qpos[1, 0] > 1e-3
    assert torch.equal(wp.to_torch(own_sim.wp_data.qpos), own_sim.data.qpos)
    own_sim.expand_model_fields(("gravity",))
    wp.to_torch(own_sim.wp_model.opt.gravity)[2] = 0.0
    assert own_sim.model.opt.gravity[2].tolist() == [0.0, 0.0, 0.0]


def test_the_device_of_warp_needs_no_mirror(sim: Simulation, caplog) -> None:
    wp = pytest.importorskip("warp")
    assert sim.wp_device == wp.get_device("cpu")
    assert not caplog.text
