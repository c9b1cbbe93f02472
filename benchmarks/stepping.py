"""Environments stepped in a separate process, of this checkout or of another.

`python benchmarks/side_by_side.py FOLDER` compares `env.step` with that of another checkout (such as an
earlier commit, with its own `.venv`), alternating. `growth.py` compares numbers of environments.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent.parent
NUM_THREADS = 2
ACTION_SIZE = 0.3
STEPS_BEFORE = 25


class Stepper:
    """Environments of a task in a separate process, which step on request with random actions."""

    def __init__(self, task: str, num_envs: int, checkout: Path = HERE) -> None:
        """Start the process; `checkout` has the package's `src` and a `.venv`, or none for ours."""
        own = checkout / ".venv" / "bin" / "python"
        python = str(own) if checkout != HERE and own.exists() else sys.executable
        self.num_envs = num_envs
        # Unbuffered on both sides: each line is a request or its answer.
        self._process: Any = subprocess.Popen(
            [python, __file__, task, str(num_envs), str(checkout / "src")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.memory = self._answer()["bytes"]
        """Bytes of memory that the environments take, beyond what Python and its imports do."""

    def _answer(self) -> dict[str, float]:
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{' '.join(self._process.args)} ended; its error stands above.")
        return json.loads(line)

    def step(self, count: int) -> None:
        """Step so often."""
        self._process.stdin.write(f"{count}\n")
        self._process.stdin.flush()
        self._answer()

    def close(self) -> None:
        """End the process."""
        self._process.stdin.close()
        self._process.wait()


def median_times(steppers: list[Stepper], samples: int, repeats: int = 15) -> list[float]:
    """Return the median seconds of a step of each, taking turns so that noise hits all.

    Each turn makes about `samples` steps of single environments.
    """
    # Here, because an earlier checkout serves this file without MuJoCo's batch engine.
    from measure import alternate

    counts = [max(1, samples // stepper.num_envs) for stepper in steppers]
    turns = [
        functools.partial(stepper.step, count)
        for stepper, count in zip(steppers, counts, strict=True)
    ]
    times = alternate(*turns, steps=1, repeats=repeats, warm_up=0)
    return [seconds / count for seconds, count in zip(times, counts, strict=True)]


def _resident_bytes() -> int:
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(fields["VmRSS"].split()[0]) * 1024


def _serve(task: str, num_envs: int) -> None:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.registry import load_env_cfg

    torch.set_num_threads(1)
    cfg = load_env_cfg(task)
    cfg.scene.num_envs = num_envs
    cfg.sim.num_threads = NUM_THREADS
    cfg.sim.engine = "native"
    cfg.seed = 1
    before = _resident_bytes()
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    generator = torch.Generator().manual_seed(0)
    shape = (num_envs, env.action_manager.total_action_dim)
    actions = ACTION_SIZE * torch.randn(shape, generator=generator)
    # As training steps.
    step = torch.inference_mode()(env.step)
    for _ in range(STEPS_BEFORE):
        step(actions)
    print(json.dumps({"bytes": _resident_bytes() - before}), flush=True)
    for line in sys.stdin:
        for _ in range(int(line)):
            step(actions)
        print(json.dumps({"steps": int(line)}), flush=True)


if __name__ == "__main__":
    sys.path.insert(0, sys.argv[3])
    _serve(sys.argv[1], int(sys.argv[2]))
