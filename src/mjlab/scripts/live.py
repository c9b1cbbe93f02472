"""`train --live`: shows the policy as it learns, from a process that training does not wait for.

Training hands over the newest weights through a file, at the end of an iteration and only while a
browser is connected. All else, the page, an environment of its own and the policy in it, lives in
the other process (`mjlab.scripts.live`), which takes processor time that training leaves.
"""

from __future__ import annotations

import contextlib
import copy
import html
import io
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.utils.errors import UserError
from mjlab.utils.os import create_locked, remove_abandoned
from mjlab.viewer.viser.viewer import ViserPlayViewer

if TYPE_CHECKING:
    import viser

    from mjlab.rl import MjlabOnPolicyRunner
    from mjlab.scripts.train_config import TrainConfig
    from mjlab.viewer.base import EnvProtocol, PolicyProtocol
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


_WAITING = 0.25


_LOWEST_PRIORITY = 19


# Times in seconds between two looks: for a browser while there is none, and for new weights.
_SLEEP_UNWATCHED = 0.25


_WEIGHTS_PERIOD = 0.25


_PANEL_PERIOD = 0.5


Stats = Mapping[str, Any]


# The training process.


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


@dataclass
class LiveJob:
    """What the view's process is to show."""

    task: str
    """Name of the task."""
    env: Any
    """Config of the environment."""
    agent: Any
    """Config of the learner."""
    runner_cls: Any
    """Class of the runner, which builds the policy's network."""


class Exchange:
    """The folder in which training and the view leave things for each other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = folder / "url"
        """Where the page is, once it is there."""
        self.watched = folder / "watched"
        """Exists while a browser is connected."""
        self.weights = folder / "weights.pt"
        """The newest policy and the figures of its iteration; it appears whole or not at all."""
        self.log = folder / "log.txt"
        """What the view's process printed."""

    def write_weights(self, policy: Any, num_steps: int, stats: IterationStats | None) -> None:
        """Leave a policy's state.

        Args:
            policy: The network.
            num_steps: Steps that each environment has made, which curricula go by.
            stats: Figures of the iteration that the policy comes from, if there was one.
        """
        import torch

        content = io.BytesIO()
        figures = None if stats is None else asdict(stats)
        policy_state = policy.state_dict()
        torch.save({"policy": policy_state, "num_steps": num_steps, "stats": figures}, content)
        temporary = self.weights.with_suffix(".tmp")
        temporary.write_bytes(content.getbuffer())
        temporary.replace(self.weights)


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
                *(sys.executable, "-m", "mjlab.scripts.live"),
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


# The process that serves the page.


def main() -> None:
    """Show what standard input says; the arguments are the exchange's folder, address and port."""
    # Training decides what Ctrl-C means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    size = int.from_bytes(sys.stdin.buffer.read(8), "little")
    pickled = sys.stdin.buffer.read(size)
    if size == 0 or len(pickled) < size:
        return
    threading.Thread(target=_end_with_parent, daemon=True).start()

    show(pickled, Exchange(Path(sys.argv[1])), sys.argv[2], int(sys.argv[3]))


def lower_priority() -> None:
    """Leave the processors to training, as far as the system can do that.

    On Linux the lowest priority is 1.5 % of a processor that others want all of, and what is left
    of one that they do not. (The idle class would be next to nothing instead: where all
    processors are busy, the page would stand still.)
    """
    with contextlib.suppress(OSError, AttributeError):
        os.nice(_LOWEST_PRIORITY)


def show(pickled: bytes, exchange: Exchange, host: str, port: int) -> None:
    """Serve the page of a pickled `LiveJob`; build what it shows when the first browser connects.

    Until then, neither torch nor the task are imported.
    """
    from mjlab.viewer.page_server import page_url, serve_page

    server = serve_page(host, port)
    temporary = exchange.url.with_suffix(".tmp")
    temporary.write_text(page_url(server))
    temporary.replace(exchange.url)
    note = server.gui.add_markdown("Preparing the view …")
    while not server.get_clients():
        time.sleep(_WAITING)
    exchange.watched.touch()
    viewer = _make_viewer(pickle.loads(pickled), exchange, server)
    # Not before: at that priority, building would take minutes where all processors are busy.
    lower_priority()
    note.remove()
    viewer.run(catch_sigint=False)


def _make_viewer(job: LiveJob, exchange: Exchange, server: viser.ViserServer) -> Any:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper
    from mjlab.rl.learners import acting_cfg

    torch.set_num_threads(1)
    env = ManagerBasedRlEnv(job.env, device="cpu")
    wrapped = RslRlVecEnvWrapper(env, clip_actions=job.agent.clip_actions)
    runner = job.runner_cls(wrapped, acting_cfg(job.agent), None, "cpu")
    network = runner.alg.get_policy()
    weights = NewestWeights(exchange, network, env)
    return LiveViewer(
        wrapped,
        runner.get_inference_policy(device="cpu"),
        title=job.task,
        take_stats=weights.take,
        set_watched=lambda watched: _set_watched(exchange, watched),
        viser_server=server,
    )


def _set_watched(exchange: Exchange, watched: bool) -> None:
    if watched:
        exchange.watched.touch()
    else:
        exchange.watched.unlink(missing_ok=True)


