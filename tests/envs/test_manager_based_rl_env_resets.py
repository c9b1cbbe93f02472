"""State that resets and steps must preserve: caches, targets, recordings, neighbors, timers."""

from __future__ import annotations

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
from mjlab.scene import SceneCfg
from mjlab.sensor import Sensor, SensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg

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


def test_a_sensor_that_a_reward_has_read_is_fresh_in_the_observation_of_the_same_step(make):
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
def test_after_a_reset_position_actuators_hold_the_joints_where_they_were_put(make, actuator, by):
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


def test_episodes_cut_short_by_hand_are_recorded_and_those_not_begun_are_not(make):
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
def test_the_timer_of_a_command_starts_with_the_episode_and_not_a_step_before(make, by):
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
