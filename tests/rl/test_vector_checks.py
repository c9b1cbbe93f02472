"""The checker of Gymnasium's vector interface: finds planted faults, passes every task."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.spaces import Box  # noqa: E402
from gymnasium.vector import AutoresetMode, VectorEnv  # noqa: E402
from gymnasium.vector.utils import batch_space  # noqa: E402

import mjlab.gymnasium  # noqa: E402, F401
from mjlab.rl import check_vector_env  # noqa: E402
from mjlab.rl.vector_checks import VectorEnvError  # noqa: E402
from mjlab.tasks.registry import list_tasks  # noqa: E402

NUM_ENVS = 3
# Tasks of which the check is quick; the others are slow.
QUICK = ("Mjlab-Cartpole-Swingup", "Mjlab-Velocity-Flat-Unitree-Go1", "Mjlab-Lift-Cube-Yam-Rgb")
LENGTHS = np.array([4, 6, 9])


class Walk(VectorEnv):
    """Random walks, whose environments end after some steps; the first by termination."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self) -> None:
        self.num_envs = NUM_ENVS
        self.single_observation_space = Box(-1e3, 1e3, (2,), np.float32)
        self.single_action_space = Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, NUM_ENVS)
        self.action_space = batch_space(self.single_action_space, NUM_ENVS)
        self.places = np.zeros((NUM_ENVS, 2), np.float32)
        self.steps = np.zeros(NUM_ENVS, int)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._restart(np.ones(NUM_ENVS, bool))
        return self.places.copy(), {}

    def step(self, actions: Any) -> Any:
        self.places = self.places + actions
        self.steps += 1
        ended = self.steps >= LENGTHS
        terminated = ended & (np.arange(NUM_ENVS) == 0)
        rewards = self.places.sum(axis=1)
        infos = self.restarted(ended) if ended.any() else {}
        return self.places.copy(), rewards, terminated, ended & ~terminated, infos

    def restarted(self, ended: np.ndarray) -> dict[str, Any]:
        final = np.full(NUM_ENVS, None, object)
        for row in np.flatnonzero(ended):
            final[row] = self.places[row].copy()
        self._restart(ended)
        length = {"length": np.where(ended, LENGTHS, 0), "_length": ended}
        return {"final_obs": final, "_final_obs": ended, "final_info": length, "_final_info": ended}

    def _restart(self, rows: np.ndarray) -> None:
        self.steps[rows] = 0
        draws = self.np_random.normal(size=self.places.shape)
        self.places = np.where(rows[:, None], draws, self.places).astype(np.float32)


def test_what_keeps_to_the_interface_passes():
    check_vector_env(Walk())
    check_vector_env(ByMask())


# Observations of the last are numbers, and may stand still.
@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
@pytest.mark.parametrize("mode", [*AutoresetMode])
def test_gymnasiums_own_environments_pass(mode, name):
    env = gymnasium.make_vec(
        name, num_envs=3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}
    )
    check_vector_env(gymnasium.wrappers.vector.RecordEpisodeStatistics(env), steps=60)
    env.close()


def changed(**of_step: Any) -> type[Walk]:
    """Return an environment with a changed entry of what `step` returns."""
    names = ("observations", "rewards", "terminated", "truncated", "infos")

    class Changed(Walk):
        def step(self, actions: Any) -> Any:
            result = dict(zip(names, super().step(actions), strict=True))
            return tuple(
                of_step[name](value) if name in of_step else value for name, value in result.items()
            )

    return Changed


class NoMode(Walk):
    metadata = {}


class ByMask(Walk):
    """Environment that resets on request."""

    metadata = {"autoreset_mode": AutoresetMode.DISABLED}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        if options is None:
            return super().reset(seed=seed)
        self._restart(self.rows(options["reset_mask"]))
        return self.places.copy(), {}

    def rows(self, mask: np.ndarray) -> np.ndarray:
        return mask

    def restarted(self, ended: np.ndarray) -> dict[str, Any]:
        return {}


class ResetsAll(ByMask):
    def rows(self, mask: np.ndarray) -> np.ndarray:
        return np.ones_like(mask)


class ResetsNone(ByMask):
    def rows(self, mask: np.ndarray) -> np.ndarray:
        self.steps[mask] = 0
        return np.zeros_like(mask)


class OwnRewards(Walk):
    rewards = np.zeros(NUM_ENVS)

    def step(self, actions: Any) -> Any:
        observations, rewards, *rest = super().step(actions)
        self.rewards[:] = rewards
        return observations, self.rewards, *rest


class SaysNextStepSilently(Walk):
    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def step(self, actions: Any) -> Any:
        observations, _, *rest = super().step(actions)
        return observations, np.zeros(NUM_ENVS), *rest


class SaysNextStep(Walk):
    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}


class ResetsTimeOutsOnly(Walk):
    def restarted(self, ended: np.ndarray) -> dict[str, Any]:
        place = self.places[0].copy()
        infos = super().restarted(ended)
        self.places[0] = place
        return infos


