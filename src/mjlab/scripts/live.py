"""`train --live`: view of the policy during training, served asynchronously by a separate process.

Training writes the newest weights to a file at the end of an iteration, only while a browser is
connected. The page, a separate environment and the policy run in the view process
(`mjlab.scripts.live_view`) at low priority.
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
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.scripts.live_view import Exchange, LiveJob
from mjlab.utils.errors import UserError
from mjlab.utils.os import create_locked, remove_abandoned

if TYPE_CHECKING:
    from mjlab.rl import MjlabOnPolicyRunner
    from mjlab.scripts.train_config import TrainConfig

logger = logging.getLogger(__name__)

# Writing weights takes some milliseconds, and iterations can be shorter: limit the rate and the
# share of training time.
_SECONDS_BETWEEN_WEIGHTS = 1.0
_MAX_TIME_SHARE = 0.01

_PREFIX = "mjlab-live-"
# Held by training; the folder of a killed training process has an unheld lock.
_LOCK = "lock"
_NUM_ENVS = 4
_SECONDS_TO_START = 20.0
_SECONDS_TO_END = 3.0
# Variables of `torchrun` that would make the view process a training process.
_DISTRIBUTED = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "TORCHELASTIC_RUN_ID")


class LiveView(TrainingObserver):
    """Observer that starts the view process and writes weights. Failures do not stop training."""

    def __init__(self, task: str, cfg: TrainConfig, runner: MjlabOnPolicyRunner) -> None:
        """Start the process.

        Args:
            task: Name of the task.
            cfg: Configuration of the run; not modified.
            runner: Runner of the shown policy.

        Raises:
            UserError: the configuration cannot be pickled.
        """
        self._runner = runner
        job = _pickled(LiveJob(task, _view_env_cfg(cfg), cfg.agent, type(runner)))
        _remove_abandoned_folders()
        self._folder = tempfile.TemporaryDirectory(prefix=_PREFIX)
        self._lock = create_locked(Path(self._folder.name) / _LOCK)
        self._exchange = Exchange(Path(self._folder.name))
        self._next_weights = 0.0
        self._process: subprocess.Popen | None = _start(
            self._exchange, cfg.live_host, cfg.live_port
        )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(len(job).to_bytes(8, "little") + job)
            self._process.stdin.flush()
        except OSError:
            self._give_up_if_ended()

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Print the URL of the page; write the initial weights."""
        self._write_weights(None)
        limit = time.perf_counter() + _SECONDS_TO_START
        while time.perf_counter() < limit and not self._give_up_if_ended():
            if self._exchange.url.exists():
                url = self._exchange.url.read_text(encoding="utf-8")
                print(f"Live:    {url} (open it in a browser)", flush=True)
                return
            time.sleep(0.02)

    def on_iteration(self, stats: IterationStats) -> None:
        """Write the newest weights if a browser is connected."""
        begin = time.perf_counter()
        if begin < self._next_weights or self._give_up_if_ended():
            return
        if not self._exchange.watched.exists():
            return
        try:
            self._write_weights(stats)
        except OSError as error:
            logger.warning("Live view: writing weights failed: %s", error)
        end = time.perf_counter()
        self._next_weights = end + max(_SECONDS_BETWEEN_WEIGHTS, (end - begin) / _MAX_TIME_SHARE)

    def on_end(self, reason: str) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            assert process.stdin is not None
            # The process ends when its standard input is closed.
            with contextlib.suppress(OSError):
                process.stdin.close()
            try:
                process.wait(_SECONDS_TO_END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._lock.close()
        self._folder.cleanup()

    def _write_weights(self, stats: IterationStats | None) -> None:
        num_steps = int(getattr(self._runner.env.unwrapped, "common_step_counter", 0))
        self._exchange.write_weights(self._runner.alg.get_policy(), num_steps, stats)

    def _give_up_if_ended(self) -> bool:
        """Return True if the process has ended; log it the first time."""
        if self._process is None:
            return True
        if self._process.poll() is None:
            return False
        self._process = None
        reason = (
            self._exchange.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            or [""]
        )[-1]
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


def _pickled(job: LiveJob) -> bytes:
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
                *(sys.executable, "-m", "mjlab.scripts.live_view"),
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
