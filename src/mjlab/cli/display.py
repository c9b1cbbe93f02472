"""Terminal display of training: live panel, or plain lines for log files."""

from __future__ import annotations

import contextlib
import os
import stat
import statistics
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from rich.console import Console
from rich.live import Live

from mjlab.rl.evaluation import RESULT_FIELDS, Bound, EvaluationResult, curricula_text
from mjlab.rl.progress import (
    NotebookProgress,
    ProgressCfg,
    TrainingProgress,
    in_notebook,
    label,
)
from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.runs.folder import write_info
from mjlab.runs.reference import DATA, Kind, Reference, reference_path, referenced_tasks
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.logging import print_notice
from mjlab.utils.string import counted, number

if TYPE_CHECKING:
    from mjlab.cli.live import LiveView
    from mjlab.cli.train_config import TrainConfig
    from mjlab.runs.folder import NewRunFolder

# Period of plain lines, for log files.
_SECONDS_BETWEEN_LINES = 5.0
_UPDATES_PER_SECOND = 4


def show_training(
    task: str, cfg: TrainConfig, runner: Any, folder: NewRunFolder, view: LiveView | None
) -> None:
    """Add observers to `runner` that show training in the terminal, and in the browser by `view`.

    Training that starts keeps `folder`. Runners of other packages, without observers, print by
    themselves.
    """
    if not hasattr(runner, "observers"):
        folder.keep()
        if cfg.live:
            print_notice("--live: not shown, because the runner of this task has no observers.")
        if cfg.grace is not None:
            print_notice("--grace: ignored, because the runner of this task stops by itself.")
        return
    progress = ProgressCfg.of_runner(runner, task, usual_iteration(task, cfg))
    display = NotebookProgress(progress) if in_notebook() else TrainingDisplay(progress)
    runner.observers += [RunRecorder(folder), display]
    if view is not None:
        view.follow(runner, display)


class _PipeSafeConsole(Console):
    """Console that survives a closed pipe: Ctrl-C in `train | tee log` ends `tee` before the save."""

    def on_broken_pipe(self) -> None:
        """Redirect further output to /dev/null."""
        pipe = os.fstat(1)
        _redirect_to_devnull(lambda file: os.path.samestat(file, pipe))


