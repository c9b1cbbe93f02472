"""The process behind `train --live`: the page of the policy that another process trains.

It is started by `mjlab.scripts.live`, reads what to show from its standard input, and ends when
that is closed, however the other process came to its end. It builds its environment when the first
browser connects, and steps it, at the lowest priority, only while one is. Until then, nothing heavy
is imported.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import signal
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.utils.os import replacing
from mjlab.viewer.page_server import page_url, serve_page

if TYPE_CHECKING:
    import viser

    from mjlab.rl.run_logger import IterationStats

_WAITING = 0.25
_LOWEST_PRIORITY = 19


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
    server = serve_page(host, port)
    with replacing(exchange.url) as file:
        file.write(page_url(server).encode())
    note = server.gui.add_markdown("Preparing the view …")
    while not server.get_clients():
        time.sleep(_WAITING)
    exchange.watched.touch()
    viewer = make_viewer(pickle.loads(pickled), exchange, server)
    # Not before: at that priority, building would take minutes where all processors are busy.
    lower_priority()
    note.remove()
    viewer.run(catch_sigint=False)


def make_viewer(job: LiveJob, exchange: Exchange, server: viser.ViserServer) -> Any:
    """Return the viewer of a job, with an environment and a network of its own."""
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper
    from mjlab.rl.learners import acting_cfg
    from mjlab.viewer.viser.live import LiveViewer

    def set_watched(watched: bool) -> None:
        if watched:
            exchange.watched.touch()
        else:
            exchange.watched.unlink(missing_ok=True)

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
        set_watched=set_watched,
        viser_server=server,
    )


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
        with replacing(self.weights) as file:
            file.write(content.getbuffer())


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


if __name__ == "__main__":
    main()
