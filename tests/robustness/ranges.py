"""Numbers inside and outside the ranges beside the fields of configs."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

from .commands import TASK, check_end, command
from .trials import Broken, Trial

WHAT = "numbers in and out of range, as flags, in a task's config, and in redefined fields"
TRIALS = 60
LIMIT = 90.0

_OWN = "Torture-Ranges"
_SMALL_SAC = {"batch_size": 16, "num_updates": 1, "replay_steps": 20, "learning_starts": 2}
_SHORT = {
    "train": (_OWN, "--device", "cpu", "--log-root", "logs"),
    "evaluate": (_OWN, "--device", "cpu", "--agent", "random", "--num-episodes=2", "--max-steps=3"),
    "play": (_OWN, "--device", "cpu", "--agent", "zero", "--viewer", "none", "--num-steps", "3"),
    "profile_env": (_OWN, "--device", "cpu", "--num-envs=2", "--steps=2", "--warm-up=1"),
    "verify": (TASK, "--device", "cpu"),
    "csv_to_npz": ("--input-file", "none.csv"),
    "visualize_terrain": (),
}
# Their other values would take long.
_ENDLESS = ("verify", "visualize_terrain")


@dataclasses.dataclass(frozen=True)
class _Field:
    script: str
    learner: Any
    path: str
    limits: Any
    value: Any


def _configs(learner: Any) -> tuple[Any, Any]:
    """Return small configs of environment and learner."""
    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

    env, agent = load_env_cfg(TASK), load_rl_cfg(TASK, learner=learner)
    env.scene.num_envs = 16
    agent.num_steps_per_env, agent.max_iterations = 8, 1
    agent.evaluation.solved_below = {"mean_length": 1e9}
    if learner == "sac":
        vars(agent.algorithm).update(_SMALL_SAC)
    return env, agent


def prepare(folder: Path) -> list[_Field]:
    """Return all fields with a range."""
    from mjlab.cli.train_config import TrainConfig
    from mjlab.scripts.csv_to_npz import CsvToNpzConfig
    from mjlab.scripts.evaluate import EvaluateConfig
    from mjlab.scripts.play import PlayConfig
    from mjlab.scripts.profile_env import ProfileConfig
    from mjlab.scripts.verify import VerifyConfig
    from mjlab.scripts.visualize_terrain import VisualizeTerrainConfig

    env, _ = _configs("ppo")
    calls: list[tuple[str, Any, Any]] = [
        ("train", learner, TrainConfig(*_configs(learner)))
        for learner in ("ppo", "sac", "distillation")
    ]
    calls += [
        ("evaluate", "ppo", EvaluateConfig(env=env)),
        ("play", "ppo", PlayConfig(env=env)),
        ("profile_env", "ppo", ProfileConfig(env=env)),
        ("verify", None, VerifyConfig()),
        ("csv_to_npz", None, CsvToNpzConfig(line_range=(1, 2))),
        ("visualize_terrain", None, VisualizeTerrainConfig()),
    ]
    return [
        _Field(script, learner, *one)
        for script, learner, cfg in calls
        for one in _fields(cfg, "")
        if one[0] != "agent.seed"
    ]


def _fields(cfg: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield path, range and value of the fields of a config with a range."""
    from mjlab.utils.ranges import Range

    def ranges(hint: Any) -> Iterator[Range]:
        if isinstance(hint, Range):
            yield hint
        for part in get_args(hint):
            yield from ranges(part)

    hints = get_type_hints(type(cfg), include_extras=True)
    for field in dataclasses.fields(cfg):
        value, inner = getattr(cfg, field.name), f"{path}{field.name}"
        limits = next(ranges(hints[field.name]), None)
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{inner}.")
        elif limits is not None and isinstance(value, dict):
            yield from ((f"{inner}.{key}", limits, number) for key, number in value.items())
        elif limits is not None:
            yield inner, limits, value


