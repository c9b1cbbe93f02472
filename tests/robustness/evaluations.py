"""Runs interrupted while they evaluate, and resumed until finished."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

from .commands import Command, check_end
from .runs import (
    check_loadable,
    checkpoints,
    leftovers,
    same,
    train_flags,
    trained,
)
from .trials import Broken, Trial

WHAT = "chains of signals in evaluations of PPO and SAC, compared with the run that none ended"
TRIALS = 12
LIMIT = 240.0

_ITERATIONS = 6
_EVALUATED = (
    "--agent.max-iterations", str(_ITERATIONS), "--agent.evaluation.num-episodes", "64",
    "--agent.evaluation.trigger-return=-1e9", "--env.episode-length-s", "5",
    # Checkpoints of these iterations are written for their evaluations only.
    "--agent.save-interval", "1000",
)  # fmt: skip
_SAC = (
    "--learner", "sac", "--agent.algorithm.batch-size", "64", "--agent.algorithm.num-updates", "1",
    "--agent.algorithm.learning-starts", "2", "--agent.algorithm.replay-steps", "40",
)  # fmt: skip
_OFTEN = ("--agent.evaluation.min-interval", "1")
# Solved by any policy, once it is evaluated and confirmed.
_SOLVED = ("--agent.evaluation.solved-return=-1e6", "--agent.evaluation.first-iteration", "4")
_KINDS = {"ppo": _OFTEN, "sac": (*_OFTEN, *_SAC), "solved ppo": _SOLVED, "solved sac": (*_SOLVED, *_SAC)}  # fmt: skip
_SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
# Longer than an evaluation on an idle machine, so that some signals come after it.
_LONGEST_S = 0.6
_MOST_SIGNALS = 4


def prepare(folder: Path) -> dict[str, Any]:
    """Train without interruption."""
    return {
        kind: _result(trained(folder / kind.replace(" ", "_"), _ITERATIONS, *_EVALUATED, *flags))
        for kind, flags in _KINDS.items()
    }


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Interrupt evaluations of a run a few times, let it finish, and compare."""
    rng, root = trial.rng, Path("logs").resolve()
    kind = list(_KINDS)[trial.number % len(_KINDS)]
    flags = (*_EVALUATED, *_KINDS[kind])
    # Some are sent twice. The replay of an iteration that SAC gave up has its first steps.
    often = 0.0 if kind == "solved sac" else 0.3
    numbers = [rng.choice(_SIGNALS) for _ in range(rng.randint(1, _MOST_SIGNALS))]
    sent = [(number, rng.uniform(0.0, _LONGEST_S), rng.random() < often) for number in numbers]
    what = (f"{n.name}{' twice' * twice} after {delay:.2f} s" for n, delay, twice in sent)
    trial.trying(f"{kind}: {', '.join(what)}")
    for number, delay, twice in sent:
        before = len(checkpoints(root))
        process = _start(root, flags)
        # The checkpoint is written before the evaluation.
        if not process.watch(60.0, lambda before=before: len(checkpoints(root)) > before):
            raise Broken("no checkpoint after 60 s")
        process.watch(delay)
        for _ in range(2 if twice else 1):
            process.signal(number)
        ended = process.end(30.0)
        check_loadable(root)
        # The signal may have come after the last evaluation, and have its usual effect then.
        is_finished = _is_finished(checkpoints(root)[-1], prepared[kind]["iterations_finished"])
        if ended.stuck:
            raise Broken(ended.stuck)
        if number is not signal.SIGKILL and (not is_finished or ended.status != -number):
            check_end(ended, statuses=(128 + number, 0))
        if "Failed" in ended.out:
            raise Broken(f"{number.name} is called a failure")
        # A solved run that is resumed would go on.
        if is_finished:
            break
    else:
        check_end(_start(root, flags).end(90.0), statuses=(0,))
    newest = max((path.parent for path in checkpoints(root)), key=lambda run: run.name)
    found, expected = _result(newest), prepared[kind]
    if not same(found, expected):
        different = [name for name in expected if not same(found.get(name), expected[name])]
        raise Broken(f"not those of the uninterrupted run: {', '.join(different) or 'names'}")
    if left := leftovers(root):
        raise Broken(f"temporary files are left: {', '.join(left)}")


def _start(root: Path, flags: tuple[str, ...]) -> Command:
    resume = ("--agent.resume", "True") if checkpoints(root) else ()
    return Command("train", train_flags(root, _ITERATIONS, *flags, *resume))


def _is_finished(checkpoint: Path, iterations: int) -> bool:
    """Return True for the last checkpoint of a run, if its evaluation was finished."""
    from mjlab.rl.checkpoint import load_checkpoint

    content = load_checkpoint(checkpoint)
    return content["iterations_finished"] == iterations and not content["owes_evaluation"]


def _result(run: Path) -> dict[str, Any]:
    """Return what was learned, and the curves of the evaluations, in all sessions of a run."""
    from mjlab.rl.checkpoint import load_checkpoint
    from mjlab.scripts.reference import read_scalars_of_sessions

    content = load_checkpoint(checkpoints(run)[-1])
    names = ("iterations_finished", "last_evaluated", "owes_evaluation")
    result = {
        name: v for name, v in content.items() if name.endswith("_state_dict") or name in names
    }
    for tag, curve in read_scalars_of_sessions(run).items():
        if tag.startswith(("Evaluation/", "Confirmation/")):
            result[tag] = dict(curve)
    return result
