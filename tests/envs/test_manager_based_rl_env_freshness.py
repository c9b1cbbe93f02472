"""Freshness of fields after a step, against a plain loop over `mj_step` and `mj_forward`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import pytest
import torch

from mjlab import managers as mm
from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.scene import SceneCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.terrains import TerrainEntityCfg

NUM_ENVS = 3
# Of the largest value of a quantity. The native engine is MuJoCo, rounded once.
TOLERANCE = {"native": 1e-6, "warp": 3e-3}

ROBOT = """
<mujoco>
  <worldbody>
    <body name="trunk" pos="0 0 .34">
      <freejoint/>
      <geom type="box" size=".2 .1 .05" mass="4"/>
      <site name="imu" pos=".05 0 0"/>
      <body name="front" pos=".15 0 0">
        <joint name="front" axis="0 1 0"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.28" mass=".5" contype="0" conaffinity="0"/>
        <geom name="front_foot" size=".05" pos="0 0 -.3" mass=".2"/>
        <site name="front_foot" size=".06" pos="0 0 -.3"/>
      </body>
      <body name="back" pos="-.15 0 0">
        <joint name="back" axis="0 1 0"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.28" mass=".5" contype="0" conaffinity="0"/>
        <geom name="back_foot" size=".05" pos="0 .02 -.3" mass=".2"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <accelerometer name="acceleration" site="imu"/>
    <touch name="touch" site="front_foot"/>
    <force name="force" site="front_foot"/>
    <jointactuatorfrc name="motor" joint="front"/>
    <framepos name="place" objtype="site" objname="front_foot"/>
    <velocimeter name="speed" site="imu"/>
    <gyro name="turning" site="imu"/>
    <subtreelinvel name="momentum" body="trunk"/>
  </sensor>
</mujoco>
"""
FORCES = ("contact", "acceleration", "touch", "force", "motor", "joint_acc", "actuator_force")
MOTION = ("place", "speed", "turning", "momentum", "links", "link_velocities")


def observe(env: Any, name: str) -> torch.Tensor:
    """Return a quantity as a task reads it, (N, ...) flattened."""
    robot = env.scene["robot"].data
    if name == "contact":
        data = env.scene["feet"].data
        parts = (data.found[..., None], data.force, data.dist[..., None], data.pos)
        return torch.cat(parts, dim=-1).flatten(1)
    if name == "links":
        return robot.body_link_pos_w.flatten(1).clone()
    if name == "link_velocities":
        return robot.body_link_vel_w.flatten(1).clone()
    if name in ("joint_acc", "actuator_force"):
        return getattr(robot, name).clone()
    return env.scene[f"robot/{name}"].data.clone()


def measure(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> torch.Tensor:
    """Return the same quantity of plain MuJoCo."""
    bodies = [model.body(f"robot/{body}").id for body in ("trunk", "front", "back")]
    if name == "contact":
        sensors = [model.sensor(f"feet_{foot}_foot") for foot in ("front", "back")]
        values = [data.sensordata[s.adr[0] : s.adr[0] + s.dim[0]] for s in sensors]
        return torch.cat([torch.tensor(value) for value in values]).float()
    if name == "links":
        return torch.tensor(data.xpos[bodies]).flatten().float()
    if name == "link_velocities":
        velocities = torch.zeros(len(bodies), 6, dtype=torch.float64).numpy()
        for row, body in zip(velocities, bodies, strict=True):
            kind = mujoco.mjtObj.mjOBJ_XBODY
            mujoco.mj_objectVelocity(model, data, kind, body, row, 0)
        angular, linear = torch.tensor(velocities).split(3, dim=1)
        return torch.cat((linear, angular), dim=1).flatten().float()
    if name == "joint_acc":
        return torch.tensor(data.qacc[6:]).float()
    if name == "actuator_force":
        return torch.tensor(data.actuator_force).float()
    sensor = model.sensor(f"robot/{name}")
    return torch.tensor(data.sensordata[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]).float()


class Reference:
    """Plain MuJoCo beside an environment: its last substep, and a forward pass at its state."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self.env, self.model = env, env.sim.mj_model
        self.last = [mujoco.MjData(self.model) for _ in range(env.num_envs)]
        self._step = env.sim.step
        env.sim.step = self.step

    def step(self, nstep: int = 1, *args: Any) -> dict[str, torch.Tensor]:
        recorded = []
        for _ in range(nstep):
            for index, data in enumerate(self.last):
                self.env.sim.copy_to_host(index, data)
                mujoco.mj_step(self.model, data)
            recorded.append(self._step(1, *args) or {})
        return {name: torch.cat([step[name] for step in recorded]) for name in recorded[0]}

    def of_last_substep(self, name: str) -> torch.Tensor:
        return torch.stack([measure(self.model, data, name) for data in self.last])

    def of_forward(self, name: str) -> torch.Tensor:
        rows = []
        for index in range(self.env.num_envs):
            data = mujoco.MjData(self.model)
            self.env.sim.copy_to_host(index, data)
            mujoco.mj_forward(self.model, data)
            rows.append(measure(self.model, data, name))
        return torch.stack(rows)


