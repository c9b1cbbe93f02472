"""`train --live`: view of the policy during training, served asynchronously by a separate process.

The view process (`mjlab.cli.live_view`) builds its environments while training builds its own. At the
end of an iteration, training writes the newest weights and the learning curve to a file for it.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab import rl
from mjlab.cli.live_view import Exchange, LiveJob
from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.tasks.registry import load_runner_cls
from mjlab.utils.errors import UserError
from mjlab.utils.os import create_locked, remove_abandoned

if TYPE_CHECKING:
    from mjlab.cli.train_config import TrainConfig
    from mjlab.rl.evaluation import EvaluationResult
    from mjlab.rl.progress import TrainingProgress

logger = logging.getLogger(__name__)

# Writing weights takes some milliseconds, and iterations can be shorter: limit the rate and the
# share of training time.
_SECONDS_BETWEEN_WEIGHTS = 1.0
_MAX_TIME_SHARE = 0.01

_PREFIX = "mjlab-live-"
# Held by training; the folder of a killed training process has an unheld lock.
_LOCK = "lock"
_NUM_ENVS = 4
_MOST_POINTS = 400
_SECONDS_TO_START = 10.0
# Variables of `torchrun` that would make the view process a training process.
_DISTRIBUTED = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "TORCHELASTIC_RUN_ID")


@contextlib.contextmanager
def live_view(task: str, cfg: TrainConfig) -> Generator[LiveView]:
    """Serve the page of a run within the block, and print its URL.

    Args:
        task: Name of the task.
        cfg: Configuration of the run, complete; not modified.

    Raises:
        UserError: the configuration cannot be pickled.
    """
    _remove_abandoned_folders()
    with (
        tempfile.TemporaryDirectory(prefix=_PREFIX) as folder,
        create_locked(Path(folder) / _LOCK),
    ):
        exchange = Exchange(Path(folder))
        # Before pickling, which imports the learner: the process starts meanwhile.
        process = _start(exchange, cfg.live_host, cfg.live_port)
        try:
            view = LiveView(exchange, process)
            view.send(_pickled_job(task, cfg))
            view.print_url()
            yield view
        finally:
            # The view has nothing to save.
            process.kill()
            process.wait()


class LiveView(TrainingObserver):
    """Observer that hands weights and progress to a view process, whose failure is one warning."""

    def __init__(self, exchange: Exchange, process: subprocess.Popen) -> None:
        """Prepare the view of `process`, a view process that reads its job from standard input."""
        self._exchange = exchange
        self._process = process
        self._is_over = False
        self._runner: Any = None
        self._progress: TrainingProgress | None = None
        self._total = 0
        self._unit = "return"
        self._curve: dict[int, float] = {}
        self._evaluations: dict[int, float] = {}
        self._next_weights = 0.0

    def send(self, job: bytes) -> None:
        """Send the pickled job."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(len(job).to_bytes(8, "little") + job)
            self._process.stdin.flush()
        except OSError:
            self._has_ended()

    def print_url(self) -> None:
        """Print the URL of the page, once it is served."""
        if self._wait_for(self._exchange.url):
            url = self._exchange.url.read_text(encoding="utf-8")
            print(f"Live:    {url} (open it in a browser)", flush=True)

    def follow(self, runner: Any, progress: TrainingProgress) -> None:
        """Observe `runner` after `progress`, whose values are shown; wait until the page is filled.

        With all cores busy with training, filling would take several times as long.
        """
        self._runner, self._progress = runner, progress
        runner.observers.append(self)
        self._wait_for(self._exchange.ready)

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Write the initial weights."""
        self._total = total_iterations
        self._write()

    def on_iteration(self, stats: IterationStats) -> None:
        """Add a point to the learning curve; write the newest weights if it is time."""
        self._unit, value = "return", stats.exploring_return
        if value is None:
            self._unit, value = "reward per step", stats.mean_step_reward
        self._curve[stats.iteration] = value
        self._total = stats.total_iterations
        if time.perf_counter() >= self._next_weights:
            self._write()

    def on_evaluation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Add a point to the evaluations."""
        self._evaluations[iteration] = result.mean_return
        self._write()

    def on_confirmation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Replace the point of the evaluation that it confirms or not."""
        self.on_evaluation(iteration, result, solved)

    def _write(self) -> None:
        if self._has_ended():
            return
        begin = time.perf_counter()
        num_steps = int(getattr(self._runner.env.unwrapped, "common_step_counter", 0))
        try:
            self._exchange.write_weights(self._runner.alg.get_policy(), num_steps, self._shown())
        except OSError as error:
            self._is_over = True
            logger.warning("Live view: training continues without it; writing failed: %s", error)
        end = time.perf_counter()
        self._next_weights = end + max(_SECONDS_BETWEEN_WEIGHTS, (end - begin) / _MAX_TIME_SHARE)

    def _shown(self) -> dict[str, Any]:
        """Return the progress as `LiveViewer` takes it."""
        assert self._progress is not None
        stride = len(self._curve) // _MOST_POINTS + 1
        return {
            "iteration": self._progress.iteration,
            "total_iterations": self._total,
            "rows": self._progress.rows(),
            "unit": self._unit,
            "curve": {
                i: v for i, v in self._curve.items() if i % stride == 0 or i in self._evaluations
            },
            # Returns: they do not compare with a reward per step.
            "evaluations": self._evaluations if self._unit == "return" else {},
            "goal": self._progress.solved_return if self._unit == "return" else None,
            "time": time.time(),
        }

    def _wait_for(self, file: Path) -> bool:
        limit = time.perf_counter() + _SECONDS_TO_START
        while time.perf_counter() < limit and not self._has_ended():
            if file.exists():
                return True
            time.sleep(0.02)
        return False

    def _has_ended(self) -> bool:
        """Return True if the process has ended; log it the first time."""
        if self._is_over or self._process.poll() is None:
            return self._is_over
        self._is_over = True
        reason = f"Exit status {self._process.returncode}."
        output = self._exchange.log.read_text(encoding="utf-8", errors="replace").strip()
        # The last line of an error. Other output is no reason.
        if self._process.returncode > 0 and output:
            reason = output.splitlines()[-1]
        logger.warning("Live view: process ended; training continues. %s", reason)
        return True


def _remove_abandoned_folders() -> None:
    """Remove the folders of training processes that were killed."""
    if os.name != "posix":
        return
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        # Other users can create files in the temporary folder.
        with contextlib.suppress(OSError):
            is_own = folder.lstat().st_uid == os.geteuid() and not folder.is_symlink()
            if is_own and remove_abandoned(folder / _LOCK):
                shutil.rmtree(folder)


def _view_env_cfg(cfg: TrainConfig) -> Any:
    """Return the config of the shown environments: few, single-threaded, without file output."""
    env = copy.deepcopy(cfg.env)
    env.scene.num_envs = min(_NUM_ENVS, env.scene.num_envs)
    env.sim.engine = "native"
    env.sim.num_threads = 1
    env.sim.nan_guard.enabled = False
    env.recorders = {}
    return env


def _pickled_job(task: str, cfg: TrainConfig) -> bytes:
    runner_cls = load_runner_cls(task) or rl.MjlabOnPolicyRunner
    job = LiveJob(task, _view_env_cfg(cfg), cfg.agent, runner_cls)
    # Only cloudpickle pickles lambdas and classes of `__main__`.
    import cloudpickle

    try:
        return cloudpickle.dumps(job)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise UserError(
            f"--live: expected a task config that can be pickled, got {error}; build such objects in "
            "functions referenced by the config, or train without --live."
        ) from error


def _start(exchange: Exchange, host: str, port: int) -> subprocess.Popen:
    environment = {k: v for k, v in os.environ.items() if k not in _DISTRIBUTED}
    # Training keeps the GPU and all threads but one.
    environment |= {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "MJLAB_TORCH_THREADS": "1"}
    with open(exchange.log, "wb") as log:
        return subprocess.Popen(
            [
                *(sys.executable, "-m", "mjlab.cli.live_view"),
                *(str(exchange.folder), host, str(port)),
            ],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=environment,
            # A process group keeps Ctrl-C from the view; training ends the view. Not a new session:
            # Linux schedules by session first, and by priority only within a session.
            process_group=0 if os.name == "posix" else None,
        )
