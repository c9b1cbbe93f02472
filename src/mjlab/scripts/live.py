"""`train --live`: shows the policy as it learns, from a process that training does not wait for.

Training hands over the newest weights through a file, at the end of an iteration and only while a
browser is connected. All else, the page, an environment of its own and the policy in it, lives in
the other process (`mjlab.scripts.live_view`), which takes processor time that training leaves.
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

# Handing over weights takes some milliseconds. Iterations can be shorter than that, so it is done
# at most this often, and never for more than this share of the time.
_SECONDS_BETWEEN_WEIGHTS = 1.0
_LARGEST_SHARE = 0.01

_PREFIX = "mjlab-live-"
# Held by training, so that the folder of one that was killed can be told.
_LOCK = "lock"
_NUM_ENVS = 4
_SECONDS_TO_START = 20.0
_SECONDS_TO_END = 3.0
# What would make the view's process one of the training processes of `torchrun`.
_DISTRIBUTED = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "TORCHELASTIC_RUN_ID")


class LiveView(TrainingObserver):
    """Runs the view's process and keeps it supplied. Whatever happens to it, training goes on."""

    def __init__(self, task: str, cfg: TrainConfig, runner: MjlabOnPolicyRunner) -> None:
        """Start the process.

        Args:
            task: Name of the task.
            cfg: The run's configuration; it is left as it is.
            runner: The runner whose policy is shown.

        Raises:
            UserError: the configuration cannot be handed to another process.
        """
        self._runner = runner
        job = _pickled(LiveJob(task, _env_to_show(cfg), cfg.agent, type(runner)))
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
        """Say where the page is; leave the weights that training starts from."""
        self._write_weights(None)
        limit = time.perf_counter() + _SECONDS_TO_START
        while time.perf_counter() < limit and not self._give_up_if_ended():
            if self._exchange.url.exists():
                url = self._exchange.url.read_text()
                print(f"Live:    {url} (open it in a browser)", flush=True)
                return
            time.sleep(0.02)

    def on_iteration(self, stats: IterationStats) -> None:
        """Leave the newest weights, if anyone is watching."""
        begin = time.perf_counter()
        if begin < self._next_weights or self._give_up_if_ended():
            return
        if not self._exchange.watched.exists():
            return
        try:
            self._write_weights(stats)
        except OSError as error:
            logger.warning("The live view gets no new weights: %s", error)
        end = time.perf_counter()
        self._next_weights = end + max(_SECONDS_BETWEEN_WEIGHTS, (end - begin) / _LARGEST_SHARE)

    def on_end(self, reason: str) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            _end(process)
        self._lock.close()
        self._folder.cleanup()

    def _write_weights(self, stats: IterationStats | None) -> None:
        num_steps = int(getattr(self._runner.env.unwrapped, "common_step_counter", 0))
        self._exchange.write_weights(self._runner.alg.get_policy(), num_steps, stats)

    def _give_up_if_ended(self) -> bool:
        """Return whether there is no process; say so when it is first noticed."""
        if self._process is None:
            return True
        if self._process.poll() is None:
            return False
        self._process = None
        reason = (self._exchange.log.read_text(errors="replace").strip().splitlines() or [""])[-1]
        logger.warning("The live view has ended; training goes on. %s", reason)
        return True


def _remove_abandoned_folders() -> None:
    """Remove the folders of training processes that were killed."""
    if os.name != "posix":
        return
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        # Other users may plant what they like there.
        with contextlib.suppress(OSError):
            is_own = folder.lstat().st_uid == os.geteuid() and not folder.is_symlink()
            if is_own and remove_abandoned(folder / _LOCK):
                shutil.rmtree(folder)


def _env_to_show(cfg: TrainConfig) -> Any:
    """Return the run's environment as it is shown: few of it, on one thread, writing no files."""
    env = copy.deepcopy(cfg.env)
    env.scene.num_envs = min(_NUM_ENVS, env.scene.num_envs)
    env.sim.engine = "native"
    env.sim.num_threads = 1
    env.sim.nan_guard.enabled = False
    env.recorders = {}
    return env


def _pickled(job: LiveJob) -> bytes:
    # Configs hold lambdas, and classes of the program that calls us, which only this pickles.
    import cloudpickle

    try:
        return cloudpickle.dumps(job)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise UserError(
            "--live cannot hand this task to another process, because something in its config "
            f"cannot be pickled: {error}. Build such things in functions that the config names, "
            "or train without --live."
        ) from error


def _start(exchange: Exchange, host: str, port: int) -> subprocess.Popen:
    environment = {k: v for k, v in os.environ.items() if k not in _DISTRIBUTED}
    # The GPU is the training's, and so are all threads but one.
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
            # Ctrl-C is for training, which ends the view. A session of its own would do that too,
            # but Linux shares processors out by session first, and by priority only within one.
            process_group=0 if os.name == "posix" else None,
        )


def _end(process: subprocess.Popen) -> None:
    """Let the process end by closing its standard input; kill it if it does not."""
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    try:
        process.wait(_SECONDS_TO_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
