"""Environment: steps, episodes, checks of its config, and dtypes."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.actuator import BuiltinMotorActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import (
    CommandTerm,
    CommandTermCfg,
    EventTermCfg,
    MetricsTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
)
from mjlab.managers.action_manager import as_action
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.tasks.registry import load_env_cfg

NUM_ENVS = 6


def cartpole(edit: Callable[[ManagerBasedRlEnvCfg], None] | None = None) -> ManagerBasedRlEnvCfg:
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 5, "native"
    if edit is not None:
        edit(cfg)
    return cfg


@pytest.fixture
def make():
    """Return a function that makes an environment, reset and ready to step."""
    made: list[ManagerBasedRlEnv] = []

    def make(edit: Callable[[ManagerBasedRlEnvCfg], None] | None = None) -> ManagerBasedRlEnv:
        env = ManagerBasedRlEnv(cartpole(edit), device="cpu")
        made.append(env)
        env.reset()
        return env

    yield make
    for env in made:
        env.close()


def actions(steps: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 2.0 * torch.rand(steps, NUM_ENVS, 1, generator=generator) - 1.0


def run(env: ManagerBasedRlEnv, steps: int) -> torch.Tensor:
    rows = []
    for action in actions(steps):
        observations, reward, terminated, truncated, _ = env.step(action)
        flags = (terminated[:, None].float(), truncated[:, None].float())
        rows.append(torch.cat([observations["actor"], reward[:, None], *flags], dim=1))
    return torch.stack(rows)


def joint_pos(env: Any) -> torch.Tensor:
    return env.sim.data.qpos[:, 0].clone()


def cart_pos(env: Any) -> torch.Tensor:
    """Cart position along the rail, derived from the joint position."""
    body = env.sim.mj_model.body("cartpole/cart").id
    return env.sim.data.xpos[:, body, 0].clone()


# The order.


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_terms_with_networks_need_no_gradients(make, engine):
    network = torch.nn.Linear(1, 1)
    torch.nn.init.constant_(network.weight, 2.0)
    torch.nn.init.constant_(network.bias, 0.0)

    def cart(env):
        return env.sim.data.qpos[:, :1].clone()

    def place(env, env_ids):
        env.sim.data.qpos[env_ids, 0] = network(torch.full((len(env_ids), 1), 0.1))[:, 0]

    def learned(cfg):
        cfg.sim.engine = engine
        cfg.events["place"] = EventTermCfg(func=place, mode="reset")
        cfg.rewards = {"net": RewardTermCfg(lambda env: network(cart(env))[:, 0], weight=1.0)}
        cfg.metrics = {"net": MetricsTermCfg(lambda env: network(cart(env))[:, 0])}
        cfg.observations["critic"].terms["net"] = ObservationTermCfg(
            lambda env: network(cart(env)), history_length=2
        )

    env = make(learned)
    assert torch.allclose(cart(env), torch.tensor(0.2))
    for _ in range(3):
        observations, reward, *_ = env.step(torch.zeros(NUM_ENVS, 1))
    assert torch.allclose(reward, 2.0 * cart(env)[:, 0] * env.step_dt, atol=1e-6)
    assert torch.equal(observations["critic"][:, -1:], 2.0 * cart(env))
    # Also where a user writes between two steps.
    env.sim.data.qpos[:, 0] = network(torch.full((NUM_ENVS, 1), 0.2))[:, 0]
    env.sim.forward()
    env.step(torch.zeros(NUM_ENVS, 1))
    assert torch.allclose(cart(env), torch.tensor(0.4), atol=1e-2)


def test_the_parts_of_a_step_come_in_their_order(make):
    calls: list[str] = []

    def log(name: str, value: Callable[[Any], Any]) -> Callable[..., Any]:
        def term(env, env_ids=None):
            calls.append(name)
            return value(env)

        return term

    def zeros(env):
        return torch.zeros(env.num_envs)

    def edit(cfg):
        cfg.terminations["t"] = TerminationTermCfg(func=log("termination", lambda e: zeros(e) > 0))
        cfg.rewards["r"] = RewardTermCfg(func=log("reward", zeros), weight=1.0)
        cfg.metrics["m"] = MetricsTermCfg(func=log("metric", zeros))
        cfg.events["s"] = EventTermCfg(func=log("step event", lambda e: None), mode="step")
        cfg.events["e"] = EventTermCfg(func=log("reset event", lambda e: None), mode="reset")
        observed = ObservationTermCfg(func=log("observation", lambda e: zeros(e)[:, None]))
        cfg.observations["extra"] = ObservationGroupCfg(terms={"o": observed})

    env = make(edit)
    calls.clear()
    env.step(actions(1)[0])
    assert calls == ["termination", "reward", "metric", "step event", "observation"]
    calls.clear()
    env.episode_length_buf[:] = env.max_episode_length - 1
    env.step(actions(1)[0])
    assert calls == [
        "termination", "reward", "metric", "step event", "reset event", "observation",
    ]  # fmt: skip


def test_rewards_lag_one_substep_and_observations_none(make):
    def edit(cfg):
        cfg.rewards = {
            "joint": RewardTermCfg(func=joint_pos, weight=1.0),
            "body": RewardTermCfg(func=cart_pos, weight=1.0),
        }
        terms = {
            "joint": ObservationTermCfg(func=lambda env: joint_pos(env)[:, None]),
            "body": ObservationTermCfg(func=lambda env: cart_pos(env)[:, None]),
        }
        cfg.observations["extra"] = ObservationGroupCfg(terms=terms)
        cfg.scale_rewards_by_dt = False

    env = make(edit)
    for action in actions(4):
        observations, *_ = env.step(action)
        joint, body = (env.reward_manager._step_reward[:, index] for index in range(2))
        velocity = env.sim.data.qvel[:, 0]
        assert (joint != body).any()
        # One substep at the velocity of the end, because the integrator is semi-implicit.
        torch.testing.assert_close(joint - body, velocity * env.physics_dt, atol=2e-6, rtol=1e-4)
        current = observations["extra"]
        torch.testing.assert_close(current[:, 0], current[:, 1], atol=1e-6, rtol=0)


@pytest.mark.parametrize("looks_between", [False, True])
def test_first_rewards_lag_as_later_ones(make, looks_between):
    # A field that nothing else reads, so that the reward of the first step is the first to do so.
    def center_of_mass(env):
        return env.sim.data.subtree_com[:, -1, 0].clone()

    def edit(cfg):
        cfg.rewards = {"body": RewardTermCfg(func=center_of_mass, weight=1.0)}
        if looks_between:
            cfg.metrics["between"] = MetricsTermCfg(func=joint_pos, per_substep=True)

    env = make(edit)
    rewards = []
    for _ in range(2):
        env.reset(seed=3)
        rewards.append(env.step(actions(1)[0])[1].clone())
    assert rewards[0].abs().min() > 0.0
    assert torch.equal(rewards[0], rewards[1])


def test_one_dispatch_for_all_substeps_gives_the_bits_of_one_for_each(make):
    together = make()
    assert together._steps_as_one
    one_by_one = make()
    one_by_one._steps_as_one = False
    assert torch.equal(run(together, 8), run(one_by_one, 8))


def delay_the_actuator(cfg: ManagerBasedRlEnvCfg) -> None:
    robot = next(iter(cfg.scene.entities.values()))
    for actuator in robot.articulation.actuators:
        actuator.delay_max_lag = 2


def test_an_actuator_with_a_delay_acts_in_every_substep(make):
    assert make(delay_the_actuator)._acts_between_substeps


# Episodes.


def test_a_time_limit_truncates_and_a_failure_terminates(make):
    def edit(cfg):
        cfg.episode_length_s = 0.15
        failed = lambda env: env.episode_length_buf * (torch.arange(NUM_ENVS) == 2) == 2  # noqa: E731
        cfg.terminations["failed"] = TerminationTermCfg(func=failed)

    env = make(edit)
    expected = torch.zeros(3, NUM_ENVS)
    expected[1, 2] = 1
    rows = run(env, 3)
    assert torch.equal(rows[:, :, -2], expected)
    expected = torch.zeros(3, NUM_ENVS)
    expected[2] = 1
    expected[2, 2] = 0
    assert torch.equal(rows[:, :, -1], expected)


def test_an_environment_that_is_done_starts_anew_in_the_same_step(make):
    env = make()
    run(env, 5)
    env.episode_length_buf[3] = env.max_episode_length - 1
    observations, _, _, truncated, extras = env.step(actions(1)[0])
    assert truncated.tolist() == [False] * 3 + [True] + [False] * 2
    assert env.episode_length_buf.tolist() == [6, 6, 6, 0, 6, 6]
    # Observations belong to the new episode: the cart near the middle, the pole hanging.
    assert abs(observations["actor"][3, 0]) <= 0.1
    assert observations["actor"][3, 1].item() == pytest.approx(-1.0, abs=1e-3)
    assert any(name.startswith("Episode_") for name in extras["log"])


def test_without_auto_reset_users_reset(make):
    env = make(lambda cfg: setattr(cfg, "auto_reset", False))
    env.episode_length_buf[3] = env.max_episode_length - 1
    before = env.sim.data.qpos[3].clone()
    _, _, _, truncated, _ = env.step(actions(1)[0])
    assert truncated[3]
    assert env.episode_length_buf[3] == env.max_episode_length
    assert not torch.equal(env.sim.data.qpos[3], before), "its last state is there to be read"
    with pytest.raises(
        RuntimeError, match=r"environments \[3\].*reset\(env_ids=\.\.\.\).*auto_reset=True"
    ):
        env.step(actions(1)[0])
    env.reset(env_ids=torch.tensor([3]))
    env.step(actions(1)[0])
    assert env.episode_length_buf.tolist() == [2, 2, 2, 1, 2, 2]


@pytest.mark.parametrize(
    "ids", [torch.tensor([1, 4]), torch.tensor([False, True, False, False, True, False])]
)
def test_environments_to_reset_are_indices_or_a_mask(make, ids):
    env = make()
    run(env, 3)
    env.reset(env_ids=ids)
    assert env.episode_length_buf.tolist() == [3, 0, 3, 3, 0, 3]


@settings(max_examples=200)
@given(steps=st.integers(1, 5000), decimation=st.integers(1, 20), timestep=st.integers(1, 20))
def test_an_episode_has_as_many_steps_as_its_length_says(steps, decimation, timestep):
    class Env:
        step_dt = decimation * (timestep / 1000)
        max_episode_length_s = steps * (decimation * timestep / 1000)

    length = ManagerBasedRlEnv.max_episode_length.fget(Env())  # ty: ignore
    assert length == steps
    Env.max_episode_length_s += 0.5 * Env.step_dt
    assert ManagerBasedRlEnv.max_episode_length.fget(Env()) == steps + 1  # ty: ignore


# Rewards.


def test_rewards_are_scaled_by_the_step(make):
    scaled = run(make(), 4)[:, :, 5]
    plain = run(make(lambda cfg: setattr(cfg, "scale_rewards_by_dt", False)), 4)[:, :, 5]
    torch.testing.assert_close(scaled, plain * 0.05)


@pytest.mark.parametrize("kind", ["rewards", "terminations", "events", "metrics", "commands"])
def test_a_term_that_is_none_is_off(make, kind):
    def edit(cfg):
        getattr(cfg, kind)["off"] = None

    assert torch.equal(run(make(edit), 3), run(make(), 3))


# Seeds.


def test_a_seed_that_was_not_given_is_drawn_and_kept():
    env = ManagerBasedRlEnv(cartpole(lambda cfg: setattr(cfg, "seed", None)), device="cpu")
    assert isinstance(env.cfg.seed, int)
    env.close()


def test_the_bits_do_not_depend_on_the_number_of_physics_threads(make):
    runs = [run(make(lambda cfg, n=n: setattr(cfg.sim, "num_threads", n)), 6) for n in (1, 2, 3)]
    assert torch.equal(runs[0], runs[1])
    assert torch.equal(runs[0], runs[2])


def test_an_environment_alone_moves_as_among_others(make):
    def keep_still(cfg):
        cfg.events = {"reset": EventTermCfg(func=mdp.reset_scene_to_default, mode="reset")}

    def alone(cfg):
        keep_still(cfg)
        cfg.scene.num_envs = 1

    among = make(keep_still)
    single = make(alone)
    for action in actions(5):
        many = among.step(action)[0]["actor"]
        one = single.step(action[:1])[0]["actor"]
        assert torch.equal(many[:1], one)


# Errors and descriptions.


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda cfg: setattr(cfg.scene, "num_envs", 0), "num_envs.*0"),
        (lambda cfg: setattr(cfg.scene, "num_envs", -4), "num_envs.*-4"),
        (lambda cfg: setattr(cfg, "decimation", 0), "decimation.*0"),
        (lambda cfg: setattr(cfg.sim.mujoco, "timestep", 0.0), "timestep.*0.0"),
        (lambda cfg: setattr(cfg.sim.mujoco, "timestep", math.nan), "timestep.*nan"),
        (lambda cfg: setattr(cfg.sim, "engine", "magic"), "engine.*'magic'"),
        (lambda cfg: setattr(cfg.sim, "num_threads", -1), "num_threads"),
    ],
)
def test_a_config_that_cannot_work_is_refused_by_name(edit, words):
    with pytest.raises(ValueError, match=words):
        ManagerBasedRlEnv(cartpole(edit), device="cpu")


def test_a_config_without_terms_is_an_environment_that_only_moves():
    cfg = cartpole()
    bare = ManagerBasedRlEnvCfg(decimation=2, scene=cfg.scene, seed=1, episode_length_s=1.0)
    env = ManagerBasedRlEnv(bare, device="cpu")
    env.reset()
    _, reward, terminated, truncated, _ = env.step(torch.zeros(NUM_ENVS, 0))
    assert (reward == 0).all()
    assert not (terminated | truncated).any()
    env.close()


def test_spaces_have_the_shapes_of_what_is_returned(make):
    env = make()
    observations, *_ = env.step(actions(1)[0])
    for name, group in observations.items():
        assert env.observation_space.spaces[name].shape == group.shape
        assert env.single_observation_space.spaces[name].shape == group.shape[1:]
    assert env.action_space.shape == (NUM_ENVS, 1)
    assert env.metadata["render_fps"] == pytest.approx(20.0)
    assert env.unwrapped is env


def test_render_modes(make):
    assert make().render() is None
    env = ManagerBasedRlEnv(cartpole(), device="cpu", render_mode="hologram")
    with pytest.raises(NotImplementedError, match=r"'hologram'.*'rgb_array'"):
        env.render()
    env.close()


def test_the_state_of_another_number_of_environments_is_refused(make):
    state = make().state_dict()
    other = make(lambda cfg: setattr(cfg.scene, "num_envs", 2))
    with pytest.raises(ValueError, match=f"expected 2 .*got {NUM_ENVS}.*--num-envs {NUM_ENVS}"):
        other.load_state_dict(state)


# Checks of the config.


@pytest.fixture(scope="module")
def env():
    env = ManagerBasedRlEnv(cartpole(), device="cpu")
    env.reset()
    yield env
    env.close()


# The config.


@pytest.mark.parametrize("value", [0, 2.5, "4"])
def test_decimation_is_a_count(value):
    cfg = cartpole()
    cfg.decimation = value
    with pytest.raises(ValueError, match="decimation.*expected an integer >= 1"):
        ManagerBasedRlEnv(cfg, device="cpu")


@pytest.mark.parametrize("length", [1e9, math.inf])
def test_an_episode_may_last_for_decades(length):
    cfg = cartpole()
    cfg.episode_length_s, cfg.decimation = length, 1
    if length == math.inf:
        cfg.terminations = {}
    env = ManagerBasedRlEnv(cfg, device="cpu")
    assert "without limit" in str(env)
    env.reset()
    assert not env.step(torch.zeros(NUM_ENVS, 1))[3].any()
    env.close()


def test_counts_of_numpy():
    cfg = cartpole()
    cfg.decimation, cfg.scene.num_envs = np.int32(2), np.int32(3)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    assert env.reset()[0]["actor"].shape[0] == 3
    env.close()


# The device.


def test_without_a_device_there_is_a_default(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    env = ManagerBasedRlEnv(cartpole(), device=None)  # ty: ignore
    assert env.device == env.reset()[0]["actor"].device.type == "cpu"
    env.close()


@pytest.mark.parametrize("length", [0.0, -1.0])
@pytest.mark.parametrize("limited", [False, True])
def test_a_time_limit_needs_an_episode_length(length, limited):
    limit = {"t": TerminationTermCfg(func=mdp.time_out, time_out=True)} if limited else {}
    cfg = cartpole()
    cfg.episode_length_s, cfg.terminations = length, limit
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        env = ManagerBasedRlEnv(cfg, device="cpu")
    assert sum("episode_length_s" in str(w.message) for w in seen) == limited
    env.reset()
    truncated = env.step(torch.zeros(NUM_ENVS, 1))[3]
    assert truncated.tolist() == [limited] * NUM_ENVS
    env.close()


# Actions.


def test_arrays_and_lists_act_as_tensors_do(env):
    action = torch.linspace(-1.0, 1.0, NUM_ENVS)[:, None]
    array = action.double().numpy()
    array.flags.writeable = False
    for form in (action, array, action.numpy(), action.tolist()):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.step(form)
        torch.testing.assert_close(env.action_manager.action, action)
    assert as_action([[1]], "cpu").dtype == torch.float32


def test_an_array_is_copied():
    array = np.zeros((2, 1), dtype=np.float32)
    action = as_action(array, "cpu")
    array[:] = 1.0
    assert (action == 0.0).all()


@pytest.mark.parametrize("action", [None, "left", {"a": 1}, [[1.0], [1.0, 2.0]], object()])
def test_an_action_of_no_numbers_is_refused(env, action):
    with pytest.raises((TypeError, ValueError)):
        env.step(action)


def test_an_array_of_another_shape_is_refused(env):
    with pytest.raises(ValueError, match=r"expected shape \(6, 1\).*got \(6, 2\)"):
        env.step(np.zeros((NUM_ENVS, 2)))


# Environments to reset.


@pytest.mark.parametrize(
    ("env_ids", "expected"),
    [
        (None, [0, 1, 2, 3, 4, 5]),
        (slice(4, None), [4, 5]),
        (3, [3]),
        ([], []),
        ([5, 0], [5, 0]),
        (torch.tensor([-1, 2], dtype=torch.int32), [5, 2]),
        (np.array([1, 2]), [1, 2]),
        (torch.tensor([True, False, False, True, False, False]), [0, 3]),
    ],
)
def test_reset_ids(env, env_ids, expected):
    env.step(torch.zeros(NUM_ENVS, 1))
    env.reset(env_ids=env_ids)
    assert (env.episode_length_buf == 0).nonzero().flatten().tolist() == sorted(expected)


@pytest.mark.parametrize(
    "env_ids", [[0, 6], torch.tensor([-7]), torch.ones(5, dtype=torch.bool), torch.tensor([1.5])]
)
def test_a_wrong_reset_changes_nothing(env, env_ids):
    env.step(torch.zeros(NUM_ENVS, 1))
    before, state = env.episode_length_buf.clone(), torch.get_rng_state()
    with pytest.raises(IndexError):
        env.reset(env_ids=env_ids, seed=3)
    assert torch.equal(env.episode_length_buf, before)
    assert torch.equal(torch.get_rng_state(), state), "no generator may be reseeded"


# Odd terms.


def odd(match, *, reset=True, **fields):
    """Return the warnings that match while a Go1 environment is built and reset."""
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    cfg.scene.num_envs = 1
    for name, value in fields.items():
        setattr(cfg, name, value)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        env = ManagerBasedRlEnv(cfg, device="cpu")
        if reset:
            env.reset()
            env.reset()
        env.close()
    return [str(w.message) for w in seen if match in str(w.message)]


@pytest.mark.parametrize(
    ("time_out", "finite", "count"), [(False, False, 1), (True, False, 0), (False, True, 0)]
)
def test_a_time_limit_that_counts_as_failure_warns(time_out, finite, count):
    terms = {"limit": TerminationTermCfg(func=mdp.time_out, time_out=time_out)}
    seen = odd("'limit'", reset=False, terminations=terms, is_finite_horizon=finite)
    assert len(seen) == count


@pytest.mark.parametrize(
    ("shortest", "global_time", "limited", "count"),
    [(1.5, False, True, 1), (1.0, False, True, 0), (1.5, True, True, 0), (1.5, False, False, 0)],
)
def test_an_interval_that_episodes_do_not_reach_warns(shortest, global_time, limited, count):
    fired = []
    event = EventTermCfg(
        func=lambda env, env_ids: fired.append(env_ids),
        mode="interval",
        interval_range_s=(shortest, 2.0),
        is_global_time=global_time,
    )
    limit = {"limit": TerminationTermCfg(func=mdp.time_out, time_out=True)}
    seen = odd(
        "['late'] interval_range_s",
        events={"late": event},
        episode_length_s=1.0,
        terminations=limit if limited else {},
    )
    assert len(seen) == count


def test_episodes_without_reset_events_warn_once():
    parts = {"commands": {}, "rewards": {}, "observations": {}, "curriculum": {}, "metrics": {}}
    assert len(odd("mode 'reset'", events={}, reset=False, **parts)) == 1
    push = EventTermCfg(func=lambda env, env_ids: None, mode="step")
    assert len(odd("mode 'reset'", events={"push": push}, reset=False, **parts)) == 1
    start = EventTermCfg(func=mdp.reset_scene_to_default, mode="reset")
    assert odd("mode 'reset'", events={"start": start}) == []


class PlaceCfg(CommandTermCfg):
    def build(self, env):
        return Place(self, env)


class Place(CommandTerm):
    """Command that starts the robot at a frame of a motion."""

    command = None

    def _resample_command(self, env_ids):
        robot = self._env.scene["robot"]
        robot.write_joint_state_to_sim(
            robot.data.default_joint_pos[env_ids],
            robot.data.default_joint_vel[env_ids],
            env_ids=env_ids,
        )


def test_a_command_may_start_episodes():
    commands = {"motion": PlaceCfg(resampling_time_range=(9.0, 9.0))}
    parts = {"rewards": {}, "observations": {}, "curriculum": {}, "metrics": {}}
    assert odd("mode 'reset'", events={}, commands=commands, **parts) == []


# Float types.


NUM_TYPED = 3


@pytest.fixture
def double() -> Iterator[None]:
    """Make float64 torch's default type."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def rollout(task: str, engine: Any, dtype: torch.dtype) -> list[torch.Tensor]:
    """Return what five steps under a default type give, one reset by a time-out among them."""
    torch.set_default_dtype(dtype)
    try:
        cfg = load_env_cfg(task)
        cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_TYPED, 3, engine
        ones = torch.ones  # Called at every step, in the default type.
        cfg.observations["actor"].terms["own"] = ObservationTermCfg(
            func=lambda env: ones(env.num_envs, 2)
        )
        cfg.rewards["own"] = RewardTermCfg(func=lambda env: ones(env.num_envs), weight=1.0)
        env = ManagerBasedRlEnv(cfg, device="cpu")
        observations, _ = env.reset()
        results = list(observations.values())
        actions = np.random.default_rng(0).uniform(
            -1, 1, (5, NUM_TYPED, *env.action_space.shape[1:])
        )
        for step, action in enumerate(actions):
            if step == 2:
                env.episode_length_buf[1] = env.max_episode_length
            observations, reward, *_ = env.step(torch.tensor(action, dtype=dtype))
            results += [*observations.values(), reward, env.sim.data.qpos.clone()]
        env.close()
    finally:
        torch.set_default_dtype(torch.float32)
    return results


