"""Engine parity: both engines compute equal values for every field that a task may read.

One tolerance for all fields. Errors are relative to the largest value of the field, because Warp
computes in float32, and small components next to large ones have the rounding error of the large.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
import torch

from mjlab.sim.config import MujocoCfg, SimulationCfg
from mjlab.sim.engine import ACCELERATION_FIELDS
from mjlab.sim.simulation import Simulation

from .parity_models import MODELS

PARITY_TOLERANCE = 5e-4

NUM_ENVS = 3
ACC = int(mujoco.mjtStage.mjSTAGE_ACC)
STATE_FIELDS = (
    "time",
    "qpos",
    "qvel",
    "act",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "eq_active",
    "mocap_pos",
    "mocap_quat",
    "qacc_warmstart",
)
DERIVED_FIELDS = (
    *("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "cvel", "subtree_com"),
    *("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat"),
    *("light_xpos", "light_xdir", "cdof", "cinert", "subtree_linvel", "subtree_angmom"),
    *("qacc", "qacc_smooth", "act_dot", "qfrc_bias", "qfrc_passive", "qfrc_spring"),
    *("qfrc_damper", "qfrc_gravcomp", "qfrc_actuator", "qfrc_smooth", "qfrc_constraint"),
    *("actuator_force", "actuator_length", "actuator_velocity", "ten_length", "ten_velocity"),
    *("cacc", "cfrc_int", "cfrc_ext", "sensordata"),
)
# MuJoCo computes these for sensors only, and only the landing box has such sensors.
SENSOR_FED = ("cacc", "cfrc_int", "cfrc_ext", "subtree_linvel", "subtree_angmom")
# Differences of nearly canceling forces carry rounding errors of the forces.
DIFFERENCE_OF = {"cfrc_int": "cfrc_ext"}
CONSTANTS = (
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_length0"),
    *("tendon_invweight0", "actuator_acc0", "eq_data", "cam_pos0", "cam_poscom0", "cam_mat0"),
    *("light_pos0", "light_poscom0", "light_dir0"),
)


@dataclass
class Pair:
    native: Simulation
    warp: Simulation
    name: str
    unread: tuple[str, ...]

    @property
    def derived(self) -> tuple[str, ...]:
        return tuple(field for field in DERIVED_FIELDS if field not in self.unread)

    def both(self) -> tuple[Simulation, Simulation]:
        return self.native, self.warp


def build(name: str, device: str) -> Pair:
    disable = ("contact",) if name == "cartpole" else ()
    mujoco_cfg = MujocoCfg(timestep=0.004, disableflags=disable)
    sims = [
        Simulation(
            NUM_ENVS,
            SimulationCfg(engine=engine, mujoco=mujoco_cfg, num_threads=1),
            spec=mujoco.MjSpec.from_string(MODELS[name]),
            device=device,
        )
        for engine, device in (("native", "cpu"), ("warp", device))
    ]
    pair = Pair(*sims, name, () if name == "landing_box" else SENSOR_FED)
    for sim in pair.both():
        for field in (*STATE_FIELDS, *DERIVED_FIELDS):
            if field not in pair.unread:
                getattr(sim.data, field)
    return pair


# Each model with Warp on the CPU and, if available, on a GPU.
CASES = [
    *(pytest.param((name, False), id=name) for name in MODELS),
    *(pytest.param((name, True), id=f"{name}-cuda", marks=pytest.mark.cuda) for name in MODELS),
]


@pytest.fixture(scope="module", params=CASES)
def pair(request: pytest.FixtureRequest, cuda_device: str) -> Pair:
    name, on_cuda = request.param
    return build(name, cuda_device if on_cuda else "cpu")


@pytest.fixture(scope="module", params=CASES)
def changed(request: pytest.FixtureRequest, cuda_device: str) -> Pair:
    """Pair with per-environment model parameters and recomputed constants."""
    name, on_cuda = request.param
    return randomize_models(build(name, cuda_device if on_cuda else "cpu"))


def set_same_state(pair: Pair, seed: int = 0) -> None:
    """Set both engines to the same state, different in every environment."""
    generator = torch.Generator().manual_seed(seed)
    native, warp = pair.both()
    for sim in pair.both():
        sim.reset()
    noise = {
        field: torch.randn(getattr(native.data, field).shape, generator=generator)
        for field in ("qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos")
    }
    scale = {"qpos": 0.15, "qfrc_applied": 0.1, "xfrc_applied": 0.3, "mocap_pos": 0.05}
    for field, values in noise.items():
        getattr(native.data, field).add_(scale.get(field, 0.5) * values)
    normalize_quaternions(native)
    if pair.name == "landing_box":
        # One environment in flight, one touching with an edge, one deep in contact and sliding.
        native.data.qpos[:, 2] = torch.tensor([0.5, 0.1, 0.045])
        native.data.qpos[2, 3:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    if native.data.eq_active.shape[1]:
        native.data.eq_active[1, 0] = False
    copy_state(native, warp)


def normalize_quaternions(sim: Simulation) -> None:
    for joint in range(sim.mj_model.njnt):
        if sim.mj_model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            start = sim.mj_model.jnt_qposadr[joint] + 3
            quat = sim.data.qpos[:, start : start + 4]
            quat.copy_(torch.nn.functional.normalize(quat, dim=-1))


def copy_state(source: Simulation, target: Simulation) -> None:
    for field in STATE_FIELDS:
        getattr(target.data, field).copy_(getattr(source.data, field))


def poison(sim: Simulation, pair: Pair) -> None:
    """Fill outputs with NaN, so that unwritten outputs cannot pass by chance.

    Except outputs that Warp writes only once: the world frame and geoms welded to the world.
    """
    moving_geoms = torch.as_tensor(sim.mj_model.body_weldid[sim.mj_model.geom_bodyid] != 0)
    moving_geoms |= torch.as_tensor(sim.mj_model.body_mocapid[sim.mj_model.geom_bodyid] >= 0)
    for field in pair.derived:
        values = getattr(sim.data, field)
        if field.startswith("geom_"):
            values[:, moving_geoms] = torch.nan
        elif values.dim() > 1 and values.shape[1] == sim.mj_model.nbody:
            values[:, 1:] = torch.nan
        else:
            values.fill_(torch.nan)


def assert_same(
    pair: Pair, fields: tuple[str, ...], struct: str = "data", rows: list[int] | None = None
) -> None:
    wrong = []
    for field in fields:
        native, warp = (
            getattr(getattr(sim, struct), field)[rows or slice(None)].cpu() for sim in pair.both()
        )
        assert native.shape == warp.shape, f"{field}: {native.shape} and {warp.shape}"
        assert native.dtype == warp.dtype, f"{field}: {native.dtype} and {warp.dtype}"
        if not native.numel():
            continue
        large = getattr(getattr(pair.native, struct), DIFFERENCE_OF.get(field, field))
        scale = 1.0 + torch.maximum(native.float().abs().max(), large.float().abs().max())
        error = ((native.float() - warp.float()).abs() / scale).max().item()
        if not error <= PARITY_TOLERANCE:
            wrong.append(f"{field}: relative error {error:.2e}")
    assert not wrong, f"{pair.name}: engines differ by more than {PARITY_TOLERANCE}: {wrong}"


@pytest.mark.parametrize("seed", [0, 1])
def test_forward_gives_the_same_derived_fields(pair: Pair, seed: int) -> None:
    set_same_state(pair, seed)
    for sim in pair.both():
        poison(sim, pair)
        sim.forward()
    assert_same(pair, (*STATE_FIELDS[:-1], *pair.derived))


@pytest.mark.parametrize("nstep", [1, 4])
def test_step_gives_the_same_state_and_derived_fields(pair: Pair, nstep: int) -> None:
    set_same_state(pair)
    for sim in pair.both():
        poison(sim, pair)
        sim.step(nstep)
    assert_same(pair, (*STATE_FIELDS, *pair.derived))


def test_derived_fields_are_one_substep_old_after_a_step_on_both_engines(pair: Pair) -> None:
    set_same_state(pair)
    for sim in pair.both():
        sim.forward()
        before = sim.data.xpos.clone()
        sim.step()
        torch.testing.assert_close(sim.data.xpos, before, atol=1e-5, rtol=1e-5)
        sim.forward()
    assert_same(pair, (*STATE_FIELDS[:-1], *pair.derived))


def test_a_reset_gives_the_same_state_and_leaves_other_environments(pair: Pair) -> None:
    set_same_state(pair)
    ids = torch.tensor([0, 2])
    for sim in pair.both():
        sim.step()
    copy_state(*pair.both())
    other = {field: getattr(pair.warp.data, field)[1].clone() for field in STATE_FIELDS}
    for sim in pair.both():
        sim.reset(ids)
    assert_same(pair, STATE_FIELDS)
    for field, value in other.items():
        assert torch.equal(getattr(pair.warp.data, field)[1], value), field
    assert not pair.warp.data.act[ids].any()
    assert not pair.warp.data.time[ids].any()
    for sim in pair.both():
        poison(sim, pair)
        sim.forward()
    assert_same(pair, (*STATE_FIELDS[:-1], *pair.derived))


def test_a_partial_forward_updates_only_its_environments(pair: Pair) -> None:
    set_same_state(pair, seed=3)
    for sim in pair.both():
        sim.forward()
    set_same_state(pair, seed=4)
    for sim in pair.both():
        before = {field: getattr(sim.data, field).clone() for field in pair.derived}
        sim.forward(torch.tensor([1]))
        for field, value in before.items():
            assert torch.equal(getattr(sim.data, field)[[0, 2]], value[[0, 2]]), field
    assert_same(pair, pair.derived, rows=[1])


@pytest.mark.parametrize("rows", [None, [1]])
def test_a_forward_keeps_later_stages(pair: Pair, rows: list[int] | None) -> None:
    set_same_state(pair, seed=3)
    for sim in pair.both():
        sim.step(2)
    copy_state(*pair.both())
    late = tuple(field for field in pair.derived if field in ACCELERATION_FIELDS)
    early = tuple(field for field in pair.derived if field not in (*late, "sensordata"))
    ids = None if rows is None else torch.tensor(rows)
    for sim in pair.both():
        before = {field: getattr(sim.data, field).clone() for field in pair.derived}
        sim.forward(ids, stage="vel")
        after = {field: getattr(sim.data, field).clone() for field in pair.derived}
        sim.forward(ids)
        columns = np.repeat(sim.mj_model.sensor_needstage, sim.mj_model.sensor_dim) == ACC
        for field in late:
            assert torch.equal(after[field], before[field]), f"{sim.engine_name} {field}"
        for field in early:
            full = getattr(sim.data, field)
            torch.testing.assert_close(after[field], full, msg=f"{sim.engine_name} {field}")
        sensors = after["sensordata"]
        assert torch.equal(sensors[:, columns], before["sensordata"][:, columns])
        torch.testing.assert_close(sensors[:, ~columns], sim.data.sensordata[:, ~columns])


def test_several_steps_in_one_call_are_single_steps(pair: Pair) -> None:
    for sim in pair.both():
        set_same_state(pair)
        sim.step(3)
        together = {field: getattr(sim.data, field).clone() for field in STATE_FIELDS}
        set_same_state(pair)
        for _ in range(3):
            sim.step()
        for field, value in together.items():
            once = getattr(sim.data, field)
            if sim.device.startswith("cuda"):
                # The contact order varies, and rounding of sums depends on it.
                scale = 1.0 + value.float().abs().max() if value.numel() else 1.0
                assert ((once.float() - value.float()).abs() <= PARITY_TOLERANCE * scale).all(), (
                    field
                )
            elif sim is pair.native:
                assert torch.equal(once, value), field
            else:
                torch.testing.assert_close(once, value, msg=field)


def randomize_models(pair: Pair) -> Pair:
    """Scale model parameters by a different factor in every environment, and recompute."""
    scaled = ("body_mass", "body_inertia", "dof_damping", "dof_armature", "geom_friction")
    moved = ("body_ipos", "body_pos", "geom_pos", "site_pos", "qpos0")
    factors = torch.tensor([0.8, 1.0, 1.7])
    for sim in pair.both():
        sim.expand_model_fields((*scaled, *moved, "gravity"))
        for field in scaled:
            values = getattr(sim.model, field)
            values.mul_(factors.to(values).view(-1, *[1] * (values.dim() - 1)))
        for field in moved:
            values = getattr(sim.model, field)
            if field == "qpos0" and sim.mj_model.nq == 7:
                values = values[:, :3]
            elif field.startswith("body_"):
                values = values[:, 1:]
            shift = 0.02 * (factors - 1).to(values)
            values.add_(shift.view(-1, *[1] * (values.dim() - 1)))
        sim.model.gravity[:, 2] *= factors.to(sim.device)
        sim.recompute_constants(3)
    return pair


def test_recomputed_constants_are_the_same(changed: Pair) -> None:
    written = [set(sim._engine.constants_written_by(3)) for sim in changed.both()]
    fields = tuple(field for field in CONSTANTS if field in written[0] & written[1])
    assert set(fields) >= {"body_subtreemass", "body_invweight0", "dof_invweight0"}
    for sim in changed.both():
        assert set(fields) <= sim.expanded_fields
    assert_same(changed, fields, struct="model")
    # Environments must differ: otherwise shared values would pass.
    assert not torch.allclose(
        changed.warp.model.dof_invweight0[0], changed.warp.model.dof_invweight0[2]
    )


def test_randomized_environments_step_and_forward_the_same(changed: Pair) -> None:
    set_same_state(changed)
    for sim in changed.both():
        poison(sim, changed)
        sim.forward()
    assert_same(changed, (*STATE_FIELDS[:-1], *changed.derived))
    for sim in changed.both():
        poison(sim, changed)
        sim.step(3)
    assert_same(changed, (*STATE_FIELDS, *changed.derived))


def test_a_reset_takes_each_environments_own_reference_pose(changed: Pair) -> None:
    set_same_state(changed)
    for sim in changed.both():
        sim.reset()
        torch.testing.assert_close(sim.data.qpos, sim.model.qpos0)
    assert_same(changed, STATE_FIELDS)


def test_rays_and_jacobians_are_the_same(pair: Pair) -> None:
    set_same_state(pair)
    for sim in pair.both():
        sim.forward()
    origins = torch.tensor([[0.02, 0.01, 2.0], [0.0, -1.0, 0.5], [5.0, 5.0, 1.0]])
    directions = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rays = [
        sim.raycast(
            origins.expand(NUM_ENVS, -1, -1).to(sim.device),
            directions.expand(NUM_ENVS, -1, -1).to(sim.device),
        )
        for sim in pair.both()
    ]
    points = pair.native.data.xpos[:, -1] + 0.1
    bodies = torch.full((NUM_ENVS,), pair.native.mj_model.nbody - 1, dtype=torch.int32)
    jacobians = [sim.jacobian(points.to(sim.device), bodies.to(sim.device)) for sim in pair.both()]
    for native, warp in zip((*rays[0], *jacobians[0]), (*rays[1], *jacobians[1]), strict=True):
        torch.testing.assert_close(warp.cpu(), native, atol=PARITY_TOLERANCE, rtol=PARITY_TOLERANCE)
