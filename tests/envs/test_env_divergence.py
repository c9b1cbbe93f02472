"""States and actions that are not finite: counted, contained, and never the end of a run."""

from __future__ import annotations

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg

NUM_ENVS = 6
BROKEN = 2
OTHERS = [index for index in range(NUM_ENVS) if index != BROKEN]


def make_env(engine: str = "native") -> ManagerBasedRlEnv:
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 5, engine
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


@pytest.fixture
def env():
    env = make_env()
    yield env
    env.close()


def actions(steps: int) -> torch.Tensor:
    return 2.0 * torch.rand(steps, NUM_ENVS, 1, generator=torch.Generator().manual_seed(0)) - 1.0


@pytest.mark.parametrize("field", ["qpos", "qvel"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_an_environment_whose_state_is_not_finite_starts_anew_and_is_counted(env, field, value):
    env.step(actions(1)[0])
    getattr(env.sim.data, field)[BROKEN, 1] = value
    observations, reward, terminated, truncated, extras = env.step(actions(1)[0])
    expected = torch.zeros(NUM_ENVS, dtype=torch.bool)
    expected[BROKEN] = True
    assert torch.equal(terminated, expected)
    assert not truncated.any()
    assert extras["log"]["Simulation/nan_resets"] == 1
    assert torch.isfinite(reward).all()
    assert torch.isfinite(observations["actor"]).all()
    assert env.episode_length_buf[BROKEN] == 0
    # The episode began where episodes begin: at rest, hanging down.
    assert env.sim.data.qpos[BROKEN, 1].item() == pytest.approx(3.1416, abs=0.035)
    _, _, terminated, _, extras = env.step(actions(1)[0])
    assert not terminated.any()
    assert extras["log"]["Simulation/nan_resets"] == 0


def test_the_other_environments_go_on_as_if_nothing_had_happened():
    runs = []
    for poisoned in (False, True):
        env = make_env()
        run = []
        for step, action in enumerate(actions(8)):
            if poisoned and step in (2, 5):
                env.sim.data.qvel[BROKEN] = float("nan")
            observations, reward, terminated, _, _ = env.step(action)
            run.append((observations["actor"][OTHERS], reward[OTHERS], terminated[OTHERS]))
        env.close()
        runs.append(run)
    for one, other in zip(*runs, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_all_environments_may_diverge_at_once(env):
    env.sim.data.qpos[:] = float("nan")
    _, _, terminated, _, extras = env.step(actions(1)[0])
    assert terminated.all()
    assert extras["log"]["Simulation/nan_resets"] == NUM_ENVS
    assert torch.isfinite(env.sim.data.qpos).all()


def test_statistics_of_an_episode_that_diverged_are_finite(env):
    env.step(actions(1)[0])
    env.sim.data.qvel[BROKEN] = float("nan")
    _, _, _, _, extras = env.step(actions(1)[0])
    log = {name: torch.as_tensor(value) for name, value in extras["log"].items()}
    assert any(name.startswith("Episode_Reward/") for name in log)
    assert not [name for name, value in log.items() if not torch.isfinite(value).all()]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_an_action_that_is_not_finite_is_refused_naming_the_environment(env, value):
    before = env.sim.data.qpos.clone()
    action = torch.zeros(NUM_ENVS, 1)
    action[BROKEN] = value
    with pytest.raises(ValueError) as caught:
        env.step(action)
    message = str(caught.value)
    for part in (f"env {BROKEN}", str(value), "1 of 6"):
        assert part in message
    assert torch.equal(env.sim.data.qpos, before), "nothing may move"
    env.step(torch.zeros(NUM_ENVS, 1))
    assert torch.isfinite(env.sim.data.qpos).all()


@pytest.mark.parametrize("shape", [(NUM_ENVS, 2), (NUM_ENVS + 1, 1), (NUM_ENVS,)])
def test_an_action_of_another_shape_is_refused_with_both_shapes(env, shape):
    with pytest.raises(ValueError) as caught:
        env.step(torch.zeros(shape))
    assert str(shape) in str(caught.value) or str(list(shape)) in str(caught.value)
    assert f"({NUM_ENVS}, 1)" in str(caught.value)


def test_the_nan_guard_dumps_what_led_to_the_nan(tmp_path):
    import numpy as np

    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed = NUM_ENVS, 5
    cfg.sim.nan_guard.enabled = True
    cfg.sim.nan_guard.output_dir = str(tmp_path)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.step(actions(1)[0])
    assert not list(tmp_path.iterdir())
    env.sim.data.qvel[BROKEN] = float("nan")
    env.step(actions(1)[0])
    env.close()
    dumps = [path for path in tmp_path.glob("*.npz") if not path.is_symlink()]
    assert len(dumps) == 1
    with np.load(dumps[0]) as dump:
        assert len(dump.files) > 1
