"""States and actions that are not finite: counted, contained, and never the end of a run."""

from __future__ import annotations

import math

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import MetricsTermCfg
from mjlab.tasks.registry import load_env_cfg

NUM_ENVS = 6
BROKEN = 2
OTHERS = [index for index in range(NUM_ENVS) if index != BROKEN]


def make_env(engine: str = "native", **metrics: MetricsTermCfg) -> ManagerBasedRlEnv:
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 5, engine
    cfg.metrics |= metrics
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
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e12])
def test_an_environment_in_a_bad_state_is_reset_and_counted(env, field, value):
    env.step(actions(1)[0])
    getattr(env.sim.data, field)[BROKEN, 1] = value
    observations, reward, terminated, truncated, extras = env.step(actions(1)[0])
    expected = torch.zeros(NUM_ENVS, dtype=torch.bool)
    expected[BROKEN] = True
    assert torch.equal(terminated, expected)
    assert not truncated.any()
    assert extras["log"]["Simulation/nan_resets"] == 1
    assert torch.isfinite(reward).all()
    assert reward[BROKEN] == 0
    assert torch.isfinite(observations["actor"]).all()
    assert env.episode_length_buf[BROKEN] == 0
    # The episode began where episodes begin: at rest, hanging down.
    assert env.sim.data.qpos[BROKEN, 1].item() == pytest.approx(3.1416, abs=0.035)
    _, _, terminated, _, extras = env.step(actions(1)[0])
    assert not terminated.any()
    assert extras["log"]["Simulation/nan_resets"] == 0


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_states_beyond_the_limit_of_mujoco_reach_no_reward(engine):
    """They are finite: without the limit, a stiff robot had rewards of -1e27 and no reset."""
    pytest.importorskip("mujoco_warp")
    env = make_env(engine)
    name = env.reward_manager.active_terms[0]
    env.reward_manager.get_term_cfg(name).func = lambda env, **_: env.sim.data.qvel.square().sum(1)
    env.sim.data.qvel[BROKEN, 1] = 1e15
    _, reward, terminated, _, extras = env.step(actions(1)[0])
    assert terminated.tolist() == [index == BROKEN for index in range(NUM_ENVS)]
    assert extras["log"]["Simulation/nan_resets"] == 1
    assert extras["log"]["Simulation/nan_rewards"] == 0
    assert reward[BROKEN] == 0
    assert reward.abs().max() < 1e6
    assert env.nan_resets.tolist() == terminated.int().tolist()
    env.close()


@pytest.mark.parametrize("dof", [0, 1])
@pytest.mark.parametrize("engine", ["native", "warp"])
def test_accelerations_beyond_the_limit_of_mujoco_end_the_episode(engine, dof, caplog):
    """With velocities that are within it, at each degree of freedom."""
    pytest.importorskip("mujoco_warp")
    env = make_env(engine)
    mass = (3e11, 3e10)[dof]
    env.sim.data.qfrc_applied[BROKEN, dof] = mass
    _, reward, terminated, *_ = env.step(actions(1)[0])
    assert env.sim.data.qvel.abs().max() < 1e10
    assert terminated.tolist() == [index == BROKEN for index in range(NUM_ENVS)]
    assert reward[BROKEN] == 0
    assert "joint 'cartpole/" in caplog.text
    env.close()


def test_metrics_leave_out_what_diverged():
    env = make_env(one=MetricsTermCfg(func=lambda env: torch.ones(env.num_envs)))
    env.sim.data.qvel[BROKEN] = 1e15
    env.step(actions(1)[0])
    values = [env.metrics_manager.get_active_iterable_terms(i)[0][1] for i in range(NUM_ENVS)]
    assert [math.isnan(value) for (value,) in values] == [i == BROKEN for i in range(NUM_ENVS)]
    env.close()


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [("qpos", float("nan"), "joint 'cartpole/"), ("qvel", 1e15, "joint 'cartpole/hinge_1'")],
)
def test_the_first_divergence_is_logged_with_environment_and_joint(
    env, caplog, field, value, named
):
    for index in (BROKEN, 0):
        getattr(env.sim.data, field)[index, 1] = value
        env.step(actions(1)[0])
    told = [record.getMessage() for record in caplog.records if "diverged" in record.getMessage()]
    assert len(told) == 1
    for part in (f"environment {BROKEN}", "step 1", named, "Simulation/nan_resets"):
        assert part in told[0]


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


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_bad_action_is_logged_and_stays_in_its_environment(caplog, engine, value):
    if engine == "warp":
        pytest.importorskip("mujoco_warp")
    worlds = [make_env(engine), make_env(engine)]
    for k, env in enumerate(worlds):
        for action in actions(3):
            action[BROKEN] = value if k else 0.0
            _, reward, *_ = env.step(action)
            assert reward.isfinite().all()
    good, bad = (env.sim.data.qpos[OTHERS] for env in worlds)
    torch.testing.assert_close(bad, good)
    assert worlds[1].sim.data.qpos.isfinite().all()
    messages = [record.getMessage() for record in caplog.records]
    assert [m for m in messages if "Action was" in m and "1 of 6" in m and "step 1" in m]
    assert len([m for m in messages if "Action was" in m]) == 1
    for env in worlds:
        env.close()


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


