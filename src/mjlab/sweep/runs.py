"""Training processes of a sweep, side by side."""

from __future__ import annotations

import ast
import contextlib
import itertools
import math
import os
import signal
import subprocess
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

from mjlab.cli.flags import typed_values
from mjlab.cli.resume import resume_flags
from mjlab.cli.train_process import train_command
from mjlab.rl.evaluation import Bound
from mjlab.sweep.settings import Setting, Sweep, train_config, train_flags
from mjlab.sweep.storage import storage_summary
from mjlab.sweep.study import Study, TrainedRun, setting_of, trained_run
from mjlab.utils.gpu import select_gpus
from mjlab.utils.processes import CORES_VARIABLE, PARENT_VARIABLE, available_cores
from mjlab.utils.signals import (
    FORWARDED,
    handled_signals,
    interrupting_signal,
    send_signal,
    start_in_background,
)
from mjlab.utils.string import clock, counted

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

_SECONDS_BETWEEN_LOOKS = 0.1
_EVALUATIONS = 10
"""Number of evaluations of a run."""
_FIRST_REPORT_S = 60.0
"""Time until what is left is printed, while no run ends (s); the times in between double."""


@dataclass(frozen=True)
class _Run:
    """Process that trains a seed of a trial."""

    trial: FrozenTrial
    seed: int
    name: str
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    slot: dict[str, str]
    begin: float
    """Start (s), as `time.monotonic`."""
    first: int
    """Number of iterations of earlier sessions."""
    total: int
    """Number of iterations."""


