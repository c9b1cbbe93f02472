"""Resets of some environments, and final observations of episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import pytest
import torch

from mjlab import managers as mm
from mjlab.actuator import BuiltinPositionActuatorCfg, IdealPdActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    TerminationTermCfg,
)
from mjlab.managers.manager_base import ManagerTermBase
from mjlab.scene import SceneCfg
from mjlab.sensor import (
    CameraSensorCfg,
    GridPatternCfg,
    ObjRef,
    RayCastSensorCfg,
    Sensor,
    SensorCfg,
)
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.noise import GaussianNoiseCfg, NoiseModelWithAdditiveBiasCfg, UniformNoiseCfg

NUM_ENVS = 3
# One kind that only passes its target through, and one that computes; they take different paths.
ACTUATORS = pytest.mark.parametrize("actuator", [BuiltinPositionActuatorCfg, IdealPdActuatorCfg])
BY = pytest.mark.parametrize("by", ["reset", "termination"])


def sledge() -> mujoco.MjSpec:
    """Two bodies that slide along x, without gravity in that direction."""
    spec = mujoco.MjSpec()
    for name, height in (("front", 1.0), ("back", 2.0)):
        body = spec.worldbody.add_body(name=name, pos=[0.0, 0.0, height])
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1.0, 0.0, 0.0])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0.0, 0.0], mass=1.0)
    return spec


def entity(actuator: type = BuiltinPositionActuatorCfg, **delay: Any) -> EntityCfg:
    servo = actuator(target_names_expr=(".*",), stiffness=50.0, damping=5.0, **delay)
    return EntityCfg(
        spec_fn=sledge,
        articulation=EntityArticulationInfoCfg(actuators=(servo,)),
        init_state=EntityCfg.InitialStateCfg(joint_pos={".*": 0.4}),
    )


def config(**fields: Any) -> ManagerBasedRlEnvCfg:
    action = JointPositionActionCfg(entity_name="robot", actuator_names=(".*",))
    return ManagerBasedRlEnvCfg(
        decimation=1,
        scene=SceneCfg(num_envs=NUM_ENVS, entities={"robot": entity()}),
        actions={"servo": action},
        sim=SimulationCfg(engine="native", mujoco=MujocoCfg(timestep=0.01)),
        seed=3,
        episode_length_s=10.0,
        **fields,
    )


@pytest.fixture
def make(request):
    """Return a function that makes an environment, reset and ready to step."""

    def make(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnv:
        env = ManagerBasedRlEnv(cfg, device="cpu")
        request.addfinalizer(env.close)
        env.reset()
        return env

    return make


def act(env: ManagerBasedRlEnv, value: float) -> tuple:
    return env.step(torch.full((NUM_ENVS, env.action_manager.total_action_dim), value))


def ends(due: list[int]) -> dict[str, mm.TerminationTermCfg | None]:
    """Return a termination of the environments listed in `due`, which it then empties."""

    def ended(env):
        mask = torch.zeros(NUM_ENVS, dtype=torch.bool)
        mask[due] = True
        due.clear()
        return mask

    return {"ended": mm.TerminationTermCfg(func=ended)}


@dataclass(kw_only=True)
class PlaceCfg(SensorCfg):
    def build(self) -> Place:
        return Place()


class Place(Sensor[torch.Tensor]):
    """Copies body positions; a view would always be up to date."""

    def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
        self._sim_data = data

    def _compute_data(self) -> torch.Tensor:
        return self._sim_data.xpos[:, 1:, 0].clone()


def test_sensors_read_by_rewards_are_observed_fresh(make):
    read: list[torch.Tensor] = []

    def reward(env):
        read.append(env.scene["place"].data)
        return read[-1].sum(dim=1)

    observed = mm.ObservationTermCfg(func=lambda env: env.scene["place"].data)
    cfg = config(
        rewards={"place": mm.RewardTermCfg(func=reward, weight=1.0)},
        observations={"all": mm.ObservationGroupCfg(terms={"place": observed})},
    )
    cfg.scene.sensors = (PlaceCfg(name="place"),)
    env = make(cfg)
    for _ in range(4):
        observations, _, terminated, truncated, _ = act(env, 1.0)
        assert not (terminated | truncated).any()
        current = env.sim.data.xpos[:, 1:, 0]
        assert torch.equal(observations["all"], current)
        assert (read[-1] != current).any(), "the reward reads what is one substep old"


@ACTUATORS
@BY
def test_position_actuators_hold_reset_joints(make, actuator, by):
    due: list[int] = []
    offset = {"position_range": (-0.2, 0.2), "velocity_range": (0.0, 0.0)}
    events: dict[str, mm.EventTermCfg | None] = {}
    for name in ("robot", "other"):
        params = {**offset, "asset_cfg": mm.SceneEntityCfg(name)}
        events[name] = mm.EventTermCfg(func=mdp.reset_joints_by_offset, params=params, mode="reset")
    cfg = config(terminations=ends(due), events=events)
    cfg.scene.entities = {"robot": entity(actuator), "other": entity(actuator)}
    env = make(cfg)
    if by == "termination":
        due[:] = [0, 1, 2]
        _, _, terminated, _, _ = act(env, 1.0)
        assert terminated.all()
    # Every joint somewhere else, and none at zero, where a target would be right by chance.
    joints = env.sim.data.qpos
    assert len(joints.unique()) == joints.numel()
    assert (joints.abs() > 0.1).all()
    for robot in env.scene.entities.values():
        torch.testing.assert_close(robot.data.joint_pos_target, robot.data.joint_pos)
    if actuator is BuiltinPositionActuatorCfg:
        torch.testing.assert_close(env.sim.data.ctrl, joints)
    assert (env.sim.data.actuator_force.abs() < 1e-4).all()


def test_episodes_reset_by_hand_are_recorded(make):
    recorded: list[tuple[list[int], torch.Tensor]] = []

    class Ends(mm.RecorderTerm):
        def record_pre_reset(self, env_ids: torch.Tensor) -> None:
            recorded.append((env_ids.tolist(), self._env.sim.data.qpos[env_ids].clone()))

    env = make(config(recorders={"ends": mm.RecorderTermCfg(func=Ends)}))
    assert recorded == [], "no environment has stepped yet"
    act(env, 1.0)
    act(env, 1.0)
    end = env.sim.data.qpos.clone()
    env.reset(env_ids=torch.tensor([1]))
    assert [ids for ids, _ in recorded] == [[1]]
    assert torch.equal(recorded[0][1], end[[1]]), "the final state of the episode"
    env.reset(env_ids=torch.tensor([1, 2]))
    assert [ids for ids, _ in recorded] == [[1], [2]]
    env.reset()
    assert [ids for ids, _ in recorded] == [[1], [2], [0]]


def beside(make, actuator: type, by: str | None, **delay: Any) -> tuple[torch.Tensor, list[int]]:
    """Return controls and lags of environment 0, step by step, while 1 is reset by `by`."""
    due: list[int] = []
    cfg = config(terminations=ends(due))
    cfg.scene.entities = {"robot": entity(actuator, **delay)}
    env = make(cfg)
    line = env.scene["robot"].actuators[0]._delay_buffer
    controls, lags = [], []
    for step in range(40):
        due[:] = [1] if by == "termination" else []
        act(env, 0.1 * (step + 1))
        controls.append(env.sim.data.ctrl[0].clone())
        lags.append(int(line.current_lags[0]))
        if by == "reset":
            env.reset(env_ids=torch.tensor([1]))
        assert env.episode_length_buf[:2].tolist() == [step + 1, 0 if by else step + 1]
    return torch.stack(controls), lags


@ACTUATORS
@BY
def test_a_delay_line_does_not_advance_when_another_environment_is_reset(make, actuator, by):
    alone, _ = beside(make, actuator, None, delay_min_lag=3, delay_max_lag=3)
    controls, _ = beside(make, actuator, by, delay_min_lag=3, delay_max_lag=3)
    assert torch.equal(controls, alone)


@ACTUATORS
@BY
def test_a_lag_is_drawn_no_sooner_because_another_environment_is_reset(make, actuator, by):
    delay = {"delay_max_lag": 50, "delay_update_period": 5, "delay_per_env_phase": False}
    _, lags = beside(make, actuator, by, **delay)
    drawn = [step for step in range(1, 40) if lags[step] != lags[step - 1]]
    assert drawn, "a lag that never changes would show nothing"
    # The reset that starts the episode counts as the first substep of the period.
    assert all((step + 1) % 5 == 0 for step in drawn)


def test_the_frame_rate_of_a_video_is_each_environments_own(make):
    slow, fast = config(), config()
    slow.decimation, fast.decimation = 10, 2
    envs = [make(slow), make(fast)]
    assert [env.metadata["render_fps"] for env in envs] == pytest.approx([10.0, 50.0])
    envs[0].metadata["render_fps"] = 1.0
    assert envs[1].metadata["render_fps"] == pytest.approx(50.0)


@dataclass(kw_only=True)
class NothingCfg(mm.CommandTermCfg):
    def build(self, env: ManagerBasedRlEnv) -> mm.CommandTerm:
        return Nothing(self, env)


class Nothing(mm.CommandTerm):
    def _resample_command(self, env_ids: torch.Tensor) -> None:
        """Draw nothing: only the timer is of interest."""


@BY
def test_command_timers_start_with_the_episode(make, by):
    due: list[int] = []
    command = NothingCfg(resampling_time_range=(2.0, 2.0))
    env = make(config(terminations=ends(due), commands={"nothing": command}))
    timer = env.command_manager.get_term("nothing").time_left
    assert timer.tolist() == [2.0] * NUM_ENVS
    act(env, 0.0)
    if by == "termination":
        due[:] = [1]
    act(env, 0.0)
    if by == "reset":
        env.reset(env_ids=torch.tensor([1]))
    assert timer[1] == 2.0
    torch.testing.assert_close(timer[[0, 2]], torch.full((2,), 2.0 - 2 * env.step_dt))
    act(env, 0.0)
    torch.testing.assert_close(timer[1], torch.tensor(2.0 - env.step_dt))


class LowPass(mm.ManagerTermBase):
    """Filter of a constant one."""

    def __init__(self, cfg: mm.ObservationTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)
        self.y = torch.zeros(env.num_envs, 1)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        self.y[slice(None) if env_ids is None else env_ids] = 0.0

    def __call__(self, env: ManagerBasedRlEnv) -> torch.Tensor:
        self.y += 0.5 * (1.0 - self.y)
        return self.y.clone()


def test_a_filter_advances_with_its_own_environment(make):
    group = mm.ObservationGroupCfg({"y": mm.ObservationTermCfg(func=LowPass)})
    env = make(config(observations={"actor": group}))
    seen = []
    for step in range(4):
        obs = act(env, 0.0)[0]
        if step == 1:
            obs = env.reset(env_ids=torch.tensor([1]))[0]
            assert torch.equal(env.get_observations()["actor"], obs["actor"])
        seen.append(obs["actor"].flatten().tolist())
    assert seen == [
        [0.75, 0.75, 0.75],
        [0.875, 0.5, 0.875],
        [0.9375, 0.75, 0.9375],
        [0.96875, 0.875, 0.96875],
    ]


# Final observations.


NUM_ENDING, STEPS = 4, 9
Edit = Callable[[ManagerBasedRlEnvCfg], None]


def joint_pos(env: Any) -> torch.Tensor:
    return env.sim.data.qpos


def pole_place(env: Any) -> torch.Tensor:
    """A derived quantity: the place of the pole's body."""
    return env.sim.data.xipos[:, -1]