def config(engine: str, **fields: Any) -> ManagerBasedRlEnvCfg:
    servo = BuiltinPositionActuatorCfg(target_names_expr=(".*",), stiffness=60.0, damping=2.0)
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(ROBOT),
        articulation=EntityArticulationInfoCfg(actuators=(servo,)),
        init_state=EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 0.345)),
    )
    feet = ContactSensorCfg(
        name="feet",
        primary=ContactMatch(mode="geom", pattern=".*_foot", entity="robot"),
        fields=("found", "force", "dist", "pos"),
        track_air_time=True,
        history_length=2,
    )
    terms = {
        name: mm.ObservationTermCfg(func=observe, params={"name": name})
        for name in (*FORCES, *MOTION)
    }
    group = mm.ObservationGroupCfg(terms=terms, concatenate_terms=False)
    drop = mm.EventTermCfg(
        func=mdp.reset_root_state_uniform,
        mode="reset",
        params={"pose_range": {"z": (-0.01, 0.01), "pitch": (-0.05, 0.05)}, "velocity_range": {}},
    )
    return ManagerBasedRlEnvCfg(
        decimation=3,
        scene=SceneCfg(
            num_envs=NUM_ENVS,
            entities={"robot": robot},
            terrain=TerrainEntityCfg(terrain_type="plane"),
            sensors=(feet,),
        ),
        actions={"servo": JointPositionActionCfg(entity_name="robot", actuator_names=(".*",))},
        observations={"all": group},
        events={"drop": drop, **fields.pop("events", {})},
        # Reads every quantity early in a step, so that observations are not the first to do so.
        rewards={"reads": mm.RewardTermCfg(func=read_all, weight=1.0), **fields.pop("rewards", {})},
        sim=SimulationCfg(engine=engine, mujoco=MujocoCfg(timestep=0.004)),
        seed=3,
        episode_length_s=10.0,
        **fields,
    )


def read_all(env: Any) -> torch.Tensor:
    return sum(observe(env, name).mean(dim=1) for name in (*FORCES, *MOTION))


@pytest.fixture(params=["native", "warp"])
def make(request):
    """Return a function that makes an environment, reset and a few steps on, and its reference."""

    def make(steps: int = 4, **fields: Any) -> tuple[ManagerBasedRlEnv, Reference]:
        env = ManagerBasedRlEnv(config(request.param, **fields), device="cpu")
        request.addfinalizer(env.close)
        if steps:
            env.reset()
        reference = Reference(env)
        for _ in range(steps):
            act(env)
        return env, reference

    return make


def act(env: ManagerBasedRlEnv) -> dict[str, torch.Tensor]:
    """Step with an action that moves the legs; return the observations."""
    phase = torch.arange(env.num_envs)[:, None] + env.common_step_counter
    return env.step(0.1 * torch.sin(phase * torch.tensor([1.0, 2.0])))[0]["all"]


def check(
    env: ManagerBasedRlEnv,
    observed: dict[str, torch.Tensor],
    expected: Any,
    names: tuple[str, ...],
    envs: Any = slice(None),
) -> None:
    """Compare rows `envs` of quantities `names` with `expected(name)`."""
    for name in names:
        value, wanted = observed[name][envs], expected(name)[envs]
        scale = wanted.abs().max() + 1.0
        error = ((value - wanted).abs().max() / scale).item()
        assert error < TOLERANCE[env.sim.engine_name], f"{name}: relative error {error:.1e}"


def ends(due: list[int]) -> dict[str, mm.TerminationTermCfg | None]:
    """Return a termination of the environments listed in `due`, which it then empties."""

    def ended(env):
        mask = torch.zeros(env.num_envs, dtype=torch.bool)
        mask[due] = True
        due.clear()
        return mask

    return {"ended": mm.TerminationTermCfg(func=ended)}


# Steps.


