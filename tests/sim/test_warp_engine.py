"""Warp engine specifics. Equality with the native engine is tested in the parity tests."""

from __future__ import annotations

import subprocess
import sys
from contextlib import contextmanager, suppress
from typing import Any

import mujoco
import pytest
import torch
import warp as wp

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import EventTermCfg, SceneEntityCfg
from mjlab.scene import SceneCfg
from mjlab.sim.config import MujocoCfg, SimulationCfg
from mjlab.sim.engine import ROTATION_MATRICES, EngineUnavailableError, RayQuery
from mjlab.sim.randomization import expand_model_fields
from mjlab.sim.sim_data import TorchArray, WarpBridge
from mjlab.sim.warp.engine import WarpEngine, offered_data_fields

from .parity_models import CARTPOLE, HINGE_CHAIN, LANDING_BOX, MOCAP, MODELS

TWO_JOINTS = """
<mujoco>
  <worldbody>
    <body><joint name="a"/><geom size=".1" mass="1"/>
      <body pos=".3 0 0"><joint name="b"/><geom size=".1" mass="1"/></body></body>
  </worldbody>
  <actuator>
    <general joint="a" dyntype="user" actdim="3"/>
    <general joint="b" dyntype="integrator"/>
  </actuator>
</mujoco>
"""


def make_engine(xml: str, num_envs: int = 2, **cfg: object) -> WarpEngine:
    model = mujoco.MjModel.from_xml_string(xml)
    return WarpEngine(model, num_envs, SimulationCfg(engine="warp", **cfg), "cpu")  # type: ignore[arg-type]


def on_the_floor(engine: WarpEngine) -> WarpEngine:
    engine.data_field("qpos")[:, 2] = 0.049
    engine.forward(None)
    return engine


# Unsupported features.


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ('<option solver="PGS"/>', "the solver 'pgs'"),
        ('<option><flag autoreset="disable"/></option>', "the disable flag 'autoreset'"),
        ('<option><flag midphase="disable"/></option>', "the disable flag 'midphase'"),
        ('<option><flag fwdinv="enable"/></option>', "the enable flag 'fwdinv'"),
    ],
)
def test_an_unsupported_option_is_refused_by_name(option: str, said: str) -> None:
    xml = TWO_JOINTS.replace("<worldbody>", f"{option}<worldbody>", 1)
    with pytest.raises(EngineUnavailableError, match="--engine native") as caught:
        make_engine(xml)
    assert said in str(caught.value)
    # Code written for MuJoCo Warp itself expects this class.
    assert isinstance(caught.value, NotImplementedError)


def test_all_problems_are_named_at_once() -> None:
    model = mujoco.MjModel.from_xml_string(TWO_JOINTS)
    MujocoCfg(solver="pgs", disableflags=("midphase",)).apply(model)
    with pytest.raises(EngineUnavailableError) as caught:
        WarpEngine(model, 1, SimulationCfg(), "cpu")
    assert "pgs" in str(caught.value)
    assert "midphase" in str(caught.value)


def test_what_only_mujoco_warp_notices_is_refused_the_same_way() -> None:
    sheet = """
    <mujoco><worldbody><body name="sheet"><freejoint/><geom size=".1" mass="1"/>
      <flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1" rigid="true" dim="2"/>
    </body></worldbody></mujoco>"""
    with pytest.raises(EngineUnavailableError, match="Rigid flexes.*--engine native"):
        make_engine(sheet)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(TWO_JOINTS)
    with pytest.raises(EngineUnavailableError, match="--device cpu"):
        WarpEngine(model, 1, SimulationCfg(), "cuda:0")


def test_too_small_a_capacity_is_refused_at_construction() -> None:
    xml = LANDING_BOX.replace('pos="0 0 .4"', 'pos="0 0 .04"')
    with pytest.raises(ValueError, match=r"njmax=1 or.*SimulationCfg\.nconmax or njmax"):
        make_engine(xml, njmax=1)


def test_contacts_of_an_unused_pose_are_allowed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """At the world origin a robot may be deep inside generated terrain."""
    xml = LANDING_BOX.replace('pos="0 0 .4"', 'pos="0 0 .04"')
    engine = make_engine(xml, nconmax=1)
    assert "4 contacts, more than SimulationCfg.nconmax=1" in caplog.text
    native = make_engine(LANDING_BOX, nconmax=8)
    moved = native.data_field("xpos") - torch.tensor([0.0, 0.0, 0.36])
    # Other fields are those of the reference pose, and contacts work once they fit.
    torch.testing.assert_close(engine.data_field("xpos")[:, 1], moved[:, 1])
    assert not engine.wp_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT


