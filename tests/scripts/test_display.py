"""The live display: a panel on a terminal, plain lines elsewhere."""

from __future__ import annotations

import dataclasses
import io

import pytest
from rich.console import Console

from mjlab.rl.evaluation import EvaluationResult
from mjlab.rl.run_logger import IterationStats
from mjlab.scripts import display
from mjlab.scripts.display import TrainingDisplay, duration

STATS = IterationStats(
    iteration=3,
    total_iterations=10,
    total_steps=123456,
    collection_time=0.25,
    learning_time=0.5,
    steps_per_second=51200.0,
    mean_reward=12.5,
    mean_episode_length=None,
    mean_step_reward=0.125,
    learning_rate=1e-3,
    action_std=0.75,
    time_left=65.0,
)


def shown(*iterations: int, terminal: bool = False) -> str:
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=100)
    panel = TrainingDisplay("My-Task", console)
    panel.on_start(0, 10)
    for iteration in iterations:
        panel.on_iteration(dataclasses.replace(STATS, iteration=iteration))
    panel.on_end("finished")
    return out.getvalue()


@pytest.mark.parametrize("terminal", [False, True])
def test_speed_reward_length_and_time_left_are_shown(terminal):
    text = shown(3, terminal=terminal)
    parts = ["51,200", "0.25", "0.5", "12.50", "none finished yet", "1:05 min", "finished after"]
    parts += ["My-Task", "3/10", "123,456", "0.125"] if terminal else ["[3/10]"]
    assert [part for part in parts if part not in text] == []


def test_lines_are_rare_but_the_first_and_the_last_are_there(monkeypatch):
    monkeypatch.setattr(display, "_SECONDS_BETWEEN_LINES", 1000.0)
    lines = [line for line in shown(*range(1, 11)).splitlines() if line.startswith("[")]
    assert [line.split()[0] for line in lines] == ["[1/10]", "[10/10]"]


def test_a_log_file_gets_no_control_codes():
    assert "\x1b" not in shown(1, 10)


def test_how_an_evaluation_went_is_one_line_in_a_log_file():
    out = io.StringIO()
    result = EvaluationResult(
        num_episodes=64,
        mean_return=512.5,
        return_interval=(500.0, 525.0),
        std_return=20.0,
        min_return=450.0,
        max_return=560.0,
        mean_length=1000.0,
    )
    panel = TrainingDisplay("My-Task", Console(file=out, width=40))
    panel.on_evaluation(120, result, solved=False)
    assert out.getvalue() == (
        "Evaluation after 120 iterations: mean return 512.5 over 64 episodes, not solved yet.\n"
    )


@pytest.mark.parametrize(("solved", "verdict"), [(True, "solved"), (False, "not confirmed")])
def test_an_evaluation_that_confirms_is_told_apart_and_failures_have_their_interval(
    solved, verdict
):
    out = io.StringIO()
    result = EvaluationResult(
        num_episodes=200,
        mean_return=512.5,
        return_interval=None,
        std_return=None,
        min_return=450.0,
        max_return=560.0,
        mean_length=1000.0,
        failure_rate=0.03,
        failure_interval=(0.014, 0.064),
    )
    panel = TrainingDisplay("My-Task", Console(file=out, width=40))
    panel.on_evaluation(120, result, solved=True)
    panel.on_confirmation(120, result, solved=solved)
    first, second = out.getvalue().splitlines()
    assert "within all bounds" in first
    assert "solved" not in first
    assert "over 200 fresh episodes, 3.0% failed (1.4% to 6.4%)" in second
    assert verdict in second


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (8.44, "8.4 s"), (185, "3:05 min"), (7800, "2:10 h"), (3599.6, "1:00 h"),
     (59.97, "1:00 min")],
)  # fmt: skip
def test_durations_read_as_people_write_them(seconds, text):
    assert duration(seconds) == text
