"""Run logs: TensorBoard or Weights & Biases events, training observers, git diffs."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import os
import statistics
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rsl_rl.utils.logger import Logger

from mjlab.rl.checkpoint import ensure_writable_folder
from mjlab.rl.config import EvaluationCfg
from mjlab.rl.evaluation import Bound, EvaluationResult
from mjlab.utils.logging import beside_results
from mjlab.utils.os import replacing
from mjlab.utils.wandb import check_wandb_login

logger = logging.getLogger(__name__)

# rsl_rl's class names of logging services, accepted by the config.
_LOGGER_TYPES = {"WandbLogWriter": "wandb", "NeptuneLogWriter": "neptune"}
# Iterations after the first of a session that an estimate of the time left needs.
_MEASURED = 2
# TensorBoard shows groups of tags by name: the first one has what the task aims at.
_FIRST = "Aim"
# Folders of installed packages.
_INSTALLED = ("site-packages", "dist-packages")


@dataclass(frozen=True, kw_only=True)
class IterationStats:
    """Statistics of one finished iteration."""

    iteration: int
    """Number of iterations finished, this one included."""
    total_iterations: int
    """Total number of iterations of the run."""
    total_steps: int
    """Number of environment steps since the start of the run, over all environments."""
    collection_time: float
    """Time spent stepping the environments and the policy, in seconds."""
    learning_time: float
    """Time spent updating the policy, in seconds."""
    steps_per_second: float
    """Environment steps per second of collection and learning time."""
    time_left: float | None
    """Estimated time until the last iteration, evaluations and checkpoints included, in seconds. None
    in the first iterations of a session, which say little: the first one also warms up."""
    mean_reward: float | None
    """Mean sum of rewards, as scaled by the environment, over the last 100 finished episodes: rsl_rl's
    `Train/mean_reward`, not in the unit of evaluations. None until an episode has finished."""
    mean_episode_length: float | None
    """Mean length of the last 100 finished episodes, in environment steps. None until one finished."""
    mean_step_reward: float
    """Mean weighted reward per step of this iteration, before scaling by the step's duration."""
    exploring_return: float | None = None
    """Undiscounted return of an episode with the exploration of this iteration: `mean_step_reward`
    times `exploring_length`, in the unit of evaluations. None for endless episodes."""
    exploring_length: float | None = None
    """Expected length of an episode at this iteration's rate of failures, in environment steps. Unlike
    `mean_episode_length`, it does not wait for episodes to finish."""
    learning_rate: float
    """Learning rate after this iteration."""
    action_std: float
    """Mean standard deviation of the actions."""
    exploring: dict[str, float] = field(default_factory=dict)
    """Means of metrics over the environments after this iteration, by the names in
    `EvaluationCfg.trigger_below`."""
    losses: dict[str, float] = field(default_factory=dict)
    """Mean losses of the update, by name."""
    environment: dict[str, float] = field(default_factory=dict)
    """Means of the environment's log entries, by name (`Episode_Reward/...`, `Metrics/...`)."""