@pytest.mark.parametrize("field", ["geom_contype", "hfield_data", "jnt_type"])
def test_expanding_a_field_that_warp_shares_is_refused_by_name(field: str) -> None:
    with pytest.raises(ValueError, match=f"shares model field '{field}'"):
        make_engine(TWO_JOINTS).expand((field,))


def test_an_unknown_model_field_names_close_ones() -> None:
    with pytest.raises(ValueError, match="vailable: .*body_mass"):
        make_engine(TWO_JOINTS).expand(("body_mas",))


@pytest.mark.parametrize(
    ("field", "said"),
    [
        ("ncon", "sim.data.nacon"),
        ("efc_force", "contact sensor"),
        ("qpso", r"vailable: .*'qpos'"),
    ],
)
def test_a_data_field_that_is_not_offered_says_why(field: str, said: str) -> None:
    with pytest.raises(AttributeError, match=said):
        make_engine(TWO_JOINTS).data_field(field)


# Fields.


@pytest.mark.parametrize("xml", MODELS.values(), ids=MODELS)
def test_data_fields_have_shapes_of_mujoco(xml: str) -> None:
    engine, host = make_engine(xml, num_envs=3), mujoco.MjData(mujoco.MjModel.from_xml_string(xml))
    mujoco.mj_forward(engine.mj_model, host)
    for field in offered_data_fields(engine.wp_data):
        shape = getattr(getattr(host, field), "shape", ())
        shape = (*shape[:-1], 3, 3) if field in ROTATION_MATRICES else shape
        # Some fields are offered only with a sensor that needs them.
        with suppress(AttributeError):
            assert engine.data_field(field).shape == (3, *shape), field


def test_fields_are_the_arrays_themselves() -> None:
    engine = make_engine(CARTPOLE)
    engine.data_field("qpos")[1, 0] = 0.7
    assert engine.wp_data.qpos.numpy()[1, 0] == pytest.approx(0.7)
    assert engine.data_field("qpos") is engine.data_field("qpos")
    engine.expand(("body_mass",))
    engine.model_fields["body_mass"][1] = 3.0
    assert (engine.wp_model.body_mass.numpy()[1] == 3.0).all()
    assert (engine.wp_model.body_mass.numpy()[0] != 3.0).any()


def test_expanded_fields_have_mujocos_shape_and_values() -> None:
    engine = make_engine(MOCAP, num_envs=3)
    host = mujoco.MjModel.from_xml_string(MOCAP)
    for field in ("geom_aabb", "eq_data", "cam_intrinsic", "body_quat", "geom_friction"):
        engine.expand((field,))
        value = torch.as_tensor(getattr(host, field), dtype=torch.float32)
        torch.testing.assert_close(engine.model_fields[field], value.expand(3, *value.shape))
    engine.expand(("gravity", "opt.timestep"))
    assert engine.model_fields["gravity"].shape == (3, 3)
    assert engine.model_fields["opt.timestep"].tolist() == pytest.approx([0.002] * 3)


def test_contacts_of_all_environments_are_tensors() -> None:
    engine = on_the_floor(make_engine(LANDING_BOX))
    count, contact = engine.data_field("nacon"), engine.data_field("contact")
    assert count.shape == (1,)
    assert count.dtype == torch.int32
    assert contact.worldid[: int(count)].sort().values.tolist() == [0] * 4 + [1] * 4
    torch.testing.assert_close(contact.dist[: int(count)], torch.full((8,), -0.001))
    assert contact.geom.shape == (engine.wp_data.naconmax, 2)
    assert contact.frame.shape == (engine.wp_data.naconmax, 3, 3)


def test_fields_first_read_in_inference_mode_are_written_outside_it() -> None:
    engine = make_engine(LANDING_BOX)
    with torch.inference_mode():
        engine.data_field("qpos")
        engine.expand(("geom_size",))
        engine.hide_geoms(torch.zeros(2, 3, dtype=torch.bool))
        engine.step(1)
        built = make_engine(LANDING_BOX)
    built.step(1)
    engine.data_field("qpos").add_(0.1)
    for field in ("geom_size", "geom_rbound", "geom_contype"):
        assert not engine.model_fields[field].is_inference()
    engine.model_fields["geom_size"].mul_(2.0)
    engine.reset(torch.tensor([0]))
    engine.forward(None)
    engine.load_state_dict(engine.state_dict())


