"""Runs of a sweep: Optuna's study, and the training processes side by side."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import re
import signal
import socket
import sqlite3
import statistics
import subprocess
import time
import uuid
import warnings
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import optuna
import sqlalchemy.exc
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import FrozenTrial, TrialState

from mjlab.scripts.resume import resume_flags
from mjlab.scripts.run_folder import read_run_info
from mjlab.scripts.sweep import Axis, Setting, Sweep, train_config, train_flags
from mjlab.scripts.sweep_results import value_of
from mjlab.scripts.train_seeds import train_command
from mjlab.utils.errors import UserError
from mjlab.utils.gpu import select_gpus
from mjlab.utils.os import write_atomically
from mjlab.utils.processes import CORES_VARIABLE, PARENT_VARIABLE, available_cores
from mjlab.utils.signals import FORWARDED, handled_signals, send_signal, start_in_background
from mjlab.utils.string import counted

_SECONDS_BETWEEN_LOOKS = 0.1
_EVALUATIONS = 10
"""Number of evaluations of a run."""
_FILE = "sweep.json"
# User attributes of trials.
_SETTING, _OWNER = "setting", "folder"


@contextlib.contextmanager
def only_process(folder: Path) -> Generator[None]:
    """Create `folder` and hold its lock within the block. The lock ends with the process.

    Raises:
        UserError: another process holds the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # Portable, unlike fcntl.
    lock = sqlite3.connect(folder / "lock.db", timeout=0.0, isolation_level=None)
    with contextlib.closing(lock):
        try:
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            raise UserError(
                f"{folder}: expected a sweep that is not running, got one in another process "
                f"({error}); wait for it, or use --folder for another sweep."
            ) from error
        yield


class Study:
    """Optuna's study of a sweep: the settings to train here, and the values of all machines."""

    def __init__(self, sweep: Sweep) -> None:
        """Create or load the study.

        Raises:
            UserError: the database cannot be opened, or the study has other flags.
        """
        self._sweep = sweep
        # Trials belong to the folder with their runs: other machines do not continue them.
        self._owner = _check_definition(sweep)
        self._study = _open(sweep)
        self._distributions = {axis.name: _distribution(axis) for axis in sweep.axes}
        self._failed_now = 0
        self._enqueue_missing()

    @property
    def trials(self) -> list[FrozenTrial]:
        """Trials with a setting, of all machines."""
        trials = self._study.get_trials(deepcopy=False)
        return [trial for trial in trials if _SETTING in trial.user_attrs]

    def is_own(self, trial: FrozenTrial) -> bool:
        """Return True if the runs of a trial are in the folder of this sweep."""
        return trial.user_attrs.get(_OWNER) == self._owner

    def own(self) -> list[FrozenTrial]:
        """Return the trials begun here, by earlier commands as well, that did not fail."""
        states = (TrialState.RUNNING, TrialState.COMPLETE)
        return [trial for trial in self.trials if self.is_own(trial) and trial.state in states]

    def next(self) -> FrozenTrial | None:
        """Return a new trial to train here, or None if the sweep has no more."""
        while self._has_more():
            trial = self._study.ask(self._distributions)
            setting = {name: _text(value) for name, value in trial.params.items()}
            # In the order of --over.
            setting = {axis.name: setting[axis.name] for axis in self._sweep.axes}
            trial.set_user_attr(_SETTING, setting)
            trial.set_user_attr(_OWNER, self._owner)
            others = [one for one in self._with_setting(setting) if one.number < trial.number]
            # Two machines that start together both enqueue the grid.
            if self._sweep.trials is None and others:
                self._study.tell(trial.number, state=TrialState.PRUNED)
                continue
            return next(one for one in self.trials if one.number == trial.number)
        return None

    def finish(self, trial: FrozenTrial) -> None:
        """Store the value of a trial, if it has no value yet: mean over seeds; failed if not finite."""
        setting = setting_of(trial)
        seeds = range(1, self._sweep.seeds + 1)
        values = [value_of(self._sweep, setting, seed) for seed in seeds]
        found = [value for value in values if value is not None and math.isfinite(value)]
        if len(found) < len(values):
            self.fail(trial)
            return
        self._study.tell(trial.number, statistics.fmean(found), skip_if_finished=True)

    def fail(self, trial: FrozenTrial) -> None:
        """Mark a trial as failed; the next command retries it."""
        self._failed_now += 1
        self._study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    def _with_setting(self, setting: Setting) -> list[FrozenTrial]:
        """Return the trials of a setting that did not fail and are not duplicates."""
        states = (TrialState.RUNNING, TrialState.COMPLETE, TrialState.WAITING)
        return [
            trial for trial in self.trials if trial.state in states and setting_of(trial) == setting
        ]

    def _enqueue_missing(self) -> None:
        """Enqueue the combinations, and the failed settings, without a trial that did not fail."""
        failed = [trial for trial in self.trials if trial.state == TrialState.FAIL]
        if self._sweep.trials is None:
            missing = [(setting, dict(setting)) for setting in self._sweep.combinations]
        else:
            missing = [(setting_of(trial), trial.params) for trial in failed]
        for setting, params in missing:
            if not self._with_setting(setting):
                self._study.enqueue_trial(params, user_attrs={_SETTING: setting})

    def _has_more(self) -> bool:
        trials = self._study.get_trials(deepcopy=False)
        if any(trial.state == TrialState.WAITING for trial in trials):
            return True
        sampled = [trial for trial in trials if trial.state != TrialState.FAIL]
        wanted = self._sweep.trials
        return wanted is not None and len(sampled) + self._failed_now < wanted


