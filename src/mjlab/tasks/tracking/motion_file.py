"""Motion files: format, validated reading, and writing.

A motion is an `.npz` file with the frame axis first. World frame, SI units, quaternions (w, x, y,
z):

| key | shape | content |
| --- | --- | --- |
| `fps` | (1,) | frames per second |
| `joint_pos`, `joint_vel` | (T, nj) | all joints except the free joint, in robot order |
| `body_pos_w`, `body_quat_w` | (T, nb, 3), (T, nb, 4) | poses of all bodies, in robot order |
| `body_lin_vel_w`, `body_ang_vel_w` | (T, nb, 3) | velocities of the body origins |
| `joint_names`, `body_names` | (nj,), (nb,) | optional names; absent from files of other tools |

The world frame of a file is relative to the environment's origin.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjlab.utils.errors import MjlabError
from mjlab.utils.logging import first_line
from mjlab.utils.os import check_archive, replacing

_ARRAYS: dict[str, tuple[str | int, ...]] = {
    "joint_pos": ("frames", "joints"),
    "joint_vel": ("frames", "joints"),
    "body_pos_w": ("frames", "bodies", 3),
    "body_quat_w": ("frames", "bodies", 4),
    "body_lin_vel_w": ("frames", "bodies", 3),
    "body_ang_vel_w": ("frames", "bodies", 3),
}
"""Arrays of a motion with their shapes."""
_OPTIONAL = {"fps", "joint_names", "body_names"}
PER_JOINT = ("joint_pos", "joint_vel")
PER_BODY = ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
_QUAT_TOLERANCE = 1e-3
_RATE_TOLERANCE = 1e-3


class MotionFileError(MjlabError, ValueError):
    """File that is not a motion, or does not match the robot."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Motion of T frames, of a robot with nj joints and nb bodies; see the module's table."""

    fps: float | None
    """Frames per second; None if not in the file."""
    joint_pos: np.ndarray
    """Joint positions (rad), (T, nj)."""
    joint_vel: np.ndarray
    """Joint velocities (rad/s), (T, nj)."""
    body_pos_w: np.ndarray
    """Body positions (m), (T, nb, 3)."""
    body_quat_w: np.ndarray
    """Body orientations, unit quaternions (w, x, y, z), (T, nb, 4)."""
    body_lin_vel_w: np.ndarray
    """Linear body velocities (m/s), (T, nb, 3)."""
    body_ang_vel_w: np.ndarray
    """Angular body velocities in world axes (rad/s), (T, nb, 3)."""
    joint_names: tuple[str, ...] = ()
    """Joint names; empty if not in the file."""
    body_names: tuple[str, ...] = ()
    """Body names; empty if not in the file."""

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return len(self.joint_pos)


def read_motion(path: str | Path) -> Motion:
    """Read a motion as float32. Nothing in the file is executed (no pickle).

    Odd content that can be played is one warning: NaN or infinite values, quaternions without unit
    norm (normalized), a single frame (repeated), arrays longer than `joint_pos` (cut), an unusable
    frame rate or unusable names (ignored).

    Raises:
        MotionFileError: file not found, not a motion, no frame, or arrays that do not fit together.
    """
    path = Path(path)
    content = _load(path)
    missing = [key for key in _ARRAYS if key not in content]
    if missing:
        raise MotionFileError(
            f"Motion {path}: missing {missing}, got {sorted(content)}; use `uv run mjlab csv-to-npz` "
            "to make a motion from joint angles."
        )
    arrays = {key: content[key] for key in _ARRAYS}
    odd = _cut(arrays)
    _check_shapes(path, arrays)
    if len(arrays["joint_pos"]) == 0:
        raise MotionFileError(f"Motion {path}: expected at least 1 frame, got 0.")
    if len(arrays["joint_pos"]) == 1:
        odd.append("1 frame, repeated")
        arrays = {key: np.repeat(value, 2, axis=0) for key, value in arrays.items()}
    odd += _not_finite(arrays)
    arrays["body_quat_w"], wrong = _normalized(arrays["body_quat_w"])
    odd += wrong
    fps, wrong = _fps(content.get("fps"))
    odd += wrong
    names: dict[str, tuple[str, ...]] = {}
    for key, like in (("joint_names", "joint_pos"), ("body_names", "body_pos_w")):
        names[key], wrong = _names(key, content.get(key), arrays[like].shape[1])
        odd += wrong
    if odd:
        warnings.warn(f"Motion {path}: {'; '.join(odd)}.", UserWarning, stacklevel=2)
    with np.errstate(over="ignore"):
        values: dict[str, Any] = {
            key: np.ascontiguousarray(value, dtype=np.float32) for key, value in arrays.items()
        }
    return Motion(fps=fps, **values, **names)


def check_rate(path: str | Path, motion: Motion, step_dt: float) -> None:
    """Warn if the frame rate of a motion is not the control rate; `step_dt` (s) is a control step.

    Frames are played one per step, whatever the rate of the file.
    """
    if motion.fps is not None and abs(motion.fps * step_dt - 1.0) > _RATE_TOLERANCE:
        warnings.warn(
            f"Motion {path} fps: expected {1.0 / step_dt:g}, the control rate (timestep {step_dt:g} "
            f"s), got {motion.fps:g}; one frame is played per step. Resample it with `uv run mjlab "
            f"csv-to-npz --input-file {path} --output-fps {1.0 / step_dt:g} --output-file ...`.",
            UserWarning,
            stacklevel=2,
        )


