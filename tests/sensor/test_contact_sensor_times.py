"""Air and contact times, against a slow count of substeps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.envs import ManagerBasedRlEnv
from mjlab.sensor import ContactSensor, ContactSensorCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.state import capture_state, restore_state

from .contact_scenes import BOX, DT, GRAVITY, TERRAIN, build, compose, geom, sense, settle

FEET = 2
ENVS = 2
CFG = sense(geom("foot_.", "robot"), TERRAIN, track_air_time=True, history_length=2, num_slots=2)
ROBOT = """
<mujoco><worldbody><body name="trunk"><freejoint/><geom name="foot_a" size=".1"/>
  <geom name="foot_b" size=".1" pos="1 0 0"/></body></worldbody></mujoco>
"""


class Fed:
    """Contact sensor with prescribed instead of simulated contacts."""

    def __init__(self) -> None:
        scene = compose(CFG, robot=ROBOT, num_envs=ENVS)
        model = scene.compile()
        self.sensordata = torch.zeros(ENVS, model.nsensordata)
        data = SimpleNamespace(sensordata=self.sensordata, qpos=torch.zeros(ENVS, model.nq))
        self.sensor: ContactSensor = scene["touch"]
        self.sensor.initialize(model, None, data, "cpu")
        # The number of contacts is the first value of each MuJoCo sensor.
        self._found = [model.sensor(f"touch_foot_{foot}").adr[0] for foot in "ab"]

    def update(self, contacts: list[list[bool]], dt: float) -> None:
        for env, row in enumerate(contacts):
            for column, touching in zip(self._found, row, strict=True):
                self.sensordata[env, column] = 2.0 * touching
        self.sensor.update(dt)

    def times(self) -> torch.Tensor:
        data = self.sensor.data
        names = ("current_air_time", "current_contact_time", "last_air_time", "last_contact_time")
        return torch.stack([getattr(data, name) for name in names])


@dataclass
class CountedFoot:
    """Rules of the documentation page, in whole substeps."""

    air: int = 0
    contact: int = 0
    last_air: int = 0
    last_contact: int = 0

    def update(self, touching: bool) -> None:
        if touching and self.air > 0:
            self.last_air = self.air + 1
        if not touching and self.contact > 0:
            self.last_contact = self.contact + 1
        self.air, self.contact = (0, self.contact + 1) if touching else (self.air + 1, 0)

    def times(self) -> tuple[int, ...]:
        return self.air, self.contact, self.last_air, self.last_contact


contacts = st.lists(
    st.lists(st.booleans(), min_size=FEET, max_size=FEET), min_size=ENVS, max_size=ENVS
)
substeps = st.lists(
    st.tuples(contacts, st.sampled_from((None, None, None, 0, 1, "all"))), min_size=1, max_size=30
)


@settings(max_examples=30, deadline=None)
@given(substeps, st.sampled_from((0.005, 0.002, 1 / 300, 0.0041)), st.integers(1, 5))
def test_clocks_count_substeps_and_tell_each_event_once(sequence, dt, decimation):
    fed = Fed()
    counted = [[CountedFoot() for _ in range(FEET)] for _ in range(ENVS)]
    for step, (now, reset) in enumerate(sequence, start=1):
        fed.update(now, dt)
        for feet, row in zip(counted, now, strict=True):
            for foot, touching in zip(feet, row, strict=True):
                foot.update(touching)
        if reset is not None:
            rows = range(ENVS) if reset == "all" else (reset,)
            fed.sensor.reset(None if reset == "all" else torch.tensor([reset]))
            for env in rows:
                counted[env] = [CountedFoot() for _ in range(FEET)]
        expected = torch.tensor([[foot.times() for foot in feet] for feet in counted])
        torch.testing.assert_close(
            fed.times(), expected.permute(2, 0, 1) * dt, rtol=1e-6, atol=1e-9, check_dtype=False
        )
        if step % decimation == 0:
            landed = fed.sensor.compute_first_contact(decimation * dt)
            left = fed.sensor.compute_first_air(decimation * dt)
            recent = range(1, decimation + 1)
            for env, feet in enumerate(counted):
                for column, foot in enumerate(feet):
                    assert landed[env, column] == (foot.contact in recent)
                    assert left[env, column] == (foot.air in recent)


@pytest.mark.parametrize("dt", [0.005, 0.002, 1 / 300])
def test_clocks_do_not_drift_in_hours_of_simulated_time(dt):
    """Single precision would round each substep by up to a third here, and later stand still."""
    fed = Fed()
    touching, flying = [[True] * FEET] * ENVS, [[False] * FEET] * ENVS
    for phase, now in ((1, touching), (0, flying)):
        fed.update(now, 10 * 3600.0)
        start = fed.times()[phase, 0, 0].double()
        for _ in range(2000):
            fed.sensor.update(dt)
        passed = (fed.sensor._clocks.contact if phase else fed.sensor._clocks.air)[0, 0] - start
        assert abs(float(passed) - 2000 * dt) < 1e-7


def test_landings_and_departures_after_hours_are_told_exactly_once():
    fed = Fed()
    dt, decimation, period = 0.005, 4, 11
    fed.update([[False] * FEET] * ENVS, 10 * 3600.0)
    landings = departures = 0
    # In the air for five substeps, on the ground for six, so that the landings come in every part
    # of an environment step, and last to the end of it.
    for substep in range(4 * period * 10):
        fed.update([[substep % period >= 5] * FEET] * ENVS, dt)
        if substep % decimation == decimation - 1:
            landings += int(fed.sensor.compute_first_contact(decimation * dt)[0, 0])
            departures += int(fed.sensor.compute_first_air(decimation * dt)[0, 0])
    assert landings == 40
    assert departures == 39, "in the beginning it was in the air already"


def test_a_foot_on_the_ground_at_reset_reports_no_landing_time():
    fed = Fed()
    fed.update([[False] * FEET] * ENVS, 0.01)
    fed.sensor.reset()
    fed.update([[True] * FEET] * ENVS, 0.01)
    assert not fed.sensor.data.last_air_time.any()


def test_without_tracking_the_clocks_are_refused():
    sensor = compose(sense(geom("box")), box=BOX)["touch"]
    for method in (sensor.compute_first_contact, sensor.compute_first_air):
        with pytest.raises(RuntimeError, match="track_air_time=True"):
            method(0.02)


def test_clocks_and_history_resume_exactly():
    first, second = Fed(), Fed()
    generator = torch.Generator().manual_seed(0)

    def random_step(*feds: Fed) -> None:
        now = (torch.rand(ENVS, FEET, generator=generator) > 0.5).tolist()
        noise = torch.rand(first.sensordata.shape, generator=generator)
        for fed in feds:
            fed.sensordata[:] = noise
            fed.update(now, 0.005)

    for _ in range(7):
        random_step(first)
    slots = second.sensor._history._slots[0].data_ptr()
    restore_state(second.sensor, capture_state(first.sensor))
    assert second.sensor._history._slots[0].data_ptr() == slots, "state is restored in place"
    for _ in range(5):
        random_step(first, second)
        assert torch.equal(first.times(), second.times())
        assert torch.equal(first.sensor.data.force_history, second.sensor.data.force_history)


# Contacts between the substeps.


def test_a_contact_between_two_environment_steps_is_not_missed():
    """A ball bounces within one environment step, and at its end it is in the air again."""
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
    from mjlab.managers import ObservationGroupCfg, ObservationTermCfg

    ball = (
        "<mujoco><worldbody><body name='ball' pos='0 0 .3'><freejoint/>"
        "<geom name='ball' size='.1' mass='1' solref='-40000 -10'/></body></worldbody></mujoco>"
    )
    cfg = sense(geom("ball", "ball"), TERRAIN, track_air_time=True, history_length=50)
    scene = compose(cfg, ball=ball, num_envs=1)
    scene.cfg.entities["ball"].init_state.pos = (0.0, 0.0, 0.3)

    def height(env):
        return env.sim.data.qpos[:, 2:3]

    env_cfg = ManagerBasedRlEnvCfg(
        decimation=50,
        scene=scene.cfg,
        observations={"actor": ObservationGroupCfg(terms={"z": ObservationTermCfg(func=height)})},
        actions={},
        episode_length_s=10.0,
    )
    env_cfg.sim.mujoco.timestep = 0.005
    env = ManagerBasedRlEnv(env_cfg, device="cpu")
    env.reset()
    env.step(torch.zeros(1, 0))
    data = env.scene["touch"].data
    assert not data.found.any(), "the case is to have no contact at the end of the step"
    assert data.force_history.abs().amax() > 10.0
    assert data.last_contact_time > 0.0
    assert 0.2 - 0.01 < data.last_air_time < 0.22, "sqrt(2 h / g) of a fall of 0.2 m"
    env.close()


def test_a_substep_is_recorded_once_whatever_is_read_in_between():
    sim, scene = build(CFG, robot=ROBOT)
    for _ in range(3):
        sim.step()
        assert scene["touch"].data is not None
        scene.update(0.004)
        sim.forward()
        assert scene["touch"].data is not None
    assert torch.equal(
        scene["touch"].data.current_contact_time + scene["touch"].data.current_air_time,
        torch.full((2, 2), 3 * 0.004),
    )


# All substeps in one call.


class CountingSensor(ContactSensor):
    """Overrides `update`, so it is called at every substep."""

    updates = 0

    def update(self, dt: float) -> None:
        super().update(dt)
        self.updates += 1


def walking_env(edit=lambda cfg: None) -> ManagerBasedRlEnv:
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    cfg.scene.num_envs, cfg.seed = 4, 2
    feet = next(sensor for sensor in cfg.scene.sensors if getattr(sensor, "track_air_time", False))
    feet.history_length, feet.fields = 6, ("found", "force", "dist")
    edit(cfg)
    return ManagerBasedRlEnv(cfg, device="cpu")


def walk(env: ManagerBasedRlEnv, steps: int = 12) -> list[torch.Tensor]:
    """Return all that contact sensors, rewards and metrics report of some steps."""
    env.reset(seed=2)
    generator = torch.Generator().manual_seed(0)
    record = []
    for k in range(steps):
        if k == steps // 2:
            env.reset(env_ids=torch.tensor([1]))
        size = (env.num_envs, env.action_manager.total_action_dim)
        env.step(torch.randn(size, generator=generator))
        for sensor in env.scene.sensors.values():
            if isinstance(sensor, ContactSensor):
                values = dataclasses.asdict(sensor.data).values()
                record += [value.clone() for value in values if value is not None]
        record += [
            env.reward_buf.clone(),
            env.sim.data.qpos.clone(),
            env.metrics_manager._sum.clone(),
        ]
    return record


def test_recorded_substeps_give_the_bits_of_single_steps() -> None:
    together, one_by_one = walking_env(), walking_env()
    assert together._steps_as_one
    one_by_one._steps_as_one = False
    found, expected = walk(together), walk(one_by_one)
    assert any((values > 0).any() for values in found)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def delay_the_actuators(cfg) -> None:
    for actuator in cfg.scene.entities["robot"].articulation.actuators:
        actuator.delay_max_lag = 2


def test_an_actuator_with_a_delay_keeps_single_steps() -> None:
    assert not walking_env(delay_the_actuators)._steps_as_one


def test_a_subclass_that_overrides_update_is_called_at_every_substep(monkeypatch) -> None:
    monkeypatch.setattr(ContactSensorCfg, "build", lambda cfg: CountingSensor(cfg))
    env = walking_env()
    assert not env._steps_as_one
    env.reset()
    env.step(torch.zeros(4, env.action_manager.total_action_dim))
    sensor = next(s for s in env.scene.sensors.values() if isinstance(s, CountingSensor))
    assert sensor.updates == env.cfg.decimation


# Fields.


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize(
    "fields",
    [
        {"fields": ("force",)},
        {"fields": ("force",), "num_slots": 3},
        {"fields": ("dist", "torque"), "reduce": "none"},
        {"fields": ("force",), "reduce": "netforce", "history_length": 2},
        {"fields": ("pos",), "reduce": "mindist", "history_length": -1},
    ],
)
def test_air_time_does_not_depend_on_fields(fields, engine):
    """A box that falls from 0.02 m and stays on the ground, in one of two environments."""
    asked = sense(geom("box"), TERRAIN, track_air_time=True, **fields)
    found = dataclasses.replace(asked, name="all", fields=("found", *asked.fields))
    sim, scene = build(asked, found, box=BOX, engine=engine)
    sim.data.qpos[:, 2] += torch.tensor([0.02, 10.0])
    for _ in range(30):
        sim.step()
        scene.update(DT)
    data, expected = scene["touch"].data, scene["all"].data
    assert data.found is None
    names = ("current_air_time", "current_contact_time", "last_air_time", "last_contact_time")
    for name in names:
        torch.testing.assert_close(getattr(data, name), getattr(expected, name))
    # Free fall takes sqrt(2 * 0.02 / 9.81) = 0.064 s.
    assert data.last_air_time[0, 0] == pytest.approx(0.064, abs=2 * DT)
    assert data.current_air_time[1, 0] == pytest.approx(30 * DT)
    assert data.current_contact_time[0, 0] > 0.0
    assert torch.equal(scene["touch"].compute_first_air(31 * DT)[:, 0], torch.tensor([False, True]))


def test_subclasses_choose_their_fields():
    @dataclass
    class FootSensorCfg(ContactSensorCfg):
        fields: tuple[str, ...] = ("force",)
        track_air_time: bool = True
        threshold: float = 1.0

        def build(self) -> ContactSensor:
            return FootSensor(self)

    class FootSensor(ContactSensor):
        pass

    sim, scene = build(FootSensorCfg("feet", geom("box"), TERRAIN), box=BOX)
    assert type(scene["feet"]) is FootSensor
    for _ in range(3):
        sim.step()
        scene.update(DT)
    data = scene["feet"].data
    torch.testing.assert_close(data.current_contact_time, torch.full((2, 1), 3 * DT))
    assert data.force is not None
    assert data.found is None


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_global_frame_keeps_a_net_force(engine):
    cfg = sense(geom("box"), TERRAIN, fields=("force", "normal", "tangent"), reduce="netforce")
    turned = dataclasses.replace(cfg, name="turned", global_frame=True)
    sim, scene = build(cfg, turned, box=BOX, engine=engine)
    settle(sim)
    weight = torch.tensor([[[0.0, 0.0, -2.0 * GRAVITY]]]).repeat(2, 1, 1)
    torch.testing.assert_close(scene["touch"].data.force, weight, rtol=1e-2, atol=1e-2)
    torch.testing.assert_close(scene["turned"].data.force, scene["touch"].data.force)
