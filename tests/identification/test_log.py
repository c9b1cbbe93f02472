"""Logs are read from CSV and NPZ, at a constant period."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjlab.identification.log import COLUMNS, JointLog, read_log
from mjlab.utils.errors import UserError

TIME = 0.01 * np.arange(200)


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    header = ",".join(columns)
    np.savetxt(path, np.stack(list(columns.values()), 1), delimiter=",", header=header, comments="")
    return path


def columns_of(*joints: str, signals: tuple[str, ...] = tuple(COLUMNS)) -> dict[str, np.ndarray]:
    names = [f"{COLUMNS[signal]}.{joint}" for joint in joints for signal in signals]
    return {"time": TIME, **{name: np.sin(TIME + n) for n, name in enumerate(names)}}


def test_csv_and_npz_agree(tmp_path: Path) -> None:
    columns = columns_of("hip", "knee")
    from_csv = read_log(write_csv(tmp_path / "log.csv", columns | {"note": TIME}))
    arrays = {
        name: np.stack([columns[f"{COLUMNS[name]}.{joint}"] for joint in ("hip", "knee")], 1)
        for name in COLUMNS
    }
    np.savez(tmp_path / "log.npz", time=TIME, joint_names=["hip", "knee"], **arrays)
    from_npz = read_log(tmp_path / "log.npz")
    assert from_csv.joints == from_npz.joints == ("hip", "knee")
    assert from_csv.period == pytest.approx(0.01)
    for name in COLUMNS:
        assert getattr(from_csv, name) == pytest.approx(getattr(from_npz, name))


def test_short_names(tmp_path: Path) -> None:
    columns = columns_of("hip", "knee")
    long = read_log(write_csv(tmp_path / "long.csv", columns))
    short = {name: f"{signal}." for signal, name in COLUMNS.items()}
    renamed = {
        next((s + key.removeprefix(f"{b}.") for b, s in short.items() if key.startswith(b)), key): v
        for key, v in columns.items()
    }
    assert "torque.knee" in renamed
    same = read_log(write_csv(tmp_path / "short.csv", renamed))
    for signal in COLUMNS:
        assert (getattr(same, signal) == getattr(long, signal)).all()


def test_velocity_and_torque_are_optional(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "log.csv", columns_of("hip", signals=("target", "position")))
    log = read_log(path)
    assert log.velocity is None
    assert log.torque is None


def test_irregular_times_are_resampled(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    time = TIME + rng.uniform(-0.003, 0.003, len(TIME))
    columns = {"time": time, "target.hip": np.floor(time), "measurement.joint_pos.hip": 2.0 * time}
    log = read_log(write_csv(tmp_path / "log.csv", columns))
    grid = time[0] + log.period * np.arange(len(log.target))
    assert log.position[:, 0] == pytest.approx(2.0 * grid, abs=1e-6)
    # A target is held until the next one, never mixed with it.
    assert set(np.unique(log.target)) <= {-1.0, 0.0, 1.0}
    assert 0.1 < log.jitter < 0.7


def test_joints_are_picked_in_order(tmp_path: Path) -> None:
    log: JointLog = read_log(write_csv(tmp_path / "log.csv", columns_of("hip", "knee")))
    own = log.of(("knee", "hip"))
    assert own.joints == ("knee", "hip")
    assert own.torque is not None
    assert log.torque is not None
    assert (own.torque == log.torque[:, ::-1]).all()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda columns: columns.pop("time"), "time"),
        (lambda columns: columns.pop("measurement.joint_pos.knee"), "joint_pos.knee"),
        (lambda columns: columns.pop("measurement.joint_torque.knee"), "joint_torque.knee"),
        (lambda columns: columns.update(time=TIME[::-1]), "increasing"),
        (
            lambda columns: columns.update({"target.hip": np.full(200, np.nan)}),
            "target.hip.*finite",
        ),
    ],
)
def test_mistakes(tmp_path: Path, change, named: str) -> None:
    columns = columns_of("hip", "knee")
    change(columns)
    with pytest.raises(UserError, match=named):
        read_log(write_csv(tmp_path / "log.csv", columns))


def test_empty_cells_are_named(tmp_path: Path) -> None:
    """Those of ignored columns are allowed."""
    path = tmp_path / "log.csv"
    rows = [f"{t:.2f},1,2," for t in TIME]
    header = "time,target.hip,position.hip,torque_of_another_joint"
    path.write_text("\n".join([header, *rows]))
    assert (read_log(path).position == 2.0).all()
    rows[16] = "0.16,1,,"
    path.write_text("\n".join([header, *rows]))
    with pytest.raises(UserError, match=r"position\.hip.*row 17"):
        read_log(path)


@pytest.mark.parametrize("text", ["", "time,target.hip", "time,target.hip\n0,left", "time\n0,1"])
def test_files_that_are_no_tables(tmp_path: Path, text: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=r"log\.csv: expected"):
        read_log(path)
