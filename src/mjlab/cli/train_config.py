"""Flags of `train`, and checks that run before anything is built."""

from __future__ import annotations

import dataclasses
import math
import os
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from mjlab.cli.flags import is_given, parse_for_run, with_task_options
from mjlab.cli.resume import run_to_continue
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import EvaluationCfg, RslRlBaseRunnerCfg
from mjlab.rl.distributed import STORE_VARIABLE
from mjlab.rl.learners import Learner, learner_of
from mjlab.runs import Run
from mjlab.runs.settings import differences
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.gpu import select_gpus
from mjlab.utils.logging import print_notice
from mjlab.utils.os import to_plain
from mjlab.utils.processes import ProcessRank, process_rank
from mjlab.utils.random import process_seed
from mjlab.utils.ranges import Count, CountOrZero, Range, check_ranges
from mjlab.utils.screen import shown
from mjlab.utils.wandb import check_wandb_login
from mjlab.viewer.page_server import check_address

# Fields of an environment config that enter the return of an episode: terms, and number and scale
# of the rewards. Curricula may change the weights of rewards.
_OF_RETURNS = (
    "rewards.", "curriculum.", "terminations.", "decimation", "sim.mujoco.timestep",
    "episode_length_s", "scale_rewards_by_dt",
)  # fmt: skip


@dataclass
class TrainConfig:
    """Flags of `train`."""

    env: ManagerBasedRlEnvCfg
    """Environment."""
    agent: RslRlBaseRunnerCfg
    """Learner."""
    profile: str | None = field(default=None, metadata=shown("run", "NAME"))
    """Task profile, such as `cpu`, that sets the defaults of all other flags; listed by `list-envs`.
    None: the defaults of the task, or the profile of the resumed run."""
    learner: Learner | None = field(
        default=None, metadata=shown("run", "ppo|sac|distillation", "learner_name")
    )
    """Learner: `ppo`, `sac` (soft actor-critic with a replay buffer) or `distillation` (a student of
    --agent.teacher-checkpoint). Determines the flags under --agent. None: learner of the resumed run, or
    of the profile or task."""
    num_envs: Count | None = field(default=None, metadata=shown("run", "N", "env.scene.num_envs"))
    """Number of environments per process; short for --env.scene.num-envs."""
    seed: Annotated[int, Range(-1, 2**32 - 1)] | None = field(
        default=None, kw_only=True, metadata=shown("run", "N", "agent.seed")
    )
    """Seed of the run and its environments; short for --agent.seed."""
    device: str | None = field(default=None, metadata=shown("run", "cpu|cuda:0"))
    """Torch device: cpu, cuda:0, ... None: a GPU if available; one GPU per process in multi-GPU runs."""
    engine: Literal["auto", "native", "warp"] | None = field(
        default=None, metadata=shown("run", "auto|native|warp", "env.sim.engine")
    )
    """Physics engine; short for --env.sim.engine."""
    video: bool = field(default=False, metadata=shown("watch"))
    """Record clips while training."""
    video_length: CountOrZero = 200
    """Number of frames per clip."""
    video_interval: Count = 2000
    """Number of environment steps between the starts of clips."""
    result_video: bool = field(default=False, metadata=shown("watch"))
    """Record a clip of the trained policy at the end."""
    enable_nan_guard: bool = field(default=False, metadata=shown("task"))
    """Dump the states that led to a NaN."""
    log_root: str = field(default="logs/rsl_rl", metadata=shown("save", "DIR"))
    """Root folder of all runs."""
    like: str | None = field(default=None, kw_only=True)
    """Run with the settings to start a new run with: its folder, or a checkpoint in it."""
    as_registered: bool = field(default=False, kw_only=True)
    """Resume with the task as registered today, without the settings of the run."""
    torchrunx_log_dir: str | None = None
    """Folder for the output of processes other than the first. None: `torchrunx` in the run folder;
    empty: discard the output. The environment variable TORCHRUNX_LOG_DIR takes precedence."""
    wandb_run_path: str | None = None
    """Weights & Biases run to resume, as entity/project/run. Requires --agent.resume True."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of the Weights & Biases run. None: newest."""
    grace: Annotated[float, Range(0.0, threading.TIMEOUT_MAX)] | None = field(
        default=None, kw_only=True
    )
    """Seconds after Ctrl-C or SIGTERM in which the running iteration may finish; after them, or at a second
    signal, training stops with the one before. None: as long as it takes. For job queues that kill what
    still runs some time after a signal."""
    live: bool = field(default=False, metadata=shown("watch"))
    """Serve a page in the browser that shows the policy during training."""
    live_port: int = field(default=8080, metadata=shown("watch", "N"))
    """Port of the live page; the next free port if taken."""
    live_host: str = field(default="127.0.0.1", kw_only=True)
    """Address of the live page. 0.0.0.0: all interfaces."""
    gpu_ids: list[int] | Literal["all"] | None = field(
        default_factory=lambda: [0], metadata=shown("run", "[0,1]|all")
    )
    """GPU indices, or `all`, used without --device; with several, one process per GPU is started.
    None: train on the CPU."""

    @staticmethod
    def from_task(
        task: str, profile: str | None = None, learner: Learner | None = None
    ) -> TrainConfig:
        """Return the registered configuration of a task under a profile.

        `learner` overrides the learner of the task or profile.
        """
        return TrainConfig(
            env=load_env_cfg(task, profile=profile),
            agent=load_rl_cfg(task, profile=profile, learner=learner),
            profile=profile,
            learner=learner,
        )

    @property
    def experiment_folder(self) -> Path:
        """Folder of the runs."""
        return Path(self.log_root).resolve() / self.agent.experiment_name

    @property
    def learner_name(self) -> Learner:
        """Learner configured by `agent`."""
        return learner_of(self.agent)

    def apply_short_forms(self, rank: ProcessRank) -> None:
        """Copy the short flags to `env`, and the seed of this process to `env` and `agent`."""
        if self.num_envs is not None:
            self.env.scene.num_envs = self.num_envs
        if self.engine is not None:
            self.env.sim.engine = self.engine
        if self.enable_nan_guard:
            self.env.sim.nan_guard.enabled = True
        self.agent.seed = process_seed(self.agent.seed, rank.rank)
        self.env.seed = self.agent.seed


