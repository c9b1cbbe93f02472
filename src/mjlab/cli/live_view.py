"""View process of `train --live`: page of a policy that another process trains.

Started by `mjlab.cli.live`; reads a pickled `LiveJob` from standard input, and ends when standard
input is closed, even if training was killed. The environment is built while training builds its own, and
stepped at the lowest priority, only while a browser is connected.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import queue
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.utils.os import replacing
from mjlab.viewer.page_server import page_url, serve_page

if TYPE_CHECKING:
    import viser

_LOWEST_PRIORITY = 19


def main() -> None:
    """Show the job from standard input. Arguments: exchange folder, address, port."""
    # Training handles Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    jobs: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read_until_end, args=(jobs,), daemon=True).start()
    show(jobs, Exchange(Path(sys.argv[1])), sys.argv[2], int(sys.argv[3]))


def lower_priority() -> None:
    """Give training precedence over this process, if the system supports priorities.

    On Linux the lowest priority gets 1.5 % of a busy core, and all idle time. (The idle scheduling
    class would get almost nothing: with all cores busy, the page would freeze.)
    """
    with contextlib.suppress(OSError, AttributeError):
        os.nice(_LOWEST_PRIORITY)


def show(jobs: queue.SimpleQueue[bytes], exchange: Exchange, host: str, port: int) -> None:
    """Serve the page of the pickled `LiveJob` in `jobs`."""
    server = serve_page(host, port)
    with replacing(exchange.url) as file:
        file.write(page_url(server).encode())
    note = server.gui.add_markdown("Building the view …")
    # Imported before the job arrives: training imports and pickles meanwhile.
    import mjlab.rl.runner
    import mjlab.viewer.viser.live  # noqa: F401

    def on_ready() -> None:
        note.remove()
        # After building: at low priority, building would take minutes with all cores busy.
        lower_priority()
        exchange.ready.touch()

    make_viewer(pickle.loads(jobs.get()), exchange, server, on_ready).run(catch_sigint=False)


def make_viewer(
    job: LiveJob, exchange: Exchange, server: viser.ViserServer, on_ready: Callable[[], None]
) -> Any:
    """Return the viewer of a job, with a new environment and network."""
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper
    from mjlab.rl.learners import acting_cfg
    from mjlab.viewer.viser.live import LiveViewer

    torch.set_num_threads(1)
    env = ManagerBasedRlEnv(job.env, device="cpu")
    wrapped = RslRlVecEnvWrapper(env, clip_actions=job.agent.clip_actions)
    runner = job.runner_cls(wrapped, acting_cfg(job.agent), None, "cpu")
    weights = NewestWeights(exchange, runner.alg.get_policy(), env)
    return LiveViewer(
        wrapped, runner.get_inference_policy(device="cpu"), server, job.task, weights.take, on_ready
    )


@dataclass
class LiveJob:
    """Job of the view process."""

    task: str
    """Name of the task."""
    env: Any
    """Environment config."""
    agent: Any
    """Learner config."""
    runner_cls: Any
    """Runner class. Builds the policy network."""


class Exchange:
    """Folder for file exchange between training and the view process."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = folder / "url"
        """URL of the page, written once the page is served."""
        self.ready = folder / "ready"
        """Exists once the page shows the robots."""
        self.weights = folder / "weights.pt"
        """Newest policy and the progress of training, replaced atomically."""
        self.log = folder / "log.txt"
        """Output of the view process."""

    def write_weights(self, policy: Any, num_steps: int, progress: Mapping[str, Any]) -> None:
        """Write the state of a policy.

        Args:
            policy: Policy network.
            num_steps: Steps per environment, the input of curricula.
            progress: Progress of training, as `LiveViewer` takes it.
        """
        import torch

        content = io.BytesIO()
        state = {"policy": policy.state_dict(), "num_steps": num_steps, "progress": progress}
        torch.save(state, content)
        with replacing(self.weights) as file:
            file.write(content.getbuffer())


class NewestWeights:
    """Loader of the newest weights written by training."""

    def __init__(self, exchange: Exchange, network: Any, env: Any) -> None:
        self._path = exchange.weights
        self._network = network
        self._env = env
        self._seen: tuple[int, int] | None = None

    def take(self) -> dict[str, Any] | None:
        """Load the newest weights; return the progress of training, or None if unchanged."""
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
        # Curricula must match those of training.
        self._env.common_step_counter = content["num_steps"]
        return content["progress"]


def _read_until_end(jobs: queue.SimpleQueue[bytes]) -> None:
    """Pass on the job from standard input; end this process when the input is closed."""
    with contextlib.suppress(OSError):
        size = int.from_bytes(sys.stdin.buffer.read(8), "little")
        jobs.put(sys.stdin.buffer.read(size))
        sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    main()
