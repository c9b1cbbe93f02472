"""Replays of SAC with odd entries, of other checkpoints, and other things in their place."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path
from typing import Any

from .checkpoints import changed, check_message
from .commands import TASK, Ended, check_end, command
from .runs import SAC, copied, learned, same, trained
from .trials import Broken, Trial

WHAT = "replays of odd types, sizes and origins: resumes name the file, and keep the run"
TRIALS = 40
LIMIT = 120.0

_ITERATIONS = 2
_NAME = f"replay_model_{_ITERATIONS - 1}.pt"


def prepare(folder: Path) -> dict[str, Any]:
    """Train twice, and resume with and without the replay."""
    run = trained(folder / "logs", _ITERATIONS, *SAC)
    other = trained(folder / "other", _ITERATIONS, *SAC, "--agent.seed", "5")
    shutil.rmtree(run / "git", ignore_errors=True)
    good = {}
    for name in ("with", "without"):
        copy = copied(run, name)
        if name == "without":
            (copy / _NAME).unlink()
        ended, good[name] = _resume(copy)
        if ended.status != 0:
            raise RuntimeError(ended.said)
    return {"run": str(run), "other": str(other), **good}


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Resume a run with an odd replay, under the same or another size of it."""
    rng = trial.rng
    folder = copied(Path(prepared["run"]), "logs")
    path = folder / _NAME
    damage = rng.choice((*[_odd_entry] * 6, _of_another, _in_its_place, _cut, _whole))
    how = damage(path, rng, prepared)
    flags: list[str] = []
    if rng.random() < 0.3:
        name, values = rng.choice(
            (("agent.algorithm.replay-steps", (13, 90)), ("num-envs", (4, 20)))
        )
        flags = [f"--{name}", str(rng.choice(values))]
    trial.trying(f"replay, {how}, {' '.join(flags)}")
    checkpoint = (folder / f"model_{_ITERATIONS - 1}.pt").read_bytes()
    ended, found = _resume(folder, *flags)
    if (folder / f"model_{_ITERATIONS - 1}.pt").read_bytes() != checkpoint:
        raise Broken("the checkpoint was changed")
    if ended.status != 0:
        check_message(ended, path, "delete this file")
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
        # The cure.
        ended, found = _resume(folder, *flags)
    starts_empty = "replay starts empty" in ended.said
    if ended.status != 0 or found is None:
        raise Broken(f"exit status {ended.status}: {ended.err[-300:]}")
    if flags:
        if not starts_empty:
            raise Broken("another size, in silence")
    elif not same(found, prepared["without" if starts_empty else "with"]):
        raise Broken(f"other weights than {'without' if starts_empty else 'with'} a replay")


# Damages: functions of the path of the replay, which describe themselves.


def _odd_entry(path: Path, rng: random.Random, prepared: dict[str, Any]) -> str:
    import torch

    content = torch.load(path, map_location="cpu", weights_only=True)
    content, how = changed(content, rng, rng.choice(("tensors", "tensors", *content)))
    torch.save(content, path)
    return how


def _of_another(path: Path, rng: random.Random, prepared: dict[str, Any]) -> str:
    shutil.copy(Path(prepared["other"]) / _NAME, path)
    return "of another run"


def _in_its_place(path: Path, rng: random.Random, prepared: dict[str, Any]) -> str:
    path.unlink()
    kind = rng.choice(("nothing", "folder", "loop", "dangling link", "checkpoint", "pipe"))
    if kind == "folder":
        (path / "mine").mkdir(parents=True)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "checkpoint":
        shutil.copy(path.with_name(f"model_{_ITERATIONS - 1}.pt"), path)
    elif kind != "nothing":
        path.symlink_to(path.name if kind == "loop" else "nowhere")
    return f"{kind} in its place"


def _cut(path: Path, rng: random.Random, prepared: dict[str, Any]) -> str:
    data = path.read_bytes()
    path.write_bytes(data[: rng.choice((0, rng.randrange(len(data))))])
    return f"cut to {path.stat().st_size} bytes"


def _whole(path: Path, rng: random.Random, prepared: dict[str, Any]) -> str:
    return "whole"


def _resume(folder: Path, *flags: str) -> tuple[Ended, Any]:
    """Resume the run; return the end of the command, and the weights."""
    root = folder.parents[1]
    ended = command(
        "train", TASK, "--device", "cpu", "--learner", "sac", "--log-root", str(root),
        "--agent.resume", "True", "--agent.max-iterations", str(_ITERATIONS + 1), *flags,
        patience=60.0,
    )  # fmt: skip
    check_end(ended)
    new = sorted(folder.parent.glob(f"*/model_{_ITERATIONS}.pt"))
    return ended, learned(new[-1]) if new else None
