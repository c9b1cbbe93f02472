"""Terminal display of training: live panel, or plain lines for log files; list of results."""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.scripts.flags import prepare_env_cfg
from mjlab.scripts.policy import policy_env_cfg
from mjlab.scripts.record import VideoCfg, record_policy
from mjlab.sim.warning_log import mujoco_warnings
from mjlab.utils.string import counted

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl.evaluation import EvaluationResult
    from mjlab.scripts.run_folder import NewRunFolder
    from mjlab.scripts.train_config import TrainConfig

# Period of plain lines, for log files.
_SECONDS_BETWEEN_LINES = 5.0


def show_training(task: str, cfg: TrainConfig, runner: Any, folder: NewRunFolder) -> None:
    """Add observers to `runner` that show training in the terminal, and with `--live` in the browser.

    Training that starts keeps `folder`.
    """
    if cfg.live:
        from mjlab.scripts.live import LiveView

        # Before the display, which owns the terminal once started.
        runner.observers.insert(0, LiveView(task, cfg, runner))
    runner.observers += [KeepRunFolder(folder), TrainingDisplay(task)]


class _PipeSafeConsole(Console):
    """Console that survives a closed pipe: Ctrl-C in `train | tee log` ends `tee` before the save."""

    def on_broken_pipe(self) -> None:
        """Redirect further output to /dev/null."""
        pipe = os.fstat(1)
        _redirect_to_devnull(lambda file: os.path.samestat(file, pipe))


class TrainingDisplay(TrainingObserver):
    """Progress, time left, speed, reward and episode length, updated every iteration."""

    def __init__(self, title: str, console: Console | None = None) -> None:
        self._console = console or _PipeSafeConsole()
        self._title = title
        self._live: Live | None = None
        self._progress = Progress(
            TextColumn("iteration"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[left]} left"),
        )
        self._last_line = float("-inf")
        self._started = time.perf_counter()

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Open the panel. `first_iteration` is the number of iterations already finished."""
        self._started = time.perf_counter()
        self._bar = self._progress.add_task(
            "", total=total_iterations, completed=first_iteration, left="?"
        )
        if self._console.is_terminal:
            self._live = Live(self._progress, console=self._console, refresh_per_second=8)
            self._live.start()

    def on_iteration(self, stats: IterationStats) -> None:
        """Show the statistics of an iteration."""
        left = duration(stats.time_left)
        self._progress.update(self._bar, completed=stats.iteration, left=left)
        if self._live is not None:
            self._live.update(self._panel(stats))
            return
        now = time.perf_counter()
        last = stats.iteration == stats.total_iterations
        if last or now - self._last_line >= _SECONDS_BETWEEN_LINES:
            self._last_line = now
            line = (
                f"[{stats.iteration}/{stats.total_iterations}] "
                f"{stats.steps_per_second:,.0f} steps/s "
                f"(collection {stats.collection_time:.2f} s, learning {stats.learning_time:.2f} s), "
                f"mean reward {_format_mean(stats.mean_reward)}, "
                f"episode length {_format_mean(stats.mean_episode_length)}, "
                f"step reward {stats.mean_step_reward:.3f}, {left} left"
            )
            # Brackets are rich markup.
            self._console.print(line.replace("[", r"\[", 1), highlight=False, soft_wrap=True)

    def on_evaluation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Print the result of an evaluation."""
        verdict = "within all bounds" if solved else "not solved yet"
        self._print_evaluation(iteration, "episodes", result, verdict)

    def on_confirmation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Print the result of the evaluation that decides whether training stops."""
        verdict = "solved" if solved else "not confirmed, so training goes on"
        self._print_evaluation(iteration, "fresh episodes", result, verdict)

    def _print_evaluation(
        self, iteration: int, episodes: str, result: EvaluationResult, verdict: str
    ) -> None:
        metrics = [f"mean return {result.mean_return:.1f} over {result.num_episodes} {episodes}"]
        metrics += [f"{name} {value.mean:.3f}" for name, value in result.metrics.items()]
        if result.failure_rate and result.failure_interval is not None:
            low, high = result.failure_interval
            metrics.append(f"{result.failure_rate:.1%} failed ({low:.1%} to {high:.1%})")
        self._console.print(
            f"Evaluation after {iteration} iterations: {', '.join(metrics)}, {verdict}.",
            highlight=False,
            soft_wrap=True,
        )

    def on_stop_requested(self, signal_name: str) -> None:
        """Print the received signal and the reaction to it."""
        if signal_name == "SIGHUP":
            # `isatty` is False for a closed terminal, which remains a character device.
            _redirect_to_devnull(lambda file: stat.S_ISCHR(file.st_mode))
        self._console.print(
            f"{signal_name}: finishing this iteration, then saving. Once more to stop at once.",
            highlight=False,
            soft_wrap=True,
        )

    def on_end(self, reason: str) -> None:
        """Close the panel."""
        if self._live is not None:
            self._live.stop()
            self._live = None
        spent = duration(time.perf_counter() - self._started)
        self._console.print(f"Training {reason} after {spent}.", highlight=False)
        sys.stdout.flush()

    def _panel(self, stats: IterationStats) -> Panel:
        cells = [
            ("steps per second", f"{stats.steps_per_second:,.0f}"),
            ("steps in total", f"{stats.total_steps:,}"),
            ("collection", f"{stats.collection_time:.3f} s"),
            ("learning", f"{stats.learning_time:.3f} s"),
            ("mean reward", _format_mean(stats.mean_reward)),
            ("mean episode length", _format_mean(stats.mean_episode_length)),
            ("mean step reward", f"{stats.mean_step_reward:.3f}"),
            ("action noise", f"{stats.action_std:.3f}"),
        ]
        table = Table.grid(padding=(0, 3))
        for _ in range(4):
            table.add_column()
        for first, second in zip(cells[::2], cells[1::2], strict=True):
            table.add_row(*first, *second)
        return Panel(Group(self._progress, table), title=self._title, title_align="left")


def _redirect_to_devnull(is_gone: Callable[[os.stat_result], bool]) -> None:
    """Redirect stdout and stderr to /dev/null if `is_gone` is True for their file.

    Otherwise the next line would raise before the checkpoint is written.
    """
    # Signal handlers must not raise, e.g. for a closed descriptor.
    with open(os.devnull, "wb") as nowhere, contextlib.suppress(OSError):
        for number in [number for number in (1, 2) if is_gone(os.fstat(number))]:
            os.dup2(nowhere.fileno(), number)


def _format_mean(value: float | None) -> str:
    return "none finished yet" if value is None else f"{value:.2f}"


def duration(seconds: float) -> str:
    """Format seconds: `8.4 s`, `3:05 min`, `2:10 h`."""
    if round(seconds, 1) < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}:{rest:02d} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d} h"


class KeepRunFolder(TrainingObserver):
    """Observer that keeps the run folder once training has started."""

    def __init__(self, folder: NewRunFolder) -> None:
        self._folder = folder

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Keep the folder."""
        self._folder.keep()


