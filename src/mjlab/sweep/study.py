"""Optuna's study of a sweep: the settings to train, and their values."""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
import sqlite3
import statistics
import time
import uuid
import warnings
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.storages import BaseStorage, RDBStorage
from optuna.trial import FrozenTrial, TrialState

from mjlab.runs import Run
from mjlab.runs.reference import read_scalars_of_sessions
from mjlab.sweep.objective import Objective
from mjlab.sweep.settings import Axis, Setting, Sweep
from mjlab.sweep.storage import (
    HEARTBEAT_S,
    STORAGE_ERRORS,
    naming_storage,
    open_storage,
    without_experimental_warnings,
)
from mjlab.utils.errors import UserError
from mjlab.utils.os import write_atomically
from mjlab.utils.string import suggest

if TYPE_CHECKING:
    from mjlab.rl.plot import Curve

_FILE = "sweep.json"
# User attributes of trials.
_SETTING, _OWNER = "setting", "folder"
# Fraction of the iterations that the objective averages, unless it is that of evaluations.
_LAST_PART = 0.1


@contextlib.contextmanager
def only_process(folder: Path) -> Generator[None]:
    """Create `folder` and hold its lock within the block. The lock ends with the process.

    Raises:
        UserError: another process holds the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "lock.db"
    with contextlib.ExitStack() as stack:
        try:
            # Portable, unlike fcntl.
            lock = sqlite3.connect(path, timeout=0.0, isolation_level=None)
            stack.enter_context(contextlib.closing(lock)).execute("BEGIN EXCLUSIVE")
        except sqlite3.Error as error:
            if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
                raise UserError(
                    f"{folder}: expected a sweep that is not running, got one in another process "
                    f"({error}); wait for it, or use --folder for another sweep."
                ) from error
            raise UserError(
                f"{path}: expected a file that can be written and locked, got: {error}; delete it, which "
                "loses nothing, or use --folder in another place."
            ) from error
        yield


class Study:
    """Optuna's study of a sweep: the settings to train here, and the values of all machines."""

    def __init__(self, sweep: Sweep) -> None:
        """Create or load the study.

        Raises:
            UserError: the database cannot be opened or is damaged, or the study has other flags.
        """
        self._sweep = sweep
        # Trials belong to the folder with their runs: other machines do not continue them.
        self._owner = _check_definition(sweep)
        self._distributions = {axis.name: _distribution(axis) for axis in sweep.axes}
        self._failed_now = 0
        self._next_heartbeat = -math.inf
        # Optuna and its parsers raise many types of errors for a damaged storage.
        with naming_storage(sweep, Exception):
            self._storage = open_storage(sweep)
            self._study = _open(sweep, self._storage)
            for trial in self.trials:
                self._check(trial)
            self._enqueue_missing()

    @property
    def trials(self) -> list[FrozenTrial]:
        """Trials with a setting, of all machines."""
        trials = self._study.get_trials(deepcopy=False)
        return [trial for trial in trials if _SETTING in trial.user_attrs]

    def is_own(self, trial: FrozenTrial) -> bool:
        """Return True if the runs of a trial are in the folder of this sweep."""
        return self._sweep.storage is None or trial.user_attrs.get(_OWNER) == self._owner

    def own(self) -> list[FrozenTrial]:
        """Return the trials begun here, by earlier commands as well, that did not fail."""
        states = (TrialState.RUNNING, TrialState.COMPLETE)
        return [trial for trial in self.trials if self.is_own(trial) and trial.state in states]

    def next(self) -> FrozenTrial | None:
        """Return a new trial to train here, or None if the sweep has no more."""
        self.send_heartbeat()
        with without_experimental_warnings():
            # Trials of machines that died are enqueued again. No effect without heartbeats.
            optuna.storages.fail_stale_trials(self._study)
        while self._has_more():
            trial = self._ask()
            setting = {name: _text(value) for name, value in trial.params.items()}
            # In the order of --over.
            setting = {axis.name: setting[axis.name] for axis in self._sweep.axes}
            trial.set_user_attr(_SETTING, setting)
            trial.set_user_attr(_OWNER, self._owner)
            others = [one for one in self._with_setting(setting) if one.number < trial.number]
            # Two machines that start together both enqueue the grid, and few integers repeat.
            if others:
                self._study.tell(trial.number, state=TrialState.PRUNED)
                continue
            begun = next(one for one in self.trials if one.number == trial.number)
            self._record_heartbeats([begun])
            return begun
        return None

    def send_heartbeat(self) -> None:
        """Tell other machines once a minute that this one trains its trials, or will."""
        if time.monotonic() > self._next_heartbeat:
            self._next_heartbeat = time.monotonic() + HEARTBEAT_S
            # Others wait for ten heartbeats, so that a database may pause.
            with contextlib.suppress(*STORAGE_ERRORS):
                self._record_heartbeats(self.own())

    def _record_heartbeats(self, trials: list[FrozenTrial]) -> None:
        """Record heartbeats of running trials. Optuna does so only within `optimize`, one trial a thread."""
        storage = self._storage
        if not isinstance(storage, RDBStorage) or storage.get_heartbeat_interval() is None:
            return
        study = storage.get_study_id_from_name(self._study.study_name)
        for trial in trials:
            if trial.state == TrialState.RUNNING:
                number = storage.get_trial_id_from_study_id_trial_number(study, trial.number)
                storage.record_heartbeat(number)

    def _ask(self) -> optuna.Trial:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Heartbeat of storage is supposed")
            return self._study.ask(self._distributions)

    def finish(self, trial: FrozenTrial) -> None:
        """Store the value of a trial, if it has no value yet: mean over seeds; failed if not finite.

        Does nothing for a trial with unfinished runs.
        """
        setting = setting_of(trial)
        seeds = range(1, self._sweep.seeds + 1)
        runs = [trained_run(self._sweep, setting, seed) for seed in seeds]
        values = [run.value for run in runs if run is not None]
        if len(values) < len(runs):
            return
        if not all(map(math.isfinite, values)):
            self.fail(trial)
            return
        self._study.tell(trial.number, statistics.fmean(values), skip_if_finished=True)

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

    def _check(self, trial: FrozenTrial) -> None:
        """Raise ValueError if a trial has not the setting of its parameters."""
        setting = setting_of(trial)
        sampled = {name: _text(value) for name, value in trial.params.items()}
        # Optuna stores the parameters of an enqueued trial one by one, after it has begun.
        if not sampled.items() <= setting.items():
            raise ValueError(f"trial {trial.number} has the setting {setting}, and {sampled}")

    def _enqueue_missing(self) -> None:
        """Enqueue the settings of the sweep that have no trial, or only failed ones.

        These are all combinations. A sweep that samples has no list: its settings are those of
        failed trials and of run folders, which outlive a database.
        """
        if self._sweep.trials is None:
            missing = [(setting, dict(setting)) for setting in self._sweep.combinations]
        else:
            failed = [trial for trial in self.trials if trial.state == TrialState.FAIL]
            missing = [(setting_of(trial), trial.params) for trial in failed]
            for setting in self._sweep.begun:
                params = {axis.name: axis.value(setting[axis.name]) for axis in self._sweep.axes}
                missing.append((setting, params))
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
    if not os.path.lexists(path):
        content = {**sweep.definition, "id": f"{socket.gethostname()}-{uuid.uuid4().hex[:8]}"}
        write_atomically(path, f"{json.dumps(content, indent=2)}\n".encode())
    try:
        # Reading a pipe would wait.
        content = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        if not isinstance(content, dict) or not isinstance(owner := content.get("id"), str):
            raise ValueError("expected a JSON file with an id")
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is damaged ({error}); delete it; the next call rebuilds it from the flags and keeps the "
            "runs."
        ) from error
    if (text := _mismatch(content, sweep)) is not None:
        raise UserError(f"--folder {sweep.folder}: {text}; use another --folder.")
    return owner


