"""Checks and conversions of an environment's arguments."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv, mdp
from mjlab.managers import (
    CommandTerm,
    CommandTermCfg,
    EventTermCfg,
    TerminationTermCfg,
)
from mjlab.managers.action_manager import as_action
from mjlab.tasks.registry import load_env_cfg

NUM_ENVS = 6


def cartpole():
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 5, "native"
    return cfg


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


def test_an_episode_may_last_for_decades():
    cfg = cartpole()
    cfg.episode_length_s, cfg.decimation = 1e9, 1
    env = ManagerBasedRlEnv(cfg, device="cpu")
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
    for given in (action, array, action.numpy(), action.tolist()):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.step(given)
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