class TrainingObserver:
    """Base class of observers of `MjlabOnPolicyRunner.learn`; override the events of interest.

    Methods are called on the training thread and should be fast.
    """

    shows_progress = False
    """True for observers that show the progress of training. Without one, a runner in a notebook adds
    `mjlab.rl.progress.NotebookProgress`."""

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Handle the start of training; `first_iteration` iterations were finished before."""

    def on_iteration(self, stats: IterationStats) -> None:
        """Handle a finished iteration."""

    def on_evaluation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Handle an evaluation after `iteration` iterations; `solved` if it met all conditions.

        Training does not stop yet: `on_confirmation` follows if `stop_when_solved` is set.
        """

    def on_confirmation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Handle the second evaluation of a solved task, on unused episodes.

        If it is `solved` again, training stops.
        """

    def on_checkpoint(self, path: str) -> None:
        """Handle a written checkpoint."""

    def on_stop_requested(self, signal_name: str) -> None:
        """Handle the first SIGINT, SIGTERM or SIGHUP. An evaluation ends; an iteration still finishes."""

    def on_end(self, reason: str) -> None:
        """Handle the end of training: `finished`, `solved`, `interrupted` or `failed`."""


class RunLogger(Logger):
    """rsl_rl's logger, silent on the console and without a GPU synchronization per step.

    Step data stays on the device until `finish_iteration` reads all of it at once. Tags in the
    event files are rsl_rl's, `Train/mean_step_reward`, `Train/exploring_return` and `Train/<metric>` of
    `IterationStats.exploring`. `Aim/` repeats the returns, and the metrics of evaluations that solve the
    task, in the group that TensorBoard shows first.

    Runners with a custom loop, written against rsl_rl, call `log` instead.
    """

    def __init__(
        self,
        *args: Any,
        reward_unit: float = 1.0,
        episode_steps: float | None = None,
        **kwargs: Any,
    ) -> None:
        """Set up with rsl_rl's arguments.

        Args:
            *args: Arguments of rsl_rl.
            reward_unit: Factor from weighted rewards to those of `process_env_step` (the step's
                duration if rewards are scaled by it).
            episode_steps: Time limit of episodes, in environment steps. None: endless.
            **kwargs: Arguments of rsl_rl.
        """
        super().__init__(*args, **kwargs)
        self.logger_type: str | None = None
        """Logging service, by its config name (`tensorboard`, `wandb`, ...). None before
        `init_logging_writer`, and in processes that do not write."""
        self._reward_unit = reward_unit
        self._episode_steps = episode_steps
        self._uses_rnd = bool(self.cfg["algorithm"].get("rnd_cfg"))
        bounds = Bound.all_of(EvaluationCfg.of(self.cfg.get("evaluation")))
        self._goals = dict.fromkeys(["mean_return", *(bound.name for bound in bounds)])
        # rsl_rl's default is the repository around the virtual environment.
        self.git_status_repos = []
        # Iterations finished, and the time, at the end of the first iteration of this session.
        self._warmed_up = (0, 0.0)
        # Sums over the running episodes, and buffers of the last finished ones.
        self._episode_sums = [
            (self.cur_reward_sum, self.rewbuffer),
            (self.cur_episode_length, self.lenbuffer),
        ]
        if self._uses_rnd:
            self._episode_sums += [
                (self.cur_ereward_sum, self.erewbuffer),
                (self.cur_ireward_sum, self.irewbuffer),
            ]
        self._finished: list[tuple[torch.Tensor, ...]] = []
        self._step_rewards: list[torch.Tensor] = []
        self._failures: list[torch.Tensor] = []
        self._write_failed = False
        self._reported_losses = False
        self._thread_hook = threading.excepthook

    def init_logging_writer(self) -> None:
        """Open the event file, and write the git diffs of `git_status_repos`.

        Raises:
            RunFolderError: the run folder is not writable.
            ModuleNotFoundError: Weights & Biases is configured but not installed.
            UserError: Weights & Biases is configured, but has no login.
            ValueError: Weights & Biases did not start a run.
        """
        service = self.cfg.get("logger", "tensorboard")
        if self.log_dir is not None and not self.disable_logs:
            ensure_writable_folder(self.log_dir)
            writer = service
            if service == "wandb":
                project = self.cfg.get("wandb_project")
                writer = {"class_name": "WandbLogWriter", "project_name": project}
            self.cfg["logger"] = writer
            is_wandb = isinstance(writer, dict) and writer.get("class_name") == "WandbLogWriter"
            if is_wandb:
                check_wandb_login("logger 'wandb'", records=True)
            if is_wandb and not self.cfg.get("upload_git_diff", False):
                # wandb would upload a separate diff, of the repository around the working folder.
                os.environ.setdefault("WANDB_DISABLE_CODE", "true")
        # Hidden from rsl_rl: it would upload the diffs to any logging service.
        sources, self.git_status_repos = self.git_status_repos, []
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            try:
                super().init_logging_writer()
            except Exception as error:
                # Compared by name: wandb is imported only if it is the logging service.
                if not any(c.__module__.partition(".")[0] == "wandb" for c in type(error).__mro__):
                    raise
                reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
                raise ValueError(
                    f"Weights & Biases did not start a run: {reason}. Log in with `wandb login`, or set "
                    "WANDB_API_KEY; WANDB_MODE=offline records without an account, and "
                    "--agent.logger tensorboard does without Weights & Biases."
                ) from error
            finally:
                # Runners read the service from their config.
                self.cfg["logger"] = service
                self.git_status_repos = sources
        if self.writer is not None:
            name = service if isinstance(service, str) else service["class_name"]
            self.logger_type = _LOGGER_TYPES.get(name, name)
        if self.log_dir is not None and not self.disable_logs:
            keeps_diff = self.cfg.get("save_git_diff", True)
            for source in self.git_status_repos if keeps_diff else ():
                diff = write_git_diff(Path(self.log_dir), Path(source))
                if diff is not None and self.cfg.get("upload_git_diff", False):
                    # TensorBoard's writer has no `save_file`.
                    getattr(self.writer, "save_file", lambda path: None)(str(diff))
            # rsl_rl creates the folder in any case.
            with contextlib.suppress(OSError):
                Path(self.log_dir, "git").rmdir()
        for line in filter(None, printed.getvalue().splitlines()):
            logger.debug("%s", line)
        if self.writer is not None and threading.excepthook != self._on_thread_error:
            self._thread_hook = threading.excepthook
            threading.excepthook = self._on_thread_error

    def process_env_step(
        self,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        extras: dict[str, Any],
        intrinsic_rewards: torch.Tensor | None = None,
    ) -> None:
        """Add one step of all environments; `rewards` and `dones` have shape (num_envs,)."""
        logged = extras.get("episode", extras.get("log"))
        if logged:
            self.ep_extras.append(logged)
        self._step_rewards.append(rewards.mean())
        done = dones > 0
        # Without `time_outs` (finite horizon), every end counts.
        failed = done
        if "time_outs" in extras:
            failed = done & ~extras["time_outs"].to(done.device).bool()
        self._failures.append(failed.float().mean())
        self.cur_reward_sum += rewards
        if intrinsic_rewards is not None:
            self.cur_reward_sum += intrinsic_rewards
            self.cur_ereward_sum += rewards
            self.cur_ireward_sum += intrinsic_rewards
        self.cur_episode_length += 1
        self._finished.append((done, *(running.clone() for running, _ in self._episode_sums)))
        for running, _ in self._episode_sums:
            running.masked_fill_(done, 0.0)

    def log(self, it: int, *args: Any, **kwargs: Any) -> None:
        """Write and print iteration number `it` (from 0), for loops written against rsl_rl.

        The arguments are those of rsl_rl's `Logger.log`.
        """
        mean_step_reward, failures = self._collect_rewards()
        super().log(it, *args, **kwargs)
        scalars = {"Train/mean_step_reward": mean_step_reward}
        if self._episode_steps is not None:
            length = mean_length(failures, self._episode_steps)
            scalars["Train/exploring_return"] = mean_step_reward * length
        self.write_scalars(scalars, it)

    def finish_iteration(
        self,
        *,
        iteration: int,
        first_iteration: int,
        total_iterations: int,
        collection_time: float,
        learning_time: float,
        losses: dict[str, float],
        learning_rate: float,
        action_std: torch.Tensor,
        rnd_weight: float | None,
        exploring: dict[str, float] | None = None,
    ) -> IterationStats:
        """Write the statistics of iteration number `iteration` (from 0), and return them."""
        steps = int(self.cfg["num_steps_per_env"]) * self.num_envs * self.gpu_world_size
        duration = collection_time + learning_time
        self.tot_timesteps += steps
        self.tot_time += duration
        mean_step_reward, failures = self._collect_rewards()
        length = None if self._episode_steps is None else mean_length(failures, self._episode_steps)
        stats = IterationStats(
            iteration=iteration + 1,
            total_iterations=total_iterations,
            total_steps=self.tot_timesteps,
            collection_time=collection_time,
            learning_time=learning_time,
            steps_per_second=steps / max(duration, 1e-9),
            time_left=self._time_left(iteration + 1, first_iteration, total_iterations),
            mean_reward=statistics.fmean(self.rewbuffer) if self.rewbuffer else None,
            mean_episode_length=statistics.fmean(self.lenbuffer) if self.lenbuffer else None,
            mean_step_reward=mean_step_reward,
            exploring_return=None if length is None else mean_step_reward * length,
            exploring_length=length,
            learning_rate=learning_rate,
            action_std=action_std.mean().item(),
            losses=losses,
            exploring=exploring or {},
            environment=self._environment_means(),
        )
        self._write(stats, iteration, rnd_weight)
        return stats

    def report_broken_losses(self, stats: IterationStats) -> None:
        """Log losses that are NaN or infinite, once."""
        broken = [name for name, value in stats.losses.items() if not math.isfinite(value)]
        if broken and not self._reported_losses:
            self._reported_losses = True
            logger.warning(
                "Losses that are NaN or infinite in iteration %d: %s. Rewards or observations may be too "
                "large. This warning is logged once.", stats.iteration, ", ".join(broken),
            )  # fmt: skip

    def write_scalars(self, scalars: dict[str, float], step: int) -> None:
        """Write `scalars` at `step` (usually the iteration) to the event file, if it is open.

        A full disk does not end training here: the next checkpoint raises a clear error.
        """
        if self.writer is None or self._write_failed:
            return
        try:
            for tag, value in scalars.items():
                self.writer.add_scalar(tag, value, step)
        except OSError as error:
            self._stop_writing(error)

    def write_evaluation(
        self, result: EvaluationResult, iteration: int, group: str = "Evaluation"
    ) -> None:
        """Write the results of an evaluation after iteration number `iteration` (from 0).

        `group` is the prefix of the tags.
        """
        scalars = {"mean_return": result.mean_return, "mean_length": result.mean_length}
        if result.success_rate is not None:
            scalars["success_rate"] = result.success_rate
        if result.failure_rate is not None:
            scalars["failure_rate"] = result.failure_rate
        scalars |= {name: value.mean for name, value in result.metrics.items()}
        scalars = {f"{group}/{name}": value for name, value in scalars.items()}
        if group == "Evaluation":
            found = {name: scalars.get(f"{group}/{name}") for name in self._goals}
            scalars |= {f"{_FIRST}/{name}": v for name, v in found.items() if v is not None}
        scalars[f"Perf/{group.lower()}_time"] = result.duration
        self.write_scalars(scalars, iteration)

    def save_model(self, path: str, it: int) -> None:
        """Upload a file to the logging service, if it takes files. Failures are logged."""
        with beside_results(f"{path} to the logging service"):
            super().save_model(path, it)

    def stop_logging_writer(self) -> None:
        """Flush and close the event file."""
        with beside_results("last values to the logging service"):
            super().stop_logging_writer()
        if threading.excepthook == self._on_thread_error:
            threading.excepthook = self._thread_hook
        close = getattr(self.writer, "close", None)
        if close is None:
            return
        try:
            close()
        except OSError as error:
            logger.warning("The event file in %s was not closed: %s", self.log_dir, error)

    def state_dict(self) -> dict[str, Any]:
        """Return the state that continues the curves of a resumed run."""
        state: dict[str, Any] = {
            "total_steps": self.tot_timesteps,
            "total_time": self.tot_time,
            "rewards": list(self.rewbuffer),
            "lengths": list(self.lenbuffer),
            "reward_sums": self.cur_reward_sum.clone(),
            "episode_lengths": self.cur_episode_length.clone(),
        }
        if self._uses_rnd:
            state |= {
                "extrinsic_rewards": list(self.erewbuffer),
                "intrinsic_rewards": list(self.irewbuffer),
                "extrinsic_reward_sums": self.cur_ereward_sum.clone(),
                "intrinsic_reward_sums": self.cur_ireward_sum.clone(),
            }
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the `state_dict` of a run with the same number of environments."""
        self.load_totals(state)
        self.cur_reward_sum.copy_(state["reward_sums"])
        self.cur_episode_length.copy_(state["episode_lengths"])
        if self._uses_rnd and "extrinsic_reward_sums" in state:
            self.cur_ereward_sum.copy_(state["extrinsic_reward_sums"])
            self.cur_ireward_sum.copy_(state["intrinsic_reward_sums"])

    def load_totals(self, state: dict[str, Any]) -> None:
        """Restore the entries of `state_dict` that do not depend on the number of environments."""
        self.tot_timesteps, self.tot_time = int(state["total_steps"]), float(state["total_time"])
        if self._uses_rnd:
            if "extrinsic_rewards" not in state:
                # State of an earlier version, or without RND. rsl_rl averages the reward and its
                # parts together, so all of them start with the next episodes.
                return
            self.erewbuffer.extend(map(float, state["extrinsic_rewards"]))
            self.irewbuffer.extend(map(float, state["intrinsic_rewards"]))
        for buffer, name in ((self.rewbuffer, "rewards"), (self.lenbuffer, "lengths")):
            buffer.clear()
            buffer.extend(map(float, state[name]))

    def drop_iteration(self) -> None:
        """Forget the steps since the last `finish_iteration`."""
        self._finished.clear()
        self._step_rewards.clear()
        self._failures.clear()
        self.ep_extras.clear()

    def _collect_rewards(self) -> tuple[float, float]:
        """Read the step data: add the finished episodes.

        Returns:
            Mean weighted reward per step, and fraction of steps that ended in a failure.
        """
        if not self._finished:
            return 0.0, 0.0
        done, *sums = (torch.stack(column) for column in zip(*self._finished, strict=True))
        for (_, last), of_steps in zip(self._episode_sums, sums, strict=True):
            last.extend(of_steps[done].tolist())
        mean = torch.stack(self._step_rewards).mean().item()
        failures = torch.stack(self._failures).mean().item()
        self._finished.clear()
        self._step_rewards.clear()
        self._failures.clear()
        return mean / self._reward_unit, failures

    def _time_left(self, iteration: int, first_iteration: int, total: int) -> float | None:
        now = time.perf_counter()
        if iteration == first_iteration + 1:
            self._warmed_up = (iteration, now)
        begin, since = self._warmed_up
        if iteration >= total:
            return 0.0
        done = iteration - begin
        return None if done < _MEASURED else (now - since) / done * (total - iteration)

    def _environment_means(self) -> dict[str, float]:
        values: dict[str, list[torch.Tensor]] = {}
        for step in self.ep_extras:
            for name, value in step.items():
                tensor = torch.as_tensor(value, dtype=torch.float32, device=self.device)
                values.setdefault(name, []).append(tensor.flatten())
        self.ep_extras.clear()
        if not values:
            return {}
        means = torch.stack([torch.cat(parts).mean() for parts in values.values()]).tolist()
        names = [name if "/" in name else f"Episode/{name}" for name in values]
        return dict(zip(names, means, strict=True))

    def _write(self, stats: IterationStats, iteration: int, rnd_weight: float | None) -> None:
        scalars = {
            **stats.environment,
            **{f"Loss/{name}": value for name, value in stats.losses.items()},
            "Loss/learning_rate": stats.learning_rate,
            "Policy/mean_std": stats.action_std,
            "Perf/total_fps": int(stats.steps_per_second),
            "Perf/collection_time": stats.collection_time,
            "Perf/learning_time": stats.learning_time,
            **{f"Train/{name}": value for name, value in stats.exploring.items()},
            "Train/mean_step_reward": stats.mean_step_reward,
        }
        if stats.exploring_return is not None:
            scalars["Train/exploring_return"] = stats.exploring_return
            scalars[f"{_FIRST}/exploring_return"] = stats.exploring_return
        aims = {name: v for name, v in stats.exploring.items() if name in self._goals}
        scalars |= {f"{_FIRST}/exploring_{name}": value for name, value in aims.items()}
        over_time = {}
        if stats.mean_reward is not None and stats.mean_episode_length is not None:
            scalars["Train/mean_reward"] = stats.mean_reward
            scalars["Train/mean_episode_length"] = stats.mean_episode_length
            # Weights & Biases has a single step counter and a built-in time axis.
            if self.logger_type != "wandb":
                over_time["Train/mean_reward/time"] = stats.mean_reward
                over_time["Train/mean_episode_length/time"] = stats.mean_episode_length
            if self._uses_rnd:
                scalars["Rnd/mean_extrinsic_reward"] = statistics.fmean(self.erewbuffer)
                scalars["Rnd/mean_intrinsic_reward"] = statistics.fmean(self.irewbuffer)
        if rnd_weight is not None:
            scalars["Rnd/weight"] = rnd_weight
        self.write_scalars(scalars, iteration)
        self.write_scalars(over_time, int(self.tot_time))

    def _stop_writing(self, error: BaseException | None) -> None:
        if not self._write_failed:
            self._write_failed = True
            logger.warning("Metrics are no longer written to %s: %s", self.log_dir, error)

    def _on_thread_error(self, args: threading.ExceptHookArgs) -> None:
        # TensorBoard writes in a thread; its traceback would precede the error that it causes.
        is_writer = type(args.thread).__module__.startswith("tensorboard.")
        if is_writer and issubclass(args.exc_type, OSError):
            self._stop_writing(args.exc_value)
        else:
            self._thread_hook(args)


