"""Environments with Gymnasium's vector interface, and in Gymnasium's registry."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium")

from rl_ending_env import TASK, ends  # noqa: E402

import mjlab.gymnasium  # noqa: E402
from mjlab.envs import ManagerBasedRlEnv  # noqa: E402
from mjlab.managers import (  # noqa: E402
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
)
from mjlab.rl import check_vector_env, gymnasium_env  # noqa: E402
from mjlab.rl.gymnasium_vector import step_env  # noqa: E402
from mjlab.tasks.registry import list_tasks, load_env_cfg  # noqa: E402

NUM_ENVS = 3
Edit = Callable[[Any], None]


def end_soon(cfg: Any) -> None:
    """End environment 0 by a failure after 3 steps, and 1 by time after 5."""
    ends(cfg, failed=[3, 99, 99], time_out=[99, 5, 99])


def go_on(cfg: Any) -> None:
    cfg.episode_length_s, cfg.terminations = 100.0, {}


def clip(cfg: Any) -> None:
    cfg.observations["clipped"] = ObservationGroupCfg(
        terms={
            "pos": ObservationTermCfg(
                func=lambda env: env.sim.data.qpos[:, :2],
                clip=(-0.5, 1.0),
                scale=(2.0, -1.0),
                history_length=2,
            ),
            "vel": ObservationTermCfg(func=lambda env: env.sim.data.qvel[:, :1]),
        }
    )


@pytest.fixture
def make() -> Iterator[Callable[..., Any]]:
    made = []

    def make(*edits: Edit, **kwargs: Any) -> Any:
        cfg = load_env_cfg(TASK)
        cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 5, "native"
        for edit in edits:
            edit(cfg)
        made.append(gymnasium_env(ManagerBasedRlEnv(cfg, device="cpu"), **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()


def trajectory(env: Any, steps: int, seed: int = 1) -> list[tuple[Any, ...]]:
    """Reset, and step with fixed actions; return what each step returns."""
    env.reset(seed=seed)
    draws = np.random.default_rng(0)
    return [env.step(draws.uniform(-1, 1, (NUM_ENVS, 1)).astype("f")) for _ in range(steps)]


def test_what_it_returns_is_what_the_environment_returns(make):
    returned = trajectory(make(end_soon), 8)
    env = make(end_soon).env
    env.reset(seed=1)
    draws = np.random.default_rng(0)
    for observations, *arrays, _ in returned:
        action = torch.tensor(draws.uniform(-1, 1, (NUM_ENVS, 1)), dtype=torch.float32)
        expected, *tensors, _ = env.step(action)
        assert observations.keys() == expected.keys()
        assert all(np.array_equal(observations[name], expected[name]) for name in expected)
        assert all(map(np.array_equal, arrays, tensors))


def test_final_observations_are_those_of_episodes_that_go_on(make):
    ended, going_on = trajectory(make(end_soon), 5), trajectory(make(go_on), 5)
    for step, row in ((2, 0), (4, 1)):
        infos = ended[step][4]
        wanted = np.arange(NUM_ENVS) == row
        assert np.array_equal(infos["_final_obs"], wanted)
        assert [value is not None for value in infos["final_obs"]] == wanted.tolist()
        for name, value in infos["final_obs"][row].items():
            assert np.array_equal(value, going_on[step][0][name][row])
            assert not np.array_equal(value, ended[step][0][name][row])
        rewards = [values[1][row] for values in ended[: step + 1]]
        assert infos["final_info"]["episode_return"][row] == pytest.approx(sum(rewards))
        assert infos["final_info"]["episode_length"][row] == step + 1
    assert [ended[2][k].tolist() for k in (2, 3)] == [[True, False, False], [False] * 3]
    assert [ended[4][k].tolist() for k in (2, 3)] == [[False] * 3, [False, True, False]]
    assert not ended[0][4]


def test_an_episode_whose_physics_diverges_ends_with_what_was_seen_before(make):
    env = make(go_on)
    before = trajectory(env, 2)[-1][0]
    env.env.sim.data.qvel[1] = float("nan")
    *_, infos = env.step(np.zeros((NUM_ENVS, 1), "f"))
    assert infos["_final_obs"].tolist() == [False, True, False]
    for name, value in infos["final_obs"][1].items():
        assert np.array_equal(value, before[name][1])


def test_a_step_before_any_reset_is_refused(make):
    with pytest.raises(RuntimeError, match="expected an environment that was reset"):
        make(group="actor").step(np.zeros((NUM_ENVS, 1), "f"))


def test_time_that_is_part_of_the_task_ends_episodes_for_good(make):
    def finite(cfg: Any) -> None:
        cfg.is_finite_horizon = True

    _, _, terminated, truncated, _ = trajectory(make(end_soon, finite), 5)[-1]
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()


def test_without_auto_reset_a_mask_says_what_is_reset(make):
    def by_hand(cfg: Any) -> None:
        cfg.auto_reset = False

    env = make(end_soon, by_hand)
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.DISABLED
    *_, terminated, _, infos = trajectory(env, 3)[-1]
    assert terminated.tolist() == [True, False, False]
    assert not infos
    env.reset(options={"reset_mask": terminated})
    assert env.env.episode_length_buf.tolist() == [0, 3, 3]
    check_vector_env(env, steps=12)
    with pytest.raises(ValueError, match=r"expected \(3,\) bool, got \(3,\) int64"):
        env.reset(options={"reset_mask": np.array([1, 0, 0])})
    with pytest.raises(ValueError, match="expected a seed or a reset_mask, got both"):
        env.reset(seed=1, options={"reset_mask": terminated})


def test_spaces_have_the_bounds_of_clipped_terms_and_actions(make):
    env = make(clip, group="clipped", clip_actions=2.0)
    assert env.single_action_space.high.tolist() == [2.0]
    space = env.single_observation_space
    assert space.low.tolist() == [-1.0, -1.0, -1.0, -1.0, -np.inf]
    assert space.high.tolist() == [2.0, 0.5, 2.0, 0.5, np.inf]
    assert env.observation_space.shape == (NUM_ENVS, 5)
    everything = make(clip)
    assert set(everything.single_observation_space) == {"actor", "critic", "clipped"}
    assert np.isinf(everything.action_space.high).all()


def test_actions_are_clipped(make):
    limited, free = make(go_on, clip_actions=0.5), make(go_on)
    results = []
    for env, action in ((limited, 3.0), (free, 0.5)):
        env.reset(seed=2)
        results.append(env.step(np.full((NUM_ENVS, 1), action, "f"))[0]["actor"])
    assert np.array_equal(*results)


def test_a_seed_starts_curricula_over(make):
    def harder(env: Any, env_ids: Any) -> torch.Tensor:
        """Push harder with every reset of an episode."""
        term = env.event_manager.get_term_cfg("kick")
        term.params["speed"] += 0.1
        return torch.zeros(())

    def kick(env: Any, env_ids: Any, speed: float) -> None:
        env.sim.data.qvel[env_ids, 1] = speed

    def grow(cfg: Any) -> None:
        cfg.events["kick"] = EventTermCfg(func=kick, mode="reset", params={"speed": 0.0})
        cfg.curriculum = {"harder": CurriculumTermCfg(func=harder)}

    env = make(end_soon, grow, group="actor")
    first = trajectory(env, 7)
    for other in (trajectory(env, 7), trajectory(env, 7)):
        for one, two in zip(first, other, strict=True):
            assert np.array_equal(one[0], two[0])
    assert not np.array_equal(trajectory(env, 7, seed=2)[0][0], first[0][0])


def test_tensors_may_be_returned(make):
    one, other = trajectory(make(end_soon, group="actor"), 4), []
    env = make(end_soon, group="actor", tensors=True)
    check_vector_env(env, steps=12)
    other = trajectory(env, 4)
    for arrays, tensors in zip(one, other, strict=True):
        for array, tensor in zip(arrays[:4], tensors[:4], strict=True):
            assert isinstance(tensor, torch.Tensor)
            assert np.array_equal(array, tensor)
    assert isinstance(other[2][4]["final_obs"][0], torch.Tensor)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"group": "policy"}, r"expected one of \['actor', 'critic'\], got 'policy'"),
        ({"clip_actions": 0.0}, "clip_actions.*0.0"),
    ],
)
def test_wrong_arguments_are_refused(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_gymnasiums_own_wrappers_take_it(make):
    env = gymnasium.wrappers.vector.RescaleAction(make(end_soon, clip_actions=1.0), -2.0, 2.0)
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    env.reset(seed=1)
    for _ in range(3):
        *_, infos = env.step(np.zeros((NUM_ENVS, 1), "f"))
    assert infos["episode"]["l"][0] == 3
    assert infos["episode"]["r"][0] == pytest.approx(infos["final_info"]["episode_return"][0])


# The registry.


def test_every_task_is_in_the_registry():
    assert {f"mjlab/{task}" for task in list_tasks()} <= set(gymnasium.registry)


@pytest.mark.slow
def test_a_task_is_made_by_its_name_alone():
    code = (
        "import gymnasium, numpy as np, warnings\n"
        "warnings.simplefilter('error')\n"
        f"env = gymnasium.make_vec('mjlab.gymnasium:mjlab/{TASK}', num_envs=4, group='actor')\n"
        "env.reset(seed=1)\n"
        "print(env.step(np.zeros((4, 1)))[0].shape, env.spec.id)\n"
        "env.close(); env.close()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"(4, 5) mjlab/{TASK}"


def test_make_vec_passes_on_what_it_is_given():
    seen = []
    env = gymnasium.make_vec(
        f"mjlab/{TASK}", num_envs=2, play=True, seed=7, edit=seen.append, clip_actions=1.5
    )
    assert (seen[0].scene.num_envs, seen[0].seed) == (2, 7)
    assert seen[0].episode_length_s == load_env_cfg(TASK, play=True).episode_length_s
    assert env.action_space.high.tolist() == [[1.5], [1.5]]
    env.close()


def test_a_task_that_is_registered_later_can_be_registered_too(monkeypatch):
    monkeypatch.setattr(mjlab.gymnasium, "list_tasks", lambda: ["A-Task", "Not a name"])
    mjlab.gymnasium.register_tasks()
    assert "mjlab/A-Task" in gymnasium.registry
    assert "mjlab/Not a name" not in gymnasium.registry
    del gymnasium.registry["mjlab/A-Task"]


def test_adapters_step_with_the_threads_of_the_runner(monkeypatch):
    monkeypatch.delenv("MJLAB_TORCH_THREADS", raising=False)
    used = []

    def step(actions: torch.Tensor) -> tuple[Any, ...]:
        used.append(torch.get_num_threads())
        return {}, actions, actions > 0.0, actions > 0.0, {}

    core = SimpleNamespace(num_envs=2, cfg=SimpleNamespace(is_finite_horizon=False))
    env = SimpleNamespace(step=step, unwrapped=core)
    torch.set_num_threads(2)
    step_env(env, torch.zeros(2), None)
    assert (used, torch.get_num_threads()) == ([1], 2)
