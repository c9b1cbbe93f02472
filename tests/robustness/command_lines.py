"""Command lines with wrong values, huge numbers, unknown names and odd characters."""

from __future__ import annotations

import os
import random
import re
from collections.abc import Sequence
from pathlib import Path

from .commands import SMALL, TASK, check_end, command
from .runs import trained
from .trials import Broken, Trial

WHAT = "flags and arguments of all commands, with values that they should not have"
TRIALS = 280
LIMIT = 90.0

_PATIENCE = 12.0
_ODD = (
    "", " ", "-", "--", "-1", "0", "00", "1.5", "1e3", "-0.0", "nan", "inf", "-inf", "1e308", "1e999",
    "1e-320", "2147483648", "9223372036854775808", "1000000000", "1" * 5000, "0x10", "1_000", "None",
    "none", "True", "maybe", "auto", "null", "[]", "[1,", "(1, 2)", "{}", "{'a': 1}", "1,2,3", "1 2 3",
    "x" * 10_000, "\u00e4\u00f6\u00fc", "\U0001f916", "\u0661\u0662", "\u202egnp.x", "a\nb", "a\tb",
    "\x1b[31mred", "'", '"', "`id`", "$(id)", "${HOME}", "%s%n", "*", ".*", "(", "[", "\\", "a b",
    "../../x", "./.", "/dev/null", "/proc/self/mem", "/nonexistent/x", "~", "~nobody/x", "file:///x",
    "cuda:9", "cuda:-1", "meta", "mps", "cpu:3", "os:system", "__import__", "torch.nn:Module",
)  # fmt: skip
# Flags whose large values require much work, as expected.
_LONG = (
    "max-iterations",
    "num-steps",
    "steps",
    "num-episodes",
    "seeds",
    "video-length",
    "num-envs",
)

_TRAIN = (TASK, *SMALL, "--agent.max-iterations", "1")
_POLICY = (TASK, "--device", "cpu", "--agent", "random")
# A short call of each command that works.
_CALLS: dict[str, tuple[str, ...]] = {
    "train": _TRAIN,
    "play": (*_POLICY, "--viewer", "none", "--num-steps", "3"),
    "evaluate": (*_POLICY, "--num-episodes", "2", "--max-steps", "3"),
    "list_envs": (),
    "train_seeds": (*_TRAIN, "--seeds", "1"),
    "plot_seeds": ("RUN", "--output", "x.png"),
    "profile_env": (TASK, "--device", "cpu", "--num-envs", "2", "--steps", "2"),
    "export_scene": (TASK, "--output-dir", "scene"),
    "viz_nan": ("RUN/nan_dump_latest.npz",),
    "demo": ("--viewer", "none", "--num-steps", "2"),
    "verify": (TASK, "--device", "cpu", "--num-envs", "16", "--resume"),
    "csv_to_npz": ("--input-file", "RUN/run.json"),
}
# Deterministic calls that would fail silently.
_MISTAKES: tuple[tuple[str, ...], ...] = (
    (
        "train",
        *_TRAIN,
        "--agent.algorithm.num-learning-epochs",
        "1",
        "--agent.algorithm.num-mini-batches",
        "129",
    ),
    ("train", *_TRAIN, "--agent.class-name", "Foo"),
    ("train", *_TRAIN, "--agent.algorithm.class-name", "Foo"),
    ("train", *_TRAIN, "--wandb-run-path", "a/b/c"),
    ("train", *_TRAIN, "--wandb-checkpoint-name", "model_1.pt"),
    ("train", *_TRAIN, "--agent.resume", "True", "--wandb-run-path", "a/b/c"),
    ("train", *_TRAIN, "--gpu-ids", "[0,1]"),
    ("train", *_TRAIN, "--gpu-ids", "all"),
    ("train", *_TRAIN, "--agent.load-run", "x"),
    ("train", *_TRAIN, "--agent.load-checkpoint", "x"),
    ("train", *_TRAIN, "--num-envs", "0"),
    ("train", *_TRAIN, "--num-envs", "-1"),
    ("train", *_TRAIN, "--num-envs", "1000000000"),
    ("train", *_TRAIN, "--agent.num-steps-per-env", "0"),
    ("train", *_TRAIN, "--agent.max-iterations", "-1"),
    ("train", *_TRAIN, "--agent.save-interval", "0"),
    ("train", *_TRAIN, "--agent.algorithm.learning-rate", "nan"),
    ("train", *_TRAIN, "--agent.algorithm.gamma", "nan"),
    ("train", *_TRAIN, "--agent.algorithm.num-learning-epochs", "0"),
    ("train", *_TRAIN, "--agent.algorithm.num-mini-batches", "0"),
    ("train", *_TRAIN, "--env.decimation", "0"),
    ("train", *_TRAIN, "--env.sim.mujoco.timestep", "0"),
    ("train", *_TRAIN, "--env.sim.mujoco.timestep", "nan"),
    ("train", *_TRAIN, "--env.sim.mujoco.timestep", "-0.01"),
    ("train", *_TRAIN, "--env.episode-length-s", "nan"),
    ("train", *_TRAIN, "--env.rewards.smooth-reward.weight", "nan"),
    ("train", *_TRAIN, "--agent.resume", "True"),
    ("train", *_TRAIN, "--profile", "nope"),
    ("train", *_TRAIN, "--device", "cuda:7"),
    ("train", "--num-envs", "16"),
    ("train", "Mjlab-Cartpole-Swingup-"),
    ("train", ""),
    ("train_seeds", *_TRAIN, "--seeds", "1", "--agent.seed", "3"),
    ("train_seeds", *_TRAIN, "--seeds", "0"),
    ("play", *_CALLS["play"], "--num-steps", "0"),
    ("play", *_CALLS["play"], "--port", "0"),
    ("play", *_CALLS["play"], "--viewer", "viser", "--num-steps", "2000", "--host", "300.1.2.3"),
    ("play", *_CALLS["play"], "--viewer", "viser", "--num-steps", "2000", "--host", "8.8.8.8"),
    ("play", *_CALLS["play"], "--checkpoint-file", "nope.pt"),
    ("play", *_CALLS["play"], "--video", "True", "--video-width", "100000"),
    ("play", *_CALLS["play"], "--wandb-checkpoint-name", "model_1.pt"),
    ("evaluate", *_CALLS["evaluate"], "--num-episodes", "0"),
    ("evaluate", *_CALLS["evaluate"], "--max-steps", "0"),
    ("evaluate", *_CALLS["evaluate"], "--num-episodes", "1000000000"),
    ("plot_seeds", "nope"),
    ("viz_nan", "nope.npz"),
    ("viz_nan", "RUN/run.json"),
    ("viz_nan", "RUN/model_0.pt"),
    ("viz_nan", "DUMP", "--host", "300.1.2.3"),
    ("export_scene", "nope"),
    ("export_scene", "os:system"),
    ("profile_env", TASK, "--steps", "0"),
    ("demo", "nope"),
    ("verify", TASK, "--seed", "-5"),
)
# Number of mistakes among ten trials, until all have been tried.
_MISTAKES_OF_TEN = 4


