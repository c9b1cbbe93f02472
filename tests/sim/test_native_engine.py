"""Native engine: writes, recorded substeps, stages, late reads, sleep, exact resume."""

from __future__ import annotations

import contextlib
import copy
import signal
import threading

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco.batch import DATA_FIELDS

from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from mjlab.sim.engine import ACCELERATION_FIELDS, INPUTS, VELOCITY_FIELDS

from .parity_models import MODELS

NUM_ENVS = 3
SCENE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="trunk" pos="0 0 .3">
      <freejoint/>
      <geom type="box" size=".2 .1 .05" mass="2"/>
      <site name="center"/>
      <body pos="0 0 -.05">
        <joint name="knee" axis="0 1 0" damping=".1"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .1 0 -.2" mass=".3"/>
      </body>
    </body>
    <body name="hand" mocap="true" pos="1 0 1"><geom size=".02" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator><motor joint="knee"/></actuator>
  <sensor>
    <accelerometer name="acc" site="center"/>
    <framepos name="pos" objtype="site" objname="center"/>
    <contact name="touch" subtree1="trunk" data="found force"/>
  </sensor>
</mujoco>
"""
WRITABLE = ("qpos", "qvel", "ctrl", "xfrc_applied", "mocap_pos", "qfrc_applied")


def build(num_threads: int = 1, scene: str = SCENE, **options) -> Simulation:
    cfg = SimulationCfg(mujoco=MujocoCfg(timestep=0.004, **options), num_threads=num_threads)
    spec = mujoco.MjSpec.from_string(scene)
    return Simulation(NUM_ENVS, cfg, spec=spec, device="cpu")


# Writes.

ONE_WRITE = st.tuples(
    st.sampled_from(WRITABLE),
    st.sampled_from(("element", "row", "column", "whole", "add", "numpy", "inference", "same")),
    st.integers(0, NUM_ENVS - 1),
    st.floats(-0.5, 0.5, width=32),
)


def write(field: torch.Tensor, kind: str, env: int, value: float) -> None:
    """Write `value` to some elements of a field, (N, ...), in one of several ways."""
    flat = field.view(NUM_ENVS, -1)
    if kind == "element":
        flat[env, -1] = value
    elif kind == "row":
        flat[env] = torch.full((flat.shape[1],), value)
    elif kind == "column":
        flat[:, -1:] = value
    elif kind == "whole":
        field.copy_(torch.full_like(field, value))
    elif kind == "add":
        field[env] += value
    elif kind == "numpy":
        field.numpy()[env] = value
    elif kind == "inference":
        with torch.inference_mode():
            field.select(0, env).fill_(value)
    elif kind == "same":
        # Not a change: the double in the row must be kept.
        field.copy_(field.clone())


@settings(max_examples=30, deadline=None)
@given(script=st.lists(st.lists(ONE_WRITE, max_size=4), min_size=1, max_size=4))
def test_only_written_elements_reach_the_rows(script) -> None:
    """The engine equals a loop over `MjData` that receives only the written elements."""
    sim = build()
    model = copy.copy(sim.mj_model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    hosts = [mujoco.MjData(model) for _ in range(NUM_ENVS)]
    fields = {name: getattr(sim.data, name) for name in WRITABLE}
    for writes in script:
        for name, kind, env, value in writes:
            before = fields[name].numpy().copy()
            write(fields[name], kind, env, value)
            after = fields[name].numpy()
            for host, old, new in zip(hosts, before, after, strict=True):
                changed = (old != new).reshape(getattr(host, name).shape)
                getattr(host, name)[changed] = new.reshape(changed.shape)[changed]
        sim.step(3)
        for host in hosts:
            for _ in range(3):
                mujoco.mj_step(model, host)
    for env, host in enumerate(hosts):
        found = sim.copy_to_host(env)
        assert np.array_equal(found.qpos, host.qpos)
        assert np.array_equal(found.qvel, host.qvel)


def test_a_model_field_that_is_not_written_keeps_its_double_precision() -> None:
    plain, expanded = build(), build()
    expanded.expand_model_fields(("body_mass", "geom_pos", "geom_friction", "qpos0"))
    expanded.model.geom_friction[1, 0, 0] = 0.5
    for sim in (plain, expanded):
        sim.step(60)
    assert torch.equal(plain.data.qpos[[0, 2]], expanded.data.qpos[[0, 2]])


# Recorded substeps.


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("guarded", [False, True])
def test_recorded_substeps_are_those_of_single_steps(engine: str, guarded: bool, tmp_path) -> None:
    fields = ("sensordata", "qpos", "xmat", "time")
    sims = []
    for _ in range(2):
        cfg = SimulationCfg(engine=engine, mujoco=MujocoCfg(timestep=0.004))
        cfg.nan_guard.enabled, cfg.nan_guard.output_dir = guarded, str(tmp_path)
        spec = mujoco.MjSpec.from_string(SCENE)
        sims.append(Simulation(NUM_ENVS, cfg, spec=spec, device="cpu"))
        sims[-1].data.qvel[:, 0] = torch.tensor([0.0, 0.5, 1.0])
        sims[-1].data.qpos[1, 2] = 0.25
    together, one_by_one = sims
    for _ in range(4):
        recorded = together.step(4, fields)
        singles = []
        for _ in range(4):
            one_by_one.step()
            singles.append({name: getattr(one_by_one.data, name).clone() for name in fields})
        for name in fields:
            expected = torch.stack([single[name] for single in singles])
            assert recorded[name].dtype == expected.dtype
            assert torch.equal(recorded[name], expected), name
        for name in (*fields, "qvel", "xpos"):
            assert torch.equal(getattr(together.data, name), getattr(one_by_one.data, name))


@pytest.mark.parametrize("per_call", [1, 3, 8])
@pytest.mark.parametrize("record", [(), ("qpos", "sensordata")])
def test_substeps_in_several_calls_are_those_of_one(monkeypatch, per_call, record) -> None:
    sims = build(), build()
    for sim, size in zip(sims, (100, per_call), strict=True):
        monkeypatch.setattr("mjlab.sim.native.engine._SUBSTEPS_PER_CALL", size)
        sim.data.qvel[:, 0] = torch.tensor([0.0, 0.5, 1.0])
        # The second environment warns.
        sim.data.ctrl[1] = float("nan")
        sim.step(2)
        recorded = sim.step(8, record)
        # First read after the step.
        values = [*recorded.values(), sim.data.qpos, sim.data.qvel, sim.data.xpos, sim.data.qH]
        sim.bits = [value.clone() for value in values]  # ty: ignore
    assert all(map(torch.equal, sims[0].bits, sims[1].bits))  # ty: ignore


def test_a_signal_acts_between_many_substeps() -> None:
    sim = build()
    timer = threading.Timer(0.2, signal.raise_signal, [signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        sim.step(10**12)
    timer.join()


def test_no_substeps_change_nothing() -> None:
    sim = build()
    sim.step(3)
    before = {name: getattr(sim.data, name).clone() for name in ("qpos", "sensordata", "xpos")}
    sim.forward(stage="pos")
    before = {name: getattr(sim.data, name).clone() for name in before}
    assert sim.step(0, ("qpos",))["qpos"].shape == (0, NUM_ENVS, sim.mj_model.nq)
    for name, values in before.items():
        assert torch.equal(getattr(sim.data, name), values)


# Stages.


def test_an_earlier_stage_leaves_quantities_of_the_acceleration_stage() -> None:
    sim = build(num_threads=2)
    acc = slice(0, 3)
    _ = sim.data.sensordata, sim.data.qacc
    sim.data.qvel[:, 0] = torch.tensor([0.0, 0.5, 1.0])
    sim.step(30)
    sensordata, qacc = sim.data.sensordata.clone(), sim.data.qacc.clone()
    sim.forward(stage="vel")
    assert torch.equal(sim.data.qacc, qacc)
    assert torch.equal(sim.data.sensordata[:, acc], sensordata[:, acc])
    assert torch.equal(sim.data.sensordata[:, 3:6], sim.data.site_xpos[:, 0])
    sim.forward(torch.tensor([1]))
    assert not torch.equal(sim.data.qacc[1], qacc[1])
    assert torch.equal(sim.data.qacc[[0, 2]], qacc[[0, 2]])


@pytest.mark.parametrize("stage", ["pos", "vel"])
@pytest.mark.parametrize("name", ["landing_box", "tendons", "hinge_chain"])
def test_a_stage_computes_its_fields_and_leaves_those_of_later_ones(name: str, stage: str) -> None:
    """Environments share one `MjData`: values must not leak between them."""
    sim = build(scene=MODELS[name])
    generator = torch.Generator().manual_seed(0)
    for field in (sim.data.qpos, sim.data.qvel):
        field += 0.1 * torch.randn(field.shape, generator=generator)
    bound = {}
    for field in sorted(DATA_FIELDS - {*INPUTS, "history", "plugin_state"}):
        with contextlib.suppress(AttributeError):
            bound[field] = getattr(sim.data, field)
    sim.step(5)
    old = {field: values.clone() for field, values in bound.items()}
    sim.forward(stage=stage)
    staged = {field: values.clone() for field, values in bound.items()}
    sim.forward()
    later = ACCELERATION_FIELDS | (VELOCITY_FIELDS if stage == "pos" else frozenset())
    for field, values in bound.items():
        if field != "sensordata":
            expected = old[field] if field in later else values
            assert torch.equal(staged[field], expected), field


# Late reads.

READ_LATE = ("xpos", "cvel", "qfrc_bias", "qacc", "qfrc_constraint", "actuator_force", "sensordata")


@pytest.mark.parametrize("name", READ_LATE)
@pytest.mark.parametrize("moment", ["step", "vel", "acc of some"])
def test_a_field_first_read_late_is_what_one_read_from_the_start_is(name: str, moment: str) -> None:
    early, late = build(num_threads=2), build(num_threads=1)
    _ = getattr(early.data, name), late.data.xquat
    for sim in (early, late):
        sim.data.qvel[:, 0] = torch.tensor([0.0, 0.5, 1.0])
        for _ in range(12):
            sim.step(3)
            sim.forward(stage="vel")
        sim.step(3)
        if moment != "step":
            sim.data.qpos[1, 2] += 0.1
            sim.forward(stage="vel")
        if moment == "acc of some":
            sim.forward(torch.tensor([1]))
    rows = early._engine._rows.clone()
    assert torch.equal(getattr(late.data, name), getattr(early.data, name))
    assert torch.equal(late._engine._rows, rows)
    for sim in (early, late):
        sim.step(3)
    assert torch.equal(late.data.qpos, early.data.qpos)


@pytest.mark.parametrize("write", ["numpy", "data"])
def test_model_fields_written_behind_torch_act_in_the_next_step(write: str) -> None:
    sim = build()
    sim.expand_model_fields(("gravity",))
    values = sim.model.gravity.numpy() if write == "numpy" else sim.model.gravity.data
    values[:] = 0.0
    sim.step(5)
    assert not sim.data.qvel.any()


# Sleep.


BOX = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="box" pos="0 0 .12"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""


def test_a_model_with_sleep_steps_as_plain_mujoco_does() -> None:
    sim = build(scene=BOX, enableflags=("sleep",))
    _ = sim.data.qpos, sim.data.qvel, sim.data.xpos
    host = mujoco.MjData(sim.mj_model)
    for _ in range(20):
        sim.step(50)
        mujoco.mj_step(sim.mj_model, host, 50)
    assert not host.tree_awake.any(), "the box must fall asleep"
    assert np.array_equal(sim.copy_to_host(1).qpos, host.qpos)
    # The push wakes up one of them.
    asleep = sim.data.qpos.clone()
    sim.data.qvel[1, 2] = host.qvel[2] = 1.0
    sim.step(20)
    mujoco.mj_step(sim.mj_model, host, 20)
    assert np.array_equal(sim.copy_to_host(1).qpos, host.qpos)
    assert torch.equal(sim.data.qpos[[0, 2]], asleep[[0, 2]])
    # State rows do not include sleep states.
    with pytest.raises(ValueError, match="sleep"):
        sim.load_state_dict(sim.state_dict())


# Exact resume.


def test_a_run_with_its_own_constants_continues_bit_for_bit() -> None:
    fields = ("body_mass", "body_ipos", "geom_pos", "geom_margin")

    def randomized() -> Simulation:
        sim = build()
        sim.expand_model_fields(fields)
        _ = sim.data.sensordata, sim.data.qacc, sim.data.xpos
        return sim

    sim = randomized()
    sim.model.body_mass[1] *= 1.3
    sim.model.body_ipos[2, 1, 2] += 0.05
    sim.recompute_constants(3)
    sim.model.geom_pos[0, 2, 2] -= 0.2
    sim.model.geom_margin[1] += 0.02
    sim.step(40)
    sim.forward(stage="vel")
    saved = sim.state_dict()
    other = build()
    other.load_state_dict(saved)
    for name in (*fields, "body_invweight0", "dof_invweight0", "body_subtreemass"):
        assert torch.equal(getattr(sim.model, name), getattr(other.model, name)), name
    for _ in range(3):
        for name in ("qpos", "qvel", "qacc", "sensordata", "xpos"):
            assert torch.equal(getattr(sim.data, name), getattr(other.data, name)), name
        for one in (sim, other):
            one.step(20)
            one.forward(stage="vel")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"library": None}, r"before mujoco.batch.* weights"),
        ({"engine": "warp"}, r"'native'.*'warp'.*--engine warp"),
        ({"state": torch.zeros(2, 5)}, r"expected .*\(3, \d+\).*got \(2, 5\)"),
    ],
)
def test_a_state_of_another_engine_or_size_is_refused_and_changes_nothing(change, message) -> None:
    sim = build()
    sim.step(5)
    before = sim.data.qpos.clone()
    with pytest.raises(ValueError, match=message):
        sim.load_state_dict({**build().state_dict(), **change})
    assert torch.equal(sim.data.qpos, before)
