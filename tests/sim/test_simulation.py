"""`Simulation` on the native engine: state, derived fields, model fields, resume."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab import compat
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from mjlab.sim.engine import EngineUnavailableError

SLIDER_AND_BALL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.01"/>
    <body name="cart" pos="0 0 2">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom name="cart" type="box" size="0.1 0.1 0.1" mass="2"/>
      <site name="tip" pos="0 0 0.3"/>
    </body>
    <body name="ball" pos="0 0 0.5">
      <freejoint name="free"/>
      <geom name="ball" type="sphere" size="0.1" mass="1"/>
    </body>
    <body name="target" mocap="true" pos="1 2 3"/>
  </worldbody>
  <actuator><motor joint="slide" gear="3"/></actuator>
</mujoco>
"""


def make_sim(num_envs: int = 4, **cfg: object) -> Simulation:
    return Simulation(
        num_envs,
        SimulationCfg(engine="native", **cfg),
        spec=mujoco.MjSpec.from_string(SLIDER_AND_BALL),
        device="cpu",
    )


def plain_mujoco(sim: Simulation, ctrl: float, steps: int) -> mujoco.MjData:
    data = mujoco.MjData(sim.mj_model)
    data.ctrl[:] = ctrl
    for _ in range(steps):
        mujoco.mj_step(sim.mj_model, data)
    return data


def test_steps_like_plain_mujoco():
    sim = make_sim()
    sim.data.ctrl[:] = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
    positions = sim.data.xpos
    sim.step(3)
    sim.step()
    for env in range(4):
        expected = plain_mujoco(sim, ctrl=float(env), steps=4)
        np.testing.assert_allclose(sim.data.qpos[env], expected.qpos, atol=1e-6)
        np.testing.assert_allclose(positions[env], expected.xpos, atol=1e-6)


def test_derived_fields_lag_one_substep_until_forward():
    sim = make_sim()
    positions = sim.data.xpos
    sim.data.qvel[:, 0] = 1.0
    sim.step()
    ball = sim.mj_model.body("cart").id
    assert torch.equal(positions[:, ball, 0], torch.zeros(4))
    sim.forward()
    assert torch.allclose(positions[:, ball, 0], sim.data.qpos[:, 0])


def test_a_derived_field_is_current_when_first_read():
    sim = make_sim()
    sim.step(5)
    tip = sim.mj_model.site("tip").id
    assert torch.allclose(sim.data.site_xpos[:, tip, 2], torch.tensor(2.3))


@pytest.mark.parametrize("substeps", [(4,), (1,), (1, 1, 1)])
def test_first_reads_lag_as_later_ones(substeps):
    early, late = make_sim(), make_sim()
    bound = {name: getattr(early.data, name) for name in ("xpos", "cvel", "qfrc_actuator")}
    for sim in (early, late):
        sim.data.ctrl[:] = torch.arange(4.0).view(4, 1)
        sim.data.qvel[:, 1:] = 0.3
        sim.forward()
        for nstep in substeps:
            sim.data.ctrl[:] += 0.1
            sim.step(nstep)
        # Writes to known and to new inputs are pending while fields are read.
        sim.reset(torch.tensor([2]))
        sim.data.xfrc_applied[1, 1, 0] = 5.0
    for name, values in bound.items():
        assert torch.equal(getattr(late.data, name), values), name
    for sim in (early, late):
        sim.forward()
        sim.step(7)
        assert sim.data.qvel[1, 0] != 0.0
    for name in ("qpos", "qvel", "xpos", "cvel", "time"):
        assert torch.equal(getattr(late.data, name), getattr(early.data, name)), name


def test_reading_a_field_late_changes_nothing_else():
    plain, late = make_sim(), make_sim()
    for sim in (plain, late):
        sim.data.qvel[:, 1] = 0.5
        positions = sim.data.xpos
        sim.step(90)
        before = positions.clone()
        if sim is late:
            assert sim.data.cvel.abs().sum() > 0
            assert torch.equal(positions, before)
        sim.step(30)
    assert torch.equal(plain.data.qpos, late.data.qpos)
    assert torch.equal(plain.data.qvel, late.data.qvel)