class NewestWeights:
    """Loads the weights that training leaves into a network."""

    def __init__(self, exchange: Exchange, network: Any, env: Any) -> None:
        self._path = exchange.weights
        self._network = network
        self._env = env
        self._seen: tuple[int, int] | None = None

    def take(self) -> dict[str, Any] | None:
        """Load the newest weights; return the figures of their iteration, or None if not new."""
        import torch

        try:
            status = self._path.stat()
            mark = (status.st_mtime_ns, status.st_ino)
            if mark == self._seen:
                return None
            content = torch.load(self._path, map_location="cpu", weights_only=True)
        except FileNotFoundError:
            return None
        self._seen = mark
        self._network.load_state_dict(content["policy"])
        # Curricula get to where they are in training.
        self._env.common_step_counter = content["num_steps"]
        return content["stats"]


def _end_with_parent() -> None:
    """End this process when its standard input is closed, whatever it is doing."""
    with contextlib.suppress(OSError):
        sys.stdin.buffer.read()
    os._exit(0)


# The page.


class LiveViewer(ViserPlayViewer):
    """Plays the newest policy of a training run, and says how far training has got.

    Without a browser nothing is stepped or drawn.
    """

    # Half of what the eye would like: what is left to do is training's.
    scene_period = 1.0 / 20.0

    def __init__(
        self,
        env: EnvProtocol,
        policy: PolicyProtocol,
        viser_server: viser.ViserServer,
        title: str,
        take_stats: Callable[[], Stats | None],
        set_watched: Callable[[bool], None],
    ) -> None:
        """Prepare the viewer.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions; `take_stats` changes its weights.
            viser_server: The page's server.
            title: What is trained.
            take_stats: Takes new weights over; returns the figures (`IterationStats`) of their
                iteration, or None if there are no new ones.
            set_watched: Is told whether a browser is connected, when that changes.
        """
        super().__init__(env, policy, frame_rate=20.0, viser_server=viser_server)
        self._title = title
        self._take_stats = take_stats
        self._set_watched = set_watched
        self._watched: bool | None = None
        self._stats: Stats | None = None
        self._stats_time = 0.0
        self._next_weights = self._next_panel = 0.0
        self._panel: viser.GuiHtmlHandle | None = None

    def tick(self) -> bool:
        """Do what is due, while a browser is connected; sleep while none is."""
        watched = bool(self._server.get_clients())
        if watched != self._watched:
            self._watched = watched
            self._set_watched(watched)
        if not watched:
            time.sleep(_SLEEP_UNWATCHED)
            # No time has passed for the simulation either.
            self._last_tick = time.perf_counter()
            return True
        self._take_weights()
        return super().tick()

    def add_first_panels(self) -> None:
        """Add the progress of training."""
        with self._server.gui.add_folder("Training"):
            self._panel = self._server.gui.add_html("")
        self._show_progress()

    def _take_weights(self) -> None:
        now = time.perf_counter()
        if now >= self._next_weights:
            self._next_weights = now + _WEIGHTS_PERIOD
            stats = self._take_stats()
            if stats is not None:
                self._stats, self._stats_time = stats, now
        if now >= self._next_panel:
            self._next_panel = now + _PANEL_PERIOD
            self._show_progress()

    def _show_progress(self) -> None:
        if self._panel is not None:
            age = time.perf_counter() - self._stats_time
            content = progress_html(self._title, self._stats, age)
            if content != self._panel.content:
                self._panel.content = content


def progress_html(title: str, stats: Stats | None, age: float) -> str:
    """How far training has got, with a bar.

    Args:
        title: What is trained.
        stats: Figures of the iteration that the shown policy comes from; None before the first.
        age: Seconds since the policy came.
    """
    name = f"<div><strong>{html.escape(title)}</strong></div>"
    style = "padding:0.25em 1em;font-size:0.85em;line-height:1.5"
    if stats is None:
        return f'<div style="{style}">{name}Waiting for the first iteration …</div>'
    done, total = stats["iteration"], stats["total_iterations"]
    bar = (
        '<div style="background:rgba(128,128,128,0.2);border-radius:2px;margin:0.3em 0">'
        f'<div style="width:{100.0 * done / max(total, 1):.1f}%;height:6px;background:#1c7ed6;'
        'border-radius:2px"></div></div>'
    )
    rows = [
        ("Iteration", f"{done:,} of {total:,}"),
        ("Mean reward", _number(stats["mean_reward"])),
        ("Episode length", f"{_number(stats['mean_episode_length'], 0)} steps"),
        ("Speed", f"{stats['steps_per_second']:,.0f} steps/s, {_time(stats['time_left'])} left"),
        ("Policy", f"{age:.0f} s old"),
    ]
    lines = "".join(f"<div><strong>{row}:</strong> {value}</div>" for row, value in rows)
    lines += '<div style="opacity:0.6">The view takes only the time that training leaves.</div>'
    return f'<div style="{style}">{name}{bar}{lines}</div>'


def _number(value: float | None, decimals: int = 2) -> str:
    return "—" if value is None else f"{value:,.{decimals}f}"


def _time(seconds: float) -> str:
    minutes, seconds = divmod(int(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


if __name__ == "__main__":
    main()
