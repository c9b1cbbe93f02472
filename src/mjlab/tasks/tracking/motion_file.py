"""Motion files: what is in them, reading them with all checks, and writing them.

A motion is an `.npz` file with the frame axis first. World frame, SI units, quaternions (w, x, y, z):

| key | shape | content |
| --- | --- | --- |
| `fps` | (1,) | frames per second |
| `joint_pos`, `joint_vel` | (T, nj) | all joints but the free one, in the order of the robot |
| `body_pos_w`, `body_quat_w` | (T, nb, 3), (T, nb, 4) | poses of all bodies, in the order of the robot |
| `body_lin_vel_w`, `body_ang_vel_w` | (T, nb, 3) | velocities of the origins of the bodies |
| `joint_names`, `body_names` | (nj,), (nb,) | their names; files of other tools lack them |

The world of a file is the environment's: origins of environments are added where it is used.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjlab.utils.errors import MjlabError
from mjlab.utils.os import replacing

_ARRAYS: dict[str, int | None] = {
    "joint_pos": None,
    "joint_vel": None,
    "body_pos_w": 3,
    "body_quat_w": 4,
    "body_lin_vel_w": 3,
    "body_ang_vel_w": 3,
}
"""The arrays of a motion with the size of their last axis; None: the number of joints."""
_MIN_FRAMES = 2
_QUAT_TOLERANCE = 1e-3
_RATE_TOLERANCE = 1e-3


class MotionFileError(MjlabError, ValueError):
    """Raised for a file that is no motion, or none of this robot; the text says why."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """A motion of T frames, of a robot with nj joints and nb bodies; see the module's table."""

    fps: float | None
    """Frames per second; None where the file does not say."""
    joint_pos: np.ndarray
    """(T, nj) in rad."""
    joint_vel: np.ndarray
    """(T, nj) in rad/s."""
    body_pos_w: np.ndarray
    """(T, nb, 3) in m."""
    body_quat_w: np.ndarray
    """(T, nb, 4), unit quaternions."""
    body_lin_vel_w: np.ndarray
    """(T, nb, 3) in m/s."""
    body_ang_vel_w: np.ndarray
    """(T, nb, 3) in rad/s, world axes."""
    joint_names: tuple[str, ...] = ()
    """Names of the joints; empty where the file does not say."""
    body_names: tuple[str, ...] = ()
    """Names of the bodies; empty where the file does not say."""

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.joint_pos)


def read_motion(path: str | Path) -> Motion:
    """Return the motion in a file, as float32. Nothing in the file is ever executed (no pickle).

    Raises:
        MotionFileError: there is no such file, it is no motion, or what it holds cannot be: another
            number of frames from one array to the next, fewer than two frames, numbers that are
            not finite, quaternions that are not unit quaternions.
    """
    path = Path(path)
    content = _load(path)
    missing = [key for key in _ARRAYS if key not in content]
    if missing:
        raise MotionFileError(
            f"The motion {path} lacks {missing}; it has {sorted(content)}. "
            "`mjlab csv-to-npz` makes a motion from joint angles."
        )
    arrays = {key: _checked_array(path, key, content[key], size) for key, size in _ARRAYS.items()}
    _check_sizes(path, arrays)
    arrays["body_quat_w"] = _unit_quaternions(path, arrays["body_quat_w"])
    names = {
        key: _names(path, key, content.get(key), like, arrays[like].shape[1])
        for key, like in (("joint_names", "joint_pos"), ("body_names", "body_pos_w"))
    }
    values: dict[str, Any] = {
        key: np.ascontiguousarray(value, dtype=np.float32) for key, value in arrays.items()
    }
    return Motion(fps=_fps(path, content.get("fps")), **values, **names)


def check_motion_fits(
    path: str | Path,
    motion: Motion,
    joint_names: Sequence[str],
    body_names: Sequence[str],
    step_dt: float,
) -> None:
    """Refuse a motion that is not of this robot or plays at another speed.

    Args:
        path: Where it was read from, for messages.
        motion: The motion.
        joint_names: Joints of the robot, in order.
        body_names: Bodies of the robot, in order.
        step_dt: The control period, in seconds.

    Raises:
        MotionFileError: another number of joints or bodies, or, where the file names them, others
            or in another order; a frame rate that is not that of control.
    """
    for what, wanted, names, columns in (
        ("joints", joint_names, motion.joint_names, motion.joint_pos),
        ("bodies", body_names, motion.body_names, motion.body_pos_w),
    ):
        if columns.shape[1] != len(wanted):
            raise MotionFileError(
                f"The motion {path} has {columns.shape[1]} {what}, and the robot {len(wanted)}: "
                f"{list(wanted)}."
            )
        if names and tuple(names) != tuple(wanted):
            pairs = zip(names, wanted, strict=True)
            first = next(i for i, (name, other) in enumerate(pairs) if name != other)
            raise MotionFileError(
                f"The {what} of the motion {path} are not those of the robot in its order: number "
                f"{first} is {names[first]!r} in the motion and {wanted[first]!r} in the robot."
            )
    if motion.fps is not None and abs(motion.fps * step_dt - 1.0) > _RATE_TOLERANCE:
        raise MotionFileError(
            f"The motion {path} has {motion.fps:g} frames per second, and the task is controlled "
            f"{1.0 / step_dt:g} times per second (every {step_dt:g} s), so that it would play at "
            "the wrong speed. Resample it: `mjlab csv-to-npz --input-file "
            f"{path} --output-fps {1.0 / step_dt:g} --output-file ...`."
        )


