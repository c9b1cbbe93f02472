"""Damaged files of every kind that is read, by the library's reader or the command that reads them."""

from __future__ import annotations

import io
import json
import logging
import random
import shutil
import signal
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import TASK, Command, Ended, check_end, command, free_port
from .runs import SAC, check_loadable, learned, same, train_flags, trained
from .trials import Broken, Trial, name_of

WHAT = "one flipped bit, cut, emptied, overwritten and absurdly nested files of all kinds"
TRIALS = 280
LIMIT = 90.0

_ITERATIONS = 2
_DEEP = 100_000


def prepare(folder: Path) -> dict[str, Any]:
    """Make one good file of each kind, with the result of its reader."""
    run = trained(folder / "logs", _ITERATIONS)
    of_sac = trained(folder / "sac", _ITERATIONS, *SAC)
    files = {
        "replay": of_sac / "replay_model_1.pt",
        "checkpoint": next(run.glob("model_1.pt")),
        "onnx": next(run.glob("*.onnx")),
        "events": next(run.glob("events.out.*")),
        "run.json": run / "run.json",
        "agent.yaml": run / "params/agent.yaml",
        "env.yaml": run / "params/env.yaml",
        "motion": _make_motion(folder / "motion.npz"),
        "motions.json": _record_motion(folder / "recorded", folder / "motion.npz"),
        "dump": _make_dump(folder / "dumps"),
    }
    files["model of a dump"] = next((folder / "dumps").glob("model_2*.mjb"))
    for one in (run, of_sac):
        shutil.rmtree(one / "git", ignore_errors=True)
    return {
        "runs": [str(run), str(of_sac), str(folder / "recorded")],
        "files": {kind: str(path) for kind, path in files.items()},
    }


# Readers return content that can be compared, and raise `Rejected` with the message of an error.


class Rejected(Exception):
    """Raised if a reader rejects a file with a message."""


def _read_checkpoint(path: Path) -> Any:
    from mjlab.rl.checkpoint import CheckpointError, load_checkpoint

    try:
        return load_checkpoint(path)
    except CheckpointError as error:
        raise Rejected(str(error)) from error


def _read_replay(path: Path) -> Any:
    from mjlab.rl.checkpoint import CheckpointError, load_checkpoint
    from mjlab.rl.replay import ReplayFiles

    checkpoint = path.with_name(path.name.removeprefix("replay_"))

    class AnySize:
        def check_fits(self, state: Any) -> None: ...

    storage: Any = AnySize()
    try:
        return ReplayFiles(checkpoint).read(storage, load_checkpoint(checkpoint)["identity"])
    except CheckpointError as error:
        if str(path) not in str(error) or "delete this file" not in str(error):
            raise Broken(f"says neither file nor cure: {error}") from error
        raise Rejected(str(error)) from error


def _read_motion(path: Path) -> Any:
    from mjlab.tasks.tracking.motion_file import MotionFileError, read_motion

    try:
        return dict(vars(read_motion(path)))
    except MotionFileError as error:
        raise Rejected(str(error)) from error


def _read_recorded_motions(path: Path) -> Any:
    from mjlab.tasks.tracking.motion_file import MotionFileError
    from mjlab.tasks.tracking.motion_sources import recorded_motions

    try:
        return [name.name for name in recorded_motions(path.parents[1])]
    except MotionFileError as error:
        raise Rejected(str(error)) from error


def _read_dump(path: Path) -> Any:
    import mujoco
    import numpy as np

    from mjlab.scripts.viz_nan import load_dump
    from mjlab.utils.errors import UserError

    try:
        dump, model = load_dump(str(path))
    except (UserError, ValueError, OSError) as error:
        raise Rejected(str(error)) from error
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return {"arrays": dump.arrays, "metadata": dump.metadata, "model": buffer}


def _read_model_of_dump(path: Path) -> Any:
    return _read_dump(path.parent / "nan_dump_latest.npz")


def _read_events(path: Path) -> Any:
    from mjlab.rl.plot import read_all_scalars

    told = io.StringIO()
    handler = logging.StreamHandler(told)
    logging.getLogger("mjlab").addHandler(handler)
    try:
        curves = read_all_scalars(path.parent)
    except (ValueError, OSError) as error:
        raise Rejected(str(error)) from error
    finally:
        logging.getLogger("mjlab").removeHandler(handler)
    if not curves:
        # Readers of curves report a run without one.
        raise Rejected("no data")
    return curves, told.getvalue()


