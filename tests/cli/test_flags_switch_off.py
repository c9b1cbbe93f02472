"""Terms are switched off by `--env.<kind>.<term> None`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from mjlab.cli.flags import parse_flags, switch_terms_off
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
from mjlab.scripts.train import TrainConfig
from mjlab.utils.os import to_plain

if TYPE_CHECKING:
    from pathlib import Path as KnownToCheckers

TASK = "Mjlab-Cartpole-Swingup"


@pytest.fixture
def config() -> TrainConfig:
    return TrainConfig.from_task(TASK)


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


def test_a_config_annotated_for_type_checkers_alone_is_left_to_the_parser(config):
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
