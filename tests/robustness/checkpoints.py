"""Checkpoints with entries that no learner saves, clutter beside them, and training that diverges."""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import SMALL, TASK, Ended, check_end, command
from .runs import SAC, check_loadable, copied, learned, same, trained
from .trials import Broken, Trial

WHAT = "checkpoints of odd types and values, folders and links named like one, and diverged weights"
TRIALS = 60
LIMIT = 120.0

_ITERATIONS = 2
_DELETED = object()
_SCORE = ("--num-episodes", "2", "--max-steps", "5", "--device", "cpu")


def prepare(folder: Path) -> dict[str, Any]:
    """Train with each learner, and read each checkpoint with each reader."""
    ppo = trained(folder / "ppo", _ITERATIONS)
    runs = {"ppo": ppo, "sac": trained(folder / "sac", _ITERATIONS, *SAC)}
    teacher = ("--agent.teacher-checkpoint", str(ppo / f"model_{_ITERATIONS - 1}.pt"))
    runs["distillation"] = trained(
        folder / "student", _ITERATIONS, "--learner", "distillation", *teacher
    )
    for run in runs.values():
        shutil.rmtree(run / "git", ignore_errors=True)
    good = {}
    for learner, run in runs.items():
        for name in _READERS if learner == "ppo" else _READERS.keys() - {"teach"}:
            path = copied(run, f"{learner}-{name}") / f"model_{_ITERATIONS - 1}.pt"
            ended, result = _READERS[name](path)
            if ended.status != 0:
                raise RuntimeError(ended.said)
            good[learner, name] = _lines(ended, path), result
    return {"runs": {learner: str(run) for learner, run in runs.items()}, "good": good}


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Read a checkpoint with an odd entry, or among odd neighbors; or train until it diverges."""
    kind = trial.rng.choice((*[_odd_entry] * 7, *[_odd_neighbors] * 2, _diverged))
    kind(trial, prepared)


# Odd entries.


def _odd_entry(trial: Trial, prepared: dict[str, Any]) -> None:
    import torch

    rng = trial.rng
    learner, name = rng.choice(sorted(prepared["good"]))
    path = copied(Path(prepared["runs"][learner]), "odd") / f"model_{_ITERATIONS - 1}.pt"
    content = torch.load(path, map_location="cpu", weights_only=True)
    content, how = changed(content, rng)
    torch.save(content, path)
    trial.trying(f"{learner}, {how}, {name}")
    ended, found = _READERS[name](path)
    if ended.status == 0:
        said, expected = prepared["good"][learner, name]
        if not same(found, expected) and _lines(ended, path) <= said:
            raise Broken("read as something else, in silence")
        return
    cures = "use an earlier checkpoint", "a checkpoint of", "as it was trained", "delete this file"
    check_message(ended, path, *cures)
    if f"model_{_ITERATIONS - 2}.pt" not in ended.err and "earlier" in ended.err:
        raise Broken(f"does not name the earlier checkpoint: {ended.err[-300:]}")
    # Training from contents that were told to be odd may fail later.
    is_told = "another checksum" in ended.err
    if len(list(path.parents[1].iterdir())) > 1 and not is_told:
        raise Broken("a failed resume left a run folder")


def _lines(ended: Ended, path: Path) -> set[str]:
    """Return the lines of messages, without the folder of the checkpoint."""
    return set(ended.err.replace(str(path.parents[2]), "").splitlines())


def check_message(ended: Ended, path: Path, *cures: str) -> None:
    """Raise Broken unless a failed command names the file and one of the cures, in few lines."""
    # A checkpoint without its identity does not belong to its replay.
    named = str(path), str(path.with_name(f"replay_{path.name}"))
    if not any(name in ended.err for name in named):
        raise Broken(f"does not name the file: {ended.err[-300:]}")
    if not any(cure in ended.err for cure in cures):
        raise Broken(f"names no cure: {ended.err[-300:]}")


def changed(content: Any, rng: random.Random, first: str | None = None) -> tuple[Any, str]:
    """Replace an entry of nested data by one that does not fit; return the data and a description.

    Entries of all depths are equally frequent, the whole included; `first` fixes the first key.
    """
    holder, way = content, [first or rng.choice(list(content))]
    while True:
        value = holder[way[-1]]
        if not isinstance(value, (dict, list, tuple)) or not value or rng.random() < 0.2:
            break
        holder = value
        way.append(rng.choice(list(value) if isinstance(value, dict) else range(len(value))))
    name, new = rng.choice(list(_misfits(value).items()))

    def replaced(holder: Any, way: list[Any]) -> Any:
        items = dict(holder) if isinstance(holder, dict) else dict(enumerate(holder))
        items[way[0]] = replaced(items[way[0]], way[1:]) if len(way) > 1 else new
        if items[way[0]] is _DELETED:
            del items[way[0]]
        return items if isinstance(holder, dict) else type(holder)(items.values())

    return replaced(content, way), f"{'/'.join(map(str, way))} replaced by {name}"


def _misfits(value: Any) -> dict[str, Any]:
    import torch

    found: dict[str, Any] = {
        "nothing": _DELETED, "None": None, "a text": "text", "-7": -7, "nan": float("nan"),
        "10**30": 10**30, "True": True, "a complex number": 1j, "{}": {}, "[[[]]]": [[[]]],
        "a tensor (2, 3)": torch.ones(2, 3), "a number": torch.tensor(-1.5),
    }  # fmt: skip
    if isinstance(value, dict) and value:
        found["numbered keys"] = dict(enumerate(value.values()))
        found["a list"] = list(value.values())
        found["half"] = dict(list(value.items())[: len(value) // 2])
        found["more"] = {**value, "more": torch.ones(2)}
    if isinstance(value, torch.Tensor):
        floats = value.float()
        found |= {
            "nan": torch.full_like(floats, torch.nan), "inf": torch.full_like(floats, torch.inf),
            "meta": value.to("meta"), "sparse": floats.to_sparse(), "complex": floats + 1j,
            "truth values": value.bool(), "too large": floats.double() * 0 + 1e300,
            "quantized": torch.quantize_per_tensor(floats, 0.1, 0, torch.qint8),
            "no rows": value[:0] if value.dim() else value[None], "a row more": torch.stack([value] * 2),
        }  # fmt: skip
    return found


# Readers of a checkpoint: the end of the command, and a result that can be compared.


def _resume(path: Path) -> tuple[Ended, Any]:
    root = path.parents[2]
    flags = ("--log-root", str(root), "--agent.resume", "True", "--agent.max-iterations", "3")
    learner = json.loads((path.parent / "run.json").read_text())["learner"]
    ended = command("train", TASK, "--device", "cpu", "--learner", learner, *flags, patience=60.0)
    check_end(ended)
    new = sorted(path.parents[1].glob(f"*/model_{_ITERATIONS}.pt"))
    return ended, learned(new[-1]) if new else None


def _evaluate(path: Path) -> tuple[Ended, Any]:
    ended = command(
        "evaluate", TASK, "--checkpoint-file", str(path), "--json", "True", *_SCORE, patience=60.0
    )
    check_end(ended)
    metrics = json.loads(ended.out) if ended.status == 0 else {}
    return ended, {k: v for k, v in metrics.items() if k not in ("policy", "duration")}


def _play(path: Path) -> tuple[Ended, Any]:
    flags = ("--viewer", "none", "--num-steps", "4", "--device", "cpu")
    ended = command("play", TASK, "--checkpoint-file", str(path), *flags, patience=60.0)
    check_end(ended)
    # Episodes of play are not those of any seed.
    return ended, None


def _teach(path: Path) -> tuple[Ended, Any]:
    """Train a student of the policy."""
    root = path.parents[2] / "students"
    ended = command(
        "train", TASK, *SMALL, "--log-root", str(root), "--agent.max-iterations", "1",
        "--learner", "distillation", "--agent.teacher-checkpoint", str(path), patience=60.0,
    )  # fmt: skip
    check_end(ended)
    new = sorted(root.glob("*/*/model_0.pt"))
    return ended, learned(new[-1]) if new else None


_READERS: dict[str, Callable[[Path], tuple[Ended, Any]]] = {
    "resume": _resume, "evaluate": _evaluate, "play": _play, "teach": _teach,
}  # fmt: skip


# Clutter.


def _odd_neighbors(trial: Trial, prepared: dict[str, Any]) -> None:
    """Put folders, links and pipes with higher numbers beside the checkpoints, and use the newest."""
    rng = trial.rng
    folder = copied(Path(prepared["runs"]["ppo"]), "logs")

    def link(path: Path, target: str) -> None:
        path.symlink_to(target)

    makers: dict[str, Callable[[Path], Any]] = {
        "folder": lambda path: (path / "mine").mkdir(parents=True),
        "loop": lambda path: link(path, path.name),
        "dangling link": lambda path: link(path, "nowhere"),
        "link to a folder": lambda path: link(path, "params"),
        "pipe": os.mkfifo,
        "link through a file": lambda path: link(path, "run.json/x"),
    }
    names = [f"model_{number}.pt" for number in rng.sample(range(7, 10**6), 2)]
    names += rng.sample(("replay_model_9.pt", "x.onnx", "events.out.tfevents.9", "x.png"), 2)
    chosen = {name: rng.choice(sorted(makers)) for name in names}
    for name, kind in chosen.items():
        makers[kind](folder / name)
    if rng.random() < 0.5:
        chosen["2099-01-01_00-00-00"] = rng.choice(("loop", "dangling link", "pipe"))
        makers[chosen["2099-01-01_00-00-00"]](folder.parent / "2099-01-01_00-00-00")
    what = ", ".join(f"{name} a {kind}" for name, kind in chosen.items())
    root = ("--log-root", str(folder.parents[1]))
    newest = folder / f"model_{_ITERATIONS - 1}.pt"
    commands: dict[str, tuple[str, ...]] = {
        "train": ("--agent.resume", "True", "--agent.max-iterations", "3", "--device", "cpu"),
        "evaluate": _SCORE,
        "play": ("--viewer", "none", "--num-steps", "3", "--device", "cpu"),
    }
    name = rng.choice(sorted(commands))
    trial.trying(f"{what}, {name}")
    ended = command(name, TASK, *root, *commands[name], patience=60.0)
    check_end(ended)
    if ended.status != 0 or str(newest) not in ended.said:
        raise Broken(f"exit status {ended.status}, without {newest.name}: {ended.said[-300:]}")


# Divergence.


def _diverged(trial: Trial, prepared: dict[str, Any]) -> None:
    """Resume under a learning rate that breaks the weights: checkpoints stay good, and the message helps."""
    rng = trial.rng
    folder = copied(Path(prepared["runs"]["ppo"]), "logs")
    root = folder.parents[1]
    flags = (
        "--agent.algorithm.learning-rate", rng.choice(("1e30", "1e38", "1e20")),
        "--agent.algorithm.schedule", "fixed", "--agent.max-iterations", "6",
        "--agent.algorithm.max-grad-norm", rng.choice(("1.0", "inf")),
    )  # fmt: skip
    trial.trying(f"train with {' '.join(flags)}")
    shared = ("train", TASK, "--device", "cpu", "--log-root", str(root), "--agent.resume", "True")
    ended = command(*shared, *flags, patience=60.0)
    check_end(ended)
    check_loadable(root)
    if ended.status != 0 and "learning rate" not in ended.err:
        raise Broken(f"names no cure: {ended.err[-300:]}")
    again = ("--agent.algorithm.learning-rate", "1e-3", "--agent.max-iterations", "7")
    ended = command(*shared, *again, patience=60.0)
    check_end(ended)
    if ended.status != 0 and "learning rate" not in ended.err:
        raise Broken(f"cannot be resumed: {ended.err[-300:]}")
