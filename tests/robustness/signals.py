"""Runs of PPO and SAC that get signals in each phase, and are resumed until finished."""

from __future__ import annotations

import functools
import importlib
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import Command, Ended, check_end, last_error, last_line
from .runs import check_loadable, checkpoints, leftovers, same, train_flags, trained
from .trials import Broken, Trial

WHAT = "signals by phase, one or two, of PPO and SAC, and SIGKILL; then as the run that none ended"
TRIALS = 60
LIMIT = 240.0

_ITERATIONS = 6
_FLAGS = (
    "--agent.max-iterations", str(_ITERATIONS), "--agent.evaluation.num-episodes", "64",
    "--agent.evaluation.trigger-return=-1e9", "--env.episode-length-s", "5",
)  # fmt: skip
_EPOCHS = "--agent.algorithm.num-learning-epochs"
_PPO = (_EPOCHS, "2")
_SAC = (
    "--learner", "sac", "--agent.algorithm.batch-size", "64", "--agent.algorithm.num-updates", "1",
    "--agent.algorithm.learning-starts", "2", "--agent.algorithm.replay-steps", "40",
)  # fmt: skip
_OFTEN = ("--agent.evaluation.min-interval", "1")
# Solved by any policy, once it is evaluated and confirmed.
_SOLVED = ("--agent.evaluation.solved-return=-1e6", "--agent.evaluation.first-iteration", "4")
_KINDS = {"ppo": (*_OFTEN, *_PPO), "sac": (*_OFTEN, *_SAC), "solved ppo": (*_SOLVED, *_PPO), "solved sac": (*_SOLVED, *_SAC)}  # fmt: skip
_SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

# The function called in each phase, and the number of its calls in the whole run.
_PHASES = {
    "build": ("mjlab.scripts.train", "training_env", 1),
    "rollout": ("mjlab.envs:ManagerBasedRlEnv", "step", 8 * _ITERATIONS),
    "update": ("mjlab.rl:MjlabOnPolicyRunner", "_update", _ITERATIONS),
    "save": ("mjlab.rl.runner", "save_checkpoint", 2),
    "evaluation": ("mjlab.rl.evaluation:SolvedCheck", "evaluate", 2),
    "confirmation": ("mjlab.rl.evaluation:SolvedCheck", "confirm", 1),
    "plot": ("mjlab.rl.plot", "plot_run", 1),
    "video": ("mjlab.cli.results", "record_policy", 1),
}
_HARMLESS = ("imports", "build", "plot", "video")
"""Phases with nothing to save, in which the default action of a signal is right."""
_PATIENCE = 10.0
"""Seconds from a signal to SIGKILL."""


