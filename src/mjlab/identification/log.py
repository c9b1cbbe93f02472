"""Logs of a robot's joints: position targets, positions, velocities, torques."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjlab.utils.csv_table import CsvTable
from mjlab.utils.errors import UserError

COLUMNS = {
    "target": "target",
    "position": "measurement.joint_pos",
    "velocity": "measurement.joint_vel",
    "torque": "measurement.joint_torque",
}
"""Beginnings of the columns of a joint in CSV, by signal: `target.FL_hip`, as in the tables of `deploy`.
The signals themselves, `position.FL_hip`, are short forms."""
_OPTIONAL = ("velocity", "torque")


@dataclass(frozen=True)
class JointLog:
    """Log at a constant period. Row k: measurements at time k, and the targets sent at that time."""

    period: float
    """Time between rows (s)."""
    joints: tuple[str, ...]
    target: np.ndarray
    """Position targets (rad or m), (T, J), each in effect until the next row."""
    position: np.ndarray
    """Measured positions (rad or m), (T, J)."""
    velocity: np.ndarray | None
    """Measured velocities (rad/s or m/s), (T, J)."""
    torque: np.ndarray | None
    """Measured or estimated torques of the motors at the joints (N m or N), (T, J)."""
    jitter: float = 0.0
    """Largest deviation of a period from the median, as a share of it, before resampling."""

    @property
    def duration(self) -> float:
        """Length (s)."""
        return self.period * len(self.position)

    def of(self, joints: tuple[str, ...]) -> JointLog:
        """Return the log of some joints, in their order."""
        columns = [self.joints.index(joint) for joint in joints]
        return dataclasses.replace(
            self,
            joints=joints,
            target=self.target[:, columns],
            position=self.position[:, columns],
            velocity=None if self.velocity is None else self.velocity[:, columns],
            torque=None if self.torque is None else self.torque[:, columns],
        )


def read_log(path: Path) -> JointLog:
    """Return the log in a CSV or NPZ file.

    CSV: columns `time` (s) and those of `COLUMNS` for each joint; velocity and torque are optional, and
    other columns ignored. NPZ: arrays `time`, (T,),
    `joint_names`, (J,), and `target`, `position`, `velocity`, `torque`, (T, J).

    Raises:
        UserError: not found, a column is missing, or values are not finite.
    """
    if not path.is_file():
        raise UserError(f"{path}: expected a log, got no such file; use a CSV or NPZ file.")
    if path.suffix == ".npz":
        joints, time, signals = _read_npz(path)
    else:
        joints, time, signals = _read_csv(path)
    if len(time) < 2:
        raise UserError(f"{path}: expected rows, got {len(time)}; use a longer log.")
    _check_finite(path, "time", time)
    for name, signal in signals.items():
        for joint, column in zip(joints, () if signal is None else signal.T, strict=False):
            _check_finite(path, f"{name}.{joint}", column)
    late = np.flatnonzero(np.diff(time) <= 0.0)
    if len(late):
        raise UserError(
            f"{path} time: expected an increasing column, got {time[late[0] + 1]:g} after "
            f"{time[late[0]]:g} s; use a monotonic clock."
        )
    return _resampled(joints, time, signals)


def _read_csv(path: Path) -> tuple[tuple[str, ...], np.ndarray, dict[str, np.ndarray | None]]:
    table = CsvTable(path)
    header = list(table.columns)
    joints = tuple(name.removeprefix("target.") for name in header if name.startswith("target."))
    if "time" not in header or not joints:
        raise UserError(f"{path}: expected columns `time` and `target.JOINT`, got {header[:6]}.")
    signals: dict[str, np.ndarray | None] = {}
    for signal, beginning in COLUMNS.items():
        if f"{beginning}.{joints[0]}" not in header:
            beginning = signal
        names = [f"{beginning}.{joint}" for joint in joints]
        missing = [name for name in names if name not in header]
        if not missing:
            signals[signal] = table.group(beginning, list(joints))
        elif signal not in _OPTIONAL or len(missing) < len(names):
            raise UserError(
                f"{path}: expected columns of {signal} for all joints, got none named {missing[:4]}; "
                "use those names."
            )
        else:
            signals[signal] = None
    return joints, table.columns["time"], signals


def _read_npz(path: Path) -> tuple[tuple[str, ...], np.ndarray, dict[str, np.ndarray | None]]:
    with np.load(path) as file:
        missing = [
            name for name in ("time", "joint_names", "target", "position") if name not in file
        ]
        if missing:
            raise UserError(f"{path}: expected arrays {missing}, got {file.files}.")
        joints = tuple(str(name) for name in file["joint_names"])
        signals = {name: file[name].astype(float) if name in file else None for name in COLUMNS}
        time = file["time"].astype(float)
    shape = (len(time), len(joints))
    for name, signal in signals.items():
        if signal is not None and signal.shape != shape:
            raise UserError(f"{path} {name}: expected shape {shape}, got {signal.shape}.")
    return joints, time, signals


def _check_finite(path: Path, name: str, column: np.ndarray) -> None:
    empty = np.flatnonzero(~np.isfinite(column))
    if len(empty):
        raise UserError(
            f"{path} {name}: expected finite numbers, got none in row {empty[0] + 1} ({len(empty)} in "
            "all); use the rows with measurements only."
        )


def _resampled(
    joints: tuple[str, ...], time: np.ndarray, signals: dict[str, np.ndarray | None]
) -> JointLog:
    """Return the log at its median period: measurements interpolated, targets held."""
    period = float(np.median(np.diff(time)))
    jitter = float(np.abs(np.diff(time) - period).max() / period)
    grid = time[0] + period * np.arange(int((time[-1] - time[0]) / period + 1e-6) + 1)
    rows = np.searchsorted(time, grid + 1e-3 * period, side="right") - 1

    def interpolated(name: str) -> np.ndarray | None:
        signal = signals[name]
        if signal is None:
            return None
        return np.stack([np.interp(grid, time, column) for column in signal.T], axis=1)

    target, position = signals["target"], interpolated("position")
    assert target is not None
    assert position is not None
    velocity, torque = interpolated("velocity"), interpolated("torque")
    return JointLog(period, joints, target[rows], position, velocity, torque, jitter)
