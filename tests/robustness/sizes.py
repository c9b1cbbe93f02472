"""Sizes from the smallest to far beyond the memory, in flags, task configs and files of a run."""

from __future__ import annotations

import dataclasses
import random
import re
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import SMALL, TASK, check_end, command
from .runs import trained
from .trials import Broken, Trial

WHAT = "numbers of environments, steps, weights, rays, pixels; with and without a limit on memory"
TRIALS = 60
LIMIT = 90.0

_OWN_TASK = "Torture-Sizes"
_EDGES = (0, -1, 1, 2**31 - 1, 2**31, 2**63 - 1, 2**63, 10**30)
# Iterations of large networks take minutes.
_SHORT = (*SMALL, "--agent.max-iterations", "1", "--grace", "2")
_TRAIN = ("train", TASK, *_SHORT)
_SAC = (*_TRAIN, "--learner", "sac", "--agent.algorithm.learning-starts", "2")
_ALGORITHM = "--agent.algorithm."
_PLAY = ("play", TASK, "--device", "cpu", "--viewer", "none", "--num-steps", "3")
_RANDOM = (*_PLAY, "--agent", "random")
_OBSERVATIONS = "--env.observations.actor."
_RECURRENT = ("--agent.actor.class-name", "RNNModel", "--agent.actor.rnn-type", "gru")
# Commands whose last flag has a size.
_FLAGS: tuple[tuple[str, ...], ...] = (
    (*_TRAIN, "--num-envs"),
    (*_TRAIN, "--agent.num-steps-per-env"),
    (*_TRAIN, "--agent.actor.hidden-dims"),
    (*_TRAIN, "--agent.critic.hidden-dims"),
    (*_TRAIN, *_RECURRENT, "--agent.actor.rnn-hidden-dim"),
    (*_TRAIN, _OBSERVATIONS + "history-length"),
    (*_TRAIN, _OBSERVATIONS + "terms.pole-vel.delay-max-lag"),
    (*_SAC, _ALGORITHM + "replay-steps"),
    (*_SAC, _ALGORITHM + "batch-size"),
    (*_SAC, _ALGORITHM + "num-atoms"),
    (*_SAC, _ALGORITHM + "noise-hold"),
    (*_SAC, "--agent.actor.hidden-dims"),
    (*_RANDOM, "--num-envs"),
    (*_RANDOM, "--video", "True", "--video-length", "2", "--video-height", "64", "--video-width"),
    ("evaluate", TASK, "--device", "cpu", "--agent", "random", "--max-steps", "3", "--num-envs"),
    ("profile_env", TASK, "--device", "cpu", "--steps", "2", "--num-envs"),
    ("csv_to_npz", "--input-file", "MOTION", "--output-fps"),
)
# Fields of a run's `params/agent.yaml`.
_FIELDS = ("hidden_dims", "num_steps_per_env", "rnn_hidden_dim")


def prepare(folder: Path) -> dict[str, str]:
    """Train a little, and write a motion of the G1."""
    motion = folder / "motion.csv"
    row = ",".join(map(str, (0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0, *(0.0,) * 29)))
    motion.write_text(f"{row}\n{row}\n{row}\n")
    return {"run": str(trained(folder / "logs", 1)), "motion": str(motion)}


def run(trial: Trial, prepared: dict[str, str]) -> None:
    """Run a command with one size, drawn from all magnitudes."""
    rng = trial.rng
    size = rng.choice(_EDGES) if rng.random() < 0.25 else int(10 ** rng.uniform(0, 20))
    kind = trial.number % 6
    before: Callable[[], None] = lambda: None  # noqa: E731
    if kind < 4:
        script, *argv = rng.choice(_FLAGS)
        argv = [word.replace("MOTION", prepared["motion"]) for word in (*argv, str(size))]
        if argv[-2].endswith("dims"):
            argv[-1] = rng.choice((f"({size},)", f"(64, {size})", f"({size}, {size})"))
        if argv[-2].endswith("num-steps-per-env") and size > 100:
            # More steps than fit into the time fit into the memory.
            argv[-1] = str(size * 10**8)
        what = f"{script} {argv[-2]} {argv[-1]}"
    elif kind == 4:
        script, *argv = _PLAY
        what = _foreign(rng, size, Path(prepared["run"]))
        argv += ["--checkpoint-file", str(Path("run/model_0.pt").resolve())]
    else:
        script, argv = "train", [_OWN_TASK, *_SHORT]
        salt, edit = rng.getrandbits(32), rng.choice(_EDITS)
        what = f"{edit.__name__.strip('_')} {size}"
        before = lambda: _register(edit, size, random.Random(salt))  # noqa: E731
    more = rng.randrange(100, 1500) << 20
    # Warp's library does not load at the limit.
    is_limited = "warp" not in what and (size < 10**13 or rng.random() < 0.5)
    trial.trying(what + (f", {more >> 20} MiB more memory (RLIMIT_AS)" if is_limited else ""))

    def prepare_process() -> None:
        before()
        if is_limited:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limit = pages * resource.getpagesize() + more
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    ended = command(script, *argv, before=prepare_process)
    check_end(ended)
    # The machine has less than 10 TB.
    if size >= 10**13 and ended.was_asked and not re.search(r"step|episode", what):
        raise Broken("was not rejected in time")
    errors = [line for line in ended.err.splitlines() if line.startswith("error")]
    if ended.status == 1 and not errors:
        raise Broken(f"exit status 1 without an error: {ended.err[-200:]}")


