"""Flags: values, terms switched off, and options of tasks."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import pytest
import torch

from mjlab.cli.flags import (
    options_of,
    parse_flags,
    prepare_env_cfg,
    switch_terms_off,
    with_task_options,
)
from mjlab.cli.policy_flags import env_cfg_of, parse_policy_flags
from mjlab.cli.train_config import parse_train_flags
from mjlab.envs import mdp
from mjlab.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    MetricsTermCfg,
    ObservationGroupCfg,
    RecorderTerm,
    RecorderTermCfg,
    TerminationTermCfg,
)
from mjlab.runs import Checkpoint
from mjlab.scripts.evaluate import EvaluateConfig
from mjlab.scripts.play import PlayConfig
from mjlab.scripts.train import TrainConfig
from mjlab.tasks import registry
from mjlab.tasks.registry import PolicyOrigin, TaskOptions
from mjlab.utils.os import to_plain


@dataclass
class Inner:
    """Things."""

    rate: float = 1.0
    """A rate."""
    switch: bool = False
    """A switch below the top."""


@dataclass
class Flags:
    """Flags of a command."""

    fast_mode: bool = False
    """A switch."""
    count: int | None = None
    """A number."""
    inner: Inner = field(default_factory=Inner)
    """More."""


def parsed(*flags: str) -> Flags:
    return parse_flags(Flags, Flags(), list(flags), "try")


def test_flags_replace_fields_and_leave_the_others():
    flags = parsed("--inner.rate", "3e-4", "--count", "5")
    assert flags == Flags(count=5, inner=Inner(rate=3e-4))
    assert parsed("--count", "None") == Flags()


@pytest.mark.parametrize("flag", ["--fast-mode", "--fast_mode"])
def test_a_switch_needs_no_value_and_takes_one(flag):
    assert parsed(flag) == Flags(fast_mode=True)
    assert parsed(flag, "--count", "2") == Flags(fast_mode=True, count=2)
    assert parsed(flag, "True") == Flags(fast_mode=True)
    assert parsed(flag, "False") == Flags()


@pytest.mark.parametrize(
    ("flags", "named"),
    [(["--cuont", "3"], "--cuont"), (["--count", "many"], "many"), (["stray"], "stray")],
)
def test_wrong_flags_end_with_status_2(flags, named, capsys):
    with pytest.raises(SystemExit) as caught:
        parsed(*flags)
    assert caught.value.code == 2
    assert named in capsys.readouterr().err


def test_a_mistyped_flag_is_answered_with_the_nearest(capsys):
    with pytest.raises(SystemExit):
        parsed("--inner.ratee", "3")
    assert "--inner.rate" in capsys.readouterr().err


def test_parsing_leaves_the_default_as_it_was():
    default = Flags()
    parse_flags(Flags, default, ["--inner.rate", "9", "--fast-mode"], "try")
    assert default == Flags()


# Values.


GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
ACTOR = "--env.observations.actor.terms"


def test_overrides_of_observations_reach_the_config():
    cfg = parse_train_flags(
        GO1,
        [
            f"{ACTOR}.joint-vel.scale", "0.05",
            f"{ACTOR}.base-lin-vel.scale", "(2.0,2.0,0.25)",
            f"{ACTOR}.base-ang-vel.scale", "[1, 1, 0.5]",
            f"{ACTOR}.projected-gravity.noise", "None",
            f"{ACTOR}.joint_pos.noise=None",
            f"{ACTOR}.actions.noise", "None",
            f"{ACTOR}.base-lin-vel.noise.n-max", "0.3",
            f"{ACTOR}.base-lin-vel.clip", "[-5.0,5.0]",
        ],
        "train",
    )  # fmt: skip
    terms = cfg.env.observations["actor"].terms
    assert terms["joint_vel"].scale == 0.05
    assert terms["base_lin_vel"].scale == (2.0, 2.0, 0.25)
    assert terms["base_ang_vel"].scale == (1, 1, 0.5)
    assert terms["command"].scale is None
    assert [name for name, term in terms.items() if term.noise is None] == [
        "projected_gravity", "joint_pos", "actions", "command",
    ]  # fmt: skip
    assert terms["base_lin_vel"].noise.n_max == 0.3
    assert terms["base_lin_vel"].clip == (-5.0, 5.0)
    # The same function of the critic has a separate config.
    assert cfg.env.observations["critic"].terms["joint_vel"].scale is None


def test_lists_are_taken_for_tuples_wherever_a_tuple_is_declared():
    cfg = parse_train_flags(
        GO1,
        [
            "--agent.actor.hidden-dims", "[32,16]",
            "--env.events.push-robot.interval-range-s", "[1.0, 2.0]",
            "--env.events.reset-base.params.pose-range.x", "[-0.1,0.1]",
            "--env.commands.twist.ranges.lin-vel-x", "[-1.0,2.0]",
            "--gpu-ids", "(0,1)",
        ],
        "train",
    )  # fmt: skip
    assert cfg.agent.actor.hidden_dims == (32, 16)  # ty: ignore
    assert cfg.env.events["push_robot"].interval_range_s == (1.0, 2.0)
    assert cfg.env.events["reset_base"].params["pose_range"]["x"] == (-0.1, 0.1)
    assert cfg.env.commands["twist"].ranges.lin_vel_x == (-1.0, 2.0)  # ty: ignore
    assert cfg.gpu_ids == [0, 1]


@dataclass
class Pairs:
    pairs: list[tuple[int, int]] = field(default_factory=list)
    bounds: tuple[tuple[float, float], ...] = ()
    weights: torch.Tensor | None = None
    axis: tuple[int, int] = (0, 1)
    joints: str | tuple[str, ...] = ".*"


def parsed_pairs(*flags: str) -> Pairs:
    return parse_flags(Pairs, Pairs(), list(flags), "test")


def test_brackets_follow_the_type_at_every_depth():
    flags = parsed_pairs("--pairs", "([1,2],(3,4))", "--bounds", "[[0.0,1.0],[2.0,3.0]]")
    assert flags.pairs == [(1, 2), (3, 4)]
    assert flags.bounds == ((0.0, 1.0), (2.0, 3.0))


def test_patterns_are_one_string_or_a_sequence_in_brackets():
    assert parsed_pairs("--joints", ".*_knee").joints == ".*_knee"
    assert parsed_pairs("--joints", "[abc]_knee").joints == "[abc]_knee"
    assert parsed_pairs("--joints", "('hip','knee')").joints == ("hip", "knee")
    assert parsed_pairs("--joints", "['knee']").joints == ("knee",)
    assert parsed_pairs("--joints", "()").joints == ()


def test_tensors_are_read_and_defaults_are_kept():
    weights = parsed_pairs("--weights", "[[1,2],[3,4]]").weights
    assert weights is not None
    assert torch.equal(weights, torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    assert parsed_pairs("--weights", "None").weights is None
    assert torch.equal(
        parse_flags(Pairs, Pairs(weights=torch.ones(2)), [], "test").weights, torch.ones(2)
    )


@pytest.mark.parametrize(
    "flags", [("--axis", "[1]"), ("--axis", "[1,2.5]"), ("--axis", "1"), ("--weights", "[a]")]
)
def test_values_of_another_type_end_the_command(flags, capsys):
    with pytest.raises(SystemExit):
        parsed_pairs(*flags)
    assert flags[0] in capsys.readouterr().err + capsys.readouterr().out


# Terms switched off.


if TYPE_CHECKING:
    from pathlib import Path as KnownToCheckers

SWINGUP = "Mjlab-Cartpole-Swingup"


@pytest.fixture
def config() -> TrainConfig:
    return TrainConfig.from_task(SWINGUP)


@pytest.mark.parametrize(
    "flags",
    [
        ["--env.rewards.smooth-reward", "None"],
        ["--env.rewards.smooth_reward", "None"],
        ["--env.rewards.smooth_reward=None"],
    ],
)
def test_every_spelling_switches_the_term_off(config, flags):
    edited, remaining = switch_terms_off(config, ["--num-envs", "3", *flags, "--device", "cpu"])
    assert edited.env.rewards == {"smooth_reward": None}
    assert remaining == ["--num-envs", "3", "--device", "cpu"]


@pytest.mark.parametrize(
    ("path", "term"),
    [
        (
            "observations.actor.terms.pole-vel",
            lambda env: env.observations["actor"].terms["pole_vel"],
        ),
        ("observations.critic", lambda env: env.observations["critic"]),
        ("actions.effort", lambda env: env.actions["effort"]),
        ("terminations.time-out", lambda env: env.terminations["time_out"]),
        ("events.reset-hinge", lambda env: env.events["reset_hinge"]),
        ("curriculum.stage", lambda env: env.curriculum["stage"]),
        ("metrics.figure", lambda env: env.metrics["figure"]),
        ("recorders.tape", lambda env: env.recorders["tape"]),
    ],
)
def test_every_kind_of_term_can_be_switched_off(config, path, term):
    config.env.curriculum["stage"] = CurriculumTermCfg(func=print)
    config.env.metrics["figure"] = MetricsTermCfg(func=print)
    config.env.recorders["tape"] = RecorderTermCfg(func=RecorderTerm)
    edited, remaining = switch_terms_off(config, [f"--env.{path}", "None"])
    assert term(edited.env) is None
    assert remaining == []
    assert term(config.env) is not None, "the input config must be unchanged"


@pytest.mark.parametrize(
    "flags",
    [
        ["--env.rewards.no-such-term", "None"],
        ["--env.rewards.smooth-reward", "3"],
        ["--env.rewards.smooth-reward"],
        ["--env.rewards", "None"],
        ["--env.rewards.smooth-reward.weight", "None"],
        ["--env.scene.entities.cartpole", "None"],
        ["--env.seed", "None"],
        ["--env.observations.actor.terms.pole-vel.func", "None"],
        ["--nothing.at.all", "None"],
        ["--agent.algorithm", "None"],
        ["env.rewards.smooth-reward", "None"],
    ],
)
def test_whatever_is_not_a_term_is_left_to_the_parser(config, flags):
    edited, remaining = switch_terms_off(config, flags)
    assert remaining == flags
    assert to_plain(edited) == to_plain(config)


@dataclass(kw_only=True)
class AnnotatedForCheckersCfg(EventTermCfg):
    source: KnownToCheckers | None = None


def test_configs_for_type_checkers_are_parsed(config):
    config.env.events["odd"] = AnnotatedForCheckersCfg(func=print, mode="reset")
    flags = ["--env.events.odd.source", "None"]
    assert switch_terms_off(config, flags)[1] == flags


def test_the_rest_of_the_command_line_still_counts(config):
    flags = ["--env.events.reset-hinge", "None", "--env.decimation", "2", "--env.seed", "None"]
    parsed = parse_flags(TrainConfig, config, flags, "train")
    assert parsed.env.events["reset_hinge"] is None
    assert parsed.env.events["reset_slider"].func is mdp.reset_joints_by_offset
    assert parsed.env.decimation == 2


def test_a_term_that_is_off_already_can_be_parsed(config):
    config.env.terminations["never"] = None
    config.env.terminations["late"] = TerminationTermCfg(func=mdp.time_out)
    config.env.observations["extra"] = ObservationGroupCfg(terms={"a": None})
    parsed = parse_flags(TrainConfig, config, ["--env.terminations.late", "None"], "train")
    assert parsed.env.terminations["never"] is None
    assert parsed.env.terminations["late"] is None
    assert parsed.env.terminations["time_out"] is not None


def test_training_goes_on_without_the_term(train, tmp_path):
    run_dir = train(tmp_path, 1, "--env.observations.critic.terms.cart-vel", "None")
    assert (run_dir / "model_0.pt").is_file()
    text = (run_dir / "params" / "env.yaml").read_text()
    assert text.count("cart_vel: null") == 1


# Options of a task.


WITH_OPTIONS = "Test-With-Options"
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
    for name, options in (
        (WITH_OPTIONS, Options),
        ("Clash", Clashing),
        ("By-Name", "no.module:Options"),
    ):
        registry.register_mjlab_task(
            name, plain.env_cfg, plain.play_env_cfg, plain.rl_cfg, options=options
        )


def test_the_options_of_a_task_are_flags_of_every_command():
    cfg = parse_train_flags(WITH_OPTIONS, ["--pole-colour", "blue", "--num-envs", "3"], "train")
    assert isinstance(cfg, TrainConfig)
    assert (options_of(WITH_OPTIONS, cfg).pole_colour, cfg.num_envs) == ("blue", 3)
    for kind in (PlayConfig, EvaluateConfig):
        found = parse_policy_flags(
            kind,
            ["--agent", "zero", "--pole-colour=green"],
            WITH_OPTIONS,
            "command",
            purpose="play",
        )
        assert isinstance(found, kind)
        assert options_of(WITH_OPTIONS, found).pole_colour == "green"


def test_without_flags_options_have_their_defaults():
    assert options_of(WITH_OPTIONS, None).pole_colour == "red"
    assert options_of(WITH_OPTIONS, TrainConfig.from_task(WITH_OPTIONS)).pole_colour == "red"
    assert type(options_of(PLAIN, None)) is TaskOptions
    assert TaskOptions().runner_kwargs() == {}


def test_other_tasks_do_not_have_the_flag(capsys):
    assert with_task_options(cfg := TrainConfig.from_task(PLAIN), PLAIN) is cfg
    with pytest.raises(SystemExit):
        parse_train_flags(PLAIN, ["--pole-colour", "blue"], "train")
    assert "pole-colour" in capsys.readouterr().err


def test_flags_of_a_task_are_in_its_help(capsys):
    with pytest.raises(SystemExit) as ended:
        parse_train_flags(WITH_OPTIONS, ["--help", "all"], "train")
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert "--pole-colour STR" in out
    assert "Colour of the pole." in out
    assert "--env.scene.num-envs" in out


def test_a_task_prepares_a_copy_of_its_config_before_it_is_built(tmp_path):
    checkpoint = Checkpoint(tmp_path / "model_3.pt")
    flags = ["--agent", "zero", "--pole-colour", "blue", "--wandb-run-path", "org/p/run"]
    cfg = parse_policy_flags(PlayConfig, flags, WITH_OPTIONS, "play", purpose="play")
    env_cfg = env_cfg_of(WITH_OPTIONS, cfg, checkpoint, purpose="play")
    assert env_cfg.prepared == ("blue", PolicyOrigin(WITH_OPTIONS, checkpoint.path, "org/p/run"))
    assert not hasattr(cfg.env, "prepared")
    # A file on disk is of no run at Weights & Biases.
    cfg.checkpoint_file = str(checkpoint)
    assert (
        env_cfg_of(WITH_OPTIONS, cfg, checkpoint, purpose="play").prepared[1].wandb_run_path is None
    )
    assert env_cfg_of(WITH_OPTIONS, cfg, None, purpose="play").prepared[1] == PolicyOrigin(
        WITH_OPTIONS
    )


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
