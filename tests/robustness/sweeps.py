"""Sweeps whose files are damaged, whose processes are killed, whose disk is full, and odd --over."""

from __future__ import annotations

import contextlib
import csv
import importlib
import json
import os
import re
import resource
import shlex
import shutil
import signal
import sqlite3
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import TASK, Command, Ended, check_end, command
from .trials import Broken, Trial

WHAT = "damaged studies, locks and run folders of sweeps, killed sweeps, full disks, odd settings"
TRIALS = 60
LIMIT = 90.0

_RATE = "agent.algorithm.learning-rate"
_FLAGS = (
    "--num-envs", "16", "--device", "cpu", "--agent.num-steps-per-env", "8",
    "--agent.max-iterations", "1", "--agent.evaluation.num-episodes", "2",
    "--env.episode-length-s", "0.2",
)  # fmt: skip
_OVER = {
    "grid": ("--over", f"{_RATE}=1e-4,1e-3"),
    "range": ("--over", f"{_RATE}=1e-5..1e-2:log", "--trials", "2"),
}
_ODD: tuple[Any, ...] = (
    None, True, -1, 10**30, 1e308, "", "x" * 10_000, "os:system", "../..", [], {}, [[]], [None],
    {"a": {}}, "\x00", "\U0001f916",
)  # fmt: skip
_DEEP = 50_000


def preload() -> None:
    """Import Optuna."""
    importlib.import_module("mjlab.sweep.results")


