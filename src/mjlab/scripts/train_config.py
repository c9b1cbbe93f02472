"""Flags of `train`, and the checks of them that need nothing built."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg
from mjlab.rl.learners import Learner, learner_of
from mjlab.scripts.flags import is_given
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.errors import BadCallError, UserError, check_count
from mjlab.utils.gpu import select_gpus
from mjlab.utils.processes import ProcessRank, process_rank
from mjlab.utils.random import process_seed
from mjlab.viewer.page_server import check_address

_AGENT_COUNTS = ("num_steps_per_env", "max_iterations", "save_interval")
_ALGORITHM_COUNTS = (
    "num_learning_epochs",
    "num_mini_batches",
    "batch_size",
    "num_updates",
    "replay_steps",
    "num_steps_return",
    "policy_delay",
    "noise_hold",
    "gradient_length",
)
_SEPARATORS = ("/", "\\")


@dataclass
class TrainConfig:
    """Flags of `train`."""

    env: ManagerBasedRlEnvCfg
    """The task."""
    agent: RslRlBaseRunnerCfg
    """The learner."""
    profile: str | None = None
    """Named settings of the task, such as `cpu`, that all other flags start from; `list-envs` shows
    which there are. None: the task's own, or where a run is resumed, that run's."""
    learner: Learner | None = None
    """Learner, which decides what flags there are under --agent.: `ppo`; `sac`, which learns from a
    replay (soft actor-critic); or `distillation`, a student of --agent.teacher-checkpoint. None: that of
    the resumed run, else that of the profile or task."""
    num_envs: int | None = None
    """Number of environments, of each process; short for --env.scene.num-envs."""
    device: str | None = None
    """Torch device: cpu, cuda:0, ... None takes a GPU where there is one; several processes take
    one each."""
    engine: Literal["auto", "native", "warp"] | None = None
    """Physics engine; short for --env.sim.engine."""
    video: bool = False
    """Record clips while training."""
    video_length: int = 200
    """Frames of a clip."""
    video_interval: int = 2000
    """Environment steps from the start of one clip to the next."""
    result_video: bool = False
    """Record a clip of the trained policy at the end."""
    enable_nan_guard: bool = False
    """Dump the states that lead to NaN."""
    log_root: str = "logs/rsl_rl"
    """Folder of all runs."""
    torchrunx_log_dir: str | None = None
    """Folder for what processes other than the first print; None is `torchrunx` in the run's
    folder, and an empty name drops it. The variable TORCHRUNX_LOG_DIR wins."""
    wandb_run_path: str | None = None
    """With --agent.resume True: the Weights & Biases run to resume, as entity/project/run."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of that run; None takes the newest."""
    live: bool = False
    """Serve a page in the browser that shows the policy as it learns."""
    live_port: int = 8080
    """Port of that page; the next free one where it is taken."""
    live_host: str = field(default="127.0.0.1", kw_only=True)
    """Address that it is served on; 0.0.0.0 serves the whole network."""
    gpu_ids: list[int] | Literal["all"] | None = field(default_factory=lambda: [0])
    """Indices of the GPUs to use where --device is not given, or `all`; with several, a process
    for each is started. None trains on the CPU."""

    @staticmethod
    def from_task(
        task: str, profile: str | None = None, learner: Learner | None = None
    ) -> TrainConfig:
        """Return the configuration that a task was registered with, under one of its profiles.

        `learner` takes the place of the one that the task or the profile chooses.
        """
        return TrainConfig(
            env=load_env_cfg(task, profile=profile),
            agent=load_rl_cfg(task, profile=profile, learner=learner),
            profile=profile,
            learner=learner,
        )

    @property
    def learner_name(self) -> Learner:
        """Learner that `agent` configures."""
        return learner_of(self.agent)

    def apply_short_forms(self, rank: ProcessRank) -> None:
        """Write the short flags into `env`, and the seed of this process into `env` and `agent`."""
        if self.num_envs is not None:
            self.env.scene.num_envs = self.num_envs
        if self.engine is not None:
            self.env.sim.engine = self.engine
        if self.enable_nan_guard:
            self.env.sim.nan_guard.enabled = True
        self.agent.seed = process_seed(self.agent.seed, rank.rank)
        self.env.seed = self.agent.seed


