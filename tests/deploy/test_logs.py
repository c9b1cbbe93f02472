"""Logs of robots and answers of other programs."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import write_random

from mjlab.deploy.check import Report
from mjlab.deploy.logs import check_answers, check_log
from mjlab.managers import ObservationTermCfg
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
    stages = {one.stage for one in report.comparisons}
    assert stages == {"rates", "history", "vector", "action", "target"}
    assert all(one.num_rows == len(one.expected) for one in report.comparisons)
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


def test_gyroscope_of_a_log_is_that_of_the_root(bundle, tmp_path):
    folder = Path(shutil.copytree(bundle("go1"), tmp_path / "bundle"))
    columns = golden(folder)
    for k, letter in enumerate("xyz"):
        columns[f"gyroscope.{letter}"] = columns.pop(f"measurement.imu_ang_vel.{k}")
    log = written(tmp_path / "log.csv", columns)
    assert not any("imu_ang_vel" in note for note in check_log(folder, log).undecided)
    contract = json.loads((folder / "contract.json").read_text())
    (gyro,) = [one for one in contract["measurements"] if one["name"] == "imu_ang_vel"]
    sensor = gyro["source"]
    for body, is_read in (("robot/trunk", True), ("robot/FR_hip", False)):
        for source in (sensor, {"kind": "body_ang_vel_b"}):
            gyro["source"] = {**source, "body": body}
            (folder / "contract.json").write_text(json.dumps(contract))
            missing = [note for note in check_log(folder, log).undecided if "imu_ang_vel" in note]
            assert (not missing) == is_read


def speeds(env: Any) -> Any:
    """Observation term that the runtime does not know."""
    return env.scene["cartpole"].data.joint_vel.abs()


def test_golden_table_has_the_values_of_custom_terms(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        env.observations["actor"].terms["speeds"] = ObservationTermCfg(func=speeds)

    folder = write_random("Mjlab-Cartpole-Swingup", tmp_path / "bundle", edit, steps=8)
    # The line that the notes name.
    (line,) = re.findall(r"`(TERMS\[.*)`", (folder / "README.md").read_text())
    with (folder / "runtime.py").open("a") as program:
        program.write(f"\n{line}\n")
    report = check_log(folder, folder / "golden.csv")
    assert report.is_passed, str(report)
    assert [one.num_rows for one in report.comparisons if one.name == "term/obs/speeds"] == [8]


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


def test_tolerance_of_a_log_with_few_decimals(bundle, tmp_path):
    folder = bundle("go1")
    log = written(tmp_path / "log.csv", {k: v.round(4) for k, v in golden(folder).items()})
    assert not check_log(folder, log).is_passed
    assert check_log(folder, log, tolerance=1e-3).is_passed


def test_late_targets_are_named(log_of):
    report = log_of(in_place("target.", lambda x: np.concatenate((x[:1], x[:-1]))))
    assert report.causes == ["one control step late"]


def test_period_of_a_log(log_of):
    slow = log_of(in_place("time", lambda x: 1.25 * x))
    assert not slow.is_passed
    assert slow.causes == ["other control rate"]
    assert slow.findings[0].comparison.stage == "rates"
    assert log_of(in_place("time", lambda x: 1.01 * x)).is_passed


def test_missing_columns_are_named(log_of):
    def drop(columns: Columns) -> None:
        for name in [name for name in columns if "imu_ang_vel" in name or name[:4] == "obs."]:
            del columns[name]

    report = log_of(drop)
    notes = " ".join(report.undecided)
    assert "measurement imu_ang_vel: not in the log" in notes
    assert "obs: not in the log" in notes
    assert report.is_passed


@pytest.mark.parametrize("gap", ["", "nan"])
def test_gaps_are_skipped(bundle, tmp_path, gap):
    folder, path = bundle("g1"), tmp_path / "log.csv"
    columns = golden(folder)
    for name in part(columns, 0, 15):
        columns[name] = 0.3 * columns[name]
    header, *rows = written(path, columns).read_text().splitlines()
    names = list(columns)
    for k in (9, 20):
        cells = rows[k].split(",")
        for j, name in enumerate(names):
            if name.startswith("measurement."):
                cells[j] = gap
        rows[k] = ",".join(cells)
    path.write_text("\n".join([header, *rows]))
    report = check_log(folder, path)
    assert report.causes == ["another scale"]
    (note,) = [note for note in report.notes if note.startswith("gaps: 2 rows")]
    # Histories of five steps hold each gap.
    assert "10 rows" in note
    assert {one.num_rows for one in report.comparisons if one.stage == "vector"} == {len(rows) - 10}


def test_log_that_begins_within_an_episode(bundle, tmp_path):
    folder, path = bundle("g1"), tmp_path / "log.csv"
    columns = {name: values[7:40] for name, values in golden(folder).items()}
    assert not check_log(
        folder, written(path, {**columns, "first": columns["step"] == 7})
    ).is_passed
    del columns["first"]
    report = check_log(folder, written(path, columns))
    assert report.is_passed, str(report)
    assert any(note.startswith("no column first") for note in report.notes)
    # The clock counts from the start of the episode.
    assert any(note.startswith("gait: not compared") for note in report.notes)
    compared = [one for one in report.comparisons if one.name == "term/obs/gait"]
    assert [one.num_rows for one in compared] == [0]


@pytest.mark.parametrize("kept", [("time",), ("time", "measurement"), ("time", "target")])
def test_log_that_decides_nothing_is_refused(log_of, kept):
    def drop(columns: Columns) -> None:
        for name in [name for name in columns if name.split(".")[0] not in kept]:
            del columns[name]

    with pytest.raises(UserError, match="expected"):
        log_of(drop)


def test_motion_of_an_episode(bundle, tmp_path):
    folder = bundle("Mjlab-Tracking-Flat-Unitree-G1")
    columns, path = golden(folder), tmp_path / "log.csv"
    first, second = json.loads((folder / "contract.json").read_text())["golden"]["episodes"]
    assert first["motion"] != second["motion"]
    # With `step`, the motions are those of the golden trace.
    assert check_log(folder, written(path, columns)).is_passed
    step = columns.pop("step")
    assert not check_log(folder, written(path, columns)).is_passed
    columns["motion"] = np.where(step < second["row"], first["motion"], second["motion"])
    assert check_log(folder, written(path, columns)).is_passed
    columns["motion"] = columns["motion"] + 10
    with pytest.raises(UserError, match="motion"):
        check_log(folder, written(path, columns))


# Answers.


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_answers_that_are_not_finite_differ(bundle, tmp_path, value):
    folder = bundle("go1")
    columns = golden(folder)
    answers = {k: v for k, v in columns.items() if k.split(".")[0] in ("obs", "action")}
    for name in part(answers, 0, 3):
        answers[name][7] = value
    report = check_answers(folder, written(tmp_path / "a.csv", answers))
    assert not report.is_passed
    assert all(one.num_rows == len(one.expected) for one in report.comparisons)
    wrong = [one for one in report.comparisons if not one.is_equal]
    assert {one.name for one in wrong} == {"term/obs/base_ang_vel", "input/obs"}
    assert {one.first[0] for one in wrong} == {7}


def test_empty_cells_are_not_compared(bundle, tmp_path):
    folder = bundle("go1")
    answers = {k: v for k, v in golden(folder).items() if k.startswith("action")}
    header, *rows = written(tmp_path / "a.csv", answers).read_text().splitlines()
    rows[3] = "," * (len(answers) - 1)
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    (action,) = check_answers(folder, tmp_path / "a.csv").comparisons
    assert action.num_rows == len(rows) - 1
    assert action.is_equal
    (tmp_path / "a.csv").write_text("\n".join([header, *[rows[3]] * len(rows)]))
    assert not check_answers(folder, tmp_path / "a.csv").is_passed


@pytest.mark.parametrize("check", [check_answers, check_log])
def test_folder_without_a_contract(tmp_path, check):
    with pytest.raises(UserError, match=r"contract\.json"):
        check(tmp_path, tmp_path / "a.csv")


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


def test_some_answers_need_their_steps(bundle, tmp_path):
    folder = bundle("go1")
    columns = {k: v[:1] for k, v in golden(folder).items() if k.startswith(("step", "action."))}
    assert check_answers(folder, written(tmp_path / "a.csv", columns)).is_passed
    del columns["step"]
    with pytest.raises(UserError, match="step"):
        check_answers(folder, written(tmp_path / "a.csv", columns))


def test_answers_need_a_known_column(bundle, tmp_path):
    with pytest.raises(UserError, match="obs"):
        check_answers(bundle("go1"), written(tmp_path / "a.csv", {"step": np.arange(3.0)}))