@pytest.mark.parametrize(
    ("field", "cure"),
    [
        ("subtree_linvel", "subtreelinvel"),
        ("cfrc_ext", "accelerometer"),
        ("cacc", "accelerometer"),
        ("energy", "enableflags"),
        ("qfrc_inverse", "qfrc_actuator + qfrc_applied"),
    ],
)
def test_a_field_that_steps_do_not_compute(field, cure, caplog):
    """Reads zero, as in MuJoCo."""
    sim = make_sim()
    sim.step(3)
    values = getattr(sim.data, field)
    sim.step(3)
    _ = getattr(sim.data, field)
    assert not values.any()
    assert caplog.text.count(f"sim.data.{field}") == 1
    assert cure in caplog.text


def test_rotation_matrices_are_three_by_three():
    sim = make_sim()
    assert sim.data.xmat.shape == (4, sim.mj_model.nbody, 3, 3)
    assert sim.data.site_xmat.shape == (4, 1, 3, 3)


def test_fields_stay_the_same_tensor():
    sim = make_sim()
    qpos, xpos = sim.data.qpos, sim.data.xpos
    sim.step()
    sim.reset()
    sim.forward()
    assert sim.data.qpos is qpos
    assert sim.data.xpos is xpos


@pytest.mark.parametrize(
    "ids", [3, -1, [3], torch.tensor(3), torch.tensor([-1, 3]), slice(3, 4), torch.arange(4) == 3]
)
def test_environment_ids_in_any_form(ids):
    sim = make_sim()
    sim.data.qpos[:, 0] = 0.5
    sim.reset(ids)
    assert sim.data.qpos[:, 0].tolist() == [0.5, 0.5, 0.5, 0.0]
    with pytest.raises(ValueError, match=r"\[0, 4\)"):
        sim.reset([4])


def test_forward_of_some_environments_leaves_the_others():
    sim = make_sim()
    positions = sim.data.xpos
    sim.data.qpos[:, 0] = 0.5
    sim.forward(torch.tensor([2, 0]))
    cart = sim.mj_model.body("cart").id
    assert torch.equal(positions[:, cart, 0], torch.tensor([0.5, 0.0, 0.5, 0.0]))


@pytest.mark.parametrize(
    "ids",
    [
        torch.tensor([3, 1]),
        torch.tensor([False, True, False, True]),
        slice(1, None, 2),
        torch.tensor([1, 3], dtype=torch.int32),
    ],
    ids=["ids", "mask", "slice", "int32"],
)
def test_reset_restores_only_the_chosen_environments(ids):
    sim = make_sim()
    start = sim.data.qpos.clone()
    sim.data.ctrl[:] = 1.0
    sim.data.xfrc_applied[:, 1, 0] = 5.0
    sim.data.mocap_pos[:] = 9.0
    sim.step(10)
    moved = sim.data.qpos.clone()
    sim.reset(ids)
    for env in range(4):
        was_reset = env in (1, 3)
        assert torch.equal(sim.data.qpos[env], start[env] if was_reset else moved[env])
        assert (sim.data.time[env] == 0) == was_reset
        assert bool((sim.data.ctrl[env] == 0).all()) == was_reset
        assert bool((sim.data.xfrc_applied[env] == 0).all()) == was_reset
        expected = torch.tensor([1.0, 2.0, 3.0]) if was_reset else torch.full((3,), 9.0)
        assert torch.equal(sim.data.mocap_pos[env, 0], expected)


def test_reset_forgets_controls_that_were_not_stepped():
    sim = make_sim()
    sim.data.ctrl[:] = 1.0
    sim.reset()
    sim.step(5)
    assert torch.equal(sim.data.qpos[:, 0], torch.zeros(4))


def test_reset_clears_accelerations_of_a_diverged_environment():
    sim = make_sim()
    acceleration = sim.data.qacc
    sim.data.qvel[1, 0] = float("nan")
    sim.step()
    sim.reset(torch.tensor([1]))
    assert torch.isfinite(acceleration).all()


def test_reset_leaves_derived_fields_until_forward():
    sim = make_sim()
    positions = sim.data.xpos
    sim.step(20)
    before = positions.clone()
    sim.reset()
    assert torch.equal(positions, before)
    sim.forward()
    assert not torch.equal(positions, before)


def test_a_shared_model_field_reads_as_a_plain_tensor():
    sim = make_sim()
    doubled = sim.model.body_mass * 2
    assert type(doubled) is torch.Tensor
    assert doubled.shape == (4, sim.mj_model.nbody)
    assert doubled[3, sim.mj_model.body("cart").id] == 4.0


