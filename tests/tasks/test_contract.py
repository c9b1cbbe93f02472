"""Contract of all registered tasks."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import pickle
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg
from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg, load_runner_cls
from mjlab.utils.os import dump_yaml
from mjlab.utils.random import rng_state, set_rng_state
from mjlab.viewer.debug_visualizer import NullDebugVisualizer

# Odd, so that no other dimension of a tensor is likely to be the same.
NUM_ENVS = 7

every_task = pytest.mark.parametrize("task", list_tasks())
no_state_estimation = pytest.mark.parametrize(
    "task", [task for task in list_tasks() if task.endswith("-No-State-Estimation")]
)
FAMILIES = {
    "Mjlab-Cartpole-Swingup",
    "Mjlab-Lift-Cube-Yam",
    "Mjlab-Reach-Yam",
    "Mjlab-Tracking-Flat-Unitree-G1",
    "Mjlab-Velocity-Rough-Unitree-Go1",
}
task_of_each_family = pytest.mark.parametrize(
    "task",
    [t if t in FAMILIES else pytest.param(t, marks=pytest.mark.slow) for t in list_tasks()],
)


@contextlib.contextmanager
def making(
    task: str,
    *,
    play: bool = False,
    seed: int = 1,
    noisy: bool = True,
    whole_terrain: bool = False,
    edit: Callable[[ManagerBasedRlEnvCfg], None] = lambda cfg: None,
) -> Iterator[ManagerBasedRlEnv]:
    cfg = load_env_cfg(task, play=play)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, seed, "native"
    generator = cfg.scene.terrain and cfg.scene.terrain.terrain_generator
    if generator and not whole_terrain:
        # Two levels take a fifth of the time of ten.
        generator.num_rows = 2
        # Terrain is part of the model: states transfer only between equal terrains.
        generator.seed = 3
    if not noisy:
        for group in cfg.observations.values():
            if group is not None:
                group.enable_corruption = False
    edit(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    try:
        yield env
    finally:
        env.close()


def actions(env: ManagerBasedRlEnv, steps: int) -> list[torch.Tensor]:
    """Return random actions from a separate generator, leaving the global ones unchanged."""
    generator = torch.Generator().manual_seed(0)
    shape = (env.num_envs, env.action_manager.total_action_dim)
    return [2.0 * torch.rand(shape, generator=generator) - 1.0 for _ in range(steps)]


def tensors(value: Any, path: str = "") -> dict[str, torch.Tensor]:
    """Return all tensors of nested dicts and lists, by their path."""
    if isinstance(value, torch.Tensor):
        return {path: value}
    items: list[tuple[Any, Any]] = []
    if isinstance(value, Mapping):
        items = list(value.items())
    elif isinstance(value, (list, tuple)):
        items = list(enumerate(value))
    return {name: t for key, item in items for name, t in tensors(item, f"{path}/{key}").items()}


def copied(value: Any) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in tensors(value).items()}


def trajectory(env: ManagerBasedRlEnv, steps: int) -> list[dict[str, torch.Tensor]]:
    """Step `env` and return copies of the results."""
    result = []
    for action in actions(env, steps):
        result.append(copied(list(env.step(action)[:4])))
    return result


def assert_same_bits(one: list[dict], other: list[dict]) -> None:
    assert len(one) == len(other)
    for step, (a, b) in enumerate(zip(one, other, strict=True)):
        assert a.keys() == b.keys()
        different = [name for name in a if not torch.equal(a[name], b[name])]
        assert not different, f"step {step}: {different}"


def dataclasses_in(value: Any, seen: set[int] | None = None) -> Iterator[Any]:
    """Yield every dataclass instance that is reachable from `value`."""
    seen = set() if seen is None else seen
    if id(value) in seen:
        return
    seen.add(id(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield value
        inner: list[Any] = [getattr(value, field.name) for field in dataclasses.fields(value)]
    elif isinstance(value, Mapping):
        inner = list(value.values())
    elif isinstance(value, (list, tuple)):
        inner = list(value)
    else:
        inner = []
    for item in inner:
        yield from dataclasses_in(item, seen)


@every_task
@pytest.mark.parametrize("play", [False, True], ids=["train", "play"])
def test_configs_are_equal_to_their_pickled_copies(task: str, play: bool) -> None:
    for cfg in (load_env_cfg(task, play=play), load_rl_cfg(task)):
        assert pickle.loads(pickle.dumps(cfg)) == cfg


@every_task
@pytest.mark.parametrize("play", [False, True], ids=["train", "play"])
def test_tasks_build_reset_and_step(task, play):
    with making(task, play=play) as env:
        space = env.single_observation_space
        observations, _ = env.reset()
        for action in [None, *actions(env, 5)]:
            if action is not None:
                observations, reward, terminated, truncated, extras = env.step(action)
                assert reward.shape == terminated.shape == truncated.shape == (NUM_ENVS,)
                assert terminated.dtype == truncated.dtype == torch.bool
                assert torch.isfinite(reward).all()
                assert all(torch.isfinite(torch.as_tensor(v)).all() for v in extras["log"].values())
            assert observations.keys() == space.spaces.keys()
            for name, tensor in tensors(observations).items():
                assert torch.isfinite(tensor).all(), name
            for name, group in observations.items():
                if isinstance(group, torch.Tensor):
                    assert group.shape == (NUM_ENVS, *space.spaces[name].shape)
        assert env.single_action_space.shape == (env.action_manager.total_action_dim,)
        assert "actor" in observations


@every_task
@pytest.mark.slow
def test_it_builds_and_steps_on_the_whole_of_its_terrain(task):
    with making(task, whole_terrain=True) as env:
        env.reset()
        for action in actions(env, 3):
            observations, reward, *_ = env.step(action)
        assert torch.isfinite(reward).all()
        assert all(torch.isfinite(t).all() for t in tensors(observations).values())


@every_task
def test_every_observation_group_of_the_learner_exists(task):
    with making(task) as env:
        observations, _ = env.reset()
        for model, groups in load_rl_cfg(task).obs_groups.items():
            assert set(groups) <= observations.keys(), model


@task_of_each_family
def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(task):
    runs = []
    for seed in (1, 1, 2):
        with making(task, seed=seed) as env:
            first = copied(env.reset()[0])
            runs.append([first, *trajectory(env, 6)])
    assert_same_bits(runs[0], runs[1])
    with pytest.raises(AssertionError):
        assert_same_bits(runs[0], runs[2])


@task_of_each_family
def test_a_reset_with_a_seed_starts_the_same_episode_again(task):
    with making(task) as env:
        starts = [copied(env.reset(seed=11)[0]) for _ in range(2)]
        assert_same_bits([starts[0]], [starts[1]])


@task_of_each_family
def test_resetting_some_environments_leaves_the_others_alone(task):
    # A partial reset recomputes the observations of all environments and would resample their noise.
    with making(task, noisy=False) as env:
        env.reset()
        trajectory(env, 4)
        # The state of curricula holds what has changed only.
        before = {n: t for n, t in copied(env.state_dict()).items() if "/curriculum/" not in n}
        chosen = torch.tensor([1, 4])
        others = torch.tensor([0, 2, 3, 5, 6])
        env.reset(env_ids=chosen)
        after = copied(env.state_dict())
        assert before.keys() <= after.keys()
        per_env = {n for n, t in before.items() if t.ndim > 0 and t.shape[0] == NUM_ENVS}
        # Physics, buffers of the environment, of its managers and of its scene are all there.
        for part in ("/sim/", "/buffers/", "/observations/", "/managers/", "/scene/"):
            assert any(name.startswith(part) for name in per_env), part
        touched = [
            name for name in per_env if not torch.equal(before[name][others], after[name][others])
        ]
        assert not touched
        assert (env.episode_length_buf[chosen] == 0).all()
        assert (env.episode_length_buf[others] == 4).all()


@task_of_each_family
def test_its_state_goes_on_bit_for_bit_in_another_environment(task):
    with making(task) as env:
        env.reset()
        trajectory(env, 3)
        # Some episodes end within the steps to come, so that resets are part of the comparison.
        env.episode_length_buf[:] = torch.arange(NUM_ENVS)
        env.episode_length_buf[:2] = min(env.max_episode_length, 10**6) - 2
        state, generators = env.state_dict(), rng_state()
        expected = trajectory(env, 5)
    with making(task, seed=99) as env:
        env.load_state_dict(state)
        set_rng_state(generators)
        assert_same_bits(trajectory(env, 5), expected)


@task_of_each_family
def test_an_environment_leaves_its_config_as_it_was_but_for_the_seed(task):
    cfg = load_env_cfg(task)
    cfg.scene.num_envs = 2
    before = load_env_cfg(task)
    before.scene.num_envs = 2
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.step(actions(env, 1)[0])
    env.close()
    before.seed = cfg.seed
    assert plain(cfg) == plain(before)


def plain(cfg: Any) -> Any:
    from mjlab.utils.os import to_plain

    return to_plain(cfg)


@every_task
@pytest.mark.parametrize("play", [False, True], ids=["train", "play"])
def test_editing_a_loaded_config_does_not_show_in_the_next(task, play):
    edited, untouched = load_env_cfg(task, play=play), plain(load_env_cfg(task, play=play))
    for config in list(dataclasses_in(edited)):
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            if isinstance(value, (dict, list)):
                value.clear()
            elif isinstance(value, (int, float)):
                with contextlib.suppress(dataclasses.FrozenInstanceError):
                    setattr(config, field.name, type(value)(-12345))
    assert plain(load_env_cfg(task, play=play)) == untouched
    rl = load_rl_cfg(task)
    rl.obs_groups.clear()
    rl.seed = -1
    assert load_rl_cfg(task).obs_groups
    assert load_rl_cfg(task).seed != -1


class Board(NullDebugVisualizer):
    """Records the colors of what is drawn in all environments, and of the legend."""

    def __init__(self):
        super().__init__()
        self.drawn, self.legend = set(), set()

    def get_env_indices(self, num_envs):
        return range(num_envs)

    def add_arrow(self, start, end, color, width=0.015, label=None):
        self.drawn.add(tuple(color))

    def add_sphere(self, center, radius, color, label=None):
        self.drawn.add(tuple(color))

    def add_legend(self, color, meaning):
        assert meaning
        self.legend.add(tuple(color))


@task_of_each_family
def test_the_legend_explains_the_colors_of_all_that_can_be_drawn(task):
    with making(task, edit=draw_all) as env:
        env.reset()
        board = Board()
        for action in actions(env, 3):
            env.step(action)
            env.update_visualizers(board)
    assert board.drawn <= board.legend


def draw_all(cfg):
    for sensor in cfg.scene.sensors:
        for field in ("debug", "debug_vis"):
            if hasattr(sensor, field):
                setattr(sensor, field, True)
        if hasattr(sensor, "viz"):
            sensor.viz.show_rays = sensor.viz.show_normals = True
    for command in cfg.commands.values():
        command.debug_vis = True


@every_task
def test_the_observation_groups_share_no_term_config(task):
    groups = [group for group in load_env_cfg(task).observations.values() if group is not None]
    terms = [id(term) for group in groups for term in group.terms.values()]
    assert len(terms) == len(set(terms))


@task_of_each_family
def test_its_configs_are_written_as_yaml_that_is_safe_to_load(task, tmp_path: Path):
    for name, config in (("env", load_env_cfg(task)), ("agent", load_rl_cfg(task))):
        dump_yaml(tmp_path / f"{name}.yaml", dataclasses.asdict(config))
        loaded = yaml.safe_load((tmp_path / f"{name}.yaml").read_text())
        assert list(loaded) == [field.name for field in dataclasses.fields(config)]
    assert isinstance(load_rl_cfg(task), RslRlBaseRunnerCfg)


@every_task
def test_the_annotations_of_all_its_configs_resolve_at_run_time(task):
    configs = [load_env_cfg(task), load_rl_cfg(task)]
    types = {type(config) for top in configs for config in dataclasses_in(top)}
    assert len(types) > 10
    for config_type in types:
        hints = typing.get_type_hints(config_type)
        assert {field.name for field in dataclasses.fields(config_type)} <= hints.keys()


@task_of_each_family
def test_its_help_lists_the_flags_of_its_terms(task):
    from mjlab.cli.flags import parse_flags
    from mjlab.scripts.train import TrainConfig

    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit) as ended:
        parse_flags(
            TrainConfig, TrainConfig.from_task(task), ["--help", "all"], prog=f"train {task}"
        )
    assert ended.value.code == 0
    cfg = load_env_cfg(task)
    flags = ["--env.scene.num-envs", "--agent.max-iterations", "--env.sim.mujoco.timestep"]
    flags += [f"--env.rewards.{name}.weight".replace("_", "-") for name in cfg.rewards]
    text = out.getvalue()
    assert not [flag for flag in flags if flag not in text]


@every_task
def test_its_runner_can_be_loaded(task):
    runner = load_runner_cls(task)
    assert runner is None or isinstance(runner, type)


@no_state_estimation
def test_actors_do_not_observe_what_needs_an_estimate(task):
    """Position and linear velocity of the base are not measured: they do not change observations."""

    def observed(env, change):
        robot = env.scene["robot"]
        state = torch.cat([robot.data.root_link_pose_w, robot.data.root_link_vel_w], dim=1)
        state[:, :3] += change
        state[:, 7:10] += change
        robot.write_root_state_to_sim(state)
        env.scene.write_data_to_sim()
        env.sim.forward()
        env.sim.sense()
        return {
            name: group.clone()
            for name, group in env.observation_manager.compute(update_history=True).items()
        }

    with making(task, noisy=False) as env:
        env.reset()
        before, after = (observed(env, change) for change in (0.0, 0.3))
        torch.testing.assert_close(after["actor"], before["actor"], atol=1e-4, rtol=1e-4)
        assert not torch.allclose(after["critic"], before["critic"], atol=0.1)
