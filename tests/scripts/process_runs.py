"""Parallel runs of `train`, in processes forked from one that has torch imported."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from commands import TASK

SMALL = (
    "--num-envs", "4", "--device", "cpu", "--agent.num-steps-per-env", "4", "--agent.seed", "7",
    "--agent.save-interval", "1", "--agent.actor.obs-normalization", "True",
)  # fmt: skip
_PATIENCE = 90.0
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    ["mjlab.scripts.train", "mjlab.rl.runner", "mjlab.envs.manager_based_rl_env", "mjlab.sim"]
)


@dataclasses.dataclass
class Ended:
    """Result of one process."""

    status: int
    out: str
    err: str


class ProcessRun:
    """Several processes that train together; `patch` names a function of this module."""

    def __init__(
        self, folder: Path, *flags: str, patches: Sequence[str] = (), count: int = 2
    ) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        # A new file, as of each launcher: a forked process ends without destructors, so it may leave the
        # file of its own run, in which all processes have joined already.
        descriptor, store = tempfile.mkstemp(prefix="store-", dir=folder)
        os.close(descriptor)
        argv = [TASK, *SMALL, "--log-root", str(folder / "logs"), *flags]
        shared = {
            "MJLAB_PROCESS_STORE": store,
            "WORLD_SIZE": str(count),
            "LOCAL_WORLD_SIZE": str(count),
            "OMP_NUM_THREADS": "1",
        }
        self.processes = [
            _CONTEXT.Process(
                target=_train,
                args=(folder, argv, {**shared, "RANK": str(i), "LOCAL_RANK": str(i)}, patches),
            )
            for i in range(count)
        ]
        for process in self.processes:
            process.start()

    def runs(self) -> list[Path]:
        """Return the run folders, oldest first."""
        return sorted((self.folder / "logs").glob("cartpole/*/"))

    def send(self, rank: int, number: signal.Signals) -> None:
        """Send a signal to one of the processes."""
        pid = self.processes[rank].pid
        assert pid is not None
        os.kill(pid, number)

    def end(self) -> list[Ended]:
        """Wait for all processes, and return how they ended."""
        for process in self.processes:
            process.join(_PATIENCE)
        for process in self.processes:
            if process.is_alive():
                process.kill()
                process.join()
        return [
            Ended(
                process.exitcode if process.exitcode is not None else -1,
                (self.folder / f"out_{rank}").read_text(),
                (self.folder / f"err_{rank}").read_text(),
            )
            for rank, process in enumerate(self.processes)
        ]

    def probe(self, rank: int) -> dict[str, Any]:
        """Return what process `rank` held after its last iteration."""
        return torch.load(self.folder / f"probe_{rank}.pt")


def _train(
    folder: Path, argv: list[str], variables: dict[str, str], patches: Sequence[str]
) -> None:
    os.environ.update(variables)
    rank = int(variables["RANK"])
    for number, name in ((1, f"out_{rank}"), (2, f"err_{rank}")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
    sys.argv = ["train", *argv]
    torch.set_num_threads(1)
    _probe(folder, rank)
    for patch in patches:
        globals()[patch](folder, rank)
    from mjlab.scripts.train import main

    main()


def _probe(folder: Path, rank: int) -> None:
    """Write down, after training, what the process holds."""
    from mjlab.rl import runner as module

    learn, save = module.MjlabOnPolicyRunner.learn, module.save_checkpoint
    saved: list[str] = []

    def save_and_note(data, path):
        saved.append(Path(path).name)
        save(data, path)

    def learn_and_note(self, *args, **kwargs):
        learn(self, *args, **kwargs)
        held = {
            "weights": {**self.alg.actor.state_dict(), **_prefixed(self.alg.critic.state_dict())},
            "learning_rate": self.alg.learning_rate,
            "seed": self.cfg["seed"],
            "env_seed": self.env.cfg.seed,
            "qpos": self.env.unwrapped.sim.data.qpos.clone(),
            "draw": torch.rand(4),
            "saved": saved,
            "iterations": self.current_learning_iteration,
            "total_steps": self.logger.tot_timesteps,
            "threads": self.env.unwrapped.sim.capabilities.num_threads,
        }
        torch.save(held, folder / f"probe_{rank}.pt")

    module.save_checkpoint = save_and_note
    module.MjlabOnPolicyRunner.learn = learn_and_note  # ty: ignore


def _prefixed(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {f"critic.{name}": value for name, value in state.items()}


def fail_while_training(folder: Path, rank: int) -> None:
    """Let process 1 fail in its sixth step."""
    from mjlab.envs import ManagerBasedRlEnv

    step = ManagerBasedRlEnv.step

    def failing(self, action):
        if rank == 1 and self.common_step_counter == 5:
            raise ValueError("the robot of process 1 fell off the table")
        return step(self, action)

    ManagerBasedRlEnv.step = failing  # ty: ignore


def fail_while_building(folder: Path, rank: int) -> None:
    """Let process 1 fail when it makes its environment."""
    from mjlab.scripts import train

    build = train.training_env

    def failing(*args):
        if rank == 1:
            raise ValueError("no room in process 1")
        return build(*args)

    train.training_env = failing


def count_lookups(folder: Path, rank: int) -> None:
    """Write down every look for the checkpoint to resume."""
    from mjlab.scripts import train

    look = train.checkpoint_to_resume

    def counting(task, cfg):
        found = look(task, cfg)
        with contextlib.ExitStack() as stack:
            file = stack.enter_context((folder / "lookups").open("a"))
            file.write(f"{rank} {found} {len(list((folder / 'logs').glob('cartpole/*/')))}\n")
        return found

    train.checkpoint_to_resume = counting