class Sum(ManagerTermBase):
    """The sum over all calls of an episode: a term with state."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(env)
        self.total = torch.zeros(env.num_envs, env.sim.data.qpos.shape[1])

    def __call__(self, env: Any) -> torch.Tensor:
        self.total += env.sim.data.qpos
        return self.total

    def reset(self, env_ids: Any) -> None:
        self.total[env_ids] = 0.0


def due(steps: list[int]) -> Callable[[Any], torch.Tensor]:
    """Return a termination of environment i when its episode has `steps[i]` steps."""
    return lambda env: env.episode_length_buf >= torch.tensor(steps)


def ending_config(engine: str, *edits: Edit) -> ManagerBasedRlEnvCfg:
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENDING, 5, engine
    cfg.episode_length_s = 100.0
    group = ObservationGroupCfg(
        terms={
            "pos": ObservationTermCfg(func=joint_pos),
            "place": ObservationTermCfg(func=pole_place),
        },
        enable_corruption=True,
    )
    cfg.observations = {"actor": group}
    # Environments 1 and 3 run out of time after the 4th and 6th step, 0 fails after the 5th.
    cfg.terminations = {
        "time_out": TerminationTermCfg(func=due([99, 4, 99, 6]), time_out=True),
        "failed": TerminationTermCfg(func=due([5, 99, 99, 99])),
    }
    for edit in edits:
        edit(cfg)
    return cfg


@pytest.fixture
def make_ending() -> Iterator[Callable[..., ManagerBasedRlEnv]]:
    """Return a function that makes an environment, reset and ready to step."""
    made: list[ManagerBasedRlEnv] = []

    def make_ending(
        *edits: Edit, observes_ends: bool = True, engine: str = "native"
    ) -> ManagerBasedRlEnv:
        env = ManagerBasedRlEnv(ending_config(engine, *edits), device="cpu")
        made.append(env)
        env.observes_ends = observes_ends
        env.reset()
        return env

    yield make_ending
    for env in made:
        env.close()


def steps(env: ManagerBasedRlEnv) -> list[tuple[Any, ...]]:
    """Step with fixed actions; return copies of what each step returns."""
    generator = torch.Generator().manual_seed(0)
    returned = []
    for _ in range(STEPS):
        values = env.step(2.0 * torch.rand(NUM_ENDING, 1, generator=generator) - 1.0)
        returned.append((*(value.clone() for value in values[1:4]), values[0], dict(values[4])))
    return returned


def go_on(cfg: ManagerBasedRlEnvCfg) -> None:
    """Let no episode end."""
    cfg.terminations = {}


def remember(cfg: ManagerBasedRlEnvCfg) -> None:
    """Add delays, histories and a term with state."""
    terms = cfg.observations["actor"].terms
    terms["late"] = ObservationTermCfg(func=joint_pos, delay_min_lag=2, delay_max_lag=2)
    terms["old"] = ObservationTermCfg(func=joint_pos, history_length=3)
    terms["both"] = ObservationTermCfg(
        func=joint_pos, delay_min_lag=1, delay_max_lag=1, history_length=2
    )
    terms["sum"] = ObservationTermCfg(func=Sum)


def disturb(cfg: ManagerBasedRlEnvCfg) -> None:
    """Add noise, random lags and a noise model, and a group that is a dict."""
    terms = cfg.observations["actor"].terms
    terms["pos"].noise = UniformNoiseCfg(n_min=-0.1, n_max=0.1)
    terms["place"].noise = NoiseModelWithAdditiveBiasCfg(
        noise_cfg=GaussianNoiseCfg(std=0.1), bias_noise_cfg=GaussianNoiseCfg(std=1.0)
    )
    terms["random"] = ObservationTermCfg(
        func=joint_pos, delay_max_lag=3, delay_hold_prob=0.3, history_length=2
    )
    terms["shared"] = ObservationTermCfg(func=joint_pos, delay_max_lag=3, delay_per_env=False)
    cfg.observations["other"] = ObservationGroupCfg(
        terms={"sum": ObservationTermCfg(func=Sum)}, concatenate_terms=False
    )


def look_down(cfg: ManagerBasedRlEnvCfg) -> None:
    """Add rays and images that move with the pole, and observe them."""
    cfg.scene.sensors = (
        RayCastSensorCfg(
            name="rays",
            frame=ObjRef(type="body", name="pole_1", entity="cartpole"),
            pattern=GridPatternCfg(size=(0.2, 0.0), resolution=0.2),
            ray_alignment="base",
            max_distance=10.0,
        ),
        CameraSensorCfg(
            name="eye",
            parent_body="cartpole/pole_1",
            pos=(0.0, -1.0, 0.0),
            quat=(0.7071, 0.7071, 0.0, 0.0),
            width=8,
            height=6,
            data_types=("depth",),
        ),
    )
    terms = cfg.observations["actor"].terms
    terms["rays"] = ObservationTermCfg(func=lambda env: env.scene["rays"].data.hit_pos_w.flatten(1))
    terms["image"] = ObservationTermCfg(func=lambda env: env.scene["eye"].data.depth.flatten(1))


def rows(values: Any, ids: Any) -> list[torch.Tensor]:
    """Return rows of observations, group by group."""
    if isinstance(values, dict):
        return [row for value in values.values() for row in rows(value, ids)]
    return [values[ids]]


# Values.


@pytest.mark.parametrize(
    ("engine", "edits"), [("native", ()), ("native", (remember,)), ("warp", (remember,))]
)
def test_final_observations_are_those_of_an_episode_that_goes_on(make_ending, engine, edits):
    ended = steps(make_ending(*edits, engine=engine))
    going_on = steps(make_ending(*edits, go_on, engine=engine))
    for step, ids in ((3, [1]), (5, [3])):
        extras, observations = ended[step][4], ended[step][3]
        assert extras["final_ids"].tolist() == ids
        final = extras["final_observations"]["actor"]
        assert torch.equal(final, going_on[step][3]["actor"][ids])
        # Neither the first observation of the next episode nor the one before the step.
        assert not torch.equal(final, observations["actor"][ids])
        assert not torch.equal(final, ended[step - 1][3]["actor"][ids])


def test_only_steps_in_which_an_episode_runs_out_of_time_have_them(make_ending):
    env = make_ending()
    returned = steps(env)
    # Environment 1 runs out of time again.
    assert [k for k, values in enumerate(returned) if "final_ids" in values[4]] == [3, 5, 7]
    assert [k for k, values in enumerate(returned) if "final_observations" in values[4]] == [
        3,
        5,
        7,
    ]
    env.episode_length_buf[3] = 5
    assert "final_ids" in env.step(torch.zeros(NUM_ENDING, 1))[4]
    assert "final_ids" not in env.reset()[1]


def test_an_episode_that_terminates_when_its_time_is_over_has_none(make_ending):
    def fail_in_time(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.terminations["failed"] = TerminationTermCfg(func=due([99, 4, 99, 99]))

    assert [k for k, v in enumerate(steps(make_ending(fail_in_time))) if "final_ids" in v[4]] == [5]


@pytest.mark.parametrize("by", ["switch", "auto_reset"])
def test_without_the_switch_or_without_auto_reset_there_are_none(make_ending, by):
    def by_hand(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.auto_reset = False

    env = make_ending(observes_ends=False) if by == "switch" else make_ending(by_hand)
    for _ in range(4):
        extras = env.step(torch.zeros(NUM_ENDING, 1))[4]
    assert env.reset_time_outs.any()
    assert "final_ids" not in extras


def test_rays_and_images_are_of_the_state_the_episode_ended_in(make_ending):
    ended, going_on = steps(make_ending(look_down)), steps(make_ending(look_down, go_on))
    for step, ids in ((3, [1]), (5, [3])):
        final = ended[step][4]["final_observations"]["actor"]
        assert torch.equal(final, going_on[step][3]["actor"][ids])
        assert not torch.equal(final[:, -48:], ended[step][3]["actor"][ids, -48:])


def test_what_an_event_placed_in_the_step_is_seen(make_ending):
    def place(env: Any, env_ids: Any) -> None:
        if env.common_step_counter == 4:
            pose = torch.full((2, 2), 0.3)
            cartpole = env.scene["cartpole"]
            cartpole.write_joint_position_to_sim(pose, env_ids=torch.tensor([1, 2]))

    def placing(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.events["place"] = EventTermCfg(func=place, mode="step")

    ended, going_on = steps(make_ending(placing)), steps(make_ending(placing, go_on))
    final = ended[3][4]["final_observations"]["actor"]
    assert torch.allclose(final[:, :2], torch.tensor(0.3))
    assert torch.equal(final, going_on[3][3]["actor"][[1]])


# No trace.


def read_everything(env: Any, env_ids: Any, seen: list[torch.Tensor]) -> torch.Tensor:
    """Curriculum that reads quantities derived from the final state of episodes."""
    values = [pole_place(env), env.sim.data.cvel, env.sim.data.qacc]
    if "rays" in env.scene.sensors:
        values += [env.scene["rays"].data.hit_pos_w.flatten(1), env.scene["eye"].data.depth]
    seen += [value.clone() for value in values]
    return torch.zeros(())


@pytest.mark.parametrize(
    ("engine", "edits"),
    [
        ("native", (remember, disturb)),
        ("native", (disturb, look_down)),
        ("warp", (remember, disturb)),
    ],
)
def test_observing_ends_changes_no_trajectory(make_ending, engine, edits):
    results = []
    for observes_ends in (False, True):
        seen: list[torch.Tensor] = []

        def reading(cfg: ManagerBasedRlEnvCfg, seen: list[torch.Tensor] = seen) -> None:
            cfg.curriculum = {
                "reads": CurriculumTermCfg(func=read_everything, params={"seen": seen})
            }

        env = make_ending(*edits, reading, engine=engine, observes_ends=observes_ends)
        returned = steps(env)
        assert any("final_ids" in values[4] for values in returned) == observes_ends
        flat = [t for values in returned for t in (*values[:3], *rows(values[3], slice(None)))]
        results.append([*flat, *seen, torch.rand(3)])
    assert len(results[0]) == len(results[1])
    assert all(map(torch.equal, *results))


def test_steps_may_come_with_and_without_inference_mode(make_ending):
    class Last(Sum):
        def __call__(self, env: Any) -> torch.Tensor:
            # Kept, made under whatever mode there is, unless the episode has just begun.
            if (env.episode_length_buf == 0).any():
                self.total = env.sim.data.qpos.clone()
            return self.total

    def add(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.observations["actor"].terms["last"] = ObservationTermCfg(func=Last)

    env = make_ending(remember, disturb, look_down, add)
    for step in range(STEPS):
        with torch.inference_mode(step % 2 == 0):
            env.step(torch.zeros(NUM_ENDING, 1))


def test_nothing_more_runs_in_steps_without_a_time_out(make_ending, monkeypatch):
    env = make_ending(go_on)
    monkeypatch.setattr(env.sim, "looking_ahead", None)
    monkeypatch.setattr(env.observation_manager, "preview", None)
    steps(env)
