"""View process of `train --live`: page of a policy that another process trains.

Started by `mjlab.scripts.live`; reads a pickled `LiveJob` from standard input, and ends when standard
input is closed, even if training was killed. The environment is built when the first browser connects,
and stepped at the lowest priority only while a browser is connected. Heavy modules are not imported
before.
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

_POLL_PERIOD = 0.25
_LOWEST_PRIORITY = 19


def main() -> None:
    """Show the job from standard input. Arguments: exchange folder, address, port."""
    # Training handles Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    size = int.from_bytes(sys.stdin.buffer.read(8), "little")
    pickled = sys.stdin.buffer.read(size)
    if size == 0 or len(pickled) < size:
        return
    threading.Thread(target=_end_with_parent, daemon=True).start()
    show(pickled, Exchange(Path(sys.argv[1])), sys.argv[2], int(sys.argv[3]))


def lower_priority() -> None:
    """Give training precedence over this process, if the system supports priorities.

    On Linux the lowest priority gets 1.5 % of a busy core, and all idle time. (The idle scheduling
    class would get almost nothing: with all cores busy, the page would freeze.)
    """
    with contextlib.suppress(OSError, AttributeError):
        os.nice(_LOWEST_PRIORITY)


def show(pickled: bytes, exchange: Exchange, host: str, port: int) -> None:
    """Serve the page of a pickled `LiveJob`; build its environment when the first browser connects.

    Neither torch nor the task is imported before.
    """
    server = serve_page(host, port)
    with replacing(exchange.url) as file:
        file.write(page_url(server).encode())
    # Shown at once to a browser that connects: building takes seconds while training uses the cores.
    note = server.gui.add_markdown("Building the view …")
    notes: list[Any] = []
    is_built = False

    @server.on_client_connect
    def _(client: Any) -> None:
        if not is_built:
            notes.append(client.add_notification("Building the view", "", loading=True))

    while not server.get_clients():
        time.sleep(_POLL_PERIOD)
    exchange.watched.touch()
    viewer = make_viewer(pickle.loads(pickled), exchange, server)
    # After building: at low priority, building would take minutes with all cores busy.
    lower_priority()
    is_built = True
    for shown in (note, *notes):
        shown.remove()
    viewer.run(catch_sigint=False)


def make_viewer(job: LiveJob, exchange: Exchange, server: viser.ViserServer) -> Any:
    """Return the viewer of a job, with a new environment and network."""
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
        self.watched = folder / "watched"
        """Exists while a browser is connected."""
        self.weights = folder / "weights.pt"
        """Newest policy and statistics of its iteration, replaced atomically."""
        self.log = folder / "log.txt"
        """Output of the view process."""

    def write_weights(self, policy: Any, num_steps: int, stats: IterationStats | None) -> None:
        """Write the state of a policy.

        Args:
            policy: Policy network.
            num_steps: Steps per environment, the input of curricula.
            stats: Statistics of the policy's iteration; None before the first iteration.
        """
        import torch

        content = io.BytesIO()
        stats_dict = None if stats is None else asdict(stats)
        policy_state = policy.state_dict()
        torch.save({"policy": policy_state, "num_steps": num_steps, "stats": stats_dict}, content)
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
        """Load the newest weights; return the statistics of their iteration, or None if unchanged."""
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
        return content["stats"]


def _end_with_parent() -> None:
    """End this process as soon as its standard input is closed."""
    with contextlib.suppress(OSError):
        sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    main()
