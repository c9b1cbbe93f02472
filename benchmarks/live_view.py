"""Cost of `train --live`: training speed with a browser connected, and without one.

Training of Go1 on flat ground runs once. A client that receives the data of a browser, without
drawing, connects and disconnects repeatedly, so that both kinds of iterations are
spread over the same minutes. `python benchmarks/live_view.py [MINUTES]` prints one line of JSON:
steps per second of both kinds, the median of their ratio over neighboring blocks, the processor
time of the view, in cores, and the time from the end of the first iteration until the page shows the
robots under a trained policy.

The machine must be idle otherwise: the expected effect is 2 %.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from measure import Row, output_of
from websockets.sync.client import connect

from mjlab.cli import training as environments
from mjlab.cli.live import LiveView
from mjlab.rl.config import EvaluationCfg
from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.scripts.train import TrainConfig, launch_training
from mjlab.tasks.registry import load_runner_cls

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
BLOCK_S = 20.0
PORT = 8790
_LIMIT = 0.02
# Progress of a finished iteration, sent together with the poses of the robots.
_SHOWN = re.compile(rb"Iteration:</strong> [1-9]")

# A browser counts as connected once it has said where its camera is.
_CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 1.0, 1.0),
    "fov": 1.0, "near": 0.1, "far": 100.0, "image_height": 800, "image_width": 1280,
    "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip


def watch(block: Any, shown: Any) -> None:
    """Watch the page until it shows a trained policy, at the time `shown`.

    Then look away and watch in turns, for `BLOCK_S` each; `block` counts both.
    """
    protocol: Any = f"viser-v{viser.__version__}"
    address, options = f"ws://localhost:{PORT}", {"max_size": None, "compression": None}
    while True:
        try:
            page = connect(address, subprotocols=[protocol], **options)
        except OSError:
            # Not served yet.
            time.sleep(0.02)
            continue
        with page:
            page.send(msgspec.msgpack.encode(_CAMERA))
            block.value += 1
            end = time.monotonic() + BLOCK_S
            while time.monotonic() < end:
                with contextlib.suppress(TimeoutError):
                    message = page.recv(timeout=0.5)
                    if shown.value == 0.0 and _SHOWN.search(decoded(message)):
                        shown.value = time.monotonic()
        block.value += 1
        time.sleep(BLOCK_S)


def decoded(message: Any) -> bytes:
    """Return the text of a message of viser, after its two sizes."""
    size = int.from_bytes(message[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(message[16 : 16 + size])


class Recorder(TrainingObserver):
    """Notes the speed of every iteration and the processor time of the view."""

    def __init__(self, view: LiveView, block: Any, minutes: float) -> None:
        self._view = view
        self._end = time.monotonic() + 60.0 * minutes
        self._block = block
        self.rows: list[tuple[int, float, float, float]] = []

    def on_iteration(self, stats: IterationStats) -> None:
        """Note one iteration; end training when the time is up."""
        now = time.monotonic()
        cpu_time = _cpu_time(self._view._process.pid)
        self.rows.append((self._block.value, stats.steps_per_second, now, cpu_time))
        if now > self._end:
            os.kill(os.getpid(), signal.SIGINT)


def _cpu_time(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure_costs(minutes: float) -> dict[str, float]:
    """Train for `minutes`; return the results."""
    spawn = multiprocessing.get_context("spawn")
    # The page is watched in blocks of an odd number.
    block, shown = spawn.Value("i", 0), spawn.Value("d", 0.0)
    # The client is a separate process: its work must not count for the measured one.
    spawn.Process(target=watch, args=(block, shown), daemon=True).start()
    recorders: list[Recorder] = []
    base: Any = load_runner_cls(TASK)

    class Runner(base):
        def learn(self, *args: Any, **kwargs: Any) -> None:
            (view,) = (item for item in self.observers if isinstance(item, LiveView))
            recorders.append(Recorder(view, block, minutes))
            self.observers.append(recorders[0])
            super().learn(*args, **kwargs)

    environments.load_runner_cls = lambda _: Runner  # ty: ignore[invalid-assignment]
    with tempfile.TemporaryDirectory() as folder:
        cfg = TrainConfig.from_task(TASK, "cpu")
        cfg.live, cfg.live_port, cfg.device, cfg.log_root = True, PORT, "cpu", folder
        cfg.agent.max_iterations = 1_000_000
        cfg.agent.evaluation = EvaluationCfg()
        launch_training(TASK, cfg)
    rows = recorders[0].rows
    return {**summary(rows), "seconds_until_shown": shown.value - rows[0][2]}


def summary(rows: list[tuple[int, float, float, float]]) -> dict[str, float]:
    """Return the results from (block, steps per second, time, processor time) of each iteration."""
    blocks: dict[int, list[float]] = {}
    cores: dict[bool, list[float]] = {False: [], True: []}
    for before, row in zip(rows, rows[1:], strict=False):
        # Iterations during a connect or disconnect belong to neither kind; nor does the first
        # watched block, because it includes the start of the view.
        if row[0] == before[0] and row[0] > 1:
            blocks.setdefault(row[0], []).append(row[1])
            cores[row[0] % 2 == 1].append((row[3] - before[3]) / (row[2] - before[2]))
    speed = {block: float(np.median(values)) for block, values in blocks.items()}
    ratios = [
        speed[block] / np.mean([speed[block - 1], speed[block + 1]])
        for block in speed
        if block % 2 == 1 and block - 1 in speed and block + 1 in speed
    ]
    return {
        "watched_steps_per_s": float(np.median([v for b, v in speed.items() if b % 2 == 1])),
        "unwatched_steps_per_s": float(np.median([v for b, v in speed.items() if b % 2 == 0])),
        "ratio": float(np.median(ratios)),
        "ratio_standard_error": float(np.std(ratios) / np.sqrt(len(ratios))),
        "blocks": len(speed),
        "view_cores_watched": float(np.mean(cores[True])),
        "view_cores_unwatched": float(np.mean(cores[False])),
    }


def measure(minutes: float = 10.0) -> list[Row]:
    """Measure in a separate process, because training takes over its process; return one row."""
    seen = json.loads(output_of([sys.executable, __file__, str(minutes)]).splitlines()[-1])
    cost, error = 1.0 - seen["ratio"], seen["ratio_standard_error"]
    return [
        Row(
            "Go1 flat, `train --live`: speed of training that a browser costs",
            f"{cost:.1%} ± {error:.1%} ({seen['watched_steps_per_s']:,.0f} env-steps/s watched; the view "
            f"takes {seen['view_cores_watched']:.1%} of a core; a trained policy is shown "
            f"{seen['seconds_until_shown']:.1f} s after the first iteration)",
            f"not watched, in turns of {BLOCK_S:.0f} s: "
            f"{seen['unwatched_steps_per_s']:,.0f} env-steps/s",
            "under 2 % (empty: the error leaves it open)",
            verdict(cost, error),
        )
    ]


def verdict(cost: float, error: float) -> bool | None:
    """Return whether the cost is under 2 %; None where its error leaves that open."""
    if abs(cost - _LIMIT) < 2.0 * error:
        return None
    return cost < _LIMIT


if __name__ == "__main__":
    # As `train` sets it.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    print(json.dumps(measure_costs(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)))