def _score(path: Path) -> Ended:
    """Score the policy of the run of `path`: its export if `path` is one."""
    run = path.parent.parent if path.parent.name == "params" else path.parent
    policy = path if path.suffix == ".onnx" else run / "model_1.pt"
    flags = ("--num-episodes", "2", "--max-steps", "5", "--json", "True", "--device", "cpu")
    return command("evaluate", TASK, "--checkpoint-file", str(policy), *flags)


def _read_by_evaluate(path: Path) -> Any:
    ended = _score(path)
    check_end(ended)
    if ended.status != 0:
        raise Rejected(ended.err)
    values = json.loads(ended.out)
    return {k: v for k, v in values.items() if k not in ("policy", "duration")}, ended.err


def _read_by_resume(path: Path) -> Any:
    run = path.parent.parent if path.parent.name == "params" else path.parent
    root = run.parents[1]
    ended = command("train", *train_flags(root, _ITERATIONS + 1, "--agent.resume", "True"))
    check_end(ended)
    if ended.status != 0:
        raise Rejected(ended.err)
    check_loadable(root)
    newest = max(run.parent.glob(f"*/model_{_ITERATIONS}.pt"))
    return learned(newest), ended.err


def _read_by_plot(path: Path) -> Any:
    ended = command("plot_seeds", str(path.parent), "--output", str(path.parent / "x.png"))
    check_end(ended)
    if ended.status != 0:
        raise Rejected(ended.err)
    return (path.parent / "x.png").read_bytes(), ended.err


def _read_by_page(path: Path) -> Any:
    """Show a dump briefly; drawings are not compared."""
    dump = path if path.suffix == ".npz" else path.parent / "nan_dump_latest.npz"
    process = Command("viz_nan", [str(dump), "--port", str(free_port())])
    process.watch(3.0)
    if process.status is None:
        process.signal(signal.SIGINT)
        check_end(process.end())
        return None
    ended = process.end()
    check_end(ended)
    raise Rejected(ended.err)


_READERS: dict[str, tuple[Callable[[Path], Any], ...]] = {
    "checkpoint": (*[_read_checkpoint] * 8, _read_by_evaluate, _read_by_resume),
    "replay": (*[_read_replay] * 4, _read_by_resume),
    "onnx": (_read_by_evaluate,),
    "events": (_read_events, _read_events, _read_by_plot),
    "run.json": (_read_by_evaluate, _read_by_resume),
    "agent.yaml": (_read_by_evaluate, _read_by_resume),
    "env.yaml": (_read_by_resume,),
    "motion": (_read_motion,),
    "motions.json": (_read_recorded_motions,),
    "dump": (*[_read_dump] * 5, _read_by_page),
    "model of a dump": (_read_model_of_dump, _read_model_of_dump, _read_by_page),
}
# One turn of trials: kinds with their frequencies.
_KINDS = (
    *["checkpoint"] * 8, *["replay"] * 4, *["onnx"] * 3, "events", "run.json", "agent.yaml", "env.yaml",
    *["motion"] * 3, "motions.json", *["dump"] * 2, "model of a dump",
)  # fmt: skip


# Damage functions map the bytes of a file to damaged bytes and a description.