def mean_length(failures: float, limit: float) -> float:
    """Return the expected length of an episode, in steps.

    With failures of probability p per step, independent of time, and a time limit of T steps:
    (1 - (1 - p)^T) / p.

    Args:
        failures: Probability p of a failure in a step.
        limit: Time limit T.
    """
    if failures <= 0.0:
        return limit
    if failures >= 1.0:
        return 1.0
    return -math.expm1(limit * math.log1p(-failures)) / failures


def write_git_diff(run_dir: Path, source: Path) -> Path | None:
    """Write the git state of the repository of `source` to `git/<repository>.diff`.

    Uncommitted changes are logged. Returns the file; None if it exists already, or if `source` is
    outside a repository, such as that of an installed package.
    """
    # A virtual environment within a checkout is not part of it.
    if any(part in _INSTALLED for part in source.parts):
        return None
    root = _git(source.parent, "rev-parse", "--show-toplevel").strip()
    commit = _git(source.parent, "rev-parse", "--verify", "HEAD").strip()
    path = run_dir / "git" / f"{Path(root).name}.diff"
    if not root or not commit or path.exists():
        return None
    status, diff = _git(Path(root), "status"), _git(Path(root), "diff", "--no-ext-diff", "HEAD")
    path.parent.mkdir(parents=True, exist_ok=True)
    text = (
        f"--- git commit ---\n{commit}\n\n\n--- git status ---\n{status} \n\n\n--- git diff ---\n"
    )
    with replacing(path) as file:
        file.write((text + diff).encode(errors="replace"))
    if diff:
        logger.info(
            "Uncommitted changes of %s are saved in %s; --agent.save-git-diff False disables this.",
            root,
            path,
        )
    return path


def _git(folder: Path, *arguments: str) -> str:
    """Return the output of git; an empty string if it fails or is not installed."""
    try:
        result = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
        )
    except OSError:
        return ""
    return result.stdout if result.returncode == 0 else ""