def test_expanding_again_keeps_values_and_the_tensor() -> None:
    engine = make_engine(CARTPOLE)
    engine.expand(("body_mass",))
    field = engine.model_fields["body_mass"]
    field[0] = 5.0
    engine.expand(("body_mass", "dof_damping"))
    assert engine.model_fields["body_mass"] is field
    assert (field[0] == 5.0).all()


def test_a_step_uses_fields_expanded_after_earlier_steps() -> None:
    # A captured graph would continue to use the shared array.
    engine = make_engine(LANDING_BOX)
    engine.step(1)
    engine.forward(None)
    engine.expand(("gravity",))
    engine.model_fields["gravity"][1] = 0.0
    engine.forward(None)
    assert engine.data_field("qacc")[:, 2].tolist() == pytest.approx([-9.81, 0.0], abs=1e-5)
    engine.data_field("qvel").zero_()
    engine.step(1)
    velocities = engine.data_field("qvel")[:, 2].tolist()
    assert velocities == pytest.approx([-9.81 * 0.002, 0.0], abs=1e-6)


def test_one_environment_can_be_written_after_expansion() -> None:
    engine = make_engine(CARTPOLE, num_envs=1)
    engine.expand(("body_mass",))
    engine.model_fields["body_mass"][0, -1] = 4.0
    assert engine.wp_model.body_mass.numpy()[0, -1] == 4.0


def test_recomputed_bounds_do_not_bring_hidden_geoms_back() -> None:
    engine = on_the_floor(make_engine(LANDING_BOX))
    engine.expand(("geom_size",))
    absent = torch.tensor([[False, False, False], [False, True, True]])
    engine.hide_geoms(absent)
    engine.model_fields["geom_size"][0, 1, 2] *= 2.0
    engine.recompute_constants(3, None)
    found = engine.data_field("sensordata")[:, -4]
    engine.forward(None)
    assert (found > 0).tolist() == [True, False]
    assert engine.model_fields["geom_rbound"][0, 1] == pytest.approx(0.2062, abs=1e-4)


# Capacities and options.


def test_options_reach_mujoco_warp() -> None:
    engine = make_engine(
        LANDING_BOX,
        contact_sensor_maxmatch=7,
        broadphase="sap_tile",
        broadphase_filter=("plane", "aabb"),
        nconmax=20,
        njmax=40,
    )
    opt, data = engine.wp_model.opt, engine.wp_data
    assert opt.contact_sensor_maxmatch == 7
    assert opt.broadphase.name == "SAP_TILE"
    assert opt.broadphase_filter.name == "PLANE|AABB"
    assert (data.naconmax, data.njmax) == (40, 40)


def test_an_unknown_broadphase_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="'nxn', 'sap_tile', 'sap_segmented'"):
        make_engine(TWO_JOINTS, broadphase="octree")


# State.


def test_reset_clears_every_activation() -> None:
    engine = make_engine(TWO_JOINTS)
    act = engine.data_field("act")
    assert act.shape == (2, 4), "more activations than actuators"
    act.fill_(1.0)
    engine.reset(torch.tensor([1]))
    assert act[0].tolist() == [1.0] * 4
    assert act[1].tolist() == [0.0] * 4


def test_reset_restarts_the_delay_lines_of_its_environments() -> None:
    xml = TWO_JOINTS.replace('dyntype="integrator"', 'delay=".01" nsample="4"')
    xml = xml.replace('dyntype="user" actdim="3"', "")
    engine = make_engine(xml)
    history = engine.data_field("history")
    start = history.clone()
    engine.data_field("ctrl").fill_(1.0)
    engine.step(2)
    after = history.clone()
    assert not torch.equal(after, start)
    engine.reset(torch.tensor([1]))
    torch.testing.assert_close(history[1], start[1])
    assert torch.equal(history[0], after[0])