class TrainingDisplay(TrainingProgress):
    """Progress in a terminal: a panel that the result replaces. Elsewhere a line every few seconds."""

    def __init__(self, cfg: ProgressCfg, console: Console | None = None) -> None:
        super().__init__(cfg)
        self._console = console or _PipeSafeConsole(markup=False, highlight=False)
        self._live: Live | None = None
        self._last_line = float("-inf")
        self._has_news = False

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Open the panel. `first_iteration` is the number of iterations already finished."""
        super().on_start(first_iteration, total_iterations)
        if self._console.is_interactive:
            # Drawn by a thread: iterations can be shorter than a drawing.
            self._live = Live(
                self, console=self._console, refresh_per_second=_UPDATES_PER_SECOND, transient=True
            )
            self._live.start()

    def on_iteration(self, stats: IterationStats) -> None:
        """Keep the statistics, and print a line if one is due."""
        super().on_iteration(stats)
        now = time.perf_counter()
        self._has_news = True
        last = stats.iteration == stats.total_iterations
        if self._live is None and (last or now - self._last_line >= _SECONDS_BETWEEN_LINES):
            self._last_line = now
            self._print_line()

    def on_confirmation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Print the result of the evaluation that decides whether training stops."""
        super().on_confirmation(iteration, result, solved)
        if self._live is None:
            self._print_line()
        if self._live is None or not solved:
            metrics = [
                f"return {number(result.mean_return)} in {counted(result.num_episodes, 'episode')}"
            ]
            units = self._cfg.evaluation.units
            metrics += [
                f"{label(name)} {number(value.mean)} {units.get(name, '')}".rstrip()
                for name, value in result.metrics.items()
            ]
            if result.failure_rate and result.failure_interval is not None:
                low, high = result.failure_interval
                metrics.append(f"{result.failure_rate:.1%} failed ({low:.1%} to {high:.1%})")
            if state := curricula_text(result.curricula):
                metrics.append(f"under {state}")
            verdict = "solved" if solved else "not confirmed, so training goes on"
            self._print(
                f"Evaluation after {iteration} iterations: {', '.join(metrics)}, {verdict}."
            )

    def on_stop_requested(self, signal_name: str) -> None:
        """Print the received signal and the reaction to it."""
        if signal_name == "SIGHUP":
            # `isatty` is False for a closed terminal, which remains a character device.
            _redirect_to_devnull(lambda file: stat.S_ISCHR(file.st_mode))
        self._print(
            f"{signal_name}: finishing this iteration, then saving. Once more: without finishing it."
        )

    def on_end(self, reason: str) -> None:
        """Replace the panel by the result."""
        super().on_end(reason)
        if self._live is not None:
            self._live.stop()
            self._live = None
        else:
            self._print_line()
        self._print(self.ending())
        sys.stdout.flush()

    def _print_line(self) -> None:
        """Print the line of the last iteration, once."""
        if self._has_news:
            self._has_news = False
            self._print(self.line())

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def usual_iteration(task: str, cfg: TrainConfig) -> int | None:
    """Return the median iteration at which the bundled reference runs of `task` were solved.

    None if the package has no reference with the settings of `cfg`, or not every seed was solved.
    """
    kinds = referenced_tasks(DATA).get(task)
    if kinds is None:
        return None
    agent, default = cfg.agent, load_rl_cfg(task, profile=cfg.profile)
    parts = ("algorithm", "actor", "critic", "num_steps_per_env")
    if any(getattr(agent, part, None) != getattr(default, part, None) for part in parts):
        return None
    if Bound.all_of(agent.evaluation) != Bound.all_of(default.evaluation):
        return None
    env = load_env_cfg(task, profile=cfg.profile)
    parts = ("rewards", "episode_length_s", "decimation")
    if any(getattr(cfg.env, part) != getattr(env, part) for part in parts):
        return None
    if cfg.env.scene.num_envs != env.scene.num_envs or not agent.evaluation.stop_when_solved:
        return None
    for kind in kinds:
        reference = Reference.load(reference_path(DATA, task, cast(Kind, kind)))
        runs = [seed.run for seed in reference.seeds]
        if reference.profile == cfg.profile and all(run.ended == "solved" for run in runs):
            return round(statistics.median(run.iterations for run in runs))
    return None


def _redirect_to_devnull(is_gone: Callable[[os.stat_result], bool]) -> None:
    """Redirect stdout and stderr to /dev/null if `is_gone` is True for their file.

    Otherwise the next line would raise before the checkpoint is written.
    """
    # Signal handlers must not raise, e.g. for a closed descriptor.
    with open(os.devnull, "wb") as nowhere, contextlib.suppress(OSError):
        for number in [number for number in (1, 2) if is_gone(os.fstat(number))]:
            os.dup2(nowhere.fileno(), number)


class RunRecorder(TrainingObserver):
    """Observer that keeps the run folder once training has started, and records evaluations in it."""

    def __init__(self, folder: NewRunFolder) -> None:
        self._folder = folder
        self._evaluations: list[dict[str, Any]] = []

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Keep the folder."""
        self._folder.keep()

    def on_evaluation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Record the result."""
        values = result.to_dict()
        entry = {name: values[name] for name in RESULT_FIELDS if values[name] is not None}
        entry |= {"metrics": {name: value.mean for name, value in result.metrics.items()}}
        entry |= {"curricula": result.curricula} if result.curricula else {}
        self._evaluations.append({"iteration": iteration, "solved": solved, **entry})
        # On a full disk, the next checkpoint raises a clear error.
        with contextlib.suppress(OSError):
            write_info(self._folder.path, evaluations=self._evaluations)

    def on_confirmation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Replace the result of the evaluation that it confirms or not."""
        self._evaluations.pop()
        self.on_evaluation(iteration, result, solved)