# A robot on rough ground, where MuJoCo raises for what it cannot collide.


@pytest.fixture(scope="module")
def walkers():
    """Go1s on rough ground with a pyramidal cone, a state of theirs, and how they go on from it."""
    cfg = load_env_cfg("Mjlab-Velocity-Rough-Unitree-Go1")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 5, "native"
    cfg.sim.mujoco.cone = "pyramidal"
    cfg.scene.terrain.terrain_generator.num_rows = 2
    cfg.scene.terrain.terrain_generator.num_cols = 2
    # Random numbers of a reset must not affect the other environments.
    for group in cfg.observations.values():
        group.enable_corruption = False
    cfg.events.pop("push_robot", None)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    for _ in range(2):
        env.step(torch.zeros(NUM_ENVS, env.action_manager.total_action_dim))
    saved = env.state_dict()
    yield env, saved, walk(env, saved)
    env.close()


def walk(env, saved, poison=lambda: None) -> list[torch.Tensor]:
    """Return states, rewards and observations of 3 steps, with `poison()` before the second."""
    env.load_state_dict(saved)
    record = []
    for k in range(3):
        if k == 1:
            poison()
        action = torch.full((NUM_ENVS, env.action_manager.total_action_dim), 0.3)
        observations, reward, *_ = env.step(action)
        parts = (env.sim.data.qpos, env.sim.data.qvel, reward, *observations.values())
        record += [part.clone() for part in parts]
    return record


def assert_contained(env, expected: list[torch.Tensor], found: list[torch.Tensor]) -> None:
    """Check that only the broken environment noticed, and that it is sound again."""
    for one, other in zip(expected, found, strict=True):
        assert torch.equal(one[OTHERS], other[OTHERS])
    assert all(torch.isfinite(part).all() for part in found[-4:])
    assert env.episode_length_buf[BROKEN] < env.episode_length_buf[OTHERS[0]]


def poison_state(env, field: str, value: float) -> None:
    getattr(env.sim.data, field)[BROKEN] = value


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e12])
@pytest.mark.parametrize("field", ["qpos", "qvel", "xfrc_applied"])
def test_what_mujoco_raises_for_one_environment_never_ends_the_run(walkers, field, value):
    env, saved, expected = walkers
    found = walk(env, saved, lambda: poison_state(env, field, value))
    assert_contained(env, expected, found)
    assert env._nan_resets[BROKEN] == saved["buffers"]["_nan_resets"][BROKEN] + 1


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e12])
def test_controls_that_are_not_finite_are_contained(walkers, value):
    env, saved, _ = walkers
    states = []
    for ctrl in (0.0, value):
        env.load_state_dict(saved)
        env.sim.data.ctrl[BROKEN] = ctrl
        env.sim.step(8, ("sensordata",))
        env.sim.forward()
        states.append(
            torch.cat((env.sim.data.qpos, env.sim.data.qvel, env.sim.data.cvel.flatten(1)), 1)
        )
    assert torch.equal(states[0][OTHERS], states[1][OTHERS])


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e12])
@pytest.mark.parametrize("path", ["single", "forward", "sense", "recompute", "reset_other"])
def test_every_call_contains_what_mujoco_raises(walkers, monkeypatch, path, value):
    env, saved, expected = walkers
    monkeypatch.setattr(env, "_steps_as_one", path != "single")
    calls = {
        "single": lambda: None,
        "forward": lambda: [env.sim.forward(stage=stage) for stage in ("pos", "vel", "acc")],
        "sense": env.sim.sense,
        "recompute": lambda: env.sim.recompute_constants(3),
        "reset_other": lambda: env.sim.forward(torch.tensor([0, BROKEN])),
    }
    if path == "recompute":  # It changes constants of all environments.
        expected = walk(env, saved, calls[path])
    found = walk(env, saved, lambda: (poison_state(env, "qpos", value), calls[path]()))
    assert_contained(env, expected, found)


def test_outputs_of_a_diverged_environment_do_not_depend_on_threads():
    """They keep their values, because MuJoCo computed none."""
    results = []
    for threads in (1, 2):
        cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
        cfg.scene.num_envs, cfg.seed, cfg.sim.num_threads = NUM_ENVS, 5, threads
        cfg.sim.mujoco.cone = "pyramidal"
        env = ManagerBasedRlEnv(cfg, device="cpu")
        env.reset()
        sim = env.sim
        sim.step(4)
        sim.forward(stage="vel")
        sim.data.qpos[BROKEN, 2:] = 1e12
        sim.step(4)
        results.append(torch.cat((sim.data.sensordata, sim.data.cvel.flatten(1)), 1)[BROKEN])
        env.close()
    assert torch.equal(*(torch.nan_to_num(result, nan=-1.0) for result in results))