def _mismatch(content: dict[str, Any], sweep: Sweep) -> str | None:
    """Return how a recorded definition differs from that of the sweep; None if it does not."""
    for name, new in sweep.definition.items():
        if (old := content.get(name, new)) != new:
            return f"expected the {name} of its sweep, {old}, got {new}"
    return None


def _open(sweep: Sweep, storage: BaseStorage) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    minimize = sweep.objective.minimize
    sampler: optuna.samplers.BaseSampler = optuna.samplers.RandomSampler()
    # Without a ranking, there are no good values to stay near.
    if sweep.trials is not None and sweep.objective.is_ranked:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            # Running trials count as bad, so that samples next to them are not drawn.
            sampler = optuna.samplers.TPESampler(constant_liar=True)
    study = optuna.create_study(
        storage=storage,
        # The runs can be compared by several objectives.
        study_name=f"{sweep.folder.resolve().name} {'-' if minimize else '+'}{sweep.objective.tag}",
        direction="minimize" if minimize else "maximize",
        sampler=sampler,
        load_if_exists=True,
    )
    for name, value in sweep.definition.items():
        if name not in study.user_attrs:
            study.set_user_attr(name, value)
    if (text := _mismatch(study.user_attrs, sweep)) is not None:
        if sweep.storage is None:
            # The definition in the folder is another.
            raise ValueError(text)
        raise UserError(f"Study {study.study_name!r}: {text}; use another --folder.")
    return study