def test_an_expanded_field_changes_one_environment():
    sim = make_sim()
    sim.expand_model_fields(("body_mass",))
    cart = sim.mj_model.body("cart").id
    sim.model.body_mass[1, cart] = 4.0
    sim.recompute_constants(3)
    sim.data.ctrl[:] = 1.0
    sim.step(10)
    assert torch.allclose(sim.data.qpos[0, 0], 2 * sim.data.qpos[1, 0], rtol=1e-4)
    assert torch.equal(sim.data.qpos[0], sim.data.qpos[2])
    assert sim.get_default_field("body_mass")[cart] == 2.0


def test_recomputing_constants_keeps_the_state():
    sim = make_sim()
    sim.step(7)
    qpos, qvel = sim.data.qpos.clone(), sim.data.qvel.clone()
    sim.expand_model_fields(("body_mass",))
    sim.model.body_mass *= 1.5
    sim.recompute_constants(3)
    assert torch.equal(sim.data.qpos, qpos)
    assert torch.equal(sim.data.qvel, qvel)
    assert sim.model.body_subtreemass[0, 0] == pytest.approx(4.5)


def test_a_moved_centre_of_mass_acts_as_if_compiled_so():
    # The compiler simplifies free bodies with coinciding frames; expansion must undo this.
    sim = make_sim(mujoco=MujocoCfg(disableflags=("contact",)))
    sim.expand_model_fields(("body_ipos",))
    offset = [0.03, -0.02, 0.05]
    ball = sim.mj_model.body("ball").id
    sim.model.body_ipos[:, ball] = torch.tensor(offset)
    sim.recompute_constants(3)
    sim.data.qvel[:, 4:7] = torch.tensor([1.0, 2.0, 3.0])
    sim.step(100)

    spec = mujoco.MjSpec.from_string(SLIDER_AND_BALL)
    body = spec.body("ball")
    body.explicitinertial, body.mass, body.ipos = True, 1.0, offset
    body.inertia = sim.mj_model.body_inertia[ball]
    body.iquat = sim.mj_model.body_iquat[ball]
    model = spec.compile()
    MujocoCfg(disableflags=("contact",)).apply(model)
    data = mujoco.MjData(model)
    data.qvel[4:7] = [1.0, 2.0, 3.0]
    for _ in range(100):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(sim.data.qpos[2], data.qpos, atol=1e-5)


@pytest.mark.parametrize("field", ["geom_pos", "site_pos", "body_ipos"])
def test_frames_can_be_moved_after_constants_were_recomputed(field):
    """mj_setConst marks coinciding frames, and MuJoCo then skips their transforms."""
    xml = """<mujoco><worldbody><body name="b"><joint axis="0 1 0"/><geom size=".1"/>
      <site name="s"/></body></worldbody></mujoco>"""
    sim = Simulation(2, SimulationCfg(), spec=mujoco.MjSpec.from_string(xml), device="cpu")
    place = {"geom_pos": "geom_xpos", "site_pos": "site_xpos", "body_ipos": "xipos"}[field]
    sim.expand_model_fields((field, "body_mass"))
    sim.recompute_constants(3)
    getattr(sim.model, field)[1, -1] = torch.tensor([0.1, 0.2, 0.3])
    sim.forward()
    assert getattr(sim.data, place)[:, -1].tolist() == [[0.0] * 3, pytest.approx([0.1, 0.2, 0.3])]


def test_a_resumed_simulation_continues_bit_for_bit():
    straight = make_sim()
    straight.expand_model_fields(("geom_friction",))
    straight.model.geom_friction[:, :, 0] = torch.linspace(0.2, 1.0, 4)[:, None]
    straight.data.qvel[:, 1] = 1.0
    straight.step(120)
    straight.forward()
    saved = straight.state_dict()
    resumed = make_sim()
    resumed.data.qpos[:] = 7.0
    resumed.load_state_dict(saved)
    assert torch.equal(resumed.data.qpos, straight.data.qpos)
    assert torch.equal(resumed.data.xpos, straight.data.xpos)
    for sim in (straight, resumed):
        sim.data.ctrl[:] = 0.3
        sim.step(50)
    assert torch.equal(resumed.data.qpos, straight.data.qpos)
    assert torch.equal(resumed.data.qvel, straight.data.qvel)


def test_results_do_not_depend_on_the_number_of_threads():
    results = []
    for threads in (1, 2):
        sim = make_sim(num_envs=64, num_threads=threads)
        sim.data.qvel[:, 1:4] = torch.linspace(-1, 1, 64)[:, None]
        sim.step(200)
        results.append(sim.data.qpos.clone())
    assert torch.equal(*results)


