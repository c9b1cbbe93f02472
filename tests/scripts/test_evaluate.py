"""`evaluate`: its progress and its table. `test_policy_commands.py` has the command itself."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from mjlab.scripts import evaluate
from mjlab.scripts.evaluate import EvaluationProgress

METRICS = {
    "task": "Walk",
    "policy": "zero",
    "physics": "native",
    "num_episodes": 4,
    "num_envs": 4,
    "mean_length": 10.0,
    "mean_return": 1.0,
    "return_interval": (0.0, 2.0),
    "min_return": 0.0,
    "max_return": 2.0,
    "success_rate": None,
    "failure_interval": (0.0, 0.5),
    "metrics": {},
    "standing_still": {},
    "units": {},
    "curricula": {},
    "notes": [],
}


@pytest.mark.parametrize(
    ("terms", "failed", "expected"),
    [
        ([], 0.0, "Failures     none: the task has no termination but time limits"),
        (["fell"], 0.0, "Failures     0.0%   95 % interval [0.0%, 50.0%]"),
        (["fell"], 0.25, "Failures     25.0%   95 % interval [0.0%, 50.0%]   (ended by: fell 25.0%)"),
        # Diverged physics ends episodes without a termination.
        ([], 0.25, "Failures     25.0%   95 % interval [0.0%, 50.0%]   (ended by: diverged physics)"),
    ],
)  # fmt: skip
def test_failures_are_listed_by_termination_without_time_limits(terms, failed, expected):
    ended = {"time_out": 1.0 - failed, "fell": failed}
    metrics = {**METRICS, "failure_rate": failed, "terminations": ended}
    assert expected in evaluate._table(metrics, terms).splitlines()


def test_metrics_have_their_units():
    error = {"mean": 0.25, "interval": None}
    metrics = {**METRICS, "failure_rate": None, "metrics": {"speed": error, "share": error}}
    lines = evaluate._table({**metrics, "units": {"speed": "m/s"}}, []).splitlines()
    assert "speed        0.25 m/s   no interval" in lines
    assert "share        0.25   no interval" in lines


def test_errors_of_standing_still_are_beside_the_measured_ones():
    measured = {
        "error": {"mean": 0.1, "interval": None},
        "error_share": {"mean": 0.25, "interval": None},
    }
    metrics = {
        **METRICS,
        "failure_rate": None,
        "metrics": measured,
        "standing_still": {"error": 0.4},
    }
    lines = evaluate._table({**metrics, "units": {"error": "m/s"}}, []).splitlines()
    assert "error        0.1 m/s   no interval   (25% of standing still, 0.4 m/s)" in lines
    assert not any(line.startswith("error_share") for line in lines)


def test_no_share_of_an_error_that_standing_still_has_not():
    measured = {"error": {"mean": 0.1, "interval": None}}
    metrics = {**METRICS, "failure_rate": None, "metrics": measured}
    text = evaluate._table({**metrics, "standing_still": {"error": 0.0}, "units": {}}, [])
    assert "error        0.1   no interval   (standing still, 0)" in text
    assert "%" not in text.splitlines()[-1]


def test_elsewhere_lines_are_rare_and_go_to_stderr(capsys):
    with EvaluationProgress(8, Console(file=io.StringIO())) as progress:
        progress.update(1, 0.2)
        assert capsys.readouterr() == ("", "")
        progress._last -= 60.0
        progress.update(2, 0.25)
        progress.update(3, 0.4)
    assert capsys.readouterr() == ("", "Evaluating: 25%, 2 of 8 episodes finished\n")