def _flip(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    position, bit = rng.randrange(len(data)), rng.randrange(8)
    changed = bytearray(data)
    changed[position] ^= 1 << bit
    return bytes(changed), f"bit {bit} of byte {position} of {len(data)} flipped"


def _cut(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    length = rng.randrange(1, len(data))
    return data[:length], f"cut to {length} of {len(data)} bytes"


def _empty(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    return b"", "emptied"


def _garbage(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    return rng.randbytes(rng.randrange(1, 4096)), "overwritten by random bytes"


def _zeros(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    length = rng.randrange(len(data))
    # Simulates a machine crash before the file system wrote the end.
    return data[:length] + bytes(len(data) - length), f"zeros from byte {length} of {len(data)}"


def _hole(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    length = rng.randint(1, max(1, len(data) // 10))
    start = rng.randrange(len(data))
    return data[:start] + data[start + length :], f"{length} bytes missing at {start}"


def _absurd(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """Nest the content in the format of the file."""
    if data[:2] == b"PK":
        return _absurd_archive(data, rng)
    kind = rng.choice(("lists", "dicts", "flow", "aliases"))
    if kind == "aliases":
        lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
        lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
        return "\n".join(lines).encode(), "nested aliases"
    text = {"lists": "[", "dicts": '{"a":', "flow": "[{"}[kind] * _DEEP
    return text.encode(), f"{_DEEP} nested {kind}"


def _absurd_archive(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """Set absurd sizes in the entries of an archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(entries))
    header = str({"descr": "<f8", "fortran_order": False, "shape": (1 << 40, 8)}).encode()
    entries[name] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for other, content in entries.items():
            archive.writestr(other, content)
    return buffer.getvalue(), f"{name} of an absurd shape"


_DAMAGES = (_flip, _flip, _flip, _flip, _cut, _cut, _zeros, _hole, _empty, _garbage, _absurd)


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Damage a copy of a file, and read it."""
    rng = trial.rng
    kind = _KINDS[trial.number % len(_KINDS)]
    reader = rng.choice(_READERS[kind])
    good = Path(prepared["files"][kind])
    path = _copied(good, prepared["runs"])
    damage = rng.choice(_DAMAGES)
    damaged, how = damage(good.read_bytes(), rng)
    trial.trying(f"{kind}, {how}, {name_of(reader)}")
    # Read the undamaged file first, from a separate copy.
    expected = reader(path)
    path = _copied(good, prepared["runs"])
    path.write_bytes(damaged)
    try:
        found = reader(path)
    except Rejected as error:
        if not str(error).strip():
            raise Broken("rejected without a message") from error
        return
    if same(_content(found), _content(expected)) or _told(found, expected):
        return
    if kind == "events" and damage in (_cut, _zeros) and _is_start_of(found, expected):
        # Files of killed runs end like this.
        return
    raise Broken("read as something else, in silence")


def _copied(good: Path, runs: list[str]) -> Path:
    """Return a new copy of `good`, with the neighboring files of its reader."""
    here = Path("files").resolve()
    shutil.rmtree(here, ignore_errors=True)
    for run in map(Path, runs):
        if good.is_relative_to(run):
            shutil.copytree(run, here / "logs/cartpole" / run.name)
            return here / "logs/cartpole" / run.name / good.relative_to(run)
    shutil.copytree(
        good.parent, here, symlinks=True
    ) if good.parent.name == "dumps" else here.mkdir()
    path = here / good.name
    shutil.copy(good, path)
    return path


def _content(read: Any) -> Any:
    """Return the content that a reader read, without the output of its command."""
    return read[0] if isinstance(read, tuple) and isinstance(read[1], str) else read


def _told(found: Any, expected: Any) -> bool:
    """Return True if the output of a command differs from that for a good file."""
    if not (isinstance(found, tuple) and isinstance(found[1], str)):
        return False
    return not set(found[1].splitlines()) <= set(expected[1].splitlines())


def _is_start_of(found: Any, expected: Any) -> bool:
    """Return True if curves equal the expected ones up to missing ends; images are not compared."""
    curves, whole = _content(found), _content(expected)
    return isinstance(curves, bytes) or all(
        same(tuple(axis[: len(curve[0])] for axis in whole[tag]), tuple(curve))
        for tag, curve in curves.items()
    )


def _make_motion(path: Path) -> Path:
    import numpy as np

    from mjlab.tasks.tracking.motion_file import Motion, write_motion

    rng = np.random.default_rng(0)

    def random(*shape: int) -> Any:
        return rng.normal(size=(20, *shape)).astype(np.float32)

    quats = random(4, 4)
    motion = Motion(
        fps=50.0, joint_pos=random(3), joint_vel=random(3), body_pos_w=random(4, 3),
        body_quat_w=quats / np.linalg.norm(quats, axis=-1, keepdims=True),
        body_lin_vel_w=random(4, 3), body_ang_vel_w=random(4, 3),
        joint_names=("a", "b", "c"), body_names=("u", "v", "w", "x"),
    )  # fmt: skip
    return write_motion(path, motion)


def _record_motion(run: Path, motion: Path) -> Path:
    """Record a motion as training does; return the index."""
    from mjlab.tasks.tracking.motion_sources import record_motions

    return record_motions([motion], run)[-1]


def _make_dump(folder: Path) -> Path:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.registry import load_env_cfg

    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.sim.nan_guard.enabled = 4, True
    cfg.sim.nan_guard.output_dir, cfg.sim.nan_guard.buffer_size = str(folder), 5
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.step(torch.zeros(4, 1))
    env.sim.data.qpos[1, 0] = torch.nan
    env.step(torch.zeros(4, 1))
    env.close()
    return next(folder.glob("nan_dump_2*.npz"))