def test_threads_of_the_physics_are_the_cores_of_this_process(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(6)), raising=False)
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert make_sim(num_envs=8).capabilities.num_threads == 3
    assert make_sim(num_envs=2).capabilities.num_threads == 2
    assert make_sim(num_envs=8, num_threads=1).capabilities.num_threads == 1


def test_nan_stays_in_its_environment_and_is_not_repaired_silently():
    sim = make_sim()
    sim.data.qvel[1, 0] = float("nan")
    sim.step(3)
    assert torch.isnan(sim.data.qvel[1]).any()
    assert torch.isfinite(sim.data.qvel[[0, 2, 3]]).all()
    sim.reset(torch.tensor([1]))
    sim.forward()
    sim.step(3)
    assert torch.isfinite(sim.data.qvel).all()


def test_rays_hit_what_is_there():
    sim = make_sim()
    origins = torch.tensor([[[0.0, 0.0, 5.0], [5.0, 5.0, 5.0]]]).repeat(4, 1, 1)
    down = torch.tensor([0.0, 0.0, -1.0]).expand(4, 2, 3).contiguous()
    distances, normals, geoms = sim.raycast(origins, down)
    assert torch.allclose(distances, torch.tensor([2.9, 5.0]).expand(4, 2))
    assert torch.allclose(normals, torch.tensor([0.0, 0.0, 1.0]))
    assert geoms[0].tolist() == [sim.mj_model.geom("cart").id, sim.mj_model.geom("floor").id]


def test_jacobian_agrees_with_mujoco():
    sim = make_sim()
    ball = sim.mj_model.body("ball").id
    points = torch.tensor([[0.1, 0.2, 0.6]]).repeat(4, 1)
    translational, rotational = sim.jacobian(points, torch.full((4,), ball))
    jacp, jacr = np.zeros((3, sim.mj_model.nv)), np.zeros((3, sim.mj_model.nv))
    mujoco.mj_jac(sim.mj_model, sim.mj_data, jacp, jacr, points[0].numpy().astype(float), ball)
    np.testing.assert_allclose(translational[3], jacp, atol=1e-6)
    np.testing.assert_allclose(rotational[3], jacr, atol=1e-6)
    doubles = sim.jacobian(points.double(), torch.full((4,), ball))
    torch.testing.assert_close(doubles, (translational, rotational))


def test_the_host_copy_includes_writes_not_yet_stepped():
    sim = make_sim()
    sim.step(2)
    sim.data.qpos[2, 0] = 0.25
    data = sim.copy_to_host(2, mujoco.MjData(sim.mj_model))
    np.testing.assert_allclose(data.qpos, sim.data.qpos[2])
    assert data.time == pytest.approx(2 * sim.cfg.mujoco.timestep)


def test_unknown_fields_name_close_ones():
    sim = make_sim()
    with pytest.raises(AttributeError, match=r"qpso .*did you mean 'qpos'"):
        _ = sim.data.qpso
    for name in ("contact", "nacon"):
        with pytest.raises(AttributeError, match=f"native .*{name}; use a contact sensor"):
            getattr(sim.data, name)
    with pytest.raises(ValueError, match="MjModel field 'body_masses'"):
        sim.expand_model_fields(("body_masses",))
    with pytest.raises(AttributeError, match="write into it in place"):
        sim.data.qpos = torch.zeros(4, 8)


@pytest.mark.parametrize(
    "field",
    ["geom_type", "geom_contype", "geom_conaffinity", "body_contype", "dof_bodyid", "sensor_adr",
     "body_geomnum", "actuator_trnid", "eq_active0", "geom_sameframe"],
)  # fmt: skip
def test_structure_stays_shared(field):
    sim = make_sim()
    with pytest.warns(UserWarning, match=f"'{field}'.* cannot differ between"):
        sim.expand_model_fields((field, "body_mass"))
    assert sim.expanded_fields == {"body_mass"}


def test_bounding_volumes_are_not_expanded_by_name():
    with pytest.raises(ValueError, match="'body_margin'"):
        make_sim().expand_model_fields(("body_margin",))


def test_a_spec_takes_precedence_over_a_model():
    spec = mujoco.MjSpec.from_string(SLIDER_AND_BALL)
    model = spec.compile()
    spec.geom("ball").mass = 7.0
    with pytest.warns(UserWarning, match="got both; `spec` is used"):
        sim = Simulation(2, SimulationCfg(), model=model, spec=spec, device="cpu")
    assert sim.model.body_mass[1, sim.mj_model.body("ball").id] == 7.0