def test_resetting_the_first_environment_keeps_the_contacts_of_others() -> None:
    engine = on_the_floor(make_engine(LANDING_BOX))
    sensordata = engine.data_field("sensordata")
    contacts, found = engine.wp_data.nacon.numpy()[0], sensordata[1].clone()
    assert contacts > 0
    engine.reset(torch.tensor([0]))
    assert engine.wp_data.nacon.numpy()[0] == contacts
    assert torch.equal(sensordata[1], found)
    assert not sensordata[0].any()


def test_reset_restores_the_mocap_pose_and_equalities_of_the_model() -> None:
    engine = make_engine(MOCAP)
    start = engine.data_field("mocap_pos").clone(), engine.data_field("mocap_quat").clone()
    engine.expand(("body_pos",))
    engine.model_fields["body_pos"][1, 1, 2] += 0.25
    for field in ("mocap_pos", "mocap_quat"):
        engine.data_field(field).add_(1.0)
    engine.data_field("eq_active").fill_(False)
    engine.reset(None)
    assert engine.data_field("eq_active").all()
    assert torch.equal(engine.data_field("mocap_quat"), start[1])
    assert torch.equal(engine.data_field("mocap_pos")[0], start[0][0])
    assert engine.data_field("mocap_pos")[1, 0, 2] == start[0][1, 0, 2] + 0.25


def test_a_reset_forgets_velocities_that_were_not_finite() -> None:
    # MuJoCo Warp's weld constraint reads body velocities before it computes them.
    engine = make_engine(MOCAP)
    engine.data_field("qvel")[0] = torch.nan
    engine.step(2)
    assert engine.data_field("cvel")[0].isnan().any()
    engine.reset(torch.tensor([0]))
    engine.forward(None)
    assert engine.data_field("qacc").isfinite().all()


def test_nan_in_one_environment_leaves_the_others_alone() -> None:
    clean, spoiled = (on_the_floor(make_engine(LANDING_BOX, num_envs=3)) for _ in range(2))
    spoiled.data_field("qpos")[1] = torch.nan
    for engine in (clean, spoiled):
        engine.step(5)
    assert spoiled.data_field("qpos")[1].isnan().any(), "Warp must not repair it by itself"
    for field in ("qpos", "qvel", "sensordata"):
        torch.testing.assert_close(
            spoiled.data_field(field)[[0, 2]], clean.data_field(field)[[0, 2]]
        )


def test_constants_of_other_environments_stay_as_they_are() -> None:
    engine = make_engine(HINGE_CHAIN, num_envs=3)
    engine.expand(("body_mass",))
    engine.model_fields["body_mass"].mul_(2.0)
    before = {"qpos": engine.data_field("qpos").clone(), "qvel": engine.data_field("qvel").clone()}
    engine.expand(engine.constants_written_by(3))
    old = engine.model_fields["body_subtreemass"].clone()
    engine.recompute_constants(3, torch.tensor([1]))
    new = engine.model_fields["body_subtreemass"]
    assert torch.equal(new[[0, 2]], old[[0, 2]])
    torch.testing.assert_close(new[1], 2 * old[1])
    for field, value in before.items():
        assert torch.equal(engine.data_field(field), value)


def test_every_environment_gets_its_own_constants() -> None:
    # A field that stayed shared would hold the first environment's values in all of them.
    engine = make_engine(HINGE_CHAIN, num_envs=2)
    engine.expand(("body_mass",))
    engine.model_fields["body_mass"][1].mul_(3.0)
    engine.recompute_constants(3, None)
    written = engine.constants_written_by(3)
    differing = {
        field
        for field in written
        if not torch.equal(engine.model_fields[field][0], engine.model_fields[field][1])
    }
    assert differing >= {
        "body_subtreemass",
        "body_invweight0",
        "dof_invweight0",
        "actuator_acc0",
    }


def test_a_saved_state_continues_bit_for_bit() -> None:
    first = on_the_floor(make_engine(LANDING_BOX))
    first.expand(("body_mass",))
    first.model_fields["body_mass"][1].mul_(1.5)
    first.recompute_constants(3, None)
    first.step(3)
    saved = first.state_dict()
    first.step(4)
    second = make_engine(LANDING_BOX)
    second.load_state_dict(saved)
    second.step(4)
    for field in ("time", "qpos", "qvel", "sensordata", "qacc_warmstart"):
        assert torch.equal(first.data_field(field), second.data_field(field)), field


