"""Task registry: registration and loading of configs."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest

import mjlab.tasks
from mjlab.cli.main import run_command
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlOnPolicyRunnerCfg
from mjlab.rl.config import RslRlOffPolicyRunnerCfg, RslRlSacAlgorithmCfg
from mjlab.rl.learners import with_learner
from mjlab.scene import SceneCfg
from mjlab.tasks import registry
from mjlab.tasks.registry import (
    Profile,
    TaskImportError,
    UnknownProfileError,
    UnknownTaskError,
    list_profiles,
    list_tasks,
    load_env_cfg,
    load_rl_cfg,
    load_runner_cls,
    register_mjlab_task,
    require_task,
    task_source,
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


def small(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    env_cfg.decimation += 5
    rl_cfg.num_steps_per_env = 3


def renamed(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    rl_cfg.experiment_name = "elsewhere"


def test_a_profile_edits_copies_of_both_configs_also_of_those_to_play_with():
    env, rl = env_cfg(1), RslRlOnPolicyRunnerCfg()
    register_mjlab_task("Test", env, env_cfg(2), rl, None, {"cpu": small})
    for _ in range(2):
        assert load_env_cfg("Test", profile="cpu").decimation == 6
        assert load_env_cfg("Test", True, "cpu").decimation == 7
        assert load_rl_cfg("Test", profile="cpu").num_steps_per_env == 3
    assert load_env_cfg("Test").decimation == env.decimation == 1
    assert load_rl_cfg("Test") == rl == RslRlOnPolicyRunnerCfg()


def test_only_training_is_eased():
    def ease(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
        env_cfg.scene.num_envs, env_cfg.episode_length_s = 64, 9.0
        rl_cfg.max_iterations = 4

    env = env_cfg(1)
    profiles = {"cpu": Profile(small, ease)}
    register_mjlab_task("Test", env, env_cfg(2), RslRlOnPolicyRunnerCfg(), profiles=profiles)
    trained, played = load_env_cfg("Test", profile="cpu"), load_env_cfg("Test", True, "cpu")
    evaluated = load_env_cfg("Test", profile="cpu", evaluate=True)
    assert (trained.decimation, evaluated.decimation, played.decimation) == (6, 6, 7)
    assert (trained.episode_length_s, trained.scene.num_envs) == (9.0, 64)
    assert replace(evaluated, decimation=1) == env
    assert load_rl_cfg("Test", profile="cpu").max_iterations == 4


def test_evaluations_may_have_other_configs():
    def make(evaluate: bool = False) -> ManagerBasedRlEnvCfg:
        return env_cfg(3 if evaluate else 1)

    register_mjlab_task("Test", make, rl_cfg=RslRlOnPolicyRunnerCfg())
    assert load_env_cfg("Test").decimation == 1
    assert load_env_cfg("Test", play=True).decimation == 1
    assert load_env_cfg("Test", evaluate=True).decimation == 3


def test_profiles_are_listed_without_importing_them():
    lazy = {"b": "no_such_module:cpu", "a": small}
    register_mjlab_task("Test", env_cfg(), rl_cfg=RslRlOnPolicyRunnerCfg(), profiles=lazy)
    assert list_profiles("Test") == ["a", "b"]
    with pytest.raises(TaskImportError, match=r"'Test' .*'no_such_module:cpu'"):
        load_rl_cfg("Test", profile="b")


def test_a_profile_that_is_not_there_is_told_with_those_that_are():
    rl = RslRlOnPolicyRunnerCfg()
    register_mjlab_task("Two", env_cfg(), rl_cfg=rl, profiles={"cpu": small, "big": small})
    register_mjlab_task("None", env_cfg(), rl_cfg=rl)
    for load in (load_env_cfg, load_rl_cfg):
        with pytest.raises(UnknownProfileError, match=r"'gpu' of task 'Two'.*'big', 'cpu'"):
            load("Two", profile="gpu")
        with pytest.raises(UnknownProfileError, match=r"'cpu' of task 'None'.*\[\]"):
            load("None", profile="cpu")


@pytest.mark.parametrize(
    ("profile", "message"),
    [
        (renamed, "experiment_name: expected 'exp1'"),
        (lambda env, rl: env, "expected None or an RslRlBaseRunnerCfg .* got ManagerBasedRl"),
        (
            lambda env, rl: replace(rl, experiment_name="elsewhere"),
            "expected 'exp1', got 'elsewhere'",
        ),
    ],
)
def test_a_profile_that_does_other_than_editing_is_refused(profile, message):
    rl = RslRlOnPolicyRunnerCfg()
    register_mjlab_task("Test", env_cfg(), rl_cfg=rl, profiles={"cpu": profile})
    with pytest.raises(ValueError, match=f"'cpu' of task 'Test'.*{message}"):
        load_env_cfg("Test", profile="cpu")


def to_sac(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg):
    env_cfg.decimation += 5
    sac = with_learner(rl_cfg, "sac")
    sac.num_steps_per_env = 2
    sac.evaluation.num_episodes = 7
    return sac


def test_a_profile_may_return_the_config_of_another_learner():
    rl = RslRlOnPolicyRunnerCfg(seed=3)
    register_mjlab_task("Test", env_cfg(), rl_cfg=rl, profiles={"cpu": to_sac})
    assert load_env_cfg("Test", profile="cpu").decimation == 6
    sac = load_rl_cfg("Test", profile="cpu")
    assert isinstance(sac, RslRlOffPolicyRunnerCfg)
    assert (sac.seed, sac.num_steps_per_env) == (3, 2)
    assert load_rl_cfg("Test", profile="cpu", learner="sac") == sac
    # PPO config of the task, with the task settings of the profile.
    ppo = load_rl_cfg("Test", profile="cpu", learner="ppo")
    assert ppo == replace(rl, evaluation=sac.evaluation)


CONSTANT = RslRlOffPolicyRunnerCfg()


def test_what_a_profile_returns_is_copied():
    profiles: dict = {"cpu": lambda env, rl: CONSTANT}
    register_mjlab_task("Test", env_cfg(), rl_cfg=RslRlOnPolicyRunnerCfg(), profiles=profiles)
    load_rl_cfg("Test", profile="cpu").seed = 99
    assert RslRlOffPolicyRunnerCfg() == CONSTANT


def test_a_learner_is_chosen_by_name():
    register_mjlab_task("Test", env_cfg(), rl_cfg=RslRlOnPolicyRunnerCfg())
    assert load_rl_cfg("Test", learner="ppo") == load_rl_cfg("Test")
    sac = load_rl_cfg("Test", learner="sac")
    assert sac == RslRlOffPolicyRunnerCfg(
        algorithm=RslRlSacAlgorithmCfg(action_bounds="joint_ranges")
    )
    unknown: Any = "td3"
    with pytest.raises(ValueError, match="'td3'.*'ppo', 'sac', 'distillation'"):
        load_rl_cfg("Test", learner=unknown)


@pytest.mark.parametrize("name", ["", "two words", "None", "--cpu="])
def test_a_profiles_name_is_one_word(name):
    with pytest.raises(ValueError, match=f"not 'None', got {name!r}"):
        register_mjlab_task(
            "Test", env_cfg(), rl_cfg=RslRlOnPolicyRunnerCfg(), profiles={name: small}
        )


@pytest.mark.parametrize("load", [load_env_cfg, load_rl_cfg, load_runner_cls, require_task])
def test_an_unknown_task_is_a_key_error_with_the_nearest_names(load):
    with pytest.raises(UnknownTaskError, match="did you mean 'Mjlab-Cartpole-Balance'") as caught:
        load("Mjlab-Cartpole-Balanse")
    assert isinstance(caught.value, KeyError)
    assert str(len(list_tasks())) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("no_such_module_anywhere:make", "No module named 'no_such_module_anywhere'"),
        ("mjlab.tasks.registry:no_such_function", "no_such_function"),
    ],
)
def test_failing_lazy_configs_name_task_and_cause(name, cause):
    register_mjlab_task("Lazy-Task", name, None, name, name)
    for load in (load_env_cfg, load_rl_cfg, load_runner_cls):
        with pytest.raises(TaskImportError, match=f"'Lazy-Task' .*'{name}'.*{cause}") as caught:
            load("Lazy-Task")
        assert isinstance(caught.value.__cause__, (ImportError, AttributeError))


def test_the_command_line_tells_of_such_a_task_in_one_message(monkeypatch, capsys):
    register_mjlab_task("Lazy-Task", "no_such_module:make", rl_cfg="no_such_module:make")
    monkeypatch.setattr("sys.argv", ["train", "Lazy-Task"])
    with pytest.raises(SystemExit) as ended:
        run_command(lambda argv: print(load_env_cfg(argv[0])))
    assert ended.value.code == 1
    error = capsys.readouterr().err
    assert "\nerror: Task 'Lazy-Task' cannot be used" in error
    assert "importlib" not in error


def test_a_subpackage_that_fails_to_import_leaves_no_task(monkeypatch, tmp_path, caplog):
    package = tmp_path / "broken_tasks_of_test"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from mjlab.tasks.registry import register_mjlab_task\n"
        "register_mjlab_task('Half-Task', object(), rl_cfg=object())\n"
        "raise RuntimeError('half way')\n"
    )
    monkeypatch.setattr("mjlab.tasks.__path__", [*mjlab.tasks.__path__, str(tmp_path)])
    monkeypatch.setattr(registry, "_discovered", False)
    tasks = list_tasks()
    assert "Half-Task" not in tasks
    assert "Mjlab-Cartpole-Balance" in tasks
    assert "half way" in caplog.text
    assert "mjlab.tasks.broken_tasks_of_test" in caplog.text


@pytest.mark.filterwarnings("ignore:.*older:FutureWarning")
def test_the_registry_reads_as_a_dict():
    rl_cfg = RslRlOnPolicyRunnerCfg()
    register_mjlab_task("Own", with_play, rl_cfg=rl_cfg, runner_cls=MjlabOnPolicyRunner)
    tasks = registry._REGISTRY
    assert list(tasks) == list_tasks()
    assert len(tasks) == len(list_tasks())
    assert ("Own" in tasks, "Other" in tasks) == (True, False)
    assert tasks["Own"].env_cfg.decimation == 1
    assert tasks["Own"].play_env_cfg.decimation == 2
    assert tasks["Own"].rl_cfg == rl_cfg
    assert tasks["Own"].runner_cls is MjlabOnPolicyRunner
    task = tasks.pop("Own")
    assert "Own" not in list_tasks()
    tasks["Again"] = task
    assert load_env_cfg("Again", play=True).decimation == 2
    with pytest.raises(KeyError, match="Other"):
        tasks["Other"]


def test_the_package_that_registers_a_task_is_its_source():
    register_mjlab_task("Test-Task", env_cfg(), rl_cfg=RslRlOnPolicyRunnerCfg())
    assert task_source("Test-Task") == getattr(sys.modules["__main__"], "__file__", None)
    source = task_source("Mjlab-Cartpole-Swingup")
    assert source is not None
    assert source.endswith("mjlab/tasks/cartpole/__init__.py")


def test_source_of_a_task_that_was_imported_before_discovery():
    code = (
        "import mjlab.tasks.cartpole; from mjlab.tasks.registry import task_source; "
        "print(task_source('Mjlab-Cartpole-Swingup'))"
    )
    outcome = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert outcome.stdout.strip().endswith("cartpole/__init__.py")


def test_a_task_without_a_learner_has_the_default():
    with pytest.warns(UserWarning, match="'NoLearner' rl_cfg: expected a learner config"):
        register_mjlab_task("NoLearner", env_cfg(), env_cfg(), None)
    assert load_rl_cfg("NoLearner") == RslRlOnPolicyRunnerCfg()