def prepare(folder: Path) -> dict[str, Any]:
    """Run one sweep of each kind."""
    preload()
    for kind, over in _OVER.items():
        ended = command("sweep", TASK, *_FLAGS, *over, "--folder", str(folder / kind), patience=120)
        if ended.status != 0:
            raise RuntimeError(ended.said)
    return {kind: str(folder / kind) for kind in _OVER}


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Damage a sweep, or one of its processes, and run it again."""
    case = _CASES[trial.number % len(_CASES)]
    kind = trial.rng.choice([*_OVER])
    good, own = Path(prepared[kind]), Path("sweeps", kind).resolve()
    shutil.copytree(good, own)
    case(trial, kind, good, own)


def _swept(
    kind: str, good: Path, own: Path, *flags: str, seconds: float = 0.0, **limits: Any
) -> Ended:
    return _start(kind, good, own, *flags, seconds=seconds, **limits).end()


def _start(
    kind: str, good: Path, own: Path, *flags: str, seconds: float = 0.0,
    before: Callable[[], None] = lambda: None,
) -> Command:  # fmt: skip
    """Start a sweep whose runs take `seconds` to copy those in `good`, and fail for other settings."""

    def start(words: list[str], environment: dict[str, str], log: Any) -> Any:
        folder = Path(log.name).parent
        runs = [*(good / "runs" / folder.name).glob("*_seed_1")]
        script = f"sleep {seconds}; exit 1"
        if runs:
            copy = ["cp", "-rT", str(runs[0]), str(folder / "2030-01-01_00-00-00_seed_1")]
            script = f"sleep {seconds}; {shlex.join(copy)}"
        return subprocess.Popen(["sh", "-c", script], stdout=log, stderr=log, process_group=0)

    def prepare() -> None:
        from mjlab.sweep import runs as sweep_runs

        sweep_runs.start_in_background = start
        before()

    argv = [TASK, *_FLAGS, *_OVER[kind], *flags, "--folder", str(own)]
    return Command("sweep", argv, before=prepare)


def _rows(own: Path) -> list[tuple[str, str, str]]:
    """Return setting, value and state of each row of the table."""
    with open(own / "table.csv", encoding="utf-8") as file:
        return [(r["learning-rate"], r["mean_return"], r["state"]) for r in csv.DictReader(file)]


def _check_same(kind: str, good: Path, own: Path, ended: Ended) -> None:
    """Raise Broken unless the sweep has its results, at the latest after the advice of its error."""
    for _ in range(4):
        check_end(ended)
        if ended.was_asked:
            raise Broken("still busy")
        if ended.status == 0:
            break
        if "another --folder" in ended.err:
            # Other flags in a damaged definition.
            return
        named = re.search(
            rf"({re.escape(str(own))}\S*?)[:;]?(?: is damaged|: ).*[dD]elete", ended.err
        )
        folder = re.search(rf"[dD]elete ({re.escape(str(own))}/\S+?);", ended.err)
        if (found := folder or named) is None:
            raise Broken(f"no file and cure in: {ended.err}")
        path = Path(found.group(1))
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        ended = _swept(kind, good, own)
    else:
        raise Broken(f"the cures do not cure: {ended.err}")
    if _rows(own) != _rows(good):
        raise Broken(f"other results: {_rows(own)} instead of {_rows(good)}")


def _damage(trial: Trial, path: Path) -> str:
    """Damage a file; return the damage."""
    rng, data = trial.rng, path.read_bytes()
    how = rng.choice(
        (
            "flip",
            "flip",
            "flip",
            "cut",
            "zeros",
            "empty",
            "garbage",
            "folder",
            "pipe",
            "loop",
            "text",
        )
    )
    place = rng.randrange(max(1, len(data)))
    if how in ("folder", "pipe", "loop"):
        path.unlink()
        make = {
            "folder": path.mkdir,
            "pipe": lambda: os.mkfifo(path),
            "loop": lambda: path.symlink_to(path.name),
        }
        make[how]()
    else:
        flipped = bytes([data[place] ^ 1 << rng.randrange(8)]) if data else b""
        path.write_bytes({
            "flip": data[:place] + flipped + data[place + 1 :], "cut": data[:place],
            "zeros": data[:place] + bytes(len(data) - place), "empty": b"",
            "garbage": rng.randbytes(3000), "text": ("[" * _DEEP).encode(),
        }[how])  # fmt: skip
    return f"{how} at {place} of {len(data)}"


def _file(trial: Trial, kind: str, good: Path, own: Path) -> None:
    path = own / trial.rng.choice(
        ("study.db", "study.db", "sweep.json", "lock.db", "table.csv", "curves.png")
    )
    trial.trying(f"{kind}, {path.name}: {_damage(trial, path)}")
    ended = _swept(kind, good, own)
    if path.name == "table.csv" and path.is_dir():
        if ended.status != 0 or "Not written: table.csv" not in ended.err:
            raise Broken(f"exit status {ended.status}: {ended.err}")
        return
    _check_same(kind, good, own, ended)


def _file_of_run(trial: Trial, kind: str, good: Path, own: Path) -> None:
    names = ("run.json", "run.json", "model_0.pt", "params/agent.yaml", "params/env.yaml")
    run = trial.rng.choice([*own.glob("runs/*/*/")])
    path = trial.rng.choice(
        (*run.glob("events*"), *(run / name for name in names), *run.parent.glob("*.log"))
    )
    what = f"{path.relative_to(run.parent)}: {_damage(trial, path)}"
    trial.trying(f"{kind}, {what}")
    ended = _swept(kind, good, own)
    if path.name.startswith("events") and ended.status == 0 and "damaged" in ended.said:
        # The values up to the damage count, with a warning.
        return
    _check_same(kind, good, own, ended)


def _lost(trial: Trial, kind: str, good: Path, own: Path) -> None:
    names = ["study.db", "sweep.json", "lock.db", "table.csv", "table.md", "curves.png"]
    lost = trial.rng.sample(names, trial.rng.randint(1, 6))
    trial.trying(f"{kind}, without {', '.join(lost)}")
    for name in lost:
        (own / name).unlink()
    ended = _swept(kind, good, own)
    if "Started" in ended.out:
        raise Broken("trains finished runs again")
    _check_same(kind, good, own, ended)


def _row(trial: Trial, kind: str, good: Path, own: Path) -> None:
    rng = trial.rng
    with contextlib.closing(sqlite3.connect(own / "study.db")) as base:
        tables = [
            name for (name,) in base.execute("select name from sqlite_master where type='table'")
        ]
        tables = [
            name for name in tables if base.execute(f"select count(*) from {name}").fetchone()[0]
        ]
        table = rng.choice(sorted(tables))
        columns = [row[1] for row in base.execute(f"pragma table_info({table})")]
        column, row = (
            rng.choice(columns),
            rng.choice([r for (r,) in base.execute(f"select rowid from {table}")]),
        )
        value = rng.choice(
            (
                None,
                -1,
                7,
                1e300,
                "",
                "x",
                "{",
                "null",
                "[" * 2000,
                '{"a": 1}',
                b"\xff",
                "7",
                "RUNNING",
            )
        )
        trial.trying(f"{kind}, {table}.{column} of row {row} = {value!r:.20}")
        with contextlib.suppress(sqlite3.Error):
            if rng.random() < 0.2:
                base.execute(f"delete from {table} where rowid = {row}")
            else:
                base.execute(f"update {table} set {column} = ? where rowid = {row}", (value,))
        base.commit()
    _check_same(kind, good, own, _swept(kind, good, own))


def _odd_json(trial: Trial, kind: str, good: Path, own: Path) -> None:
    path = own / "sweep.json"
    content = json.loads(path.read_text())
    key, value = trial.rng.choice([*content, "more"]), trial.rng.choice(_ODD)
    trial.trying(f"{kind}, sweep.json with {key} = {value!r:.40}")
    path.write_text(json.dumps(trial.rng.choice(({**content, key: value}, value, [content]))))
    ended = _swept(kind, good, own)
    check_end(ended)
    if ended.status != 0 and "another --folder" not in ended.err:
        _check_same(kind, good, own, ended)


def _locked(trial: Trial, kind: str, good: Path, own: Path) -> None:
    name = trial.rng.choice(("study.db", "lock.db"))
    trial.trying(f"{kind}, {name} locked by another process")
    with contextlib.closing(sqlite3.connect(own / name, isolation_level=None)) as base:
        base.execute("BEGIN EXCLUSIVE")
        ended = _swept(kind, good, own)
    check_end(ended)
    if ended.status == 0 or str(own) not in ended.err or "delete" in ended.err:
        raise Broken(f"exit status {ended.status}: {ended.err}")
    _check_same(kind, good, own, _swept(kind, good, own))


def _full(trial: Trial, kind: str, good: Path, own: Path) -> None:
    size = trial.rng.choice((0, trial.rng.randrange(200_000)))
    new = trial.rng.random() < 0.5
    trial.trying(f"{kind}, files limited to {size} bytes, {'new' if new else 'finished'}")
    if new:
        shutil.rmtree(own)
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))  # noqa: E731
    ended = _swept(kind, good, own, before=limit)
    check_end(ended)
    if ended.status not in (0, 1):
        raise Broken(f"exit status {ended.status}")
    if kind == "grid" or not new:
        _check_same(kind, good, own, _swept(kind, good, own))


def _killed(trial: Trial, kind: str, good: Path, own: Path) -> None:
    rng = trial.rng
    for name in ("study.db", "table.csv"):
        (own / name).unlink()
    if kind == "grid":
        shutil.rmtree(own / "runs")
    number = rng.choice(
        (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    )
    after = rng.uniform(0.0, 1.5)
    trial.trying(f"{kind}, {number.name} after {after:.2f} s")
    process = _start(kind, good, own, seconds=0.2)
    process.watch(after)
    process.signal(number)
    ended = process.end()
    # Signals end a command that has not begun, too.
    if ended.status != -number:
        check_end(ended)
    _check_same(kind, good, own, _swept(kind, good, own))


def _odd_over(trial: Trial, kind: str, good: Path, own: Path) -> None:
    rng = trial.rng
    name = rng.choice(
        (
            _RATE,
            _RATE,
            "agent.gamma",
            "agent.algorithm.gamma",
            "",
            "--",
            "x.y",
            "env",
            "over",
            "agent.seed",
            "\U0001f916",
            "agent.actor.hidden-dims",
        )
    )
    value = rng.choice(
        (
            "",
            ",",
            "1,,2",
            "..",
            "1..",
            "..1",
            "1..1",
            "2..1",
            "nan..1",
            "0..inf",
            "1e400..2",
            "-1..1:log",
            "0..1:log",
            ":log",
            "a..b",
            "1..2..3",
            "[1,2],[3",
            "{}",
            "1e-4",
            "1,1,1",
            "\u0661..\u0662",
            "x" * 5000,
            "None",
            "1;2",
            "1..2:lin",
        )
    )
    argument = rng.choice((f"{name}={value}", f"{name}", f"={value}", f"{name}={value}={value}"))
    trials = rng.choice(([], ["--trials", "1"], ["--trials", rng.choice(("0", "-1", "x", "1e3"))]))
    trial.trying(f"--over {argument!r:.60} {' '.join(trials)}")
    new = Path("new").resolve()
    ended = command(
        "sweep", TASK, *_FLAGS, "--over", argument, *trials, "--folder", str(new), before=_fail_runs
    )
    check_end(ended)
    if ended.status == 0:
        raise Broken("exit status 0, though its runs fail")


def _fail_runs() -> None:
    from mjlab.sweep import runs as sweep_runs

    def start(words: list[str], environment: dict[str, str], log: Any) -> Any:
        return subprocess.Popen(["sh", "-c", "exit 1"])

    sweep_runs.start_in_background = start


_CASES = (
    _file, _row, _file, _file_of_run, _row, _killed, _lost, _odd_json, _full, _odd_over, _locked, _file,
)  # fmt: skip
