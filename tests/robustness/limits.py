"""Resource limits of training: full disks, few open files, little memory, read-only folders."""

from __future__ import annotations

import os
import re
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import PATIENCE, Command, Ended, check_end, free_port
from .runs import check_loadable, checkpoints, leftovers, train_flags
from .trials import Broken, Trial

WHAT = "limits on files and memory, read-only and vanishing folders, odd variables"
TRIALS = 112
LIMIT = 90.0

_ITERATIONS = 8
# Unprivileged user: folders of others are read-only.
_NOBODY = 65534
# Seconds until processes should report that they wait for others.
_WAIT = 20.0
_VARIABLES = (
    ("MUJOCO_GL", "nonsense"), ("WORLD_SIZE", "2"), ("TMPDIR", "/nonexistent"), ("RANK", "5"),
    ("OMP_NUM_THREADS", "many"), ("WORLD_SIZE", "many"), ("MUJOCO_GL", ""), ("WORLD_SIZE", "0"), ("LOCAL_RANK", "-1"), ("CUDA_VISIBLE_DEVICES", "9"),
    ("OMP_NUM_THREADS", "-1"),
    ("PYTHONIOENCODING", "ascii"), ("LC_ALL", "C"), ("TERM", "nonsense"), ("COLUMNS", "1"),
    ("COLUMNS", "many"), ("MPLCONFIGDIR", "/dev/null"), ("MPLBACKEND", "nonsense"),
    ("TORCHRUNX_LOG_DIR", "/dev/null"), ("WANDB_MODE", "nonsense"), ("DISPLAY", ":99"),
    ("PYTHONWARNINGS", "error"), ("PYTHONOPTIMIZE", "2"), ("PATH", ""),
)  # fmt: skip
# Settings that accompany a variable.
_WITH = {"WORLD_SIZE": {"RANK": "0", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1"}}


def prepare(folder: Path) -> None:
    """Return an empty dict: trials share no data."""


def _limited(kind: int, value: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(kind, (value, value))


def _train(root: Path, before: Callable[[], None] = lambda: None, *flags: str) -> Command:
    return Command("train", train_flags(root, _ITERATIONS, *flags), before=before)


def _check(ended: Ended, root: Path, *, may_succeed: bool = True) -> None:
    """Raise Broken unless training finished, or reported the reason and kept its files."""
    check_end(ended)
    check_loadable(root)
    complete = any(path.name == f"model_{_ITERATIONS - 1}.pt" for path in checkpoints(root))
    if ended.status == 0 and not complete:
        raise Broken("exit status 0, though the last checkpoint is missing")
    if ended.status == 0 and not may_succeed:
        raise Broken("exit status 0, as if nothing had happened")
    if left := leftovers(root):
        raise Broken(f"temporary files are left: {', '.join(left)}")


def _file_size(trial: Trial, root: Path) -> None:
    # A checkpoint has about 170 kB. Output goes to a pipe and is not limited.
    size = trial.rng.choice((0, 1000, trial.rng.randrange(200_000)))
    trial.trying(f"files limited to {size} bytes (RLIMIT_FSIZE)")
    _check(_train(root, _limited(resource.RLIMIT_FSIZE, size)).end(), root)


def _file_size_later(trial: Trial, root: Path) -> None:
    size = trial.rng.randrange(170_000)
    trial.trying(f"files limited to {size} bytes after the first checkpoint")
    process = _train(root)
    process.watch(20.0, lambda: bool(checkpoints(root)))
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, size))
    _check(process.end(), root)


def _open_files(trial: Trial, root: Path) -> None:
    count = trial.rng.randint(3, 40)
    trial.trying(f"{count} open files (RLIMIT_NOFILE)")
    _check(_train(root, _limited(resource.RLIMIT_NOFILE, count)).end(), root)


def _memory(trial: Trial, root: Path) -> None:
    more = trial.rng.randrange(0, 600) << 20
    trial.trying(f"{more >> 20} MiB more memory (RLIMIT_AS)")

    def limit() -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        _limited(resource.RLIMIT_AS, pages * resource.getpagesize() + more)()

    _check(_train(root, limit).end(), root)


def _file_for_folder(trial: Trial, root: Path) -> None:
    place = trial.rng.choice((root, root / "cartpole"))
    trial.trying(f"a file in place of {place.relative_to(root.parent)}")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("")
    _check(_train(root).end(), root, may_succeed=False)


def _special_folder(trial: Trial, root: Path) -> None:
    place = trial.rng.choice(
        ("/dev/null", "/proc/logs", "/sys/logs", "x" * 300, "\U0001f916 ä", "a\nb", "r\udcff")
    )
    trial.trying(f"--log-root {place[:20]!r}")
    check_end(_train(Path(place)).end())


def _as_nobody(folder: Path) -> Callable[[], None]:
    def give_up_rights() -> None:
        if os.getuid() == 0:
            os.chown(folder, _NOBODY, _NOBODY)
            os.setgid(_NOBODY)
            os.setuid(_NOBODY)

    return give_up_rights


def _read_only(trial: Trial, root: Path) -> None:
    trial.trying("a log folder without write access")
    root.mkdir()
    root.chmod(0o555)
    _opened(trial)
    _check(_train(root, _as_nobody(root)).end(), root, may_succeed=False)


def _turns_read_only(trial: Trial, root: Path) -> None:
    trial.trying("a log folder that loses write access after the first checkpoint")
    root.mkdir()
    _opened(trial)
    process = _train(root, _as_nobody(root))
    process.watch(20.0, lambda: bool(checkpoints(root)))
    for folder in [*root.glob("**"), root]:
        folder.chmod(0o555)
    _check(process.end(), root, may_succeed=process.status is not None)


def _opened(trial: Trial) -> None:
    """Make the folders above that of a trial accessible to all users."""
    above = trial.folder
    while above.name and above != Path("/tmp") and os.stat(above).st_uid == os.getuid():
        above.chmod(0o755)
        above = above.parent


def _deleted(trial: Trial, root: Path) -> None:
    what = trial.rng.choice(("run", "experiment", "root"))
    trial.trying(f"the {what} folder is deleted after the first checkpoint")
    process = _train(root)
    process.watch(20.0, lambda: bool(checkpoints(root)))
    run = checkpoints(root)[0].parent
    is_over = process.status is not None
    gone = {"run": run, "experiment": run.parent, "root": root}[what]
    gone.rename(root.parent / "gone")
    shutil.rmtree(root.parent / "gone")
    ended = process.end()
    check_end(ended)
    if is_over:
        return
    if ended.status == 0:
        raise Broken("exit status 0, as if nothing had happened")
    named = [Path(word) for word in re.findall(r"/[^\s'\",;:]*\.pt", ended.said)]
    if not any(path.is_file() for path in [*checkpoints(root.parent), *named]):
        raise Broken("what was in memory is lost")
    if str(run) not in ended.said:
        raise Broken(f"the folder is not named: {ended.err.splitlines()[0]}")


def _output_full(trial: Trial, root: Path) -> None:
    target = trial.rng.choice(("/dev/full", "closed"))
    which = trial.rng.choice((1, 2))
    trial.trying(f"output {which} is {target}")

    def redirect() -> None:
        os.dup2(os.open("/dev/full", os.O_WRONLY), which) if target != "closed" else os.close(which)

    ended = _train(root, redirect).end()
    check_loadable(root)
    if ended.stuck or ended.status < 0 or "Traceback" in ended.said:
        check_end(ended)


def _no_home(trial: Trial, root: Path) -> None:
    home = trial.rng.choice(("/nonexistent", "", "/dev/null"))
    trial.trying(f"HOME={home!r}")

    def move() -> None:
        os.environ["HOME"] = home

    _check(_train(root, move).end(), root)


def _environment(trial: Trial, root: Path) -> None:
    # Cyclic; the seed sets the start.
    turn = trial.number // (len(_KINDS) // _KINDS.count(_environment)) + 7 * trial.seed
    name, value = _VARIABLES[turn % len(_VARIABLES)]
    trial.trying(f"{name}={value!r}")
    variables = {"MASTER_PORT": str(free_port()), name: value, **_WITH.get(name, {})}
    # Imports read many environment variables.
    flags = train_flags(root, _ITERATIONS)
    process = Command("train", flags, before=lambda: os.environ.update(variables), is_fresh=True)
    ended = process.end(_WAIT if name == "WORLD_SIZE" else PATIENCE)
    check_end(ended)
    check_loadable(root)
    if ended.was_asked and not re.search(r"wait|WORLD_SIZE", ended.said):
        raise Broken("waits without saying for whom")


_KINDS = (
    _file_size, _file_size_later, _open_files, _memory, _deleted, _file_size, _open_files,
    _environment, _memory, _read_only, _turns_read_only, _file_for_folder, _special_folder,
    _output_full, _no_home, _environment,
)  # fmt: skip


def run(trial: Trial, prepared: Any) -> None:
    """Train under one limit."""
    _KINDS[trial.number % len(_KINDS)](trial, Path("logs").resolve())