class StaleFinal(Walk):
    def step(self, actions: Any) -> Any:
        self.before = self.places.copy()
        return super().step(actions)

    def restarted(self, ended: np.ndarray) -> dict[str, Any]:
        infos = super().restarted(ended)
        for row in np.flatnonzero(ended):
            infos["final_obs"][row] = self.before[row]
        return infos


class NoFinal(Walk):
    def restarted(self, ended: np.ndarray) -> dict[str, Any]:
        super().restarted(ended)
        return {}


class OwnMemory(Walk):
    def __init__(self) -> None:
        super().__init__()
        self.shown = np.zeros((NUM_ENVS, 2), np.float32)

    def step(self, actions: Any) -> Any:
        self.shown[:], *rest = super().step(actions)
        return self.shown, *rest


class IgnoresSeed(Walk):
    draws = np.random.default_rng(1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=int(self.draws.integers(1000)))
        return self.places.copy(), {}


class Narrow(Walk):
    def __init__(self) -> None:
        super().__init__()
        self.single_observation_space = Box(-1e-3, 1e-3, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, NUM_ENVS)


class Unbatched(Walk):
    def __init__(self) -> None:
        super().__init__()
        self.observation_space = batch_space(self.single_observation_space, NUM_ENVS + 1)


def without_mask(infos: dict[str, Any]) -> dict[str, Any]:
    return {**infos, "speed": np.zeros(NUM_ENVS)}


def late(infos: dict[str, Any]) -> dict[str, Any]:
    return {**infos, "speed": 0.5, "_speed": np.ones(NUM_ENVS, bool)}


FAULTS: dict[str, tuple[type[Walk], str]] = {
    "no mode": (NoMode, r"autoreset_mode: expected metadata\['autoreset_mode'\]"),
    "another mode": (SaysNextStep, "expected none with AutoresetMode.NEXT_STEP|expected reward 0"),
    "another mode, no rewards": (
        SaysNextStepSilently,
        "final_obs: expected none with AutoresetMode",
    ),
    "reset of all": (ResetsAll, "reset_mask: expected resets only of environments"),
    "reset of none": (ResetsNone, "reset: observations after an end are those before the reset"),
    "one buffer of rewards": (OwnRewards, "aliasing: the next step modifies returned"),
    "no reset": (ResetsTimeOutsOnly, "reset: observations after an end are those before the reset"),
    "stale final observation": (StaleFinal, "stale final_obs: it is the observation before"),
    "no final observation": (NoFinal, r"final_obs: expected infos\['_final_obs'\] to be true"),
    "one buffer": (OwnMemory, "aliasing: the next step modifies returned arrays"),
    "seed": (IgnoresSeed, "seed: two runs with seed 0 differ from step 0 on"),
    "bounds": (Narrow, "observations: observations: values are outside the bounds"),
    "batched space": (Unbatched, r"observation_space: expected batch_space\(single_obs"),
    "type of observations": (
        changed(observations=lambda value: value.astype(float)),
        r"observations: expected \(3, 2\) of float32, got \(3, 2\) of float64",
    ),
    "shape of rewards": (
        changed(rewards=lambda value: value[:, None]),
        r"rewards: expected \(3,\) of floats, got \(3, 1\)",
    ),
    "rewards without a value": (
        changed(rewards=lambda value: value * np.nan),
        "rewards: expected finite numbers",
    ),
    "type of terminations": (
        changed(terminated=lambda value: value.astype(float)),
        r"terminations: expected \(3,\) of bool, got \(3,\) of float64",
    ),
    "a mask": (changed(infos=without_mask), r"infos: expected a mask \(3,\) bool '_speed'"),
    "one info for all": (changed(infos=late), "infos: expected an array of 3 values"),
    "a list of infos": (changed(infos=lambda value: [value] * 3), "step: expected five results"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(fault):
    env, message = FAULTS[fault]
    with pytest.raises(VectorEnvError, match=message) as error:
        check_vector_env(env())
    # And nothing else.
    assert str(error.value).count("\n") == 1


def test_without_an_end_nothing_is_said_of_resets():
    with pytest.raises(ValueError, match="No episode ended in 3 steps"):
        check_vector_env(Walk(), steps=3)


# Tasks.


def shorten(cfg: Any) -> None:
    """Let episodes end within a few steps, and make the ground small."""
    cfg.episode_length_s = 4.5 * cfg.decimation * cfg.sim.mujoco.timestep
    generator = cfg.scene.terrain and cfg.scene.terrain.terrain_generator
    if generator:
        generator.num_rows = 2


@pytest.mark.parametrize("engine", ["native", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "task",
    [t if t in QUICK else pytest.param(t, marks=pytest.mark.slow) for t in list_tasks()],
)
def test_every_task_keeps_to_the_interface(task, engine):
    if engine == "warp":
        pytest.importorskip("mujoco_warp")

    def edit(cfg: Any) -> None:
        shorten(cfg)
        cfg.sim.engine = engine

    env = gymnasium.make_vec(f"mjlab/{task}", num_envs=3, device="cpu", seed=1, edit=edit)
    check_vector_env(env, steps=12)
    env.close()
