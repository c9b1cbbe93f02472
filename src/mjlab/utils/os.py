"""Run files: YAML configs, checkpoint lookup, atomic and locked files."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import errno
import functools
import logging
import os
import re
import secrets
import socket
import stat
import struct
import tempfile
import time
import zipfile
from collections.abc import Generator, Iterable, Mapping
from pathlib import Path, PureWindowsPath
from typing import IO, Any

from mjlab.compat import older_names
from mjlab.utils.errors import UserError
from mjlab.utils.string import qualified_name
from mjlab.utils.wandb import asking_wandb

try:
    import fcntl
except ImportError:
    # Windows.
    fcntl = None

logger = logging.getLogger(__name__)

WANDB_CACHE = "wandb_checkpoints"
"""Folder of an experiment with downloads from Weights & Biases, a folder per run."""
# Names of `temporary_path`. Files of other programs and of earlier versions are not locked.
_TEMPORARY = re.compile(r"\.(.+)\.\d+-[0-9a-f]{8}\.tmp")
# Age for removal of files of other machines, because their locks may not be visible here.
_SECONDS_TO_KEEP = 86400.0
# Record at the end of a ZIP archive, and its count in archives that have another one.
_END_OF_ARCHIVE = struct.Struct("<4s4H2LH")
_MANY_ENTRIES = 0xFFFF
_CHECKPOINT = re.compile(r"model_(\d+)\.pt")


def dump_yaml(filename: Path, data: dict[str, Any], sort_keys: bool = False) -> None:
    """Write `data` as plain YAML, readable by `yaml.safe_load`.

    Converts dataclasses to mappings, tuples, arrays and tensors to lists, enum members to names, and
    functions and classes to "module:name". Creates missing folders, and adds the suffix ".yaml"
    unless the name ends in ".yaml" or ".yml". The write is atomic.
    """
    import yaml

    filename = Path(filename)
    if filename.suffix not in (".yaml", ".yml"):
        filename = filename.with_name(filename.name + ".yaml")

    class PlainDumper(yaml.SafeDumper):
        # Repeat objects, because YAML anchors are hard to read.
        def ignore_aliases(self, data: Any) -> bool:
            return True

    text = yaml.dump(
        to_plain(data), Dumper=PlainDumper, sort_keys=sort_keys, default_flow_style=False
    )
    write_atomically(filename, text.encode())


def to_plain(value: Any, _parents: tuple[int, ...] = ()) -> Any:
    """Return `value` as dicts, lists, strings, numbers, booleans and None."""
    if isinstance(value, enum.Enum):
        return value.name
    if value is None:
        return None
    for kind in (bool, int, float, str):
        # The safe dumper rejects subclasses such as NumPy's float64.
        if isinstance(value, kind):
            return kind(value)
    if id(value) in _parents:
        return "<contains itself>"
    inner = (*_parents, id(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        # Not `asdict`, because it copies values and not all values can be copied.
        return {f.name: to_plain(getattr(value, f.name), inner) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        items = {}
        for key, item in value.items():
            plain_key = to_plain(key)
            is_scalar = not isinstance(plain_key, (list, dict))
            items[plain_key if is_scalar else str(key)] = to_plain(item, inner)
        return items
    if isinstance(value, (set, frozenset)):
        return sorted((to_plain(item, inner) for item in value), key=str)
    if isinstance(value, (list, tuple)):
        return [to_plain(item, inner) for item in value]
    if isinstance(value, functools.partial):
        parts = ("func", "args", "keywords")
        return {part: to_plain(getattr(value, part), inner) for part in parts}
    return _plain_object(value)


def _plain_object(value: Any) -> Any:
    # Arrays, tensors and NumPy scalars; their classes also have `tolist`, but no values.
    if hasattr(value, "tolist") and not isinstance(value, type):
        return value.tolist()
    if callable(value):
        return qualified_name(value)
    if isinstance(value, (os.PathLike, slice)) or type(value).__module__ == "torch":
        return str(value)
    # The default `repr` contains a memory address that differs between runs.
    if type(value).__repr__ is object.__repr__ or type(value).__module__.startswith("mujoco"):
        return f"<{qualified_name(type(value))}>"
    return repr(value)


def checkpoint_number(name: str) -> int | None:
    """Return the number of a checkpoint file `model_<number>.pt`; None for other names."""
    match = _CHECKPOINT.fullmatch(name)
    return int(match.group(1)) if match else None


def checkpoint_names(names: Iterable[str]) -> list[str]:
    """Return those of `names` that are checkpoints, in the order of their numbers."""
    numbered = [(n, name) for name in names if (n := checkpoint_number(name)) is not None]
    return [name for _, name in sorted(numbered)]


def files_in(folder: Path, pattern: str) -> list[Path]:
    """Return the files in `folder` that match a glob pattern, without folders, and links to no file."""
    # Unlike `Path.is_file`, False for links and folders that cannot be followed.
    return [path for path in folder.glob(pattern) if os.path.isfile(path)]


def regular_file(path: Path) -> Path:
    """Return `path`, a file that can be read to its end.

    Raises:
        OSError: no such file; or a folder, a FIFO or a device, which may have no end.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a file", str(path))
    return path


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the checkpoint files in `folder`, in the order of their numbers."""
    names = checkpoint_names(path.name for path in files_in(folder, "model_*.pt"))
    return [folder / name for name in names]


def get_checkpoint_path(
    log_path: Path, run_dir: str = ".*", checkpoint: str = ".*", sort_alpha: bool = True
) -> Path:
    """Return the newest checkpoint of the newest run with a checkpoint.

    Args:
        log_path: Folder of the experiment; its sub-folders are runs.
        run_dir: Regular expression for the name of the run. Full matches are preferred to matches
            at the start.
        checkpoint: Regular expression for the whole name of the checkpoint file.
        sort_alpha: Sort runs by name. False: by modification time.

    The newest checkpoint of a run has the highest number in its name. Raises `ValueError`, listing
    the available runs, if the folder, a matching run or a checkpoint is not found.
    """
    log_path = Path(log_path)
    if not log_path.is_dir():
        raise ValueError(f"Log folder {str(log_path)!r} not found; train the task first.")
    folders = [p for p in log_path.iterdir() if p.is_dir() and p.name != WANDB_CACHE]
    folders.sort(key=lambda p: p.name if sort_alpha else (p.stat().st_mtime_ns, p.name))
    names = matching_names([p.name for p in folders], run_dir)
    runs = [p for p in folders if p.name in names]
    if not runs:
        raise ValueError(
            f"No run in {str(log_path)!r} matches {run_dir!r}. "
            f"Available: {[p.name for p in folders]}."
        )
    for run in reversed(runs):
        if (path := newest_match(run, checkpoint)) is not None:
            return path
    raise ValueError(
        f"No checkpoint matching {checkpoint!r} in the runs {[p.name for p in runs]} of "
        f"{str(log_path)!r}."
    )


def matching_names(names: list[str], pattern: str) -> list[str]:
    """Return the names that match a regular expression, or else those that match at the start."""
    full = [name for name in names if re.fullmatch(pattern, name)]
    return full or [name for name in names if re.match(pattern, name)]


def newest_match(run: Path, checkpoint: str) -> Path | None:
    """Return the newest file in a run folder whose name matches a regular expression, if any."""
    files = [path for path in files_in(run, "*") if re.fullmatch(checkpoint, path.name)]
    return max(files, key=_checkpoint_age, default=None)


def _checkpoint_age(path: Path) -> tuple[bool, int, str]:
    numbers = re.findall(r"\d+", path.stem)
    # ".pt" files first, because event files also have long numbers in their names.
    return path.suffix == ".pt", int(numbers[-1]) if numbers else -1, path.name


def get_wandb_checkpoint_path(
    log_path: Path, run_path: Path, checkpoint_name: str | None = None
) -> tuple[Path, bool]:
    """Return a checkpoint of a Weights & Biases run, and True if it was cached.

    Args:
        log_path: Folder of the experiment; the cache is its sub-folder `wandb_checkpoints/<run id>/`.
        run_path: "entity/project/run_id".
        checkpoint_name: File name such as "model_100.pt". None: highest number.

    Cached files are not downloaded again. Raises `ValueError`, listing the available checkpoints, if
    the checkpoint is not found, `UserError` without a login or if the run path does not end in a
    name, and `WandbError` if the download fails.
    """
    cache = inside(Path(log_path) / WANDB_CACHE, Path(run_path).name)
    if checkpoint_name is not None and checkpoint_number(checkpoint_name) is not None:
        cached = cache / checkpoint_name
        if cached.is_file():
            return cached, True
    request = f"Run {str(run_path)!r}"
    with asking_wandb(request) as wandb:
        run = wandb.Api().run(str(run_path))
        names = checkpoint_names(file.name for file in run.files())
        recorded = dict(getattr(run, "config", {}))
    if not names or (checkpoint_name is not None and checkpoint_name not in names):
        raise ValueError(
            f"Checkpoint {checkpoint_name or 'model_<n>.pt'!r} not found in run {str(run_path)!r}. "
            f"Available: {names}."
        )
    name = checkpoint_name or names[-1]
    target = cache / name
    if target.is_file():
        return target, True
    cache.mkdir(parents=True, exist_ok=True)
    # The configs, as in a run folder.
    for entry, file in (("env_cfg", "env.yaml"), ("train_cfg", "agent.yaml")):
        if isinstance(recorded.get(entry), dict):
            dump_yaml(cache / "params" / file, recorded[entry])
    # Download to a temporary file and rename it, so that a failed download leaves no partial file.
    with tempfile.TemporaryDirectory(dir=cache) as folder, asking_wandb(request):
        run.file(name).download(folder, replace=True)
        os.replace(Path(folder) / name, target)
    return target, False


def inside(folder: Path, name: str) -> Path:
    """Return the path below `folder` of a file or folder that a user or a server names.

    Raises:
        UserError: the name is empty, absolute, or has empty parts, "." or "..".
    """
    parts = name.replace("\\", "/").split("/")
    if PureWindowsPath(name).drive or any(part in ("", ".", "..") for part in parts):
        raise UserError(
            f"{folder}: expected the name of a file in this folder, got {name!r}; use one "
            "without '..', empty parts, and '/' at its start."
        )
    return folder / name


def check_archive(path: Path) -> None:
    """Raise an error unless a ZIP archive has all its entries, which match their names and checksums.

    Of damage in the directory at its end, `zipfile` may notice nothing.
    """
    with zipfile.ZipFile(path) as archive, open(path, "rb") as file:
        if (damaged := archive.testzip()) is not None:
            raise zipfile.BadZipFile(f"{damaged} does not match its checksum")
        file.seek(-_END_OF_ARCHIVE.size, os.SEEK_END)
        signature, *_, count, _, _, _ = _END_OF_ARCHIVE.unpack(file.read())
        # Archives with a comment end otherwise.
        if signature == b"PK\5\6" and count not in (len(archive.infolist()), _MANY_ENTRIES):
            raise zipfile.BadZipFile(f"it has {len(archive.infolist())} of {count} entries")


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file by `replacing`. Creates missing folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(content)


@contextlib.contextmanager
def naming(path: Path) -> Generator[None]:
    """Name `path` in an error of the system within the block that names no file, such as a full disk."""
    try:
        yield
    except OSError as error:
        # Without a number, the message is the error's own.
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def file_to_write(path: str) -> Path:
    """Return the path of a file that a command writes at its end (`--output`).

    Raises:
        UserError: a folder of this name exists.
    """
    if (file := Path(path)).is_dir():
        raise UserError(f"--output: expected a file, got the folder {path}; use a path in it.")
    return file


@contextlib.contextmanager
def replacing(path: Path, *, flush: bool = False) -> Generator[IO[bytes]]:
    """Yield a binary file that replaces `path` atomically if the block succeeds.

    The file is written next to `path` and then renamed. Permissions follow the umask, and a link at
    `path` is replaced, not followed. `flush`: sync the content to disk before renaming.
    """
    with naming(path), create_locked(temporary_path(path)) as file:
        try:
            yield file
            file.flush()
            if flush:
                os.fsync(file.fileno())
            rename_locked(file, path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise


def temporary_path(path: Path) -> Path:
    """Return a unique temporary path next to `path`, for a file of this process to replace `path`."""
    owner = f"{socket.gethostname()}.{os.getpid()}"
    return path.with_name(f".{path.name}.{owner}-{secrets.token_hex(4)}.tmp")


def create_locked(path: Path) -> IO[bytes]:
    """Create and open a locked file. `remove_abandoned` skips it until it is closed.

    Raises:
        OSError: the file cannot be created, or a file or link of that name exists.
    """
    while True:
        file = open(path, "xb")  # noqa: SIM115
        if fcntl is not None:
            # Some file systems do not support locks.
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
        # Another process may have removed the file before it was locked.
        if os.fstat(file.fileno()).st_nlink > 0:
            return file
        file.close()


def rename_locked(file: IO[bytes], path: Path) -> None:
    """Rename a file of `create_locked` to `path`, and close it."""
    if fcntl is None:
        # Windows cannot rename open files.
        file.close()
    os.replace(file.name, path)
    file.close()


def is_locked(path: Path) -> bool:
    """Return True while a process holds a file of `create_locked` open.

    Without locks (Windows), True if the file exists.
    """
    try:
        with open(path, "rb") as file:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return fcntl is None
    except BlockingIOError:
        return True
    except OSError:
        return False


def remove_abandoned(path: Path) -> bool:
    """Remove a file of `create_locked` if its process has ended; return True if removed."""
    if fcntl is None:
        return False
    try:
        with open(path, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
    except OSError:
        return False
    return True


def remove_temporary_files(folder: Path) -> None:
    """Remove partial files in `folder`, left by killed processes (`replacing`).

    Files of other machines are removed only after a day.
    """
    for path in folder.glob(".*.tmp"):
        match = _TEMPORARY.fullmatch(path.name)
        if match is None:
            continue
        with contextlib.suppress(OSError):
            is_old = time.time() - path.stat().st_mtime > _SECONDS_TO_KEEP
            if is_old or match.group(1).endswith(f".{socket.gethostname()}"):
                remove_abandoned(path)


def own_folder(folder: Path) -> Path:
    """Create and return `folder`, or a folder of that name in the user's cache if it is foreign.

    A folder is foreign if another user could have planted it or a link to it: in a world-writable
    folder such as `/tmp`, a part of the path belongs to neither this user nor root.

    Raises:
        OSError: the folder cannot be created.
    """
    path = Path(os.path.abspath(folder))
    for part in (*reversed(path.parents), path):
        if not os.path.lexists(part):
            with contextlib.suppress(FileExistsError):
                part.mkdir()
        is_shared = hasattr(os, "geteuid") and part.parent.stat().st_mode & stat.S_IWOTH
        if is_shared and part.lstat().st_uid not in (os.geteuid(), 0):
            cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            own = cache / "mjlab" / path.name
            own.mkdir(parents=True, exist_ok=True)
            logger.warning("%s belongs to another user; using %s.", part, own)
            return own
    return folder


__getattr__ = older_names(__name__)