def run(trial: Trial, prepared: list[_Field]) -> None:
    """Run a command with a number in one of its fields."""
    rng = trial.rng
    # Each command as often as the others.
    script = rng.choice(("train", "train", "train", *_SHORT))
    field = rng.choice([one for one in prepared if one.script == script])
    limits = field.limits
    ways = ["flag", "flag"]
    if script == "train" and "." in field.path:
        ways += ["config", "redefined", "overridden"]
    way = rng.choice(ways)
    number = rng.choice(_numbers(limits, is_plain=isinstance(field.value, tuple)))
    is_valid = _holds(limits, number)
    if is_valid and script in _ENDLESS:
        number, is_valid = limits.low - 1, False
    value = _with(field.value, number)
    cfg = dict(zip(("env", "agent"), _configs(field.learner or "ppo"), strict=True))
    if way != "flag":
        _set(cfg, field.path.split("."), value, way == "redefined")
    flag = f"--{field.path.replace('_', '-')}"
    if rng.random() < 0.3:
        flag = f"--{field.path}"
    argv = list(_SHORT[script])
    text = str(value).replace(" ", "")
    if way == "flag":
        argv += rng.choice(((flag, text), (f"{flag}={text}",)))
    elif way == "overridden":
        # A flag in range replaces the number of the config.
        argv += [f"{flag}={str(field.value).replace(' ', '')}"]
        is_valid = True
    trial.trying(f"{script} {field.learner}: {way} {field.path} = {text}, {limits}")

    def register() -> None:
        from mjlab.tasks.registry import register_mjlab_task

        register_mjlab_task(_OWN, cfg["env"], rl_cfg=cfg["agent"])

    ended = command(script, *argv, before=register)
    check_end(ended)
    if ended.was_asked:
        raise Broken("still busy")
    plain = ended.said.replace("-", "_")
    told = plain.count(f"{field.path}: expected {limits}".replace("-", "_"))
    if is_valid and told:
        raise Broken("a number in range was rejected")
    if is_valid:
        return
    if told != 1:
        raise Broken(f"told {told} times: exit status {ended.status}")
    is_zero_count = number == 0 and str(limits) == "an integer >= 1"
    must_fail = way == "flag" or is_zero_count
    if must_fail and ended.status == 0:
        raise Broken("exit status 0")
    if must_fail and any(Path("logs").rglob("*")):
        raise Broken("a run was started")
    if not must_fail and f"error: {field.path}" in ended.err:
        raise Broken("a number of a task's config was rejected")


def _numbers(limits: Any, is_plain: bool) -> list[Any]:
    """Return numbers around the ends of a range, and odd ones."""
    ends = [end for end in (limits.low, limits.high) if math.isfinite(end)]
    if isinstance(limits.low, int):
        return [end + step for end in ends for step in (-1, 0, 1)] + [0, -1, -(2**40)]
    near = [end + step for end in ends for step in (-0.5, -1e-9, 0.0, 1e-9, 0.5)]
    return [*near, -1.0, 0.25] + ([] if is_plain else [math.nan, math.inf, -math.inf])


def _holds(limits: Any, number: float) -> bool:
    above = number > limits.low or (number == limits.low and limits.ends[0] == "[")
    below = number < limits.high or (number == limits.high and limits.ends[1] == "]")
    return above and below


def _with(value: Any, number: float) -> Any:
    """Return `value` with `number` as its last item, or `number`."""
    if isinstance(value, tuple) and value:
        return (*value[:-1], _with(value[-1], number))
    return number


def _set(holder: Any, parts: list[str], value: Any, redefines: bool) -> Any:
    """Set an entry in depth; with `redefines`, by a subclass with another default."""
    name, *rest = parts
    inner = holder[name] if isinstance(holder, dict) else getattr(holder, name)
    value = _set(inner, rest, value, redefines) if rest else value
    if isinstance(holder, dict):
        holder[name] = value
    elif redefines and not rest:
        own = (name, type(value), dataclasses.field(default=copy.deepcopy(value)))
        kind = dataclasses.make_dataclass("Own", [own], bases=(type(holder),), kw_only=True)
        made = object.__new__(kind)
        vars(made).update(vars(holder) | {name: value})
        return made
    else:
        setattr(holder, name, value)
    return holder
