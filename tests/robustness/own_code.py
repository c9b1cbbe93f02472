"""Errors of a user's own code: shown with the user's lines, and no others."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import Any

from .commands import SMALL, TASK, command
from .runs import check_loadable
from .trials import Broken, Trial

WHAT = (
    "errors of all kinds in a task's own functions, at build, reset and step, in training and play"
)
TRIALS = 40
LIMIT = 90.0

_TASK = "Torture-Own"
_MARK = "# here"
_SHOWN = 4
_ERRORS = {
    "KeyError": "{}['height']",
    "ZeroDivisionError": "1 / 0",
    "AttributeError": "math.no_such_name",
    "IndexError": "[][3]",
    "AssertionError": "throw(AssertionError())",
    "ValueError": "float('tall')",
    "FileNotFoundError": "open('/nonexistent/gait.csv')",
    "RuntimeError": "torch.ones(2) @ torch.ones(3)",
    "UnicodeDecodeError": "b'\\xff'.decode()",
    "RecursionError": "throw(RecursionError('too deep'))",
    "Odd": "throw(Odd('a\\nb'))",
}
_TERM = """\
def {name}(env, *args):
    if env is None or env.common_step_counter >= {first}:
        wrong()
    return {value}
"""
_ROWS = "torch.zeros(env.num_envs)"
# Kind of term: its value, and the line that adds it.
_TERMS = {
    "reward": (_ROWS, "cfg.rewards['own'] = RewardTermCfg(func=own, weight=1.0)"),
    "observation": (
        f"{_ROWS}[:, None]",
        "cfg.observations['actor'].terms['own'] = ObservationTermCfg(func=own)",
    ),
    "termination": (f"{_ROWS} > 0", "cfg.terminations['own'] = TerminationTermCfg(func=own)"),
    "metric": (_ROWS, "cfg.metrics['own'] = MetricsTermCfg(func=own)"),
    "reset": ("None", "cfg.events['own'] = EventTermCfg(func=own, mode='reset')"),
    "startup": ("None", "cfg.events['own'] = EventTermCfg(func=own, mode='startup')"),
    "curriculum": ("1.0", "cfg.curriculum['own'] = CurriculumTermCfg(func=own)"),
    "model": ("None", "cfg.scene.entities['cartpole'].spec_fn = lambda: own(None)"),
    "config": ("None", "own(None)"),
}
_MODULE = """\
import math
import torch
from mjlab.managers import *
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, register_mjlab_task

class Odd(Exception):
    pass

def throw(error):
    raise error

def wrong():
    {error}  {mark}

{term}
def make():
    cfg = load_env_cfg("{task}")
    {line}
    return cfg

register_mjlab_task("{own}", make, rl_cfg=lambda: load_rl_cfg("{task}"))
"""


def prepare(folder: Path) -> None:
    """Return nothing: trials share no data."""


def run(trial: Trial, prepared: Any) -> None:
    """Train or play a task with a function that raises."""
    kind = trial.rng.choice(list(_TERMS))
    name = trial.rng.choice(list(_ERRORS))
    # Terms are called once while the environment is built.
    first = trial.rng.choice((0, 3, 11))
    script = trial.rng.choice(("train", "play", "profile_env"))
    trial.trying(f"{name} in a {kind} at step {first}, {script}")
    value, line = _TERMS[kind]
    text = _MODULE.format(
        error=_ERRORS[name],
        mark=_MARK,
        term=_TERM.format(name="own", first=first, value=value),
        line=line,
        task=TASK,
        own=_TASK,
    )
    path = Path("own_task.py").resolve()
    path.write_text(text)

    def register() -> None:
        sys.path.insert(0, str(path.parent))
        importlib.import_module(path.stem)

    argv = {
        "train": (*SMALL, "--log-root", "logs", "--agent.max-iterations", "4"),
        "play": ("--agent", "random", "--viewer", "none", "--num-steps", "40", "--device", "cpu"),
        "profile_env": ("--num-envs", "4", "--steps", "40", "--device", "cpu"),
    }[script]
    ended = command(script, _TASK, *argv, before=register)
    if ended.stuck:
        raise Broken(ended.stuck)
    if ended.status == 0 and kind in ("startup", "reset", "curriculum") and first:
        # Not called again.
        return
    if ended.status != 1:
        raise Broken(f"exit status {ended.status}")
    shown = re.findall(r'^  File "(.*)", line (\d+)', ended.err, re.M)
    number = next(k for k, row in enumerate(text.splitlines(), 1) if row.endswith(_MARK))
    if (str(path), str(number)) not in shown:
        raise Broken("the line of the error is not shown")
    if len(shown) > _SHOWN or any(file != str(path) for file, _ in shown):
        raise Broken(f"{len(shown)} lines are shown, of {sorted({file for file, _ in shown})}")
    if "\nerror: " not in ended.err:
        raise Broken("no message")
    check_loadable(Path("logs"))
