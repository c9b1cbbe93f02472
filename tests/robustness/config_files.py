"""Hostile and absurd files of a run, read by the commands: nothing may be executed."""

from __future__ import annotations

import io
import json
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import TASK, check_end, command
from .runs import check_loadable, train_flags, trained
from .trials import Broken, Trial

WHAT = "files of a run that want to execute something, or hold what they should not"
TRIALS = 60
LIMIT = 90.0

_ITERATIONS = 2
_DEEP = 50_000
# Invalid values of settings, and some that refer elsewhere.
_ODD: tuple[Any, ...] = (
    None, True, -1, 0, 10**30, 1e308, float("nan"), float("inf"), "", "None", "x" * 100_000,
    "os:system", "../../../../etc/passwd", "/etc/passwd", "\x00", "\U0001f916", [], {}, [[]],
    [None], {"a": {}}, ["os", "system"], {"class_name": "os:system"}, [10**12], [-1], [0],
)  # fmt: skip


def prepare(folder: Path) -> dict[str, str]:
    """Train a policy."""
    return {"run": str(trained(folder / "logs", _ITERATIONS))}


class _Marks:
    """Writes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self._mark = mark

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self._mark,)


def _evil_yaml(mark: Path, trial: Trial) -> str:
    tag = trial.rng.choice((
        f'!!python/object/apply:os.system ["touch {mark}"]',
        f'!!python/object/new:os.system ["touch {mark}"]',
        f"!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [{mark}]]",
        f'!!python/object/apply:subprocess.check_call [[touch, "{mark}"]]',
    ))  # fmt: skip
    return trial.rng.choice((tag, f"actor: {tag}\n", f"seed: 7\nactor:\n  class_name: {tag}\n"))


def _hostile_yaml(trial: Trial, run: Path, mark: Path) -> None:
    name = trial.rng.choice(("agent", "env"))
    trial.trying(f"params/{name}.yaml with a tag that calls")
    (run / f"params/{name}.yaml").write_text(_evil_yaml(mark, trial))


def _hostile_pickle(trial: Trial, run: Path, mark: Path) -> None:
    kind = trial.rng.choice(("bare", "archive", "entry", "legacy"))
    trial.trying(f"checkpoint with a pickle that calls ({kind})")
    evil, path = _Marks(mark), run / "model_1.pt"
    if kind == "bare":
        path.write_bytes(pickle.dumps(evil))
        return
    import torch

    content = torch.load(path, weights_only=True)
    content["infos" if kind == "entry" else "actor_state_dict"] = evil
    torch.save(content, path, _use_new_zipfile_serialization=kind != "legacy")


def _hostile_onnx(trial: Trial, run: Path, mark: Path) -> None:
    import onnx

    trial.trying("exported policy with weights in a file elsewhere")
    (path,) = run.glob("*.onnx")
    model = onnx.load(str(path))
    tensor = model.graph.initializer[0]
    location = trial.rng.choice(("/etc/passwd", "../../../../../../../../etc/passwd", "missing"))
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    path.write_bytes(model.SerializeToString())


def _hostile_dump(trial: Trial, run: Path, mark: Path) -> None:
    trial.trying("NaN dump with pickled objects")
    buffer, path = io.BytesIO(), run / "nan_dump_latest.npz"
    import numpy as np

    np.lib.format.write_array(buffer, np.array([_Marks(mark)], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            trial.rng.choice(("_metadata.npy", "states_step_000001.npy")), buffer.getvalue()
        )


def _odd_yaml(trial: Trial, run: Path, mark: Path) -> None:
    import yaml

    name = trial.rng.choice(("agent", "agent", "env"))
    path = run / f"params/{name}.yaml"
    content = yaml.safe_load(path.read_text())
    key, value = _replace_one(trial, content)
    trial.trying(f"params/{name}.yaml with {key} = {value!r:.40}")
    path.write_text(yaml.safe_dump(content))


def _odd_json(trial: Trial, run: Path, mark: Path) -> None:
    path = run / "run.json"
    content = json.loads(path.read_text())
    keys = ["resumed", "profile", "learner", "task", "iterations", "ended"]
    key, value = trial.rng.choice(keys), trial.rng.choice(_ODD)
    content[key] = value
    trial.trying(f"run.json with {key} = {value!r:.40}")
    path.write_text(json.dumps(content))


def _nested(trial: Trial, run: Path, mark: Path) -> None:
    name = trial.rng.choice(("run.json", "params/agent.yaml", "params/env.yaml"))
    opening, closing = trial.rng.choice((("[", "]"), ('{"a":', "}"), ("- ", ""), ("&a [", "]")))
    trial.trying(f"{name} of {_DEEP} nested {opening!r}")
    (run / name).write_text(opening * _DEEP + closing * _DEEP)


def _not_a_file(trial: Trial, run: Path, mark: Path) -> None:
    names = ("run.json", "params/agent.yaml", "params/env.yaml", "model_1.pt", "params")
    path = run / trial.rng.choice(names)
    kind = trial.rng.choice(("folder", "loop", "null", "binary"))
    trial.trying(f"{path.relative_to(run)} is a {kind}")
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "null":
        path.symlink_to("/dev/null")
    else:
        path.write_bytes(trial.rng.randbytes(1000))


def _replace_one(trial: Trial, content: Any) -> tuple[str, Any]:
    """Put an odd value into nested dicts; return its path and the value."""
    way: list[str] = []
    while True:
        key = trial.rng.choice(sorted(content))
        way.append(str(key))
        if not (isinstance(content[key], dict) and content[key]) or trial.rng.random() < 0.3:
            content[key] = trial.rng.choice(_ODD)
            return ".".join(way), content[key]
        content = content[key]


_KINDS = (
    _hostile_yaml, _hostile_pickle, _odd_yaml, _odd_json, _nested, _odd_yaml, _odd_json, _not_a_file,
    _hostile_onnx, _hostile_dump,
)  # fmt: skip


def run(trial: Trial, prepared: dict[str, str]) -> None:
    """Read a run with one hostile file by a command."""
    root = Path("logs").resolve()
    good = Path(prepared["run"])
    own = root / "cartpole" / good.name
    shutil.copytree(good, own)
    mark = Path("executed").resolve()
    kind = _KINDS[trial.number % len(_KINDS)]
    kind(trial, own, mark)
    short = ("--device", "cpu", "--log-root", str(root))
    commands: dict[str, tuple[str, ...]] = {
        "evaluate": (TASK, *short, "--num-episodes", "2", "--max-steps", "5"),
        "play": (TASK, *short, "--viewer", "none", "--num-steps", "5"),
        "train": train_flags(root, _ITERATIONS + 1, "--agent.resume", "True"),
    }
    if kind is _hostile_dump:
        commands = {"viz_nan": (str(own / "nan_dump_latest.npz"),)}
    elif kind is _hostile_onnx:
        del commands["train"]
        policy = ("--checkpoint-file", str(next(own.glob("*.onnx"))))
        commands = {name: (*argv, *policy) for name, argv in commands.items()}
    what = trial.what
    for name, argv in commands.items():
        trial.trying(f"{what}, read by {name.replace('_', '-')}")
        ended = command(name, *argv)
        if mark.exists():
            raise Broken("it was executed")
        check_end(ended)
        if ended.was_asked:
            raise Broken("still busy")
        if "allow_pickle" in ended.said:
            raise Broken("advises allow_pickle")
        if "root:x:0" in ended.said:
            raise Broken("a file of the machine was shown")
    check_loadable(root) if "model_1" not in what and "checkpoint" not in what else None