@pytest.mark.parametrize(
    ("task", "engine"),
    [
        ("Mjlab-Velocity-Rough-Unitree-Go1", "native"),
        pytest.param("Mjlab-Lift-Cube-Yam", "native", marks=pytest.mark.slow),
        pytest.param("Mjlab-Lift-Cube-Yam-Depth", "native", marks=pytest.mark.slow),
        pytest.param("Mjlab-Lift-Cube-Yam-Rgb", "native", marks=pytest.mark.slow),
        pytest.param("Mjlab-Multi-Cube-Seg-Yam", "native", marks=pytest.mark.slow),
        ("Mjlab-Cartpole-Swingup", "native"),
        pytest.param("Mjlab-Cartpole-Swingup", "warp", marks=pytest.mark.slow),
    ],
)
def test_a_rollout_is_the_same_under_default_float64(task: str, engine: str):
    single, double = (rollout(task, engine, dtype) for dtype in (torch.float32, torch.float64))
    for expected, found in zip(single, double, strict=True):
        assert found.dtype == expected.dtype == torch.float32
        assert torch.equal(found, expected)


XML = """
<mujoco>
  <worldbody>
    <body name="base" {mocap}>
      {root}
      <geom size=".1"/>
      <body pos="0 0 1"><joint name="j"/><geom size=".1"/>
        <body pos="0 0 1"><joint name="k"/><geom size=".1"/><site name="s"/></body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
</mujoco>
"""