def test_observations_have_last_forces_and_new_motion(make):
    env, reference = make()
    for _ in range(5):
        observed = act(env)
        check(env, observed, reference.of_last_substep, FORCES)
        check(env, observed, reference.of_forward, MOTION)
    touching = observed["contact"][:, 0] > 0
    assert touching.any(), "a test of contact forces needs contacts"
    old, new = reference.of_last_substep("contact"), reference.of_forward("contact")
    assert not torch.allclose(old, new, rtol=1e-3), "old and new must differ"


def test_rewards_read_what_the_last_substep_computed(make):
    seen: dict[str, torch.Tensor] = {}

    def look(env):
        seen.update({name: observe(env, name) for name in (*FORCES, *MOTION)})
        return torch.zeros(env.num_envs)

    env, reference = make(rewards={"look": mm.RewardTermCfg(func=look, weight=1.0)})
    act(env)
    check(env, seen, reference.of_last_substep, (*FORCES, *MOTION))


def test_an_environment_that_was_reset_sees_nothing_of_the_old_episode(make):
    due: list[int] = []
    env, reference = make(terminations=ends(due))
    due[:] = [1]
    observed = act(env)
    check(env, observed, reference.of_forward, (*FORCES, *MOTION), [1])
    check(env, observed, reference.of_last_substep, FORCES, [0, 2])
    check(env, observed, reference.of_forward, MOTION)
    feet = env.scene["feet"].data
    assert not feet.force_history[1].any()
    assert not feet.current_contact_time[1].any()
    assert feet.force_history[[0, 2]].any()
    # It goes on by the rule.
    observed = act(env)
    check(env, observed, reference.of_last_substep, FORCES)


def test_all_reset_at_once_see_a_full_forward(make):
    due: list[int] = []
    env, reference = make(terminations=ends(due))
    due[:] = [0, 1, 2]
    check(env, act(env), reference.of_forward, (*FORCES, *MOTION))


def test_observations_ignore_resets_of_others(make):
    runs = []
    for ended in ([], [1]):
        due: list[int] = []
        env, _ = make(terminations=ends(due))
        due[:] = ended
        runs.append([act(env), act(env)])
    for with_reset, without in zip(*runs, strict=True):
        for name in (*FORCES, *MOTION):
            torch.testing.assert_close(with_reset[name][[0, 2]], without[name][[0, 2]])


def test_last_observations_have_the_last_forces(make):
    due: list[int] = []
    env, reference = make(terminations=ends(due), auto_reset=False)
    due[:] = [2]
    observed = act(env)
    check(env, observed, reference.of_last_substep, FORCES)
    check(env, observed, reference.of_forward, MOTION)
    started = env.reset(env_ids=torch.tensor([2]))[0]["all"]
    check(env, started, reference.of_forward, (*FORCES, *MOTION), [2])
    check(env, started, reference.of_last_substep, FORCES, [0, 1])


# Resets.


def test_a_reset_of_some_leaves_the_forces_of_the_others(make):
    env, reference = make()
    before = act(env)
    observed = env.reset(env_ids=torch.tensor([1]))[0]["all"]
    check(env, observed, reference.of_forward, (*FORCES, *MOTION), [1])
    for name in (*FORCES, *MOTION):
        torch.testing.assert_close(observed[name][[0, 2]], before[name][[0, 2]])


@pytest.mark.parametrize("ids", [None, torch.tensor([1])])
def test_before_the_first_substep_a_forward_gives_all_there_is(make, ids):
    env, reference = make(steps=0)
    # As a script that places robots by itself.
    env.sim.data.qpos[:, 2] = torch.tensor([0.33, 0.34, 0.35])
    observed = env.reset(env_ids=ids)[0]["all"]
    check(env, observed, reference.of_forward, (*FORCES, *MOTION))
    check(env, act(env), reference.of_last_substep, FORCES)


# Events and commands that write state.


def place(env: Any, env_ids: torch.Tensor) -> None:
    pose = torch.tensor([[0.5, 0.0, 0.34, 1.0, 0.0, 0.0, 0.0]])
    env.scene["robot"].write_root_link_pose_to_sim(pose, env_ids=torch.tensor([2]))


def push(env: Any, env_ids: torch.Tensor) -> None:
    velocity = torch.tensor([[0.5, 0.0, 0.0, 0.0, 0.0, 1.0]])
    env.scene["robot"].write_root_link_velocity_to_sim(velocity, env_ids=torch.tensor([2]))


