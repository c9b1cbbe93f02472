"""Warp's kernels for all tasks, compiled in parallel processes, so that later parts do not wait.

Warp keeps what it has compiled in a folder of the user. `python -m gpu_parts.kernels TASK DEVICE NUM`
compiles those of one task and prints the seconds.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from measure import Row

from gpu_parts.options import Options
from gpu_parts.tasks import (
    CARTPOLE,
    G1_FLAT,
    G1_ROUGH,
    GO1_FLAT,
    GO1_ROUGH,
    LIFT_CUBE,
    LIFT_CUBE_RGB,
    TRACKING,
    make_env,
)
from gpu_parts.tests import environment_of_tests, missing_for_tests, pytest_command
from mjlab.utils.processes import available_cores

_TESTS = "tests marked `cuda`"
# The first has contacts, joint limits and sensors: most modules of `mujoco_warp`.
_TASKS = (GO1_FLAT, G1_ROUGH, LIFT_CUBE_RGB, TRACKING, G1_FLAT, GO1_ROUGH, LIFT_CUBE, CARTPOLE)


def measure(options: Options) -> Iterator[Row]:
    """Compile; yield a row per process, as it ends.

    The first task runs alone: it compiles the common kernels for the others.

    Raises:
        RuntimeError: some processes failed; all have ended.
    """
    failed: list[str] = []
    begin = time.monotonic()
    waiting = _commands(options)
    with contextlib.ExitStack() as stack:
        running: dict[str, tuple[subprocess.Popen[str], IO[str]]] = {}
        has_compiled = False
        while waiting or running:
            most = max(1, available_cores() // 2) if has_compiled else 1
            while waiting and len(running) < most:
                name = next(iter(waiting))
                # Into a file: a full pipe would block the processes.
                log = stack.enter_context(tempfile.TemporaryFile("w+"))
                process = subprocess.Popen(
                    waiting.pop(name),
                    cwd=Path(__file__).parents[1],
                    env=environment_of_tests(options),
                    stdout=log,
                    stderr=log,
                    text=True,
                )
                stack.callback(process.wait)
                stack.callback(process.kill)
                running[name] = (process, log)
            ended = [name for name, (process, _) in running.items() if process.poll() is not None]
            for name in ended:
                has_compiled = True
                process, log = running.pop(name)
                log.seek(0)
                said = log.read()
                # The part `tests` checks that tests pass.
                if process.returncode != 0 and name != _TESTS:
                    failed.append(f"{name} ended with {process.returncode}:\n{said[-3000:]}")
                    continue
                yield Row(
                    f"{name}: kernels compiled and loaded",
                    f"after {time.monotonic() - begin:.0f} s",
                    said.strip().rpartition("\n")[2],
                    "",
                    None,
                )
            time.sleep(0.2)
    if failed:
        raise RuntimeError("\n".join(failed))


def _commands(options: Options) -> dict[str, list[str]]:
    """Return a command per task, and one that makes the steps of the tests."""
    num_envs = str(options.sized(64, 2))
    commands = {
        task: [sys.executable, "-m", "gpu_parts.kernels", task, options.device, num_envs]
        for task in options.sized(_TASKS, (CARTPOLE,))
    }
    if not options.tiny and not missing_for_tests():
        commands[_TESTS] = pytest_command(options)
    return commands


def _compile(task: str, device: str, num_envs: int) -> None:
    import torch

    from gpu_parts.device import wait

    begin = time.perf_counter()
    env = make_env(task, num_envs, device)
    actions = torch.zeros(num_envs, env.action_manager.total_action_dim, device=device)
    env.step(actions)
    wait(device)
    first = time.perf_counter()
    for _ in range(5):
        env.step(actions)
    # Resets of some environments and their randomization.
    env.reset(env_ids=torch.tensor([0], device=device))
    wait(device)
    env.close()
    after = time.perf_counter() - first
    print(f"built, reset and stepped once in {first - begin:.1f} s; five more steps {after:.1f} s")


if __name__ == "__main__":
    _compile(sys.argv[1], sys.argv[2], int(sys.argv[3]))
