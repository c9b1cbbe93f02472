"""Registering tasks, and loading what they were registered with."""

from __future__ import annotations

import pytest

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlOnPolicyRunnerCfg
from mjlab.scene import SceneCfg
from mjlab.tasks import registry
from mjlab.tasks.registry import (
    UnknownTaskError,
    list_tasks,
    load_env_cfg,
    load_rl_cfg,
    load_runner_cls,
    register_mjlab_task,
    require_task,
)


@pytest.fixture(autouse=True)
def _own_registry(monkeypatch):
    list_tasks()
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))


def env_cfg(decimation: int = 1) -> ManagerBasedRlEnvCfg:
    return ManagerBasedRlEnvCfg(decimation=decimation, scene=SceneCfg())


def with_play(play: bool = False) -> ManagerBasedRlEnvCfg:
    return env_cfg(decimation=2 if play else 1)


def without_play() -> ManagerBasedRlEnvCfg:
    return env_cfg(decimation=1)


@pytest.mark.parametrize(
    ("train", "play", "decimations"),
    [
        (env_cfg(1), env_cfg(2), (1, 2)),
        (env_cfg(1), None, (1, 1)),
        (with_play, None, (1, 2)),
        (without_play, None, (1, 1)),
        (without_play, env_cfg(5), (1, 5)),
        (without_play, lambda: env_cfg(4), (1, 4)),
        ("mjlab.tasks.cartpole.cartpole_env_cfg:cartpole_balance_env_cfg", None, (5, 5)),
    ],
)
def test_a_config_is_an_object_a_function_or_a_functions_name(train, play, decimations):
    register_mjlab_task("Test", train, play, RslRlOnPolicyRunnerCfg())
    assert (load_env_cfg("Test").decimation, load_env_cfg("Test", play=True).decimation) == (
        decimations
    )


def test_a_runner_is_a_class_or_its_name():
    register_mjlab_task("A", env_cfg(), rl_cfg=RslRlOnPolicyRunnerCfg)
    register_mjlab_task("B", env_cfg(), env_cfg(), RslRlOnPolicyRunnerCfg(), MjlabOnPolicyRunner)
    name = "mjlab.rl:MjlabOnPolicyRunner"
    register_mjlab_task("C", env_cfg(), rl_cfg=RslRlOnPolicyRunnerCfg(seed=3), runner_cls=name)
    assert load_runner_cls("A") is None
    assert load_runner_cls("B") is load_runner_cls("C") is MjlabOnPolicyRunner
    assert load_rl_cfg("A") == RslRlOnPolicyRunnerCfg()
    assert load_rl_cfg("C").seed == 3


def test_editing_what_was_registered_or_loaded_changes_nothing():
    shared = env_cfg(1)
    for name, source in [("Object", env_cfg(1)), ("Function", lambda: shared)]:
        register_mjlab_task(name, source, rl_cfg=RslRlOnPolicyRunnerCfg())
        loaded = load_env_cfg(name)
        loaded.decimation = 99
        loaded.scene.num_envs = 99
        assert load_env_cfg(name).decimation == 1
        assert load_env_cfg(name).scene.num_envs == 1


def test_a_task_without_a_learner_is_refused():
    with pytest.raises(ValueError, match="'Test' needs an rl_cfg"):
        register_mjlab_task("Test", env_cfg())
    assert "Test" not in list_tasks()


@pytest.mark.parametrize("load", [load_env_cfg, load_rl_cfg, load_runner_cls, require_task])
def test_an_unknown_task_is_a_key_error_with_the_nearest_names(load):
    with pytest.raises(UnknownTaskError, match="Did you mean Mjlab-Cartpole-Balance") as caught:
        load("Mjlab-Cartpole-Balanse")
    assert isinstance(caught.value, KeyError)
    assert str(len(list_tasks())) in str(caught.value)
