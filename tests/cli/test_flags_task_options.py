"""Flags that a task brings itself."""

from __future__ import annotations

from dataclasses import dataclass, fields

import pytest

from mjlab.cli.flags import options_of, prepare_env_cfg, with_task_options
from mjlab.cli.policy_flags import env_cfg_of, parse_policy_flags
from mjlab.cli.train_config import parse_train_flags
from mjlab.runs import Checkpoint
from mjlab.scripts.evaluate import EvaluateConfig
from mjlab.scripts.play import PlayConfig
from mjlab.scripts.train import TrainConfig
from mjlab.tasks import registry
from mjlab.tasks.registry import PolicyOrigin, TaskOptions

TASK = "Test-With-Options"
PLAIN = "Mjlab-Cartpole-Balance"


@dataclass
class Options(TaskOptions):
    """Flags of the task under test."""

    pole_colour: str = "red"
    """Colour of the pole."""

    def prepare(self, env_cfg, origin: PolicyOrigin) -> None:
        env_cfg.prepared = (self.pole_colour, origin)

    def runner_kwargs(self):
        return {"colour": self.pole_colour}


@dataclass
class Clashing(TaskOptions):
    """Flags that the commands have already."""

    device: str = "cpu"


@pytest.fixture(autouse=True)
def _task_with_options(monkeypatch):
    registry.list_tasks()
    tasks = dict(registry._tasks)
    monkeypatch.setattr(registry, "_tasks", tasks)
    plain = tasks[PLAIN]
    for name, options in ((TASK, Options), ("Clash", Clashing), ("By-Name", "no.module:Options")):
        registry.register_mjlab_task(
            name, plain.env_cfg, plain.play_env_cfg, plain.rl_cfg, options=options
        )


def test_the_options_of_a_task_are_flags_of_every_command():
    cfg = parse_train_flags(TASK, ["--pole-colour", "blue", "--num-envs", "3"], "train")
    assert isinstance(cfg, TrainConfig)
    assert (options_of(TASK, cfg).pole_colour, cfg.num_envs) == ("blue", 3)
    for kind in (PlayConfig, EvaluateConfig):
        found = parse_policy_flags(
            kind, ["--agent", "zero", "--pole-colour=green"], TASK, "command", purpose="play"
        )
        assert isinstance(found, kind)
        assert options_of(TASK, found).pole_colour == "green"


def test_without_flags_options_have_their_defaults():
    assert options_of(TASK, None).pole_colour == "red"
    assert options_of(TASK, TrainConfig.from_task(TASK)).pole_colour == "red"
    assert type(options_of(PLAIN, None)) is TaskOptions
    assert TaskOptions().runner_kwargs() == {}


def test_other_tasks_do_not_have_the_flag(capsys):
    assert with_task_options(cfg := TrainConfig.from_task(PLAIN), PLAIN) is cfg
    with pytest.raises(SystemExit):
        parse_train_flags(PLAIN, ["--pole-colour", "blue"], "train")
    assert "pole-colour" in capsys.readouterr().err


def test_flags_of_a_task_are_in_its_help(capsys):
    with pytest.raises(SystemExit) as ended:
        parse_train_flags(TASK, ["--help", "all"], "train")
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert "--pole-colour STR" in out
    assert "Colour of the pole." in out
    assert "--env.scene.num-envs" in out


def test_a_task_prepares_a_copy_of_its_config_before_it_is_built(tmp_path):
    checkpoint = Checkpoint(tmp_path / "model_3.pt")
    flags = ["--agent", "zero", "--pole-colour", "blue", "--wandb-run-path", "org/p/run"]
    cfg = parse_policy_flags(PlayConfig, flags, TASK, "play", purpose="play")
    env_cfg = env_cfg_of(TASK, cfg, checkpoint, purpose="play")
    assert env_cfg.prepared == ("blue", PolicyOrigin(TASK, checkpoint.path, "org/p/run"))
    assert not hasattr(cfg.env, "prepared")
    # A file on disk is of no run at Weights & Biases.
    cfg.checkpoint_file = str(checkpoint)
    assert env_cfg_of(TASK, cfg, checkpoint, purpose="play").prepared[1].wandb_run_path is None
    assert env_cfg_of(TASK, cfg, None, purpose="play").prepared[1] == PolicyOrigin(TASK)


def test_a_task_without_options_prepares_nothing():
    cfg = registry.load_env_cfg(PLAIN)
    before = {field.name: getattr(cfg, field.name) for field in fields(cfg)}
    prepare_env_cfg(PLAIN, None, cfg, None)
    assert {field.name: getattr(cfg, field.name) for field in fields(cfg)} == before


def test_options_with_the_name_of_a_flag_are_refused():
    with pytest.raises(ValueError, match=r"Clash.* got \['device'\]"):
        with_task_options(TrainConfig.from_task("Clash"), "Clash")


def test_options_that_cannot_be_imported_are_told():
    with pytest.raises(registry.TaskImportError, match="'By-Name' cannot be used"):
        with_task_options(TrainConfig.from_task("By-Name"), "By-Name")
