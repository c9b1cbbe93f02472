"""Values of flags: scales of observations, lists for tuples, tensors, and configs set to None."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
import torch

from mjlab.cli.flags import parse_flags
from mjlab.cli.train_config import parse_train_flags

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
ACTOR = "--env.observations.actor.terms"


def test_overrides_of_observations_reach_the_config():
    cfg = parse_train_flags(
        TASK,
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
        TASK,
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
class Flags:
    pairs: list[tuple[int, int]] = field(default_factory=list)
    bounds: tuple[tuple[float, float], ...] = ()
    weights: torch.Tensor | None = None
    axis: tuple[int, int] = (0, 1)
    joints: str | tuple[str, ...] = ".*"


def parsed(*flags: str) -> Flags:
    return parse_flags(Flags, Flags(), list(flags), "test")


def test_brackets_follow_the_type_at_every_depth():
    flags = parsed("--pairs", "([1,2],(3,4))", "--bounds", "[[0.0,1.0],[2.0,3.0]]")
    assert flags.pairs == [(1, 2), (3, 4)]
    assert flags.bounds == ((0.0, 1.0), (2.0, 3.0))


def test_patterns_are_one_string_or_a_sequence_in_brackets():
    assert parsed("--joints", ".*_knee").joints == ".*_knee"
    assert parsed("--joints", "[abc]_knee").joints == "[abc]_knee"
    assert parsed("--joints", "('hip','knee')").joints == ("hip", "knee")
    assert parsed("--joints", "['knee']").joints == ("knee",)
    assert parsed("--joints", "()").joints == ()


def test_tensors_are_read_and_defaults_are_kept():
    weights = parsed("--weights", "[[1,2],[3,4]]").weights
    assert weights is not None
    assert torch.equal(weights, torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    assert parsed("--weights", "None").weights is None
    assert torch.equal(
        parse_flags(Flags, Flags(weights=torch.ones(2)), [], "test").weights, torch.ones(2)
    )


@pytest.mark.parametrize(
    "flags", [("--axis", "[1]"), ("--axis", "[1,2.5]"), ("--axis", "1"), ("--weights", "[a]")]
)
def test_values_of_another_type_end_the_command(flags, capsys):
    with pytest.raises(SystemExit):
        parsed(*flags)
    assert flags[0] in capsys.readouterr().err + capsys.readouterr().out