def _foreign(rng: random.Random, size: int, run_folder: Path) -> str:
    """Copy the run to `run`, with a size in its `params/agent.yaml`."""
    shutil.copytree(run_folder, "run")
    path, field = Path("run/params/agent.yaml"), rng.choice(_FIELDS)
    # Runs of other releases have only this record.
    Path("run/run.json").unlink()
    text = path.read_text()
    if field == "hidden_dims":
        text = re.sub(r"(hidden_dims:(?:.*\n\s*-)?\s*)\d+", rf"\g<1>{size}", text)
    else:
        text = re.sub(rf"({field}:) .*", rf"\1 {size}", text)
        if field.startswith("rnn"):
            text = text.replace("MLPModel", "RNNModel").replace("rnn_type: null", "rnn_type: gru")
    path.write_text(text)
    return f"play, params/agent.yaml with {field} {size}"


def _register(
    edit: Callable[[Any, int, random.Random], None], size: int, rng: random.Random
) -> None:
    from mjlab.tasks.registry import load_env_cfg, register_mjlab_task

    def cfg() -> Any:
        made = load_env_cfg(TASK)
        edit(made, size, rng)
        return made

    learner = "mjlab.tasks.cartpole.cartpole_env_cfg:cartpole_ppo_runner_cfg"
    register_mjlab_task(_OWN_TASK, cfg, rl_cfg=learner)


# Edits of the task's config.


def _rays(cfg: Any, size: int, rng: random.Random) -> None:
    from mjlab.sensor import GridPatternCfg, ObjRef, RayCastSensorCfg, RingPatternCfg

    resolution = 1.0 / size if size else 0.0
    pattern = rng.choice((
        GridPatternCfg(resolution=resolution), RingPatternCfg.single_ring(num_samples=size),
    ))  # fmt: skip
    frame = ObjRef(type="body", name="pole_1", entity="cartpole")
    cfg.scene.sensors += (RayCastSensorCfg(name="rays", frame=frame, pattern=pattern),)


def _camera(cfg: Any, size: int, rng: random.Random) -> None:
    from mjlab.sensor import CameraSensorCfg

    sides = rng.choice(((size, 2), (2, size)))
    camera = CameraSensorCfg(name="camera", width=sides[0], height=sides[1], data_types=("depth",))
    cfg.scene.sensors += (camera,)


def _pixels(cfg: Any, size: int, rng: random.Random) -> None:
    _add_terrain(cfg, "random_rough", horizontal_scale=8.0 / max(size, 1))


def _cells(cfg: Any, size: int, rng: random.Random) -> None:
    _add_terrain(cfg, "flat")
    cfg.scene.terrain.terrain_generator.num_rows = size


def _add_terrain(cfg: Any, kind: str, **changes: float) -> None:
    from mjlab.terrains import TerrainEntityCfg, TerrainGeneratorCfg
    from mjlab.terrains.config import ALL_TERRAIN_PRESETS

    sub = dataclasses.replace(ALL_TERRAIN_PRESETS[kind](), **changes)
    grid = TerrainGeneratorCfg(size=(8.0, 8.0), num_rows=1, num_cols=1, sub_terrains={kind: sub})
    cfg.scene.terrain = TerrainEntityCfg(terrain_type="generator", terrain_generator=grid)


def _nan_guard(cfg: Any, size: int, rng: random.Random) -> None:
    cfg.sim.nan_guard.enabled, cfg.sim.nan_guard.buffer_size = True, size


def _contact_history(cfg: Any, size: int, rng: random.Random) -> None:
    from mjlab.sensor import ContactMatch, ContactSensorCfg

    match = ContactMatch(mode="body", pattern="pole_1", entity="cartpole")
    sensor = ContactSensorCfg(name="touch", primary=match, fields=("force",), history_length=size)
    cfg.scene.sensors += (sensor,)


def _warp_rows(cfg: Any, size: int, rng: random.Random) -> None:
    # Kernels for fewer rows may compile for longer than the trial.
    cfg.sim.engine, cfg.sim.njmax, cfg.sim.nconmax = "warp", 10**12 + size, 10


_EDITS = (_rays, _camera, _pixels, _cells, _nan_guard, _contact_history, _warp_rows)
