"""Lines printed before and after training, and the files written at its end."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mjlab
from mjlab.cli.flags import prepare_env_cfg, profile_to_suggest
from mjlab.cli.record import VideoCfg, record_policy
from mjlab.runs import Checkpoint, Run
from mjlab.runs.reference import parts_of
from mjlab.sim.divergence import mujoco_warnings
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.logging import beside_results
from mjlab.utils.os import files_in
from mjlab.utils.string import command_line, counted
from mjlab.viewer.viewer_config import ViewerConfig

if TYPE_CHECKING:
    from mjlab.cli.train_config import TrainConfig
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.utils.processes import ProcessRank

_LOG_ROOT = "logs/rsl_rl"
# Pixels of a clip of the result.
_WIDTH, _HEIGHT = 640, 360


def print_heading(task: str, cfg: TrainConfig, env: Any, rank: ProcessRank) -> None:
    """Print the task, the number of environments and the physics."""
    under = f", profile {cfg.profile}" if cfg.profile else ""
    under += "" if cfg.learner_name == "ppo" else f", learner {cfg.learner_name}"
    each = "" if rank.is_alone else f" in each of {rank.world_size} processes"
    print(f"Task:    {task}, {counted(env.num_envs, 'environment')}{each}{under}")
    print(f"Physics: {env.unwrapped.sim.capabilities.description}", flush=True)


def report_divergence(env: ManagerBasedRlEnv) -> None:
    """Print the number of diverged environments, and MuJoCo's warnings."""
    episodes = int(env.nan_resets.sum())
    if episodes > 0:
        environments = int((env.nan_resets > 0).sum())
        print(
            f"Diverged: the physics of {environments} of {counted(env.num_envs, 'environment')}, in "
            f"{counted(episodes, 'episode')} (Simulation/nan_resets)"
        )
    for kind, times in mujoco_warnings().items():
        print(f"MuJoCo warned {counted(times, 'time')}: {kind}")


def write_results(
    task: str, cfg: TrainConfig, run_dir: Path, device: str, ended: str | None = None
) -> None:
    """Plot the learning curve, record the trained policy if `cfg.result_video`, and list the files.

    The last lines are commands for the next step, which depend on the stop reason `ended`.
    """
    from mjlab.rl.plot import plot_run

    # A run solved at resume has no iterations.
    with beside_results("learning curve"), contextlib.suppress(ValueError):
        plot_run(parts_of(run_dir), title=task, evaluation=cfg.agent.evaluation)
    run = Run(run_dir, task)
    checkpoint = run.newest
    if cfg.result_video and checkpoint is not None:
        with beside_results("video"):
            _record_result(task, cfg, run, checkpoint, device)
    print(f"Saved in {_short(run_dir)}:")
    for pattern in ("model_*.pt", "*.onnx", "*.png", "videos/**/*.mp4"):
        files = sorted(files_in(run_dir, pattern), key=lambda path: path.stat().st_mtime)
        if files:
            print(f"    {files[-1].relative_to(run_dir)}")
    print("Next:")
    for line in next_commands(task, cfg, run_dir, ended):
        print(f"    {line}")
    if (better := command_that_learns(task, cfg, device, ended)) is not None:
        number = counted(cfg.env.scene.num_envs, "environment")
        print(f"Settings for this machine (this run: defaults of the task, {number}):")
        print(f"    {better}")


def _record_result(
    task: str, cfg: TrainConfig, run: Run, checkpoint: Checkpoint, device: str
) -> None:
    """Record a clip of the trained policy, large enough for a page unless the task sets a size."""
    env_cfg = run.cfg("play").env
    prepare_env_cfg(task, cfg, env_cfg, checkpoint.path)
    size, default = env_cfg.viewer, ViewerConfig()
    video = VideoCfg(profile=cfg.profile)
    if (size.width, size.height) == (default.width, default.height):
        video = replace(video, width=_WIDTH, height=_HEIGHT)
    record_policy(task, env_cfg, checkpoint, run.folder / "videos", device, video)


def command_that_learns(task: str, cfg: TrainConfig, device: str, ended: str | None) -> str | None:
    """Return the command with the profile for this machine.

    None: the task is solved, has no such profile, or a profile or number of environments was set.
    """
    profile = profile_to_suggest(task, cfg.profile, device)
    is_default = cfg.env.scene.num_envs == load_env_cfg(task).scene.num_envs
    if profile is None or ended == "solved" or not is_default:
        return None
    return _line(["train", task, "--profile", profile])


def next_commands(task: str, cfg: TrainConfig, run_dir: Path, ended: str | None) -> list[str]:
    """Return the commands that watch, score and, if interrupted, resume the run in `run_dir`.

    The run records its settings, so only flags of the machine are repeated.
    """
    root = [] if cfg.log_root == _LOG_ROOT else ["--log-root", cfg.log_root]
    machine = [
        word
        for flag, value in (("--device", cfg.device), ("--engine", cfg.engine))
        if value is not None
        for word in (flag, value)
    ]
    resume, flags = [*root, *machine], root
    # The commands look for the newest policy in the experiment of the task.
    if cfg.agent.experiment_name != load_rl_cfg(task).experiment_name:
        resume += ["--agent.experiment-name", cfg.agent.experiment_name]
        newest = Run(run_dir).newest
        flags = ["--checkpoint-file", str(_short(run_dir if newest is None else newest.path))]
    commands = [["play", task, *flags], ["evaluate", task, *flags]]
    if ended == "interrupted":
        commands.insert(0, ["train", task, *resume, "--agent.resume", "True"])
    return [_line(command) for command in commands]


def _line(command: list[str]) -> str:
    """Return a command line, by the user's script if that was called: it may register the task."""
    script = Path(sys.argv[0])
    is_own = script.suffix == ".py" and Path(mjlab.__file__).parent not in script.resolve().parents
    program = ["python", sys.argv[0]] if is_own else ["mjlab"]
    return command_line(["uv", "run", *program, *command])


def _short(path: Path) -> Path:
    """Return `path` relative to the working folder if it is inside."""
    path = path.resolve()
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