def write_motion(path: str | Path, motion: Motion) -> Path:
    """Write a compressed motion and return its path. Creates folders; appends `.npz` if missing.

    Output is deterministic: equal motions give equal bytes.

    Raises:
        MotionFileError: the motion has no frame rate, arrays of different numbers of frames, or
            values that are not finite as float32.
    """
    if motion.fps is None:
        raise MotionFileError(f"Motion {path} fps: expected frames per second, got None.")
    path = npz_path(path)
    entries = {"fps": np.array([motion.fps], dtype=np.float32)}
    arrays = {key: np.asarray(getattr(motion, key)) for key in _ARRAYS}
    _check_shapes(path, arrays)
    if problems := _not_finite(arrays):
        raise MotionFileError(f"Motion {path}: {'; '.join(problems)}.")
    entries |= {key: array.astype(np.float32) for key, array in arrays.items()}
    for key in ("joint_names", "body_names"):
        if getattr(motion, key):
            entries[key] = np.array(getattr(motion, key))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, array in entries.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, allow_pickle=False)
            # ZipInfo has a fixed date; `np.savez` would write the current date.
            info = zipfile.ZipInfo(f"{key}.npy")
            archive.writestr(info, buffer.getvalue(), zipfile.ZIP_DEFLATED, 9)
    return path


def npz_path(path: str | Path) -> Path:
    """Return `path` with `.npz` appended if missing."""
    path = Path(path)
    return path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")


def motion_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not hasattr(archive, "files"):
                raise MotionFileError(
                    f"Motion {path}: expected an .npz archive, got a single array."
                )
            # Missing or damaged optional entries would be ignored.
            check_archive(path)
            keys = set(archive.files)
            content = {key: archive[key] for key in _ARRAYS if key in keys}
            for key in _OPTIONAL & keys:
                # Objects cannot be read without executing the file.
                with contextlib.suppress(ValueError):
                    content[key] = archive[key]
            return content
    except MotionFileError:
        raise
    except Exception as error:
        # Damaged or hostile files make zipfile and NumPy raise many types of errors.
        raise MotionFileError(
            f"{path} cannot be read as a motion (.npz): {first_line(error)}; copy it from its source, or make it again by "
            "`uv run mjlab csv-to-npz`."
        ) from error


def _names(key: str, value: np.ndarray | None, count: int) -> tuple[tuple[str, ...], list[str]]:
    """Return the names of `count` columns, or () without usable names, and what is wrong."""
    if value is None or value.size == 0:
        return (), []
    if value.dtype.kind not in "US" or value.shape != (count,):
        return (), [f"{key} of {value.dtype} {value.shape} instead of {count} names, ignored"]
    return tuple(n.decode() if isinstance(n, bytes) else str(n) for n in value.tolist()), []


def _cut(arrays: dict[str, np.ndarray]) -> list[str]:
    """Cut arrays to the frames of `joint_pos`; return what is wrong."""
    frames = len(arrays["joint_pos"]) if arrays["joint_pos"].ndim else 0
    longer = [key for key, value in arrays.items() if value.ndim and len(value) > frames > 0]
    arrays |= {key: arrays[key][:frames] for key in longer}
    return [f"{longer} with more frames than joint_pos, cut"] if longer else []


def _check_shapes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise `MotionFileError` unless the arrays are numbers of equal sizes."""
    # Sizes of axes, from the first array that has them.
    sizes: dict[str | int, int] = {3: 3, 4: 4}
    for key, axes in _ARRAYS.items():
        value = arrays[key]
        if value.ndim == len(axes):
            sizes = dict(zip(axes, value.shape, strict=True)) | sizes
        expected = tuple(sizes.get(axis, axis) for axis in axes)
        if value.dtype.kind not in "fiu" or value.shape != expected:
            shape = ", ".join(map(str, expected))
            raise MotionFileError(
                f"Motion {path} {key}: expected numbers ({shape}), got {value.dtype} {value.shape}."
            )


def _not_finite(arrays: dict[str, np.ndarray]) -> list[str]:
    """Return the arrays with values that are not finite, one text each."""
    found = []
    for key, value in arrays.items():
        # Motions are stored as float32: values above 3.4e38 become infinite.
        with np.errstate(over="ignore"):
            is_finite = np.isfinite(value.astype(np.float32))
        if not is_finite.all():
            found.append(
                f"{key} expected finite float32 values (up to 3.4e38), got "
                f"{int((~is_finite).sum())} that are NaN or infinite, the first in frame "
                f"{np.argwhere(~is_finite)[0][0]}"
            )
    return found


def _normalized(quats: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return unit quaternions, zeros as they are, and what is wrong."""
    quats = quats.astype(np.float64)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    wrong = np.abs(norms[..., 0] - 1.0) > _QUAT_TOLERANCE
    quats = quats / np.where(norms > 0.0, norms, 1.0)
    if not wrong.any():
        return quats, []
    frame, body = (int(i) for i in np.argwhere(wrong)[0])
    return quats, [
        f"body_quat_w expected unit quaternions, got {int(wrong.sum())} without unit norm, "
        f"normalized; in frame {frame}, body {body} the norm is {norms[frame, body, 0]:.4g}"
    ]


def _fps(value: Any) -> tuple[float | None, list[str]]:
    """Return the frame rate, None without a usable one, and what is wrong."""
    if value is None:
        return None, []
    array = np.asarray(value)
    is_number = array.size == 1 and array.dtype.kind in "fiu"
    with np.errstate(over="ignore", under="ignore"):
        if is_number and 0.0 < float(np.float32(array.item())) < math.inf:
            return float(array.item()), []
    return None, [f"fps expected one finite number > 0, got {value!r}, ignored"]
