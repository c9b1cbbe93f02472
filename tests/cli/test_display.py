"""The display of training: a panel on a terminal, plain lines elsewhere, and what to type next."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import shlex
import sys

import pytest
from commands import run_script
from rich.console import Console

from mjlab.cli import display
from mjlab.cli.display import TrainingDisplay, usual_iteration
from mjlab.cli.results import command_that_learns, next_commands
from mjlab.cli.train_config import parse_train_flags
from mjlab.rl.config import EvaluationCfg
from mjlab.rl.evaluation import EvaluationResult, MeanAndInterval
from mjlab.rl.progress import ProgressCfg, sparkline
from mjlab.rl.run_logger import IterationStats
from mjlab.scripts.train import TrainConfig
from mjlab.utils.processes import process_rank
from mjlab.utils.string import clock, counted, duration

SWINGUP = "Mjlab-Cartpole-Swingup"
RETURN = {"solved_return": 900.0, "trigger_fraction": 0.8}
BOUNDS = {
    "solved_below": {"lin_vel_error": 0.25, "failure_rate": 0.05},
    "units": {"lin_vel_error": "m/s"},
    "min_interval": 8,
}
STATS = IterationStats(
    iteration=3,
    total_iterations=10,
    total_steps=123456,
    collection_time=0.25,
    learning_time=0.5,
    steps_per_second=51200.0,
    mean_reward=12.5,
    mean_episode_length=None,
    mean_step_reward=0.741,
    exploring_return=741.0,
    exploring_length=1000.0,
    learning_rate=1e-3,
    action_std=0.75,
    time_left=65.0,
)


@pytest.fixture(autouse=True)
def typed_train(monkeypatch):
    """The next commands follow the one that was typed, here by pytest or `python -m pytest`."""
    monkeypatch.setattr(sys, "argv", ["train", SWINGUP])


def outcome(error: float = 0.31, failures: float = 0.075, mean_return: float = 845.0):
    return EvaluationResult(
        num_episodes=256,
        mean_return=mean_return,
        return_interval=None,
        std_return=None,
        min_return=0.0,
        max_return=1000.0,
        mean_length=1000.0,
        failure_rate=failures,
        failure_interval=(failures, failures),
        metrics={"lin_vel_error": MeanAndInterval(error, None)},
    )


class Shown:
    """A display that writes to a string, `text`."""

    def __init__(self, evaluation: dict, terminal=False, encoding="utf-8", **facts) -> None:
        self._out = io.TextIOWrapper(io.BytesIO(), encoding=encoding, write_through=True)
        console = Console(file=self._out, force_terminal=terminal, width=90, color_system=None)
        cfg = ProgressCfg(
            title=SWINGUP,
            evaluation=EvaluationCfg(**evaluation),
            step_seconds=0.02,
            episode_steps=1000,
            **facts,
        )
        self.panel = TrainingDisplay(cfg, console)
        self.panel.on_start(0, 10)

    def iterate(self, *iterations: int, **values: object) -> None:
        for iteration in iterations:
            self.panel.on_iteration(
                dataclasses.replace(STATS, iteration=iteration, **values)  # ty: ignore
            )

    @property
    def text(self) -> str:
        return self._out.buffer.getvalue().decode(self._out.encoding)  # ty: ignore

    def drawn(self, encoding: str = "utf-8") -> str:
        out = io.TextIOWrapper(io.BytesIO(), encoding=encoding, write_through=True)
        Console(file=out, width=90).print(self.panel)
        return out.buffer.getvalue().decode(encoding)  # ty: ignore


def test_the_exploring_return_stands_beside_the_return_that_solves():
    shown = Shown(RETURN)
    shown.iterate(3)
    panel = " ".join(shown.drawn().split())
    assert "return 741, exploring; 900 solves" in panel
    assert "at iteration 4" in panel
    assert "return=741(exploring) goal=900 steps/s=51200" in shown.text
    shown.iterate(4, mean_step_reward=0.5, exploring_return=500.0)
    assert "from exploring return 720 on" in shown.drawn()


@pytest.mark.parametrize("value", [0.4, float("nan")])
def test_an_exploring_bound_that_waits_is_shown(value):
    shown = Shown({**BOUNDS, "trigger_return": -math.inf, "trigger_below": {"lin_vel_error": 0.3}})
    shown.iterate(3, exploring={"lin_vel_error": value})
    assert f"from exploring lin vel error 0.3 m/s on ({value:.2f} now)" in shown.drawn()
    shown.iterate(4, exploring={"lin_vel_error": 0.2})
    assert "at iteration" in shown.drawn()


def test_other_bounds_have_the_last_evaluation_beside_them_and_its_trend():
    shown = Shown(BOUNDS)
    shown.iterate(1)
    assert "none yet" in shown.drawn()
    shown.panel.on_evaluation(1, outcome(error=0.4, failures=0.02), solved=False)
    shown.panel.on_evaluation(9, outcome(error=0.31, failures=0.075), solved=False)
    shown.iterate(9)
    rows = [" ".join(line.split()) for line in shown.drawn().splitlines()]
    assert "last eval lin vel error 0.31 m/s falling at most 0.25 m/s" in rows
    assert "failure rate 7.5 % rising at most 5 %" in rows
    assert "next eval at iteration 17" in rows
    line = shown.panel.line()
    assert "lin_vel_error=0.31(at_most_0.25_m/s) failure_rate=7.5%(at_most_5%) " in line
    assert "evaluated_at=9" in line
    shown.panel.on_evaluation(17, outcome(error=0.2), solved=False)
    assert "0.2 m/s met" in " ".join(shown.drawn().split())


@pytest.mark.parametrize(
    ("evaluation", "reason", "result", "parts"),
    [
        (RETURN, "solved", outcome(mean_return=967.0), ["Finished: solved at iteration 10, ", "967 of 900"]),
        (RETURN, "finished", outcome(), ["Finished: unsolved", "Return 845 of 900, missed by 55"]),
        (RETURN, "finished", outcome(mean_return=899.9), ["899.9 of 900, missed by 0.1"]),
        (RETURN, "finished", outcome(mean_return=950.0), ["Finished: all bounds met"]),
        (RETURN, "finished", None, ["unsolved", "741, exploring", "not evaluated", "Goal: return at least 900"]),
        (BOUNDS, "finished", outcome(), ["unsolved", "0.31 m/s (at most 0.25 m/s), missed by 0.06 m/s", "missed by 2.5 points"]),
        ({}, "finished", None, ["Finished at iteration 10 of 10, ", "Return 741, exploring."]),
        (RETURN, "interrupted", None, ["Interrupted at iteration 10 of 10"]),
        (RETURN, "failed", None, ["Failed at iteration 10 of 10"]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("terminal", [False, True])
def test_the_end_says_which_bound_was_missed_by_how_much(
    evaluation, reason, result, parts, terminal
):
    shown = Shown(evaluation, terminal)
    shown.iterate(10)
    if result is not None:
        shown.panel.on_evaluation(10, result, solved=False)
    shown.panel.on_end(reason)
    *_, ending = shown.text.splitlines()
    assert [part for part in parts if part not in ending] == []


def test_rates_are_shown_as_observed_beside_what_is_judged():
    shown = Shown(BOUNDS, terminal=False)
    shown.iterate(10)
    none_failed = dataclasses.replace(outcome(failures=0.0), failure_interval=(0.0, 0.0876))
    shown.panel.on_evaluation(10, none_failed, solved=False)
    assert "failure_rate=0%(judged_4.38%_at_most_5%)" in shown.panel.line()
    shown.panel.on_end("finished")
    *_, ending = shown.text.splitlines()
    assert "ailure rate 0 % (judged: 4.38 %) (at most 5 %)" in ending


def test_dumb_terminals_get_lines(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    shown = Shown(RETURN, terminal=True)
    shown.iterate(10)
    assert "[10/10]" in shown.text


def test_a_run_that_fails_before_it_starts_is_shown_as_failed(capsys):
    TrainingDisplay(ProgressCfg(evaluation=EvaluationCfg()), Console(file=sys.stdout)).on_end(
        "failed"
    )
    assert capsys.readouterr().out == "Failed before the first iteration.\n"


def test_no_border_is_drawn_and_characters_fit_the_encoding():
    shown = Shown(RETURN, terminal=True, encoding="ascii", usual_iteration=8)
    shown.iterate(*range(1, 6))
    shown.iterate(6, exploring_return=float("nan"))
    shown.panel.on_evaluation(6, outcome(), solved=False)
    assert shown.drawn("ascii").isascii()
    assert not set("│─╭╰|") & set(shown.drawn())
    shown.panel.on_end("finished")
    assert shown.text.isascii()


def test_the_time_left_is_at_most_and_the_usual_end_is_named():
    shown = Shown(RETURN, usual_iteration=8)
    shown.iterate(3)
    # 65 s are left for 7 iterations, 5 of them until the task is usually solved.
    drawn = " ".join(shown.drawn().split())
    assert "usually solved near iteration 8, in 46.4 s; at most 1:05 min left" in drawn
    line = shown.panel.line()
    assert "usually_solved_near=8(in_0:46)" in line
    assert "left" not in line
    shown.iterate(9)
    assert "left_at_most=1:05" in shown.panel.line()
    assert "near iteration 8, in" not in shown.drawn()
    assert "usually" not in Shown(RETURN, usual_iteration=11).drawn()


def test_a_line_has_no_estimate_that_says_little():
    for facts, words in (({}, []), ({"usual_iteration": 8}, ["usually_solved_near=8"])):
        shown = Shown(RETURN, **facts)
        shown.iterate(1, time_left=None)
        parts = shown.text.split()
        assert parts[2:] == ["return=741(exploring)", "goal=900", "steps/s=51200", *words]
        assert "starting ..." in shown.drawn()


def test_an_evaluated_return_stands_beside_the_goal():
    shown = Shown(RETURN)
    shown.panel.on_evaluation(3, outcome(mean_return=964.0), solved=True)
    shown.iterate(3)
    assert "return=741(exploring) evaluated_return=964 goal=900 evaluated_at=3" in shown.text


@pytest.mark.parametrize(
    ("task", "flags", "known"),
    [
        (SWINGUP, ["--profile", "cpu"], True),
        (SWINGUP, [], False),
    ],
)
def test_the_usual_end_is_that_of_reference_runs_with_the_same_settings(task, flags, known):
    usual = usual_iteration(task, parse_train_flags(task, flags, "train"))
    assert (usual is not None and 10 < usual < 500) == known


def test_lines_are_rare_but_the_first_and_the_last_are_there(monkeypatch):
    monkeypatch.setattr(display, "_SECONDS_BETWEEN_LINES", 1000.0)
    shown = Shown(RETURN)
    shown.iterate(*range(1, 11))
    lines = [line for line in shown.text.splitlines() if line.startswith("[")]
    assert [line.split()[0] for line in lines] == ["[1/10]", "[10/10]"]


def test_the_line_of_the_iteration_that_solved_the_task_is_there_once(monkeypatch):
    monkeypatch.setattr(display, "_SECONDS_BETWEEN_LINES", 1000.0)
    shown = Shown(RETURN)
    shown.iterate(*range(1, 8))
    shown.panel.on_evaluation(7, outcome(), solved=True)
    shown.panel.on_confirmation(7, outcome(), solved=True)
    shown.panel.on_end("solved")
    words = [line.split()[0] for line in shown.text.splitlines()]
    assert [word for word in words if word.startswith("[")] == ["[1/10]", "[7/10]"]
    assert words.index("[7/10]") < words.index("Evaluation")


def test_a_log_file_gets_no_control_codes_and_words_of_key_and_value():
    shown = Shown(BOUNDS)
    shown.iterate(1, exploring_return=3704.0)
    shown.panel.on_evaluation(1, outcome(), solved=False)
    shown.iterate(10, exploring_return=3704.0)
    assert "\x1b" not in shown.text
    last = shown.text.splitlines()[-1].split()
    assert last[2] == "return=3704(exploring)"
    assert [word for word in last[2:] if word.count("=") != 1] == []


def test_an_evaluation_that_confirms_has_failures_with_their_interval():
    result = dataclasses.replace(outcome(), failure_rate=0.03, failure_interval=(0.014, 0.064))
    for solved, verdict in ((True, "solved"), (False, "not confirmed")):
        shown = Shown(RETURN)
        shown.panel.on_evaluation(120, result, solved=True)
        shown.panel.on_confirmation(120, result, solved=solved)
        assert "256 episodes" in shown.text
        assert "3.0% failed (1.4% to 6.4%)" in shown.text
        assert verdict in shown.text


@pytest.mark.parametrize(
    ("flags", "root"),
    [([], []), (["--log-root", "a b"], ["--log-root", "a b"])],
)
def test_the_next_commands_name_the_folder_if_it_is_needed(flags, root, tmp_path):
    cfg = parse_train_flags(SWINGUP, flags, "train")
    commands = [shlex.split(line) for line in next_commands(SWINGUP, cfg, tmp_path, "solved")]
    assert commands == [
        ["uv", "run", "mjlab", name, SWINGUP, *root] for name in ("play", "evaluate")
    ]


def test_an_interrupted_run_is_resumed_without_its_settings(tmp_path):
    flags = ["--num-envs", "8", "--env.decimation", "2", "--device", "cpu", "--live", "True"]
    cfg = parse_train_flags(SWINGUP, flags, "train")
    resume, play, _ = map(shlex.split, next_commands(SWINGUP, cfg, tmp_path, "interrupted"))
    program = ["uv", "run", "mjlab"]
    expected = ["train", SWINGUP, "--device", "cpu", "--agent.resume", "True"]
    assert (resume, play) == ([*program, *expected], [*program, "play", SWINGUP])


def test_the_next_commands_of_a_script_are_called_through_it(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["examples/mine.py", "train", SWINGUP])
    play, _ = next_commands(SWINGUP, TrainConfig.from_task(SWINGUP), tmp_path, "solved")
    assert play == f"uv run python examples/mine.py play {SWINGUP}"


@pytest.mark.parametrize(
    ("flags", "device", "ended", "is_suggested"),
    [
        ([], "cpu", "finished", True),
        ([], "cpu", "interrupted", True),
        ([], "cpu", "solved", False),
        ([], "cuda:0", "finished", False),
        (["--num-envs", "8"], "cpu", "finished", False),
        (["--profile", "cpu"], "cpu", "finished", False),
    ],
)
def test_an_unsolved_default_run_names_settings_that_learn(flags, device, ended, is_suggested):
    cfg = parse_train_flags(SWINGUP, flags, "train")
    cfg.apply_short_forms(process_rank())
    found = command_that_learns(SWINGUP, cfg, device, ended)
    assert found == (f"uv run mjlab train {SWINGUP} --profile cpu" if is_suggested else None)


@pytest.mark.parametrize(
    "name",
    [
        "cartpole",
        pytest.param("elsewhere", marks=pytest.mark.slow),
    ],
)
def test_the_printed_commands_find_the_policy(trained, name):
    cfg = parse_train_flags(SWINGUP, ["--log-root", str(trained.parents[1])], "train")
    cfg.agent.experiment_name = name
    *_, line = next_commands(SWINGUP, cfg, trained, "finished")
    _, _, _, script, *argv = shlex.split(line)
    scored = run_script(script, *argv, "--num-episodes", "1", "--max-steps", "2", "--json", "True")
    assert scored.status == 0, scored.err
    assert json.loads(scored.out)["policy"] == str(trained / "model_1.pt")


def test_a_sparkline_shows_the_course_and_skips_nan():
    assert sparkline([0.0, float("nan"), 7.0], "01234567") == "07"
    assert sparkline([1.0, 1.0], "01") == "00"
    assert sparkline([], "01") == ""
    assert len(sparkline(list(map(float, range(1000))))) == 24


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (8.44, "8.4 s"), (185, "3:05 min"), (7800, "2:10 h"), (3599.6, "1:00 h"),
     (59.97, "1:00 min")],
)  # fmt: skip
def test_durations_read_as_people_write_them(seconds, text):
    assert duration(seconds) == text


def test_counts_and_clocks_read_as_people_write_them():
    assert [counted(n, "environment") for n in (1, 4096)] == ["1 environment", "4,096 environments"]
    assert [clock(s) for s in (5, 161, 3761)] == ["0:05", "2:41", "1:02:41"]