def parse_train_flags(task: str, flags: list[str], prog: str) -> TrainConfig:
    """Return the configuration of `task` updated by `flags`; exits on an unknown flag.

    Raises:
        UnknownProfileError: unknown profile.
        ValueError: the learner is unknown, or not supported by the task.
    """

    def make_default(run: Run | None, **choices: Any) -> TrainConfig:
        if run is None:
            return with_task_options(TrainConfig.from_task(task, **choices), task)
        # All processes parse the flags; our launcher has printed the messages before.
        if STORE_VARIABLE not in os.environ and process_rank().is_first:
            _report_choices(task, run, choices)
        choices = {"profile": run.profile, "learner": run.learner, **choices}
        resolved = run.cfg("train", **choices)
        cfg = TrainConfig(env=resolved.env, agent=resolved.agent, **choices)
        return with_task_options(cfg, task, run)

    return parse_for_run(make_default, lambda cfg: run_to_continue(task, cfg), flags, prog)


def _report_choices(task: str, run: Run, requested: Mapping[str, Any]) -> None:
    """Print the profile and the learner of a run, unless requested or the default."""
    if "profile" not in requested and run.profile is not None:
        print_notice(f"Resuming with the profile {run.profile!r}, as before; --profile overrides.")
    default = learner_of(load_rl_cfg(task, profile=requested.get("profile", run.profile)))
    if "learner" not in requested and run.learner not in (None, default):
        print_notice(f"Resuming with the learner {run.learner!r}, as before.")


def check_flags(cfg: TrainConfig, typed: Collection[str]) -> None:
    """Raise UserError or ValueError for flags that are invalid before anything is built.

    `typed` are the paths of the settings that the user typed, such as `agent.algorithm.gamma`.
    """
    check_ranges(cfg, typed)
    _check_relations(cfg)
    run_name = cfg.agent.run_name
    if "/" in run_name or "\\" in run_name:
        print_notice(
            f"--agent.run-name: expected a name without path separators, got {run_name!r}; `play` and "
            "--agent.resume do not find this run. Use --agent.experiment-name to group runs."
        )
    root, folder = Path(cfg.log_root).resolve(), os.path.normpath(cfg.experiment_folder)
    if not Path(folder).is_relative_to(root):
        print_notice(
            f"--agent.experiment-name: expected a folder in --log-root {root}, got {folder}; `play` does not "
            "find this run, and --agent.resume only with this name. Use --log-root for another folder."
        )
    if cfg.agent.logger == "wandb":
        check_wandb_login("--agent.logger wandb", records=True)
    if cfg.live:
        check_address(cfg.live_host, cfg.live_port, "--live-")