def setting_of(trial: FrozenTrial) -> Setting:
    """Return the setting of a trial."""
    return dict(trial.user_attrs[_SETTING])


def _text(value: Any) -> str:
    """Return a sampled value as on the command line, with six digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _distribution(axis: Axis) -> BaseDistribution:
    if not axis.is_range:
        return CategoricalDistribution(axis.values)
    low, high = map(float, axis.values)
    if axis.is_integer:
        return IntDistribution(int(low), int(high), log=axis.is_log)
    return FloatDistribution(low, high, log=axis.is_log)


def _check_definition(sweep: Sweep) -> str:
    """Return the identifier of the sweep's folder.

    Raises:
        UserError: the folder is of a sweep with other flags.
    """
    path = sweep.folder / _FILE
    if not path.is_file():
        content = {**sweep.definition, "id": f"{socket.gethostname()}-{uuid.uuid4().hex[:8]}"}
        write_atomically(path, f"{json.dumps(content, indent=2)}\n".encode())
    content = json.loads(path.read_text(encoding="utf-8"))
    _check_same(f"--folder {sweep.folder}", content, sweep)
    return content["id"]


def _check_same(owner: str, content: dict[str, Any], sweep: Sweep) -> None:
    for name, new in sweep.definition.items():
        if (old := content.get(name, new)) != new:
            raise UserError(
                f"{owner}: expected the {name} of its sweep, {old}, got {new}; use another --folder."
            )


def _open(sweep: Sweep) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    url = sweep.storage or f"sqlite:///{(sweep.folder / 'study.db').as_posix()}"
    sampler: optuna.samplers.BaseSampler = optuna.samplers.RandomSampler()
    if sweep.trials is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            # Running trials count as bad, so that samples next to them are not drawn.
            sampler = optuna.samplers.TPESampler(constant_liar=True)
    try:
        study = optuna.create_study(
            storage=url,
            # The runs can be compared by several objectives.
            study_name=f"{sweep.folder.resolve().name} {'-' if sweep.minimize else '+'}{sweep.objective}",
            direction="minimize" if sweep.minimize else "maximize",
            sampler=sampler,
            load_if_exists=True,
        )
        for name, value in sweep.definition.items():
            if name not in study.user_attrs:
                study.set_user_attr(name, value)
    except (
        ImportError,
        ValueError,
        optuna.exceptions.OptunaError,
        sqlalchemy.exc.SQLAlchemyError,
    ) as error:
        where = "study.db" if sweep.storage is None else "--storage"
        raise UserError(
            f"{where}: cannot open the database: {str(error).splitlines()[0]}; use a URL such as "
            "postgresql://user@host/database with its driver installed, or leave out --storage."
        ) from error
    _check_same(f"Study {study.study_name!r}", study.user_attrs, sweep)
    return study


# Processes.


@dataclass(frozen=True)
class _Run:
    """Process that trains a seed of a trial."""

    trial: FrozenTrial
    seed: int
    name: str
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    slot: dict[str, str]


class Runs:
    """Training processes side by side."""

    def __init__(self, sweep: Sweep, study: Study) -> None:
        self._sweep = sweep
        self._study = study
        self.interrupted = False
        """True if a run was interrupted."""
        self.failed: list[Path] = []
        """Output of failed runs."""
        self._slots = machine_slots(sweep)
        self._signals: list[signal.Signals] = []
        self._queue: deque[tuple[FrozenTrial, int]] = deque()
        # Unfinished seeds by trial.
        self._left: dict[int, int] = {}
        self._running: list[_Run] = []

    def train(self) -> None:
        """Train the runs that are not finished, until none is left or a signal arrives.

        SIGINT, SIGTERM and SIGHUP are forwarded to all runs, which save a checkpoint; a second signal
        stops them without saving. After an error, such as a lost database, runs are saved too.
        """
        _print_summary(self._sweep, self._slots)
        forward = self._signals
        with handled_signals(lambda number, _: forward.append(FORWARDED[number]), FORWARDED):
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
            finally:
                if self._running:
                    self._stop(signal.SIGINT)
                for run in self._running:
                    run.process.wait()

    def _update(self) -> None:
        """Forward signals, and replace the processes that have ended."""
        while self._signals:
            self._stop(self._signals.pop(0))
        for run in [run for run in self._running if run.process.poll() is not None]:
            self._running.remove(run)
            self._slots.insert(0, run.slot)
            self._settle(run)
            self._fill()

    def _stop(self, number: signal.Signals) -> None:
        self.interrupted = True
        print(f"\nSaving {counted(len(self._running), 'run')} ...", flush=True)
        for run in self._running:
            send_signal(run.process, number)

    def _add(self, trial: FrozenTrial) -> None:
        """Queue the unfinished seeds of a trial."""
        seeds = [
            seed
            for seed in range(1, self._sweep.seeds + 1)
            if self._sweep.finished_run(setting_of(trial), seed) is None
        ]
        self._left[trial.number] = len(seeds)
        self._queue.extend((trial, seed) for seed in seeds)
        if not seeds:
            self._study.finish(trial)

    def _fill(self) -> None:
        """Start runs on the free slots."""
        while self._slots and not self.interrupted and not self._signals:
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
        saved = sweep.last_checkpoint(setting, seed)
        flags += [] if saved is None else resume_flags(saved.parent, saved)
        command = train_command(sweep.task, flags, seed)
        name = f"{sweep.describe(setting)}, seed {seed}"
        print(f"{'Resumed' if saved else 'Started'}  {name}", flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        log = open(sweep.log_file(setting, seed), "ab")  # noqa: SIM115
        environment = {**os.environ, **slot, PARENT_VARIABLE: str(os.getpid())}
        process = start_in_background(command, environment, log)
        self._running.append(_Run(trial, seed, name, process, log, slot))

    def _settle(self, run: _Run) -> None:
        """Print how a run ended; store the value of its trial after the last seed."""
        run.log.close()
        sweep, setting = self._sweep, setting_of(run.trial)
        newest = next(iter(sweep.sessions(setting, run.seed)), None)
        info = {} if newest is None else read_run_info(newest)
        self._left[run.trial.number] -= 1
        if (value := value_of(sweep, setting, run.seed)) is not None:
            print(f"Finished {run.name}: {sweep.label} {value:.4g}", flush=True)
        elif self.interrupted or info.get("ended") == "interrupted":
            self.interrupted = True
            print(f"Saved    {run.name}, iteration {info.get('iterations', 0)}", flush=True)
            return
        else:
            self.failed.append(sweep.log_file(setting, run.seed))
            print(f"Failed   {run.name}: {_last_error(self.failed[-1])}", flush=True)
        if self._left[run.trial.number] == 0:
            self._study.finish(run.trial)


def machine_slots(sweep: Sweep) -> list[dict[str, str]]:
    """Return the environment variables of runs side by side: one GPU each, or a share of the cores."""
    flags = dict(zip(sweep.machine_flags[::2], sweep.machine_flags[1::2], strict=True))
    gpus: list[int | str] = []
    if "--device" not in flags:
        ids = flags.get("--gpu-ids", "all")
        named = [int(number) for number in re.findall(r"\d+", ids)]
        gpus = select_gpus("all" if ids == "all" else named or None)[0] or []
    # A device by name, such as cuda:1, is one.
    is_gpu = flags.get("--device", "cpu") != "cpu"
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
    print(f"Compare: {sweep.objective}, {'lowest' if sweep.minimize else 'highest'} first")
    print(f"Curves:  uv run tensorboard --logdir {sweep.folder / 'runs'}", flush=True)


def _evaluations(sweep: Sweep, setting: Setting) -> list[str]:
    """Return flags that make runs comparable: to the last iteration, and evaluated there.

    Flags of the user come later and override them.
    """
    total = train_config(sweep, setting).agent.max_iterations
    interval = max(1, total // _EVALUATIONS)
    settings = {
        "stop-when-solved": False,
        "trigger-return": -1e9,
        "min-interval": interval,
        "first-iteration": max(0, total - (_EVALUATIONS - 1) * interval),
    }
    return [f"--agent.evaluation.{name}={value}" for name, value in settings.items()]


def _last_error(path: Path) -> str:
    """Return the last error message in the output of a run."""
    lines = [
        line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line
    ]
    errors = [line for line in lines if line.startswith("error")]
    return (errors or lines or ["no output"])[-1]
