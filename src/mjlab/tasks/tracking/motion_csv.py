"""Recordings as CSV, in the layout of the retargeted LAFAN1 sets.

No header, comma separated, one pose a line: position of the root (m), its quaternion x y z w, and the
angles of all joints (rad) in the order of the robot.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjlab.tasks.tracking.motion_file import MotionFileError
from mjlab.tasks.tracking.motion_kinematics import Recording

_ROOT_COLUMNS = 7
_QUAT_TOLERANCE = 1e-2


def read_csv(
    path: str | Path,
    fps: float,
    joint_names: Sequence[str],
    line_range: tuple[int, int] | None = None,
) -> Recording:
    """Return the recording in a file.

    Args:
        path: The file.
        fps: Its poses per second.
        joint_names: Joints of the robot, in order.
        line_range: First and last line to read, counted from 1; both are read. None reads all.

    Raises:
        MotionFileError: there is no such file, a line is not of numbers, there are more or fewer
            columns than the robot needs, the lines do not exist, fewer than two are left, or a
            quaternion is not a unit quaternion.
    """
    path = Path(path)
    table = _chosen_lines(path, _table(path), line_range)
    first = 1 if line_range is None else line_range[0]
    expected = _ROOT_COLUMNS + len(joint_names)
    if table.shape[1] != expected:
        raise MotionFileError(
            f"{path} has {table.shape[1]} columns, and the robot needs {expected}: 3 of position, 4 "
            f"of orientation (x y z w), and {len(joint_names)} of joints: {list(joint_names)}."
        )
    if not np.isfinite(table).all():
        line = int(np.argwhere(~np.isfinite(table))[0][0]) + first
        raise MotionFileError(f"Line {line} of {path} has a number that is NaN or infinite.")
    quat = table[:, [6, 3, 4, 5]]
    norms = np.linalg.norm(quat, axis=1, keepdims=True)
    wrong = np.flatnonzero(np.abs(norms[:, 0] - 1.0) > _QUAT_TOLERANCE)
    if len(wrong) > 0:
        raise MotionFileError(
            f"Columns 4 to 7 of {path} have to be unit quaternions (x y z w); in line {wrong[0] + first} "
            f"the norm is {norms[wrong[0], 0]:.4g}."
        )
    return Recording(
        fps=fps, root_pos=table[:, :3], root_quat=quat / norms, joint_pos=table[:, _ROOT_COLUMNS:]
    )


def write_csv(path: str | Path, recording: Recording) -> None:
    """Write a recording."""
    quat = recording.root_quat[:, [1, 2, 3, 0]]
    table = np.hstack((recording.root_pos, quat, recording.joint_pos))
    np.savetxt(path, table, delimiter=",", fmt="%.8f")


def _table(path: Path) -> np.ndarray:
    if not path.is_file():
        raise MotionFileError(f"There is no file {path}.")
    try:
        with warnings.catch_warnings():
            # Of an empty file, which has a message below.
            warnings.simplefilter("ignore", UserWarning)
            return np.loadtxt(path, delimiter=",", ndmin=2)
    except ValueError as error:
        raise MotionFileError(
            f"{path} is not a table of numbers, separated by commas and without a header: {error}"
        ) from error


def _chosen_lines(path: Path, table: np.ndarray, line_range: tuple[int, int] | None) -> np.ndarray:
    if line_range is not None:
        first, last = line_range
        if not 1 <= first <= last <= len(table):
            raise MotionFileError(
                f"Lines {first} to {last} were asked for, and {path} has lines 1 to {len(table)}."
            )
        table = table[first - 1 : last]
    if len(table) < 2:
        raise MotionFileError(f"{path} has {len(table)} poses to read; at least 2 are needed.")
    return table