def prepare(folder: Path) -> dict[str, Any]:
    """Train without interruption."""
    return {
        kind: _result(trained(folder / kind.replace(" ", "_"), _ITERATIONS, *_FLAGS, *flags))
        for kind, flags in _KINDS.items()
    }


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Send signals in phases of a run, let it finish, and compare."""
    rng, root = trial.rng, Path("logs").resolve()
    kind = list(_KINDS)[trial.number % len(_KINDS)]
    names = ["imports", *_PHASES]
    phases = [names[trial.number % len(names)], *rng.choices([*_PHASES], k=rng.randrange(3))]
    expected, whole, said, is_exact = prepared[kind], False, [], True
    for phase in phases:
        number, twice, flags = rng.choice(_SIGNALS), rng.random() < 0.3, _flags(kind, root)
        if is_endless := phase == "update" and _EPOCHS in flags and rng.random() < 0.5:
            # Deaf to the first signal: the iteration is finished first.
            twice, flags[flags.index(_EPOCHS) + 1] = True, str(10**9)
        said.append(f"{number.name}{' twice' * twice} in {'an endless ' * is_endless}{phase}")
        trial.trying(f"{kind}: {', '.join(said)}")
        flags += ["--result-video", "True"] * (phase == "video")
        for name in ("finished", "sent"):
            Path(name).unlink(missing_ok=True)
        before = set(root.glob("cartpole/*"))
        if phase == "imports":
            process = Command("train", flags, is_fresh=True)
            # Before, Python itself starts.
            maps = Path(f"/proc/{process.pid}/maps")
            process.watch(30.0, lambda maps=maps: "libtorch" in maps.read_text())
            if not process.watch(rng.uniform(0.0, 2.0)):
                Path("sent").touch()
                process.signal(number)
        else:
            call = 1 if is_endless else rng.randint(1, _PHASES[phase][2])
            delay = rng.uniform(0.0, 0.1)
            hook = functools.partial(_send_in_call, phase, call, delay, number, twice)
            process = Command("train", flags, before=hook)
        # As a job queue does.
        if process.watch(90.0, Path("sent").exists) and not process.watch(_PATIENCE):
            process.signal(signal.SIGKILL)
        ended = process.end(5.0)
        check_loadable(root)
        # A solved run that is resumed would go on.
        whole = _is_finished(root, expected["iterations_finished"])
        # Only the first SIGHUP counts, because a terminal and its shell both send it. The second of
        # other signals may come when all is saved because of the first.
        end = signal.SIGKILL if is_endless and number is signal.SIGHUP else number
        _check(ended, end if Path("sent").exists() else None, phase in _HARMLESS or whole or twice)
        _check_files(set(root.glob("cartpole/*")) - before, ended.status == -signal.SIGKILL)
        # The replay of an iteration that SAC gave up has its first steps.
        is_exact &= not (twice and "sac" in kind)
        if whole:
            break
    if not whole:
        check_end(Command("train", _flags(kind, root)).end(90.0), statuses=(0,))
    newest = max((path.parent for path in checkpoints(root)), key=lambda run: run.name)
    found = _result(newest)
    if is_exact and not same(found, expected):
        different = [name for name in expected if not same(found.get(name), expected[name])]
        raise Broken(f"not those of the uninterrupted run: {', '.join(different) or 'names'}")
    if left := leftovers(root):
        raise Broken(f"temporary files are left: {', '.join(left)}")


def _flags(kind: str, root: Path) -> list[str]:
    resume = ("--agent.resume", "True") if checkpoints(root) else ()
    return list(train_flags(root, _ITERATIONS, *_FLAGS, *_KINDS[kind], *resume))


def _send_in_call(phase: str, call: int, delay: float, number: signal.Signals, twice: bool) -> None:
    """Let this process send itself a signal, some time after a function is called."""
    from mjlab.rl.run_logger import RunLogger

    def send() -> None:
        Path("sent").touch()
        for _ in range(1 + twice):
            os.kill(os.getpid(), number)
            time.sleep(2.0 * delay)

    def start(left: list[int] = [call]) -> None:  # noqa: B006
        left[0] -= 1
        if left[0] == 0:
            threading.Timer(delay, send).start()

    def note(*_: Any, iteration: int, **__: Any) -> None:
        Path("note").write_text(str(iteration + 1))
        os.replace("note", "finished")

    place, name, _ = _PHASES[phase]
    module, _, owner = place.partition(":")
    holder = importlib.import_module(module)
    _before(getattr(holder, owner) if owner else holder, name, lambda *_, **__: start())
    _before(RunLogger, "finish_iteration", note)


def _before(holder: Any, name: str, call: Callable[..., None]) -> None:
    function = getattr(holder, name)

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        call(*args, **kwargs)
        return function(*args, **kwargs)

    setattr(holder, name, wrapped)


def _check(ended: Ended, number: signal.Signals | None, is_harmless: bool) -> None:
    """Raise Broken unless a command ended by `number`, or successfully before it."""
    if ended.stuck:
        raise Broken(ended.stuck)
    for text in ("Traceback", "Exception ignored", "Failed at"):
        if text in ended.said:
            raise Broken(f"{text}: {last_error(ended.said)}")
    statuses = {0} if number is None else {0, 128 + number}
    if number is not None and (is_harmless or number is signal.SIGKILL):
        statuses.add(-number)
    if ended.status not in statuses:
        raise Broken(f"exit status {ended.status}: {last_line(ended.said)}")


def _check_files(folders: set[Path], was_killed: bool) -> None:
    """Raise Broken unless the newest checkpoint has the last finished iteration, or the one before."""
    from mjlab.rl.checkpoint import load_checkpoint
    from mjlab.runs import Run

    for folder in folders:
        # A first iteration that was given up leaves nothing to save.
        if not was_killed and not checkpoints(folder) and Run(folder).info.get("iterations") != 0:
            raise Broken("a run folder without a checkpoint is left")
    if not Path("finished").exists():
        return
    done, files = int(Path("finished").read_text()), checkpoints(Path("logs"))
    saved = load_checkpoint(files[-1])["iterations_finished"] if files else 0
    if not done - was_killed <= saved <= done:
        raise Broken(f"{done} iterations were finished, {saved} are saved")


def _is_finished(root: Path, iterations: int) -> bool:
    """Return True if the last checkpoint is that of a finished run, after its evaluation."""
    from mjlab.rl.checkpoint import load_checkpoint

    content = load_checkpoint(checkpoints(root)[-1]) if checkpoints(root) else {}
    return content.get("iterations_finished") == iterations and not content["owes_evaluation"]


def _result(run: Path) -> dict[str, Any]:
    """Return what was learned, and the curves of the evaluations, in all sessions of a run."""
    from mjlab.rl.checkpoint import load_checkpoint
    from mjlab.runs.reference import read_scalars_of_sessions

    content = load_checkpoint(checkpoints(run)[-1])
    names = ("iterations_finished", "last_evaluated", "owes_evaluation")
    result = {
        name: v for name, v in content.items() if name.endswith("_state_dict") or name in names
    }
    for tag, curve in read_scalars_of_sessions(run).items():
        if tag.startswith(("Evaluation/", "Confirmation/")):
            result[tag] = dict(curve)
    return result