def report_divergence(env: ManagerBasedRlEnv) -> None:
    """Print the number of diverged environments, and MuJoCo's warnings."""
    episodes = int(env.nan_resets.sum())
    if episodes > 0:
        environments = int((env.nan_resets > 0).sum())
        print(
            f"Diverged: the physics of {environments} of {counted(env.num_envs, 'environment')}, in "
            f"{counted(episodes, 'episode')} (Simulation/nan_resets)"
        )
    for kind, count in mujoco_warnings().items():
        print(f"MuJoCo warned {count:,} times: {kind}")


def write_results(task: str, cfg: TrainConfig, run_dir: Path, device: str) -> None:
    """Plot the learning curve, record the trained policy if `cfg.result_video`, and list the files."""
    from mjlab.rl.checkpoint import latest_checkpoint
    from mjlab.rl.plot import plot_run

    # A run solved at resume has no iterations.
    with contextlib.suppress(ValueError):
        plot_run(run_dir, run_dir / "learning_curve.png", title=task)
    checkpoint = latest_checkpoint(run_dir)
    if cfg.result_video and checkpoint is not None:
        from mjlab.viewer.offscreen_renderer import RenderingUnavailableError

        env_cfg = policy_env_cfg(task, cfg.profile, purpose="play")
        prepare_env_cfg(task, None, env_cfg, checkpoint)
        try:
            video = VideoCfg(profile=cfg.profile)
            record_policy(task, env_cfg, checkpoint, run_dir / "videos", device, video)
        except RenderingUnavailableError as error:
            print(f"No video: {error}")
    print("Results:")
    for pattern in ("model_*.pt", "*.onnx", "*.png", "videos/**/*.mp4"):
        files = sorted(run_dir.glob(pattern), key=lambda path: path.stat().st_mtime)
        if files:
            print(f"    {files[-1]}")