def test_a_saved_state_holds_what_the_last_substep_computed() -> None:
    engine = on_the_floor(make_engine(LANDING_BOX))
    qacc, sensors = engine.data_field("qacc"), engine.data_field("sensordata")
    engine.step(3)
    engine.forward(None, "vel")
    second = make_engine(LANDING_BOX)
    second.load_state_dict(engine.state_dict())
    assert torch.equal(second.data_field("qacc"), qacc)
    assert torch.equal(second.data_field("sensordata"), sensors)
    engine.forward(None)
    assert not torch.equal(second.data_field("qacc"), qacc)


def test_a_saved_state_holds_results_that_were_not_read_before() -> None:
    engine = on_the_floor(make_engine(LANDING_BOX))
    engine.step(3)
    engine.forward(None, "vel")
    second = make_engine(LANDING_BOX)
    second.load_state_dict(engine.state_dict())
    for name in ("qacc", "qfrc_constraint", "qacc_smooth"):
        assert torch.equal(second.data_field(name), engine.data_field(name)), name
    assert engine.data_field("qfrc_constraint").any()


def test_a_forward_leaves_delay_lines_alone() -> None:
    xml = HINGE_CHAIN.replace(
        '<jointpos joint="a"/>', '<jointpos joint="a" delay=".01" nsample="4"/>'
    )
    engine = make_engine(xml)
    engine.data_field("qvel").fill_(1.0)
    engine.step(2)
    before = engine.data_field("history").clone()
    engine.data_field("qpos").add_(0.1)
    for stage in ("pos", "vel", "acc"):
        engine.forward(None, stage)
        assert torch.equal(engine.data_field("history"), before)


def test_a_saved_state_of_another_size_is_refused() -> None:
    saved = make_engine(CARTPOLE, num_envs=3).state_dict()
    with pytest.raises(ValueError, match="--num-envs"):
        make_engine(CARTPOLE, num_envs=2).load_state_dict(saved)


def test_the_host_gets_one_environments_state() -> None:
    engine = make_engine(MOCAP)
    engine.data_field("qpos")[1, 0] = 0.3
    engine.data_field("mocap_pos")[1, 0, 1] = 0.4
    engine.step(2)
    host = mujoco.MjData(mujoco.MjModel.from_xml_string(MOCAP))
    engine.copy_to_host(1, host)
    assert host.time == pytest.approx(0.004)
    assert host.mocap_pos[0, 1] == pytest.approx(0.4)
    torch.testing.assert_close(torch.as_tensor(host.qpos).float(), engine.data_field("qpos")[1])


def test_rays_hit_only_the_groups_and_bodies_asked_for() -> None:
    engine = make_engine(LANDING_BOX)
    down = torch.tensor([0.0, 0.0, -1.0]).expand(2, 2, 3)
    start = torch.tensor([-0.05, 0.1, 2.0]).expand(2, 2, 3)
    distances, normals, geoms = engine.raycast(RayQuery(start, down, None, torch.tensor([-1, 1])))
    torch.testing.assert_close(distances, torch.tensor([[1.55, 2.0]] * 2))
    assert geoms.tolist() == [[1, 0]] * 2
    torch.testing.assert_close(normals, torch.tensor([0.0, 0.0, 1.0]).expand(2, 2, 3))
    distances, normals, geoms = engine.raycast(RayQuery(start, down, (3,)))
    assert (distances == -1).all()
    assert (geoms == -1).all()
    assert not normals.any()


def test_a_reset_wakes_what_sleeps() -> None:
    def make() -> WarpEngine:
        xml = LANDING_BOX.replace(
            "<worldbody>", '<option><flag sleep="enable"/></option><worldbody>', 1
        )
        return make_engine(xml)

    engine = make()
    assert engine.mj_model.opt.enableflags
    engine.step(1500)
    assert (engine.data_field("tree_asleep") >= 0).all()
    resumed = make()
    resumed.load_state_dict(engine.state_dict())
    height = engine.data_field("qpos")[:, 2].clone()
    engine.reset(torch.tensor([0]))
    engine.data_field("qpos")[0, 2] = 1.0
    for each in (engine, resumed):
        each.forward(None)
        each.step(50)
    assert torch.equal(resumed.data_field("qpos")[:, 2], height)
    assert engine.data_field("qpos")[0, 2] == pytest.approx(0.95, abs=1e-3)
    assert engine.data_field("qpos")[1, 2] == height[1]


# Public names for packages that hold Warp arrays.