@pytest.mark.parametrize("mode", ["step", "interval"])
def test_an_event_that_places_a_robot_leaves_no_forces_of_the_place_before(make, mode):
    interval = {"interval_range_s": (0.0, 0.0)} if mode == "interval" else {}
    env, reference = make(events={"place": mm.EventTermCfg(func=place, mode=mode, **interval)})
    observed = act(env)
    check(env, observed, reference.of_forward, (*FORCES, *MOTION), [2])
    check(env, observed, reference.of_last_substep, FORCES, [0, 1])


def test_a_push_changes_velocities_and_leaves_the_forces_that_acted(make):
    env, reference = make(events={"push": mm.EventTermCfg(func=push, mode="step")})
    observed = act(env)
    check(env, observed, reference.of_last_substep, FORCES)
    check(env, observed, reference.of_forward, MOTION)
    assert observed["turning"][2, 2] > 0.5


def test_places_set_between_substeps_act_next(make, monkeypatch):
    env, reference = make()
    apply = env.action_manager.apply_action
    monkeypatch.setattr(env.action_manager, "apply_action", lambda: (apply(), place(env, None)))
    check(env, act(env), reference.of_last_substep, FORCES)


@dataclass(kw_only=True)
class LiftCfg(CommandTermCfg):
    def build(self, env: Any) -> Lift:
        return Lift(self, env)


class Lift(CommandTerm):
    """Places robot 0 in the air, in every step, and computes what follows for this one."""

    command = torch.zeros(NUM_ENVS, 1)

    def _update_command(self, env_ids: torch.Tensor | None = None) -> None:
        ids = torch.tensor([0])
        pose = torch.tensor([[0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]])
        self._env.scene["robot"].write_root_link_pose_to_sim(pose, env_ids=ids)
        self._env.sim.forward(ids)

    def _update_metrics(self) -> None: ...

    def _resample_command(self, env_ids: torch.Tensor) -> None: ...


def test_a_command_that_places_a_robot_computes_what_follows_for_it_alone(make, monkeypatch):
    env, reference = make(commands={"lift": LiftCfg(resampling_time_range=(1.0, 1.0))})
    calls = []
    forward = env.sim.forward

    def count(ids=None, stage="acc"):
        calls.append((None if ids is None else ids.tolist(), stage))
        forward(ids, stage)

    monkeypatch.setattr(env.sim, "forward", count)
    observed = act(env)
    check(env, observed, reference.of_forward, (*FORCES, *MOTION), [0])
    assert not observed["contact"][0].any()
    check(env, observed, reference.of_last_substep, FORCES, [1, 2])
    env.reset(env_ids=torch.tensor([1]))
    of_command = ([0], "acc")
    all_moved = (None, "vel")
    assert calls == [all_moved, of_command, all_moved, ([1], "acc"), of_command]


# Resuming.


def build_go1() -> ManagerBasedRlEnv:
    """A Go1 that observes the forces of all its contact sensors."""
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 6, 5, "native"
    terms = {
        sensor.name: mm.ObservationTermCfg(
            func=lambda env, name: env.scene[name].data.force.flatten(1),
            params={"name": sensor.name},
        )
        for sensor in cfg.scene.sensors
        if isinstance(sensor, ContactSensorCfg) and "force" in sensor.fields
    }
    cfg.observations["forces"] = mm.ObservationGroupCfg(terms=terms)
    return ManagerBasedRlEnv(cfg, device="cpu")


def walk(env: ManagerBasedRlEnv, steps: int) -> list[dict[str, torch.Tensor]]:
    """Return the observations of random steps; environment 3 resets at step 2."""
    generator = torch.Generator().manual_seed(steps)
    size = (env.num_envs, env.action_manager.total_action_dim)
    seen = []
    for step in range(steps):
        if step == 2:
            env.episode_length_buf[3] = env.max_episode_length - 1
        observations = env.step(torch.randn(size, generator=generator))[0]
        seen.append({name: value.clone() for name, value in observations.items()})
    return seen


def test_a_go1_goes_on_bit_for_bit_with_the_contacts_of_its_last_substep():
    env = build_go1()
    env.reset()
    forces = walk(env, 12)[-1]["forces"]
    assert forces.any()
    state, generator = env.state_dict(), torch.get_rng_state()
    there = walk(env, 5)
    other = build_go1()
    other.load_state_dict(state)
    torch.set_rng_state(generator)
    assert torch.equal(other.observation_manager.compute_group("forces"), forces)
    here = walk(other, 5)
    for one, two in zip(there, here, strict=True):
        for group, values in one.items():
            assert torch.equal(values, two[group]), group
    env.close()
    other.close()
