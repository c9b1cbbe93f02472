"""Files of a run: readable YAML of its configs, and the search for a checkpoint."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import logging
import os
import re
import secrets
import socket
import stat
import tempfile
import time
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import IO, Any

from mjlab.compat import older_names
from mjlab.utils.string import qualified_name

try:
    import fcntl
except ImportError:
    # Windows.
    fcntl = None

logger = logging.getLogger(__name__)

_WANDB_CACHE = "wandb_checkpoints"
# See `temporary_path`. Those of other programs, and of earlier versions, carry no lock.
_TEMPORARY = re.compile(r"\.(.+)\.\d+-[0-9a-f]{8}\.tmp")
# Age from which those of other machines, whose locks may not be seen here, are removed.
_SECONDS_TO_KEEP = 86400.0
_WANDB_CHECKPOINT = re.compile(r"model_(\d+)\.pt")


def dump_yaml(filename: Path, data: dict[str, Any], sort_keys: bool = False) -> None:
    """Write `data` as plain YAML that `yaml.safe_load` reads.

    Dataclasses become mappings, tuples, arrays and tensors lists, enum members their names, and
    functions and classes "module:name". Missing folders are made, and the suffix ".yaml" is added
    unless the name has it (or ".yml"). The file appears whole or not at all.
    """
    import yaml

    filename = Path(filename)
    if filename.suffix not in (".yaml", ".yml"):
        filename = filename.with_name(filename.name + ".yaml")
    filename.parent.mkdir(parents=True, exist_ok=True)

    class PlainDumper(yaml.SafeDumper):
        # An object reached twice is written twice: anchors are hard to read.
        def ignore_aliases(self, data: Any) -> bool:
            return True

    text = yaml.dump(
        to_plain(data),
        Dumper=PlainDumper,
        sort_keys=sort_keys,
        default_flow_style=False,
    )
    with replacing(filename) as file:
        file.write(text.encode())


def to_plain(value: Any, _parents: tuple[int, ...] = ()) -> Any:
    """Return `value` as dicts, lists, strings, numbers, booleans and None."""
    if isinstance(value, enum.Enum):
        return value.name
    if value is None:
        return None
    for kind in (bool, int, float, str):
        # Subclasses (numpy's float64 among them) are unknown to the safe dumper.
        if isinstance(value, kind):
            return kind(value)
    if id(value) in _parents:
        return "<contains itself>"
    inner = (*_parents, id(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        # Fields are read one by one: `asdict` copies, which not every value allows.
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
        return {
            "func": to_plain(value.func, inner),
            "args": to_plain(value.args, inner),
            "keywords": to_plain(value.keywords, inner),
        }
    return _plain_object(value)


def _plain_object(value: Any) -> Any:
    # Arrays, tensors and numpy scalars; a class has the method too, but no values.
    if hasattr(value, "tolist") and not isinstance(value, type):
        return value.tolist()
    if callable(value):
        return qualified_name(value)
    if isinstance(value, (os.PathLike, slice)) or type(value).__module__ == "torch":
        return str(value)
    # The default `repr` shows a memory address, which differs from run to run.
    if type(value).__repr__ is object.__repr__ or type(value).__module__.startswith("mujoco"):
        return f"<{qualified_name(type(value))}>"
    return repr(value)


def get_checkpoint_path(
    log_path: Path, run_dir: str = ".*", checkpoint: str = ".*", sort_alpha: bool = True
) -> Path:
    """Return the newest checkpoint of the newest run that has one.

    Args:
        log_path: Folder of the experiment; its sub-folders are runs.
        run_dir: Regular expression for the name of the run. Runs matched in full are preferred to
            those of which it matches only the start.
        checkpoint: Regular expression for the whole name of the checkpoint file.
        sort_alpha: The newest run is the last by name; False: the one changed last.

    The newest checkpoint of a run is the one with the highest number in its name. Raises
    `ValueError`, saying what there is, if the folder, a matching run or a checkpoint is missing.
    """
    log_path = Path(log_path)
    if not log_path.is_dir():
        raise ValueError(f"There is no log folder {str(log_path)!r}. Has the task been trained?")
    folders = [p for p in log_path.iterdir() if p.is_dir() and p.name != _WANDB_CACHE]
    folders.sort(key=lambda p: p.name if sort_alpha else (p.stat().st_mtime_ns, p.name))
    runs = [p for p in folders if re.fullmatch(run_dir, p.name)]
    runs = runs or [p for p in folders if re.match(run_dir, p.name)]
    if not runs:
        raise ValueError(
            f"No run in {str(log_path)!r} matches {run_dir!r}. "
            f"Runs there: {[p.name for p in folders]}."
        )
    for run in reversed(runs):
        files = [p for p in run.iterdir() if p.is_file() and re.fullmatch(checkpoint, p.name)]
        if files:
            return max(files, key=_checkpoint_age)
    raise ValueError(
        f"No file matching {checkpoint!r} in any of the runs {[p.name for p in runs]} of "
        f"{str(log_path)!r}."
    )


def _checkpoint_age(path: Path) -> tuple[bool, int, str]:
    numbers = re.findall(r"\d+", path.stem)
    # Event files have long numbers in their names too: a ".pt" file goes before all others.
    return path.suffix == ".pt", int(numbers[-1]) if numbers else -1, path.name


def get_wandb_checkpoint_path(
    log_path: Path, run_path: Path, checkpoint_name: str | None = None
) -> tuple[Path, bool]:
    """Return a checkpoint of a Weights & Biases run, and whether it was in the cache already.

    Args:
        log_path: Folder of the experiment; the cache is `wandb_checkpoints/<run id>/` in it.
        run_path: "entity/project/run_id".
        checkpoint_name: File name as "model_100.pt"; None takes the highest number.

    A cached file is used as it is. Raises `ValueError`, listing the checkpoints there are, if the
    run does not have the one asked for, and `ConnectionError` if Weights & Biases does not give it.
    """
    cache = Path(log_path) / _WANDB_CACHE / Path(run_path).name
    if checkpoint_name is not None and _WANDB_CHECKPOINT.fullmatch(checkpoint_name):
        cached = cache / checkpoint_name
        if cached.is_file():
            return cached, True
    import wandb

    with _asking_wandb(run_path):
        run = wandb.Api().run(str(run_path))
        names = [file.name for file in run.files() if _WANDB_CHECKPOINT.fullmatch(file.name)]
    names.sort(key=lambda name: int(name[len("model_") : -len(".pt")]))
    if not names or (checkpoint_name is not None and checkpoint_name not in names):
        raise ValueError(
            f"The run {str(run_path)!r} has no checkpoint {checkpoint_name or 'model_<n>.pt'!r}. "
            f"Checkpoints there: {names}."
        )
    name = checkpoint_name or names[-1]
    target = cache / name
    if target.is_file():
        return target, True
    cache.mkdir(parents=True, exist_ok=True)
    # Downloaded next to its place and renamed, so that a broken transfer leaves nothing behind.
    with tempfile.TemporaryDirectory(dir=cache) as folder, _asking_wandb(run_path):
        run.file(name).download(folder, replace=True)
        os.replace(Path(folder) / name, target)
    return target, False


@contextlib.contextmanager
def _asking_wandb(run_path: Path) -> Generator[None]:
    """Turn what wandb raises within the block into one `ConnectionError` that says what to do."""
    try:
        yield
    except OSError:
        # The disk's, and those of the network, which say what they are.
        raise
    except Exception as error:
        # wandb raises errors of many kinds, of its own and of what it is built on.
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ConnectionError(
            f"The Weights & Biases run {str(run_path)!r} cannot be read: {reason} Use `wandb login`, and "
            "a path as entity/project/run."
        ) from error


@contextlib.contextmanager
def replacing(path: Path, *, flush: bool = False) -> Generator[IO[bytes]]:
    """Yield a binary file that takes the place of `path` if the block succeeds.

    It is written beside `path` and renamed, so `path` appears whole or not at all. The umask decides
    who may read it, and a link at `path` is replaced instead of followed. `flush`: the content is on
    the disk before the file gets its name.
    """
    with create_locked(temporary_path(path)) as file:
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
    """Return a new name beside `path`, for a file of this process that will take its place."""
    owner = f"{socket.gethostname()}.{os.getpid()}"
    return path.with_name(f".{path.name}.{owner}-{secrets.token_hex(4)}.tmp")


def create_locked(path: Path) -> IO[bytes]:
    """Make a file and open it; until it is closed, `remove_abandoned` leaves it alone.

    Raises:
        OSError: it cannot be made, or there is a file or a link of that name.
    """
    while True:
        file = open(path, "xb")  # noqa: SIM115
        if fcntl is not None:
            # Not every file system has locks.
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
        # It may have been removed before it was locked.
        if os.fstat(file.fileno()).st_nlink > 0:
            return file
        file.close()


def rename_locked(file: IO[bytes], path: Path) -> None:
    """Give a file of `create_locked` its name, and close it."""
    if fcntl is None:
        # Windows does not rename an open file.
        file.close()
    os.replace(file.name, path)
    file.close()


def remove_abandoned(path: Path) -> bool:
    """Remove a file of `create_locked` if its process is gone; return whether it was removed."""
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
    """Remove the files in `folder` that a process was writing (`replacing`) when it was killed.

    Those of other machines only after a day.
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
    """Make `folder` and return it, or a folder of that name in the user's cache if it is foreign.

    Foreign is a folder that another user could have planted, or a link to one: in a folder that
    everyone may write to, such as `/tmp`, a part of the path belongs to neither this user nor root.

    Raises:
        OSError: the folder cannot be made.
    """
    path = Path(os.path.abspath(folder))
    for part in (*reversed(path.parents), path):
        if not os.path.lexists(part):
            with contextlib.suppress(FileExistsError):
                part.mkdir()
        if _is_foreign(part):
            cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            own = cache / "mjlab" / path.name
            own.mkdir(parents=True, exist_ok=True)
            logger.warning("%s belongs to another user; %s is used instead.", part, own)
            return own
    return folder


def _is_foreign(path: Path) -> bool:
    if not hasattr(os, "geteuid") or not path.parent.stat().st_mode & stat.S_IWOTH:
        return False
    return path.lstat().st_uid not in (os.geteuid(), 0)


__getattr__ = older_names(__name__)