def test_fields_of_warps_own_layout_are_views() -> None:
    engine = make_engine(CARTPOLE)
    data = engine.wp_data
    assert (engine.data_field("nworld"), engine.data_field("njmax")) == (2, data.njmax)
    assert engine.data_field("solver_niter").shape == (2,)
    assert engine.data_field("efc").force.shape == data.efc.force.shape
    engine.data_field("efc").force[0] = 7.0
    assert (data.efc.force.numpy()[0] == 7.0).all()


def test_a_torch_array_is_indexed_and_computed_with_as_a_tensor() -> None:
    engine = make_engine(CARTPOLE)
    array = TorchArray(engine.wp_data.qpos)
    array[:, 1] = 2.0
    assert engine.data_field("qpos")[:, 1].tolist() == [2.0, 2.0]
    assert array.shape == (2, 2)
    assert torch.equal(array + 1, engine.data_field("qpos") + 1)
    assert torch.equal(torch.cos(array), engine.data_field("qpos").cos())
    assert torch.equal(1.0 - array, 1.0 - engine.data_field("qpos"))
    assert (array > 1.0)[:, 1].all()
    assert array.wp_array is engine.wp_data.qpos


def test_a_bridge_wraps_arrays_and_warns_of_a_shared_row() -> None:
    engine = make_engine(CARTPOLE)
    model = WarpBridge(engine.wp_model, nworld=2)
    assert model.body_mass.shape == (2, 3)
    assert model.nv == 2
    with pytest.warns(UserWarning, match="expand_model_fields") as warned:
        model.body_mass[0] = 3.0
        model.body_mass[0] = 2.0
    assert len(warned) == 1
    assert model.body_mass.tolist() == [[2.0] * 3] * 2
    with pytest.raises(AttributeError, match="in place"):
        model.body_mass = torch.zeros(2, 3)
    expand_model_fields(model, 2, ["body_mass"])
    model.clear_cache()
    model.body_mass[0] = 1.0
    assert engine.wp_model.body_mass.numpy()[:, 0].tolist() == [1.0, 2.0]
    data = WarpBridge(engine.wp_data)
    assert data.qpos.shape == (2, 2)
    assert torch.equal(data.efc.force + 0, engine.data_field("efc").force)
    assert model.opt.iterations == engine.wp_model.opt.iterations
    with pytest.warns(UserWarning, match="changes all worlds"):
        model.opt.gravity[0] = torch.tensor([0.0, 0.0, -1.0])
    assert engine.wp_model.opt.gravity.numpy().tolist() == [[0.0, 0.0, -1.0]]
    with pytest.raises(AttributeError, match="in place"):
        model.opt.gravity = 1.0