def prepare(folder: Path) -> dict[str, object]:
    """Read the flags of the commands from their help, and train a little."""
    flags = {}
    for script, argv in _CALLS.items():
        ask = (*argv[:1], "--help", "all") if argv[:1] == (TASK,) else ("--help",)
        said = command(script, *ask).out
        flags[script] = sorted(set(re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", said)) - {"--help"})
    return {"flags": flags, "run": str(trained(folder / "logs", 1))}


def run(trial: Trial, prepared: dict[str, object]) -> None:
    """Call a command with mistakes in its arguments."""
    tens, position = divmod(trial.number, 10)
    mistake = tens * _MISTAKES_OF_TEN + position
    is_mistake = position < _MISTAKES_OF_TEN and mistake < len(_MISTAKES)
    if is_mistake:
        script, *argv = _MISTAKES[mistake]
    else:
        script, argv = _fuzzed(trial.rng, prepared["flags"])
    argv = [word.replace("RUN", str(prepared["run"])) for word in argv]
    # Process arguments cannot contain a null, and a page may use any free port.
    shown = " ".join(repr(w) if not re.fullmatch(r"[\w./,:-]+", w) else w for w in argv)
    own = shown.replace(" ".join(SMALL), "").replace(str(prepared["run"]), "RUN")
    trial.trying(f"{script.replace('_', '-')} {own[:300]}")

    def environment() -> None:
        os.environ["WANDB_MODE"] = "offline"

    ended = command(script, *argv, before=environment, patience=_PATIENCE)
    check_end(ended)
    # Releases 1.x accept some of these: a notice names the flag.
    fields = [
        word.removeprefix("--").rpartition(".")[2]
        for word in argv
        if word[:2] == "--" and word not in SMALL
    ]
    is_told = any(name.replace("-", "_") in ended.err.replace("-", "_") for name in fields)
    if is_mistake and ended.status == 0 and not is_told:
        raise Broken("was neither rejected nor told: exit status 0")
    if is_mistake and ended.was_asked:
        raise Broken(f"was not rejected within {_PATIENCE:.0f} s")


def _fuzzed(rng: random.Random, flags: object) -> tuple[str, list[str]]:
    """Return a command, and arguments with one to three changes."""
    assert isinstance(flags, dict)
    # Commands with many flags are tried more often.
    script = rng.choice([*_CALLS, "train", "train", "train", "play", "evaluate"])
    argv = list(_CALLS[script])
    for _ in range(rng.choice((1, 1, 2, 3))):
        change = rng.random()
        if change < 0.75 and flags[script]:
            flag = rng.choice(flags[script])
            argv += _with_value(rng, flag)
        elif change < 0.83 and argv:
            argv[rng.randrange(len(argv))] = rng.choice(_ODD)
        elif change < 0.89 and argv:
            del argv[rng.randrange(len(argv))]
        elif change < 0.94:
            argv.insert(rng.randrange(len(argv) + 1), rng.choice(_ODD))
        else:
            argv.append(_misspelt(rng, rng.choice(flags[script] or ["--x"])))
    return script, argv


def _with_value(rng: random.Random, flag: str) -> Sequence[str]:
    values = _ODD
    if any(word in flag for word in _LONG):
        values = tuple(v for v in _ODD if not (v.isdigit() and len(v) > 4))
    value = rng.choice(values)
    return rng.choice(
        ((flag, value), (f"{flag}={value}",), (flag, value, rng.choice(_ODD)), (flag,))
    )


def _misspelt(rng: random.Random, flag: str) -> str:
    position = rng.randrange(2, len(flag)) if len(flag) > 2 else 0
    return flag[:position] + rng.choice("xyz-. ") + flag[position + 1 :]