def make_entity(floating: bool) -> Any:
    xml = XML.format(mocap="", root="<freejoint/>" if floating else "")
    motors = tuple(
        BuiltinMotorActuatorCfg(target_names_expr=names, transmission_type=kind, effort_limit=9.0)
        for names, kind in ((("j", "k"), "joint"), (("t",), "tendon"), (("s",), "site"))
    )
    cfg = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(xml),
        articulation=EntityArticulationInfoCfg(actuators=motors),
    )
    scene = Scene(SceneCfg(num_envs=NUM_TYPED, entities={"robot": cfg}), device="cpu")
    sim = Simulation(NUM_TYPED, SimulationCfg(), spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    return scene["robot"]


# By name: the width of its values, and the data or target that it writes.
WRITERS = {
    "write_root_state_to_sim": (13, "qpos"),
    "write_root_link_pose_to_sim": (7, "qpos"),
    "write_root_link_velocity_to_sim": (6, "qvel"),
    "write_root_link_velocity_b_to_sim": (6, "qvel"),
    "write_root_com_velocity_to_sim": (6, "qvel"),
    "write_joint_position_to_sim": (2, "qpos"),
    "write_joint_velocity_to_sim": (2, "qvel"),
    "write_ctrl_to_sim": (4, "ctrl"),
    "write_mocap_pose_to_sim": (7, "mocap_pos"),
    "set_joint_position_target": (2, "joint_pos_target"),
    "set_joint_velocity_target": (2, "joint_vel_target"),
    "set_joint_effort_target": (2, "joint_effort_target"),
    "set_tendon_len_target": (1, "tendon_len_target"),
    "set_tendon_vel_target": (1, "tendon_vel_target"),
    "set_tendon_effort_target": (1, "tendon_effort_target"),
    "set_site_effort_target": (1, "site_effort_target"),
}


@pytest.mark.parametrize("env_ids", [None, torch.tensor([2, 0])], ids=("all", "some"))
@pytest.mark.parametrize("convert", [torch.from_numpy, np.asarray, np.ndarray.tolist])
@pytest.mark.parametrize("name", WRITERS)
def test_writers_take_values_of_any_float_type(name: str, convert: Any, env_ids: Any):
    entity = make_entity(floating="mocap" not in name)
    width, written = WRITERS[name]
    rows = NUM_TYPED if env_ids is None else len(env_ids)
    values = np.random.default_rng(1).normal(size=(rows, width))

    def field() -> torch.Tensor:
        source = entity.data if "target" in written else entity.data.data
        return getattr(source, written)

    before = field().clone()
    getattr(entity, name)(convert(values), env_ids=env_ids)
    found = field().clone()
    field().copy_(before)
    getattr(entity, name)(torch.from_numpy(values).float(), env_ids=env_ids)
    assert found.dtype == torch.float32
    assert not torch.equal(found, before)
    torch.testing.assert_close(found, field(), rtol=1e-6, atol=1e-6)


def test_wrenches_take_float64(double):
    entity = make_entity(floating=True)
    force = np.arange(NUM_TYPED * 9.0).reshape(NUM_TYPED, 3, 3)
    entity.write_external_wrench_to_sim(force, torch.zeros(NUM_TYPED, 3, 3))
    found = entity.data.body_external_force
    assert found.dtype == torch.float32
    np.testing.assert_array_equal(found.numpy(), force)


def test_environments_need_no_compiler() -> None:
    # Its import takes 1 s.
    code = (
        "import sys, torch\n"
        "from mjlab.envs import ManagerBasedRlEnv\n"
        "from mjlab.tasks.registry import load_env_cfg\n"
        "cfg = load_env_cfg('Mjlab-Cartpole-Swingup')\n"
        "cfg.observations['actor'].terms['cart_vel'].scale = 0.5\n"
        "env = ManagerBasedRlEnv(cfg, device='cpu')\n"
        "env.reset()\n"
        "env.step(torch.zeros(1, 1))\n"
        "loaded = [name for name in ('torch._dynamo', 'sympy') if name in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