def write_motion(path: str | Path, motion: Motion) -> Path:
    """Write a motion, compressed, and return its path; folders are made, `.npz` is added.

    The same motion always gives the same bytes.

    Raises:
        MotionFileError: the motion has no frame rate, or numbers that are not finite as float32.
    """
    if motion.fps is None:
        raise MotionFileError(f"The motion to write to {path} has no fps.")
    path = npz_path(path)
    entries = {"fps": np.array([motion.fps], dtype=np.float32)}
    entries |= {
        key: _checked_array(path, key, np.asarray(getattr(motion, key)), size).astype(np.float32)
        for key, size in _ARRAYS.items()
    }
    entries |= {
        key: np.array(names)
        for key in ("joint_names", "body_names")
        if (names := getattr(motion, key))
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, array in entries.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, allow_pickle=False)
            # A fixed date, because `np.savez` would write that of today.
            info = zipfile.ZipInfo(f"{key}.npy")
            archive.writestr(info, buffer.getvalue(), zipfile.ZIP_DEFLATED, 9)
    return path


def npz_path(path: str | Path) -> Path:
    """Return where a motion of that name goes: `.npz` is added where it is missing."""
    path = Path(path)
    return path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")


def motion_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not hasattr(archive, "files"):
                raise MotionFileError(f"{path} is a single array and no motion (.npz).")
            return {key: archive[key] for key in archive.files}
    except MotionFileError:
        raise
    except Exception as error:
        # Whatever a damaged or hostile file makes zipfile and NumPy raise.
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise MotionFileError(f"{path} cannot be read as a motion (.npz): {reason}") from error


def _names(
    path: Path, key: str, value: np.ndarray | None, like: str, count: int
) -> tuple[str, ...]:
    """Return names of the columns of the array `like`, of which there are `count`, or none."""
    if value is None:
        return ()
    if value.ndim != 1 or value.dtype.kind != "U":
        raise MotionFileError(f"{key} of the motion {path} has to be a list of texts.")
    if len(value) not in (0, count):
        raise MotionFileError(
            f"The motion {path} has {len(value)} {key}, and {count} columns in {like}."
        )
    return tuple(str(name) for name in value)


def _checked_array(path: Path, key: str, value: np.ndarray, size: int | None) -> np.ndarray:
    if value.dtype.kind not in "fiu":
        raise MotionFileError(f"{key} of the motion {path} holds {value.dtype}, and no numbers.")
    dims = 2 if size is None else 3
    if value.ndim != dims or (size is not None and value.shape[-1] != size):
        wanted = "(frames, joints)" if size is None else f"(frames, bodies, {size})"
        raise MotionFileError(
            f"{key} of the motion {path} has the shape {value.shape}; it has to be {wanted}."
        )
    # What is read and written is float32, in which numbers above 3.4e38 are infinite.
    with np.errstate(over="ignore"):
        is_finite = np.isfinite(value.astype(np.float32))
    if not is_finite.all():
        frame = int(np.argwhere(~is_finite)[0][0])
        raise MotionFileError(
            f"{key} of the motion {path} has {int((~is_finite).sum())} numbers that are NaN or "
            f"infinite, the first in frame {frame}; expected float32, up to 3.4e38."
        )
    return value


def _check_sizes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    frames = {key: len(value) for key, value in arrays.items()}
    if len(set(frames.values())) > 1:
        raise MotionFileError(f"The arrays of the motion {path} differ in frames: {frames}.")
    if frames["joint_pos"] < _MIN_FRAMES:
        raise MotionFileError(
            f"The motion {path} has {frames['joint_pos']} frames; it needs at least {_MIN_FRAMES}."
        )
    for group in (("joint_pos", "joint_vel"), [key for key, size in _ARRAYS.items() if size]):
        columns = {key: arrays[key].shape[1] for key in group}
        if len(set(columns.values())) > 1:
            raise MotionFileError(f"The arrays of the motion {path} differ in columns: {columns}.")


def _unit_quaternions(path: Path, quats: np.ndarray) -> np.ndarray:
    quats = quats.astype(np.float64)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    wrong = np.abs(norms[..., 0] - 1.0) > _QUAT_TOLERANCE
    if wrong.any():
        frame, body = (int(i) for i in np.argwhere(wrong)[0])
        raise MotionFileError(
            f"body_quat_w of the motion {path} is no unit quaternion in {int(wrong.sum())} places: "
            f"in frame {frame}, body {body} its norm is {norms[frame, body, 0]:.4g}."
        )
    return quats / norms


def _fps(path: Path, value: Any) -> float | None:
    if value is None:
        return None
    array = np.asarray(value)
    is_number = array.size == 1 and array.dtype.kind in "fiu"
    with np.errstate(over="ignore", under="ignore"):
        if not (is_number and 0.0 < float(np.float32(array.item())) < math.inf):
            raise MotionFileError(
                f"fps of the motion {path} is {value!r}; it has to be one rate above 0."
            )
    return float(array.item())
