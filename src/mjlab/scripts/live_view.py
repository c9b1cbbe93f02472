"""The process behind `train --live`: the page of the policy that another process trains.

It is started by `mjlab.scripts.live`, reads what to show from its standard input, and ends when
that is closed, however the other process came to its end. It builds its environment when the first
browser connects, and steps it, at the lowest priority, only while one is.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import viser

    from mjlab.scripts.live import Exchange, LiveJob

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
    from mjlab.scripts.live import Exchange

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
    from mjlab.viewer.viser.live import LiveViewer

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


if __name__ == "__main__":
    main()