@pytest.mark.slow
def test_importing_the_compatibility_names_loads_no_warp() -> None:
    code = (
        "import sys, mjlab.sim.sim_data, mjlab.sim.randomization, mjlab.sim\n"
        "from mjlab.sim import TorchArray, WarpBridge\n"
        "assert 'warp' not in sys.modules and 'mujoco_warp' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(("wish", "quiet"), [(None, True), ("1", True), ("0", False)])
def test_warp_is_quiet_unless_asked_otherwise(
    wish: str | None, quiet: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
    if wish is None:
        monkeypatch.delenv("MJLAB_WARP_QUIET", raising=False)
    else:
        monkeypatch.setenv("MJLAB_WARP_QUIET", wish)
    make_engine(TWO_JOINTS)
    assert (wp.config.log_level > wp.LOG_INFO) is quiet


# Order of work. On entry of `ordered`, Warp's stream waits for torch's queued work. Warp might read
# results of work that torch queues within the block too early.


# CUDA code paths, tested by an engine on the CPU that is patched to act as on CUDA.


@pytest.fixture
def as_on_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def ordered(self):
        with wp.ScopedDevice(self.wp_device):
            yield

    monkeypatch.setattr(WarpEngine, "_on_cuda", True)
    monkeypatch.setattr(WarpEngine, "ordered", ordered)


def test_graphs_are_captured_at_construction_without_a_trace(
    as_on_cuda: None, caplog: pytest.LogCaptureFixture
) -> None:
    # The box lies on the floor, with more contacts than the capacity.
    engine = make_engine(LANDING_BOX.replace('pos="0 0 .4"', 'pos="0 0 .04"'), nconmax=1)
    caplog.clear()
    assert engine._graphs.keys() == {"step", "pos", "vel", "acc"}
    assert not engine.data_field("time").any()
    assert engine.data_field("qpos").tolist() == [pytest.approx([0, 0, 0.04, 1, 0, 0, 0])] * 2
    torch.testing.assert_close(engine.data_field("xpos")[:, 1], engine.data_field("qpos")[:, :3])
    engine.data_field("qpos")[:, 2] = 1.0
    engine.step(2)
    engine.close()
    assert not caplog.records


@pytest.mark.parametrize("mode", ["startup", "reset"])
def test_graphs_are_captured_before_the_first_reset(
    as_on_cuda: None, monkeypatch: pytest.MonkeyPatch, mode: Any
) -> None:
    captures: list[int] = []
    capture = WarpEngine._capture
    monkeypatch.setattr(
        WarpEngine, "_capture", lambda self, work: (captures.append(1), capture(self, work))[1]
    )
    robot = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(LANDING_BOX))
    params = {"ranges": (0.5, 2.0), "asset_cfg": SceneEntityCfg("robot", body_names=(".*",))}
    cfg = ManagerBasedRlEnvCfg(
        decimation=2,
        scene=SceneCfg(num_envs=2, entities={"robot": robot}),
        observations={},
        actions={},
        events={"mass": EventTermCfg(func=mdp.dr.body_mass, mode=mode, params=params)},
        sim=SimulationCfg(engine="warp"),
    )
    env = ManagerBasedRlEnv(cfg, device="cpu")
    assert env.sim.expanded_fields
    captured = len(captures)
    env.reset()
    for _ in range(2):
        env.step(torch.zeros(2, 0))
    assert len(captures) == captured
    env.close()


def test_rays_replay_one_graph_for_all_sensors(as_on_cuda: None) -> None:
    engine = make_engine(LANDING_BOX)
    captured = engine._graphs.keys() - {"step", "pos", "vel", "acc"}
    down = torch.tensor([0.0, 0.0, -1.0]).expand(2, 3, 3)
    start = torch.tensor([-0.05, 0.1, 2.0]).expand(2, 3, 3)
    first = engine.raycast(RayQuery(start, down))
    engine.raycast(RayQuery(start, down, None, torch.tensor([-1, -1, 1])))
    captured = engine._graphs.keys() - {"step", "pos", "vel", "acc"}
    assert len(captured) == 1
    torch.testing.assert_close(first[0], torch.full((2, 3), 1.55))


# Captured graphs on a GPU. Skipped without a GPU.


@pytest.mark.cuda
@pytest.mark.parametrize("own_stream", [False, True])
def test_graphs_on_the_gpu_compute_what_the_cpu_does(own_stream: bool, cuda_device: str) -> None:
    model = mujoco.MjModel.from_xml_string(LANDING_BOX)
    engines = [WarpEngine(model, 3, SimulationCfg(), device) for device in ("cpu", cuda_device)]
    make_stream = torch.cuda.Stream if own_stream else torch.cuda.default_stream
    stream = make_stream(cuda_device)
    with torch.cuda.stream(stream):
        for engine in engines:
            on_the_floor(engine)
            engine.step(4)
            engine.expand(("body_mass", "geom_pos"))
            engine.model_fields["body_mass"][1].mul_(2.0)
            engine.recompute_constants(3, None)
            engine.reset(torch.tensor([0], device=engine.device))
            engine.step(3)
            engine.forward(None)
        for field in ("time", "qpos", "qvel", "xpos", "sensordata"):
            cpu, gpu = (engine.data_field(field).cpu() for engine in engines)
            torch.testing.assert_close(gpu, cpu, atol=1e-3, rtol=1e-3)


@pytest.mark.cuda
def test_a_step_on_the_gpu_does_not_wait_for_it(cuda_device: str) -> None:
    engine = WarpEngine(
        mujoco.MjModel.from_xml_string(LANDING_BOX), 3, SimulationCfg(), cuda_device
    )
    ids = torch.tensor([1], device=cuda_device)
    engine.step(2)
    engine.forward(None)
    engine.reset(ids)
    torch.cuda.set_sync_debug_mode("error")
    try:
        engine.step(2)
        engine.reset(ids)
        engine.forward(None)
    finally:
        torch.cuda.set_sync_debug_mode("default")