@pytest.mark.parametrize("field", ["geom_matid", "geom_condim", "jnt_limited"])
def test_whole_numbers_that_nothing_was_compiled_from_may_differ(field):
    sim = make_sim()
    sim.expand_model_fields((field,))
    assert getattr(sim.model, field).shape[0] == sim.num_envs


def test_bad_requests_are_refused_when_the_simulation_is_built():
    spec = mujoco.MjSpec.from_string(SLIDER_AND_BALL)
    with pytest.raises(ValueError, match="num_envs.*got 0"):
        Simulation(0, SimulationCfg(), spec=spec, device="cpu")
    with pytest.raises(ValueError, match="got neither"):
        Simulation(1, SimulationCfg(), device="cpu")
    with pytest.raises(ValueError, match=r"engine.*native.*warp.*'bullet'"):
        Simulation(1, SimulationCfg(engine="bullet"), spec=spec, device="cpu")  # ty: ignore
    with pytest.raises(EngineUnavailableError, match="--engine warp"):
        Simulation(1, SimulationCfg(engine="native"), spec=spec, device="cuda:0")
    with pytest.raises(ValueError, match="num_threads.*got -1"):
        Simulation(1, SimulationCfg(num_threads=-1), spec=spec, device="cpu")


def test_a_scene_that_does_not_compile_passes_on_why():
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="massless").add_freejoint()
    with pytest.raises(ValueError, match=r"does not compile: .*mass"):
        Simulation(1, SimulationCfg(), spec=spec, device="cpu")


def test_options_are_written_and_unknown_ones_listed():
    model = mujoco.MjSpec.from_string(SLIDER_AND_BALL).compile()
    cfg = MujocoCfg(timestep=0.01, gravity=(0, 0, -1), cone="elliptic", disableflags=("contact",))
    cfg.apply(model)
    assert model.opt.timestep == 0.01
    assert model.opt.gravity[2] == -1
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    with pytest.raises(ValueError, match=r"disableflags.*'contact'.*'contacts'"):
        MujocoCfg(disableflags=("contacts",)).apply(model)
    with pytest.raises(ValueError, match=r"solver.*'newton'.*'magic'"):
        MujocoCfg(solver="magic").apply(model)  # ty: ignore
    for wrong in (mujoco.mjtCone.mjCONE_ELLIPTIC, 1, None, ("pyramidal", "elliptic")):
        with pytest.raises(ValueError, match=r"MujocoCfg.cone.*'pyramidal', 'elliptic'"):
            MujocoCfg(cone=wrong).apply(model)  # ty: ignore


def test_an_older_flag_is_accepted_with_a_warning():
    compat._warn_once.cache_clear()
    with pytest.warns(FutureWarning, match="multiccd"):
        on = MujocoCfg(multiccd=True)  # ty: ignore
    # MuJoCo enables it by default, so only False has an effect.
    assert (on.enableflags, on.disableflags) == ((), ())
    off = MujocoCfg(multiccd=False, disableflags=("contact",))  # ty: ignore
    assert off.disableflags == ("contact", "multiccd")
    off.apply(mujoco.MjModel.from_xml_string("<mujoco/>"))


def test_a_feature_that_is_always_on_today_may_still_be_enabled():
    model = mujoco.MjSpec.from_string(SLIDER_AND_BALL).compile()
    MujocoCfg(enableflags=("multiccd",)).apply(model)
    assert not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_MULTICCD


def test_the_warm_start_of_a_diverged_environment_does_not_come_back():
    sim = make_sim()
    sim.data.qvel[1] = float("nan")
    sim.step()
    sim.reset(torch.tensor([1]))
    # Reading a field for the first time computes it, and must not bring the old values back.
    assert torch.isfinite(sim.data.xpos).all()
    sim.step(50)
    assert torch.isfinite(sim.data.qpos).all()


def test_saving_right_after_a_reset_does_not_change_the_run():
    runs = []
    for saves in (False, True):
        sim = make_sim()
        sim.step(120)
        sim.reset(torch.tensor([1]))
        sim.data.qpos[1, 3] = 0.09
        if saves:
            sim.state_dict()
        sim.step(30)
        runs.append(sim.data.qpos.clone())
    assert torch.equal(*runs)