def check_typed_flags(cfg: TrainConfig, flags: list[str]) -> None:
    """Print a notice for each flag on the command line that is ignored.

    Raises:
        BadCallError: GPUs are selected and not visible, or together with a device.
    """
    for flag in ("--wandb-run-path", "--agent.load-run", "--agent.load-checkpoint"):
        if is_given(flag, flags) and not cfg.agent.resume:
            print_notice(f"{flag} is ignored by a new run; use --agent.resume True to resume one.")
    if is_given("--wandb-checkpoint-name", flags) and cfg.wandb_run_path is None:
        print_notice("--wandb-checkpoint-name is ignored without --wandb-run-path.")
    if is_given("--env.seed", flags):
        print_notice("--env.seed is ignored: --agent.seed seeds the environments, too.")
    if is_given("--gpu-ids", flags) and cfg.gpu_ids is not None:
        if cfg.device is not None and (
            process_rank().is_alone or not cfg.device.startswith("cuda")
        ):
            raise BadCallError(
                f"--gpu-ids: expected no --device, got --device {cfg.device}; leave out one of them."
            )
        if select_gpus(cfg.gpu_ids) == (None, 0) and cfg.gpu_ids != "all":
            raise BadCallError(
                f"--gpu-ids: expected a visible GPU, got {cfg.gpu_ids} without visible GPUs; leave it "
                "out to train on the CPU."
            )
    # Class names select networks and algorithms; the task selects the runner.
    kinds = {field.name: field.default for field in dataclasses.fields(cfg.agent)}
    name = getattr(cfg.agent, "class_name", None)
    if is_given("--agent.class-name", flags) and name != kinds["class_name"]:
        print_notice(
            f"--agent.class-name: {name!r} is ignored; use runner_cls of register_mjlab_task for a "
            "runner, or --learner."
        )


def report_moved_goal(task: str, cfg: TrainConfig) -> None:
    """Print a notice if the goal of the task is a return, and `cfg` changes what enters returns."""
    registered = TrainConfig.from_task(task, cfg.profile, cfg.learner)
    goal = goal_return(cfg.agent.evaluation)
    changes = return_differences(registered.env, cfg.env)
    # Other goals are the user's.
    if changes and goal is not None and goal == goal_return(registered.agent.evaluation):
        others = f" and {len(changes) - 3} others" if len(changes) > 3 else ""
        print_notice(
            f"The goal of return {goal:g} was set for the registered rewards; {', '.join(changes[:3])}"
            f"{others} may change what a return is. Set --agent.evaluation.solved-return to match."
        )


def goal_return(evaluation: EvaluationCfg) -> float | None:
    """Return the return that decides whether the task is solved, None if the return does not."""
    if evaluation.solved_return is not None:
        return evaluation.solved_return
    by_rate = "success_rate" in {**evaluation.solved_above, **evaluation.solved_below}
    criterion = evaluation.criterion
    return criterion if by_rate and isinstance(criterion, int | float) else None


def return_differences(env: ManagerBasedRlEnvCfg, other: ManagerBasedRlEnvCfg) -> list[str]:
    """Return the names of fields that differ and enter the return, such as `rewards.alive.weight`."""
    found = (one.path.removeprefix("env.") for one in differences(env, to_plain(other), "env"))
    return [name for name in found if name.startswith(_OF_RETURNS)]


def _check_relations(cfg: TrainConfig) -> None:
    """Check numbers of mjlab's learners against each other: the policy would never be updated."""
    agent: Any = cfg.agent
    algorithm = vars(agent.algorithm)
    steps = agent.num_steps_per_env * algorithm.get("num_learning_epochs", 1)
    if (length := algorithm.get("gradient_length", -math.inf)) > steps:
        raise UserError(
            f"--agent.algorithm.gradient-length: expected at most {steps}, the steps of an iteration "
            f"times its epochs, got {length}; otherwise the policy is never updated."
        )
    total = agent.num_steps_per_env * agent.max_iterations
    if (first := algorithm.get("learning_starts", -math.inf)) > total:
        raise UserError(
            f"--agent.algorithm.learning-starts: expected at most {total}, the environment steps of "
            f"the run, got {first}; otherwise learning never starts."
        )