class Runs:
    """Training processes side by side."""

    def __init__(self, sweep: Sweep, study: Study) -> None:
        self._sweep = sweep
        self._study = study
        self.stopped_by: signal.Signals | None = None
        """Signal that stopped the sweep or one of its runs."""
        self.failed: list[Path] = []
        """Output of failed runs."""
        self._slots = machine_slots(sweep)
        self._signals: list[signal.Signals] = []
        self._queue: deque[tuple[FrozenTrial, int]] = deque()
        self._running: list[_Run] = []
        self._num_jobs = len(self._slots)
        self._num_ended = 0
        # Time of all processes, and the number of runs that it trained.
        self._spent, self._trained = 0.0, 0.0
        self._begin = time.monotonic()
        self._next_report = self._begin + _FIRST_REPORT_S
        # Training and evaluations of the finished runs (s).
        self._training, self._evaluating = 0.0, 0.0

    def train(self) -> None:
        """Train the runs that are not finished, until none is left or a signal arrives.

        SIGINT, SIGTERM and SIGHUP are forwarded to all runs, which save a checkpoint; at a second signal
        without the running iteration. After an error, such as a lost database, runs are saved too.
        """
        _print_summary(self._sweep, self._slots)
        received = self._signals
        with handled_signals(lambda number, _: received.append(signal.Signals(number)), FORWARDED):
            try:
                own = self._study.own()
                for trial in own:
                    self._add(trial)
                if kept := len(own) * self._sweep.seeds - len(self._queue):
                    print(f"Kept     {counted(kept, 'finished run')}", flush=True)
                self._fill()
                while self._running:
                    time.sleep(_SECONDS_BETWEEN_LOOKS)
                    self._update()
                    self._study.send_heartbeat()
                    if time.monotonic() > self._next_report:
                        self._next_report += time.monotonic() - self._begin
                        print(f"Running  {self.what_is_left()}", flush=True)
            finally:
                # A second signal would stop runs that are saving.
                if self._running and self.stopped_by is None:
                    self._stop(signal.SIGINT)
                while any(run.process.poll() is None for run in self._running):
                    time.sleep(_SECONDS_BETWEEN_LOOKS)
                    self._forward_signals()

    def _update(self) -> None:
        """Forward signals, and replace the processes that have ended."""
        self._forward_signals()
        for run in [run for run in self._running if run.process.poll() is not None]:
            self._running.remove(run)
            self._slots.insert(0, run.slot)
            self._settle(run)
            self._fill()

    def _forward_signals(self) -> None:
        while self._signals:
            self._stop(self._signals.pop(0))

    def _stop(self, number: signal.Signals) -> None:
        self.stopped_by = self.stopped_by or number
        for run in self._running:
            send_signal(run.process, FORWARDED[number])
        # A terminal that was closed takes no output.
        with contextlib.suppress(OSError):
            print(f"\nSaving {counted(len(self._running), 'run')} ...", flush=True)

    def _add(self, trial: FrozenTrial) -> None:
        """Queue the unfinished seeds of a trial."""
        seeds = [
            seed
            for seed in range(1, self._sweep.seeds + 1)
            if self._sweep.finished_run(setting_of(trial), seed) is None
        ]
        self._num_ended += self._sweep.seeds - len(seeds)
        self._queue.extend((trial, seed) for seed in seeds)
        if not seeds:
            self._study.finish(trial)

    def _fill(self) -> None:
        """Start runs on the free slots."""
        while self._slots and self.stopped_by is None and not self._signals:
            while not self._queue and (trial := self._study.next()) is not None:
                self._add(trial)
            if not self._queue:
                return
            self._start(*self._queue.popleft(), self._slots.pop(0))

    def _start(self, trial: FrozenTrial, seed: int, slot: dict[str, str]) -> None:
        """Start a run, or resume it from its last checkpoint."""
        sweep, setting = self._sweep, setting_of(trial)
        folder = sweep.runs_folder(setting)
        flags = [*_evaluations(sweep, setting), *train_flags(sweep, setting)]
        # A process that sees one GPU uses it.
        flags += ["--gpu-ids", "all"] if "CUDA_VISIBLE_DEVICES" in slot else sweep.machine_flags
        flags += ["--log-root", str(folder.parent), "--agent.experiment-name", folder.name]
        flags += ["--agent.run-name", f"seed_{seed}"]
        if sweep.objective.past_goal is not None:
            flags += ["--agent.evaluation.stop-when-solved=False"]
        saved = sweep.last_checkpoint(setting, seed)
        flags += [] if saved is None else resume_flags(saved.path.parent, saved.path)
        command = train_command(sweep.task, flags, seed)
        name = f"{sweep.describe(setting)}, seed {seed}"
        print(f"{'Resumed' if saved else 'Started'}  {name}", flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        log = open(sweep.log_file(setting, seed), "ab")  # noqa: SIM115
        environment = {**os.environ, **slot, PARENT_VARIABLE: str(os.getpid())}
        process = start_in_background(command, environment, log)
        first = 0 if saved is None or saved.number is None else saved.number + 1
        total = max(1, train_config(sweep, setting).agent.max_iterations)
        self._running.append(
            _Run(trial, seed, name, process, log, slot, time.monotonic(), first, total)
        )

    def _settle(self, run: _Run) -> None:
        """Print how a run ended; store the value of its trial after the last seed."""
        run.log.close()
        sweep, setting = self._sweep, setting_of(run.trial)
        sessions = sweep.sessions(setting, run.seed)
        info = sessions[0].info if sessions else {}
        stopped = interrupting_signal(run.process.returncode)
        if (trained := trained_run(sweep, setting, run.seed)) is not None:
            self._count(run, trained)
            value = f"{sweep.objective.label} {trained.value:.4g}"
            print(f"Finished {run.name}: {value}; {self.what_is_left()}", flush=True)
        elif stopped or self.stopped_by:
            self.stopped_by = self.stopped_by or stopped
            is_saved = stopped and info.get("ended") == "interrupted"
            saved = f"Saved    {run.name}, iteration {info.get('iterations', 0)}"
            print(saved if is_saved else f"Stopped  {run.name} without saving", flush=True)
            return
        else:
            self._num_ended += 1
            self.failed.append(sweep.log_file(setting, run.seed))
            print(f"Failed   {run.name}: {_last_error(self.failed[-1])}", flush=True)
        pending = [*(trial for trial, _ in self._queue), *(one.trial for one in self._running)]
        if any(trial.number == run.trial.number for trial in pending):
            return
        logs = {sweep.log_file(setting, seed) for seed in range(1, sweep.seeds + 1)}
        if logs.isdisjoint(self.failed):
            self._study.finish(run.trial)
        else:
            self._study.fail(run.trial)

    def _count(self, run: _Run, trained: TrainedRun) -> None:
        """Add a finished run to what the time left is estimated from."""
        self._num_ended += 1
        self._spent += time.monotonic() - run.begin
        self._trained += 1.0 - run.first / run.total
        self._training += trained.training_seconds
        self._evaluating += trained.evaluation_seconds

    def _iteration(self, run: _Run) -> int:
        """Return the number of iterations that a run has recorded in its evaluations and checkpoints."""
        sessions = self._sweep.sessions(setting_of(run.trial), run.seed)
        done = [run.first]
        for session in sessions[:1]:
            done += [one["iteration"] for one in session.evaluations]
            done += [saved.number + 1 for saved in session.checkpoints if saved.number is not None]
        return max(done)

    def what_is_left(self) -> str:
        """Return the number of runs left here, the time they take, and the share of evaluations."""
        elsewhere = sum(
            trial.state.name in ("RUNNING", "COMPLETE") and not self._study.is_own(trial)
            for trial in self._study.trials
        )
        left = (self._sweep.num_settings - elsewhere) * self._sweep.seeds - self._num_ended
        # After the last iteration, the last evaluation is left.
        done = [
            (min(self._iteration(run), run.total - 1) / run.total, run) for run in self._running
        ]
        spent = self._spent + sum(time.monotonic() - run.begin for run in self._running)
        trained = self._trained + sum(part - run.first / run.total for part, run in done)
        text = f"{counted(left, 'run')} left"
        if left > 0 and trained > 0.0:
            seconds = spent / trained * (left - sum(part for part, _ in done))
            text += f", about {clock(seconds / min(left, self._num_jobs))}"
        if self._evaluating:
            share = self._evaluating / (self._training + self._evaluating)
            text += f"; evaluations take {share:.0%} of the time"
        return text


def machine_slots(sweep: Sweep) -> list[dict[str, str]]:
    """Return the environment variables of runs side by side: one GPU each, or a share of the cores."""
    flags = typed_values([*sweep.machine_flags])
    gpus: list[int | str] = []
    if "device" not in flags:
        ids = flags.get("gpu_ids", "all")
        gpus = select_gpus("all" if ids == "all" else ast.literal_eval(ids))[0] or []
    # A device by name, such as cuda:1, is one.
    is_gpu = flags.get("device", "cpu") != "cpu"
    suited = len(gpus) or (1 if is_gpu else available_cores())
    jobs = min(sweep.jobs or suited, sweep.num_settings * sweep.seeds)
    share = str(max(1, available_cores() // jobs))
    slots = [{CORES_VARIABLE: share, "OMP_NUM_THREADS": share} for _ in range(jobs)]
    for slot, gpu in zip(slots, itertools.cycle(gpus), strict=False):
        slot["CUDA_VISIBLE_DEVICES"] = str(gpu)
    return slots


def _print_summary(sweep: Sweep, slots: list[dict[str, str]]) -> None:
    settings = counted(sweep.num_settings, "setting")
    each = counted(int(slots[0][CORES_VARIABLE]), "core")
    each += " and one GPU" if "CUDA_VISIBLE_DEVICES" in slots[0] else ""
    print(f"Sweep:   {settings} x {counted(sweep.seeds, 'seed')} of {sweep.task}")
    print(f"Runs:    {len(slots)} side by side with {each} each, in {sweep.folder}")
    print(f"Output:  {sweep.folder / 'runs' / '*' / 'seed_*.log'}")
    if sweep.storage is not None:
        print(f"Storage: {storage_summary(sweep.storage)}")
    objective = sweep.objective
    order = "lowest" if objective.minimize else "highest"
    print(f"Compare: {objective.reason or f'{objective.tag}, {order} first'}")
    if objective.past_goal is not None:
        print(
            f"Goal:    the return of {objective.past_goal:g} was set for the registered rewards; it neither "
            "ranks settings nor ends runs"
        )
    print(f"Curves:  uv run tensorboard --logdir {sweep.folder / 'runs'}", flush=True)


def _evaluations(sweep: Sweep, setting: Setting) -> list[str]:
    """Return flags that make runs comparable: to the last iteration, and evaluated there.

    Flags of the user come later and override them.
    """
    agent = train_config(sweep, setting).agent
    total, interval = agent.max_iterations, max(1, agent.max_iterations // _EVALUATIONS)
    # A trigger also evaluates tasks without a goal.
    if not (sweep.objective.is_evaluated or Bound.all_of(agent.evaluation)):
        return []
    settings = {
        "stop-when-solved": False,
        "trigger-return": -1e9,
        "min-interval": interval,
        "first-iteration": max(0, total - (_EVALUATIONS - 1) * interval),
        **{f"trigger-below.{name}": math.inf for name in agent.evaluation.trigger_below},
    }
    return [f"--agent.evaluation.{name}={value}" for name, value in settings.items()]


def _last_error(path: Path) -> str:
    """Return the last error message in the output of a run."""
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    lines = [line for line in text.splitlines() if line]
    errors = [line for line in lines if line.startswith("error")]
    return (errors or lines or ["no output"])[-1]
