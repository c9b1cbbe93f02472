"""Logs of robots and answers of other programs."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mjlab.deploy.check import Report
from mjlab.deploy.logs import check_answers, check_log
from mjlab.utils.errors import UserError

Columns = dict[str, np.ndarray]


def golden(folder: Path) -> Columns:
    """Return the columns of `golden.csv`."""
    with (folder / "golden.csv").open() as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, float).T, strict=True))


def written(path: Path, columns: Columns) -> Path:
    lines = [",".join(columns)]
    lines += [",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def log_of(bundle, tmp_path) -> Callable[..., Report]:
    """Return a function that checks a log: `golden.csv` with changed columns."""

    def check(change: Callable[[Columns], None], name: str = "g1") -> Report:
        columns = golden(bundle(name))
        change(columns)
        return check_log(bundle(name), written(tmp_path / "log.csv", columns))

    return check


def in_place(prefix: str, function: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """Return a change of the columns whose names begin with `prefix`, taken as (K, n)."""

    def change(columns: Columns) -> None:
        names = [name for name in columns if name.startswith(prefix)]
        assert names
        values = function(np.stack([columns[name] for name in names], axis=1))
        columns.update(zip(names, values.T, strict=True))

    return change


def part(columns: Columns, start: int, stop: int) -> list[str]:
    return [f"obs.{k}" for k in range(start, stop)]


@pytest.mark.parametrize("name", ["go1", "g1"])
def test_golden_table_is_a_log_without_differences(log_of, name):
    report = log_of(lambda columns: None, name)
    assert report.is_passed, str(report)
    assert {one.stage for one in report.comparisons} == {"history", "vector", "action", "target"}
    assert any(note.startswith("sensors, torque") for note in report.undecided)
    assert "median 20.00 ms" in " ".join(report.notes)


def test_plain_names_of_columns(log_of):
    def rename(columns: Columns) -> None:
        names = {"measurement.root_quat.": "quaternion.", "measurement.imu_ang_vel.": "gyroscope."}
        for old, new in names.items():
            letters = "wxyz" if new == "quaternion." else "xyz"
            for k, letter in enumerate(letters):
                columns[f"{new}{letter}"] = columns.pop(f"{old}{k}")
        for kind, new in (("joint_pos", "position"), ("joint_vel", "velocity")):
            for key in [key for key in columns if key.startswith(f"measurement.{kind}.")]:
                columns[f"{new}.{key.rsplit('.', 1)[1]}"] = columns.pop(key)

    report = log_of(rename)
    assert report.is_passed
    assert not any("not in the log" in note for note in report.undecided)


def test_wrong_observation_in_a_log_is_named(log_of):
    def negate(columns: Columns) -> None:
        for name in part(columns, 15, 30):
            columns[name] = -columns[name]

    report = log_of(negate)
    assert report.causes == ["opposite sign"]
    (finding,) = report.findings
    assert finding.comparison.name == "term/obs/projected_gravity"


def test_action_is_compared_at_the_logged_observation(log_of):
    report = log_of(in_place("action.", lambda x: -x))
    assert "opposite sign" in report.causes
    # The observations of the next steps hold the last action of the log.
    assert {one.comparison.stage for one in report.findings} <= {"history", "action"}


def test_late_targets_are_named(log_of):
    report = log_of(in_place("target.", lambda x: np.concatenate((x[:1], x[:-1]))))
    assert report.causes == ["one control step late"]


def test_period_of_a_log(log_of):
    slow = log_of(in_place("time", lambda x: 1.25 * x))
    assert "25.00 ms" in slow.notes[0]
    assert any("other control rate" in note for note in slow.notes)


def test_missing_columns_are_named(log_of):
    def drop(columns: Columns) -> None:
        for name in [name for name in columns if "imu_ang_vel" in name or name[:4] == "obs."]:
            del columns[name]

    report = log_of(drop)
    notes = " ".join(report.undecided)
    assert "measurement imu_ang_vel: not in the log" in notes
    assert "obs: not in the log" in notes
    assert report.is_passed


# Answers.


def test_answers_of_another_program(bundle, tmp_path):
    folder = bundle("go1")
    columns = golden(folder)
    answers = {k: v for k, v in columns.items() if k.split(".")[0] in ("obs", "action", "target")}
    assert check_answers(folder, written(tmp_path / "a.csv", answers)).is_passed
    for k in range(6, 18):
        answers[f"obs.{k}"] = np.roll(columns[f"obs.{k}"], 1)
    some = {"step": columns["step"][3:], **{k: v[3:] for k, v in answers.items()}}
    report = check_answers(folder, written(tmp_path / "a.csv", some))
    assert report.causes == ["one control step late"]


def test_answers_need_a_known_column(bundle, tmp_path):
    with pytest.raises(UserError, match="obs"):
        check_answers(bundle("go1"), written(tmp_path / "a.csv", {"step": np.arange(3.0)}))
