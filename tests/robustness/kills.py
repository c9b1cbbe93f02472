"""Runs interrupted by signals at random moments, and resumed until finished."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from pathlib import Path
from typing import Any

from .commands import Command, Ended, check_end
from .runs import (
    check_loadable,
    checkpoints,
    learned,
    leftovers,
    same,
    train_flags,
    trained,
)
from .trials import Broken, Trial

WHAT = "chains of signals at random moments and resumes, compared with the run that none ended"
TRIALS = 30
LIMIT = 180.0

_ITERATIONS = 24
_SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_MOST_KILLS = 4
# Every n-th chain starts Python each time, so that imports are interrupted, too.
_FRESH = 8
# Every n-th trial kills the launcher of a training process.
_LAUNCHERS = 10


def prepare(folder: Path) -> dict[str, Any]:
    """Train without interruption."""
    begin = time.monotonic()
    run = trained(folder / "straight", _ITERATIONS)
    return {"final": str(run / f"model_{_ITERATIONS - 1}.pt"), "seconds": time.monotonic() - begin}


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Kill and resume a run a few times, let it finish, and compare."""
    if trial.number % _LAUNCHERS == _LAUNCHERS - 1:
        _kill_launcher(trial)
        return
    rng, root = trial.rng, Path("logs").resolve()
    is_fresh = trial.number % _FRESH == _FRESH - 1
    kinds = [_SIGNALS[(trial.number + k) % 4] for k in range(rng.randint(1, _MOST_KILLS))]
    # Longer than a run on an idle machine, so that signals hit its end, too.
    delays = [rng.uniform(0.0, 1.1) for _ in kinds]
    longest = prepared["seconds"] + (4.0 if is_fresh else 0.0)
    what = (f"{kind.name} at {delay:.2f}" for kind, delay in zip(kinds, delays, strict=True))
    trial.trying(f"{'fresh ' if is_fresh else ''}chain of {', '.join(what)}")
    for kind, delay in zip(kinds, delays, strict=True):
        before = set(root.glob("cartpole/*"))
        process = _start(root, is_fresh)
        if not process.watch(delay * longest):
            own = sorted(set(root.glob("cartpole/*")) - before)
            begun = own[-1] if own and checkpoints(own[-1]) else None
            process.signal(kind)
            # A killed process cannot remove its folder.
            left = set(root.glob("cartpole/*")) - before
            _check_interrupted(process.end(30.0), kind, left, begun)
        else:
            check_end(process.end())
        check_loadable(root)
    ended = _start(root, is_fresh).end(60.0)
    check_end(ended, statuses=(0,))
    files = checkpoints(root)
    last = [path for path in files if path.name == f"model_{_ITERATIONS - 1}.pt"]
    if not last:
        raise Broken(f"the last checkpoint is {files[-1].name if files else 'missing'}")
    if not same(learned(last[-1]), learned(Path(prepared["final"]))):
        raise Broken("the weights are not those of the uninterrupted run")
    if left := leftovers(root):
        raise Broken(f"temporary files are left: {', '.join(left)}")


def _kill_launcher(trial: Trial) -> None:
    """Kill `train-seeds` alone. That no process outlives a trial is checked after each."""
    kind = trial.rng.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGHUP))
    trial.trying(f"{kind.name} to train-seeds alone, in its first training")
    root = Path("logs").resolve()
    flags = [*train_flags(root, 100_000), "--seeds", "2"]
    # The command sets the seeds.
    seed = flags.index("--agent.seed")
    del flags[seed : seed + 2]
    process = Command("train_seeds", flags)
    if process.watch(60.0, lambda: bool(checkpoints(root))):
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, kind)
    process.end(30.0)
    check_loadable(root)


def _start(root: Path, is_fresh: bool) -> Command:
    flags = ("--agent.resume", "True") if checkpoints(root) else ()
    return Command("train", train_flags(root, _ITERATIONS, *flags), is_fresh=is_fresh)


def _check_interrupted(
    ended: Ended, kind: signal.Signals, left: set[Path], run: Path | None
) -> None:
    """Raise Broken unless a signal with a handler led to a saved checkpoint.

    `left` are the folders made by the process, `run` is the run folder if iterations had begun.
    """
    if kind is signal.SIGKILL:
        return
    if ended.status < 0 and not ended.stuck:
        # The default action is correct unless unsaved iterations exist.
        if run and not (run / f"model_{_ITERATIONS - 1}.pt").is_file():
            raise Broken(f"died of {kind.name} in training, without saving")
    else:
        check_end(ended)
    for folder in left:
        if folder.is_dir() and not checkpoints(folder):
            raise Broken(f"{kind.name} left a run folder without a checkpoint")
    if run and ended.status in (0, 128 + kind):
        done = json.loads((run / "run.json").read_text())["iterations"]
        newest = {int(path.stem.removeprefix("model_")) for path in checkpoints(run)}
        if max(newest) != done - 1:
            raise Broken(f"{done} iterations, and the newest checkpoint is {max(newest)}")