class TrainedRun:
    """Results of a run that was trained to its end, over all its sessions."""

    def __init__(self, run: Run, objective: Objective) -> None:
        """Read the event files of the last session `run` and of those before.

        Raises:
            UserError: the run did not log the objective, or its event files are missing or damaged.
        """
        self.run = run
        """Last session."""
        self._objective = objective
        try:
            self._scalars = read_scalars_of_sessions(run.folder)
        except (UserError, ValueError) as error:
            raise UserError(f"{error} Or delete {run.folder}; the next call repeats it.") from error
        if objective.tag not in self._scalars:
            raise UserError(
                f"--objective: unknown tag {objective.tag!r} in {run.folder}; "
                f"{suggest(objective.tag, sorted(self._scalars))} If its event file is damaged, delete this "
                "folder; the next call repeats the run."
            )

    @property
    def curve(self) -> Curve:
        """Iterations, from 1, and the objective, each (P,)."""
        curve = sorted(self._scalars[self._objective.tag].items())
        return np.array([i + 1 for i, _ in curve]), np.array([v for _, v in curve], dtype=float)

    @property
    def value(self) -> float:
        """Objective: last evaluation, or mean over the last iterations."""
        _, values = self.curve
        count = 1 if self._objective.is_evaluated else _LAST_PART * len(values)
        return float(values[-max(1, math.ceil(count)) :].mean())

    def last(self, tag: str) -> float | None:
        """Return the last value of a tag, None if it was not logged."""
        values = self._scalars.get(tag)
        return values[max(values)] if values else None

    @property
    def training_seconds(self) -> float:
        """Time of collecting and learning (s)."""
        return self._total("collection", "learning")

    @property
    def evaluation_seconds(self) -> float:
        """Time of evaluations (s); 0 for runs of versions that did not log it."""
        return self._total("evaluation", "confirmation")

    def _total(self, *names: str) -> float:
        return sum(sum(self._scalars.get(f"Perf/{name}_time", {}).values()) for name in names)


def trained_run(sweep: Sweep, setting: Setting, seed: int) -> TrainedRun | None:
    """Return the results of a finished run, None for others.

    Raises:
        UserError: the run did not log the objective.
    """
    run = sweep.finished_run(setting, seed)
    return None if run is None else TrainedRun(run, sweep.objective)
