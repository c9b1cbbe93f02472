"""Checkpoint files: written whole or not at all, and loaded without running what is in them."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import pickle
import re
import socket
import tempfile
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from mjlab.rl.learners import Learner
from mjlab.rl.plain_data import as_plain_data

_TEMPORARY_SUFFIX = ".tmp"
# Seconds after which a temporary file is nobody's, if its writer is not known: a day.
_SECONDS_TO_KEEP = 86400.0
# Only in checkpoints of SAC.
_SAC_KEY = "sac_state_dict"


class CheckpointError(RuntimeError):
    """A checkpoint could not be written, read or used; the message says what to do."""


class RunFolderError(OSError):
    """A run folder cannot be written to."""


def ensure_writable_folder(folder: str | os.PathLike[str]) -> Path:
    """Make `folder` if it is missing, and write a file into it to see that this works.

    Raises:
        RunFolderError: the folder cannot be made or written to.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".write-test-") as file:
            file.write(b"x")
            file.flush()
    except OSError as error:
        raise RunFolderError(
            f"The run folder {str(folder)!r} cannot be written to ({error.strerror or error}). "
            "Choose another place with --log-root, or change its permissions."
        ) from error
    return folder


def save_checkpoint(data: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Write `data` (tensors, numbers, strings, and dicts and lists of those) to `path`.

    The file appears whole or not at all: everything goes to a temporary file in the same folder,
    which is flushed to the disk and then renamed. Whatever was at `path` stays until then, and
    nothing is left behind on failure. Numbers of numpy are written as Python's.

    Raises:
        CheckpointError: the disk is full, the folder is read-only, and the like; or `data` holds
            something that `load_checkpoint` would refuse, which the message names.
    """
    path = Path(path)
    try:
        data = as_plain_data(dict(data))
    except TypeError as error:
        raise CheckpointError(
            f"The checkpoint {str(path)!r} was not written, because it could not be loaded again: "
            f"{error}. A checkpoint may hold tensors, numbers, strings, None, and dicts, lists and "
            "tuples of those; convert this entry, or leave it out."
        ) from error
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(
            dir=path.parent,
            prefix=f".{path.name}.{socket.gethostname()}.{os.getpid()}.",
            suffix=_TEMPORARY_SUFFIX,
        )
        with os.fdopen(descriptor, "wb") as file:
            _write(data, file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
        temporary = None
        _flush_folder(path.parent)
    except OSError as error:
        raise CheckpointError(_save_message(path, error)) from error
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of checkpoints below `folder` whose writers were killed.

    A name says which process of which machine wrote the file. Those of running processes are kept; so
    are, for a day, those of other machines and of files that do not say.
    """
    for path in folder.glob(f"*/.model_*.pt.*{_TEMPORARY_SUFFIX}"):
        words = path.name.removesuffix(_TEMPORARY_SUFFIX).rsplit(".", 2)
        is_own = len(words) == 3 and words[0].endswith(f".pt.{socket.gethostname()}")
        with contextlib.suppress(OSError):
            if is_own and words[1].isdigit():
                is_over = not _is_running(int(words[1]))
            else:
                is_over = time.time() - path.stat().st_mtime > _SECONDS_TO_KEEP
            if is_over:
                path.unlink()


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        # It is another user's.
        return True
    return True


def _write(data: Mapping[str, Any], file: io.IOBase) -> None:
    # Serialized in memory first, because torch's zip writer turns a failing `write` of the file
    # below it into a RuntimeError that hides the reason.
    buffer = io.BytesIO()
    torch.save(dict(data), buffer)
    file.write(buffer.getbuffer())


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _flush_folder(folder: Path) -> None:
    # The rename itself is on the disk only once the folder is. Not every system can open one.
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass
    finally:
        os.close(descriptor)


def _save_message(path: Path, error: OSError) -> str:
    kept = latest_checkpoint(path.parent)
    rescue = f" The last checkpoint, {str(kept)!r}, is intact." if kept is not None else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return (
            f"The disk is full: the checkpoint {str(path)!r} could not be written.{rescue} "
            "Make room and resume with --agent.resume True."
        )
    return f"The checkpoint {str(path)!r} could not be written ({error.strerror or error}).{rescue}"


def latest_checkpoint(folder: Path) -> Path | None:
    """Return the `model_<number>.pt` with the highest number in `folder`, or None."""
    if not folder.is_dir():
        return None
    numbered = {
        int(match.group(1)): path
        for path in folder.iterdir()
        if (match := re.fullmatch(r"model_(\d+)\.pt", path.name))
    }
    return numbered[max(numbered)] if numbered else None


def load_checkpoint(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what `save_checkpoint` (or rsl_rl) wrote to `path`, with all tensors on the CPU.

    Only data is read: a file whose pickle would run code is refused.

    Raises:
        CheckpointError: the file is missing, truncated, not a checkpoint, or hostile.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(_missing_message(path))
    try:
        with warnings.catch_warnings():
            # About pickle protocols, which say nothing to a user.
            warnings.simplefilter("ignore", UserWarning)
            data = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(_unpickling_message(path, error)) from error
    except Exception as error:
        # Damaged bytes make the reader fail in any way there is.
        raise CheckpointError(
            f"The checkpoint {str(path)!r} is truncated or corrupt "
            f"({path.stat().st_size} bytes; {_first_line(error)}). Use an earlier one."
        ) from error
    if not isinstance(data, dict):
        raise CheckpointError(
            f"{str(path)!r} is not a checkpoint of a training run: it holds a "
            f"{type(data).__name__}, not a dict."
        )
    return data


def learner_of_checkpoint(path: str | os.PathLike[str]) -> Learner:
    """Return the learner that wrote a checkpoint.

    Raises:
        CheckpointError: see `load_checkpoint`.
    """
    checkpoint = load_checkpoint(path)
    if "student_state_dict" in checkpoint:
        return "distillation"
    return "sac" if _SAC_KEY in checkpoint else "ppo"


def _missing_message(path: Path) -> str:
    if path.is_dir():
        return f"{str(path)!r} is a folder; give a checkpoint file such as 'model_100.pt' in it."
    if not path.parent.is_dir():
        return f"There is no checkpoint {str(path)!r}: its folder does not exist."
    others = sorted(other.name for other in path.parent.glob("*.pt"))
    found = f"Checkpoints in that folder: {others}." if others else "Its folder has none."
    return f"There is no checkpoint {str(path)!r}. {found}"


def _unpickling_message(path: Path, error: Exception) -> str:
    forbidden = re.search(r"GLOBAL ([\w.]+)|class ([\w.]+)|function ([\w.]+)", str(error))
    if forbidden is None:
        return (
            f"The checkpoint {str(path)!r} was refused: it is not a file of torch, or is corrupt. "
            "Nothing in it was run."
        )
    name = next(group for group in forbidden.groups() if group)
    return (
        f"The checkpoint {str(path)!r} was refused: it wants to call {name!r}, and a checkpoint "
        "may hold data only. Nothing in it was run. Do not use this file unless you trust where "
        "it comes from; weights can be saved again with torch.save({...: state_dict()})."
    )


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:160]
