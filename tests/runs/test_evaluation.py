"""Evaluations in files: whose they are, and their rows."""

from __future__ import annotations

import json

import pytest

from mjlab.runs.evaluation import evaluation_command, evaluation_rows, read_evaluation

TASK = "Walk"
EVALUATION = {
    "task": TASK,
    "policy": "elsewhere/run/model_9.pt",
    "mean_return": 1234.5,
    "return_interval": [1200.0, 1269.0],
    "success_rate": None,
    "failure_rate": 0.05,
    "failure_interval": [0.02, 0.11],
    "metrics": {
        "speed_error": {"mean": 0.25, "interval": None},
        "speed_error_share": {"mean": 0.5, "interval": [0.4, 0.6]},
    },
    "standing_still": {"speed_error": 0.5},
    "units": {"speed_error": "m/s"},
}


@pytest.mark.parametrize(
    ("change", "is_of_policy"),
    [({}, True), ({"task": "Run"}, False), ({"policy": "elsewhere/run/model_8.pt"}, False)],
)
def test_evaluations_of_others_are_left_out(change, is_of_policy, tmp_path):
    path = tmp_path / "evaluation.json"
    content = {**EVALUATION, **change}
    path.write_text(json.dumps(content))
    found = read_evaluation(path, TASK, tmp_path / "model_9.pt")
    assert found == (content if is_of_policy else None)


def test_missing_evaluations_are_none(tmp_path):
    assert read_evaluation(tmp_path / "evaluation.json", TASK, tmp_path / "model_9.pt") is None


@pytest.mark.parametrize("text", ["", "[1]", '{"task": "Walk", "policy": "model_9.pt"}', "null"])
def test_damaged_evaluations_are_left_out_with_a_warning(text, tmp_path):
    path = tmp_path / "evaluation.json"
    path.write_text(text)
    with pytest.warns(UserWarning, match=r"evaluation\.json"):
        assert read_evaluation(path, TASK, tmp_path / "model_9.pt") is None


def test_rows_have_values_units_and_intervals():
    assert evaluation_rows(EVALUATION) == [
        ("mean return", "1,234", "1,200 to 1,269"),
        ("failure rate", "5.0 %", "2.0 to 11.0"),
        ("speed_error", "0.25 m/s", ""),
        ("speed_error, share of standing still", "50.0 %", "40.0 to 60.0"),
    ]


def test_command_writes_the_file_that_is_read(tmp_path):
    words = evaluation_command(TASK, tmp_path / "model_9.pt", "cpu").split()
    assert words[words.index("--output") + 1] == str(tmp_path / "evaluation.json")