def check_flags(cfg: TrainConfig) -> None:
    """Raise UserError or ValueError for wrong flags that can be told without building anything."""
    _check_numbers(cfg)
    # Names that would put the run's folder elsewhere than below that of all runs.
    run_name, experiment = cfg.agent.run_name, cfg.agent.experiment_name
    if any(separator in run_name for separator in _SEPARATORS):
        raise UserError(
            f"--agent.run-name is {run_name!r}; it is part of one folder's name and may not hold "
            "a path separator. Runs are grouped by --agent.experiment-name."
        )
    if Path(experiment).is_absolute() or ".." in experiment.replace("\\", "/").split("/"):
        raise UserError(
            f"--agent.experiment-name is {experiment!r}; it names a folder within --log-root, so "
            "it may be neither absolute nor contain '..'. Choose another place with --log-root."
        )
    if cfg.live:
        check_address(cfg.live_host, cfg.live_port, "--live-")


def check_typed_flags(cfg: TrainConfig, flags: list[str]) -> None:
    """Raise BadCallError for a flag of the command line `flags` that would be ignored."""
    for flag in ("--wandb-run-path", "--agent.load-run", "--agent.load-checkpoint"):
        if is_given(flag, flags) and not cfg.agent.resume:
            raise BadCallError(
                f"{flag}: expected a run to resume, got a new one; use --agent.resume True with it."
            )
    if is_given("--wandb-checkpoint-name", flags) and cfg.wandb_run_path is None:
        raise BadCallError(
            "--wandb-checkpoint-name: expected a run at Weights & Biases, got none; use "
            "--wandb-run-path with it."
        )
    if is_given("--gpu-ids", flags) and cfg.gpu_ids is not None:
        if cfg.device is not None and (
            process_rank().is_alone or not cfg.device.startswith("cuda")
        ):
            raise BadCallError(
                f"--gpu-ids: expected no --device beside it, got {cfg.device!r}; leave out one of "
                "them."
            )
        if select_gpus(cfg.gpu_ids) == (None, 0):
            raise BadCallError(
                f"--gpu-ids: expected a GPU, got {cfg.gpu_ids} where none is visible; leave it out "
                "to train on the CPU."
            )
    # Networks and algorithms are chosen by their class names, and the runner by the task.
    kinds = {field.name: field.default for field in dataclasses.fields(cfg.agent)}
    name = getattr(cfg.agent, "class_name", None)
    if is_given("--agent.class-name", flags) and name != kinds["class_name"]:
        raise BadCallError(
            f"--agent.class-name: expected {kinds['class_name']!r}, got {name!r}, which nothing reads; "
            "use runner_cls of register_mjlab_task for a runner, or --learner."
        )


def _check_numbers(cfg: TrainConfig) -> None:
    """Refuse counts that could only fail once training runs; the environment checks its own."""
    agent: Any = cfg.agent
    counts = {f"--agent.{name}": getattr(agent, name) for name in _AGENT_COUNTS}
    for name in _ALGORITHM_COUNTS:
        # Each algorithm has some of them.
        counts[f"--agent.algorithm.{name}"] = getattr(getattr(agent, "algorithm", None), name, 1)
    gradient_length = getattr(agent.algorithm, "gradient_length", None)
    steps = agent.num_steps_per_env * getattr(agent.algorithm, "num_learning_epochs", 1)
    if gradient_length is not None and gradient_length > steps:
        raise UserError(
            f"--agent.algorithm.gradient-length: expected at most {steps}, the steps of an iteration "
            f"times its epochs, got {gradient_length}; with it nothing is learned."
        )
    learning_starts = getattr(agent.algorithm, "learning_starts", 0)
    if learning_starts > (total := agent.num_steps_per_env * agent.max_iterations):
        raise UserError(
            f"--agent.algorithm.learning-starts: expected at most {total}, the environment steps of "
            f"the run, got {learning_starts}; with it nothing is learned."
        )
    counts |= {"--video-length": cfg.video_length, "--video-interval": cfg.video_interval}
    for flag, value in counts.items():
        check_count(flag.replace("_", "-"), value)
    # An infinite bound, as of gradients, is one that is not there.
    for name, value in vars(agent.algorithm).items():
        if isinstance(value, float) and (
            math.isnan(value) or (name.endswith("learning_rate") and math.isinf(value))
        ):
            flag = f"--agent.algorithm.{name.replace('_', '-')}"
            raise UserError(f"{flag}: expected a finite number, got {value}.")
