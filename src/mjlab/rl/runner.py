"""On-policy runner: rollout, update, evaluation, checkpoints and exact resume.

`MjlabOnPolicyRunner.learn` is the training loop. Checkpoint files are written by
`mjlab.rl.checkpoint`, evaluations run by `mjlab.rl.evaluation`, policies exported by
`mjlab.rl.exporter_utils`.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import secrets
import signal
import time
import warnings
from collections.abc import Generator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from mjlab.rl.checkpoint import (
    RunRescue,
    capture_training_state,
    check_terms,
    copied,
    load_algorithm,
    load_checkpoint,
    migrate,
    naming_checkpoint,
    override_algorithm,
    restore_lasting_state,
    restore_training_state,
    save_checkpoint,
    set_deviation,
    start_episodes,
    term_shapes,
)
from mjlab.rl.config import EvaluationCfg
from mjlab.rl.distributed import join_processes
from mjlab.rl.evaluation import (
    EvaluationResult,
    EvaluationStopped,
    SolvedCheck,
    reward_unit,
    time_limit,
)
from mjlab.rl.exporter_utils import export_to_onnx, export_with_metadata, get_base_metadata
from mjlab.rl.networks import (
    MODELS,
    check_mini_batches,
    deduplicate_parameters,
    prepare_train_cfg,
)
from mjlab.rl.progress import NotebookProgress, ProgressCfg, in_notebook
from mjlab.rl.replay import ReplayFiles, ReplayStorage
from mjlab.rl.rollout_watch import RolloutWatch
from mjlab.rl.run_logger import IterationStats, RunLogger, TrainingObserver
from mjlab.rl.schedule import Schedule
from mjlab.utils.errors import UserError
from mjlab.utils.memory import check_memory
from mjlab.utils.processes import process_rank
from mjlab.utils.random import process_seed, seed_rng, session_seed
from mjlab.utils.signals import Interrupted, StopRequest
from mjlab.utils.torch import torch_threads, using_torch_threads

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg

logger = logging.getLogger(__name__)


class MjlabOnPolicyRunner(OnPolicyRunner):
    """Runner that trains a policy with rsl_rl's algorithms.

    Unlike rsl_rl's runner, it counts total iterations: `learn(10)` is equal, bit for bit, to
    `learn(5)`, `load` in a new process, and `learn(10)`. Progress goes to `observers` instead of the
    console; in a notebook, it is shown in one output.

    Two numbers name an iteration. `done` counts those finished: `current_learning_iteration`,
    observers, messages, `iterations_finished` of checkpoints. `index`, one less, counts from 0 as in
    rsl_rl: names of checkpoints, event files, `iter` of checkpoints.

    After `learn`, `stop_reason` is `finished`, `solved`, `interrupted` (by the signal `stop_signal`)
    or `failed`, and `last_evaluation` is the result of the last evaluation, if any. In a solved run,
    that is the confirming evaluation.
    """

    grace: float | None = None
    """Time after the first stop signal (s): the running iteration is given up if it takes longer. None:
    unlimited."""

    # Any: environments have attributes that rsl_rl's `VecEnv` lacks (`unwrapped`).
    env: Any

    # True in subclasses whose `save` exports the policy.
    exports_on_save = False

    def __init__(
        self, env: VecEnv, train_cfg: dict, log_dir: str | None = None, device: str = "cpu"
    ) -> None:
        """Build networks and algorithm.

        Args:
            env: Environments.
            train_cfg: A `RslRlOnPolicyRunnerCfg` as a dict; edited here and by rsl_rl.
            log_dir: Run folder. None: no files are written.
            device: Device of the networks.

        Raises:
            ValueError: the policy has no distribution to explore with, or rsl_rl cannot build the
                networks.
        """
        prepare_train_cfg(env, train_cfg)
        for model in MODELS:
            widths = train_cfg.get(model, {}).get("hidden_dims") or ()
            weights = sum(abs(a * b) for a, b in pairwise((1, *widths)))
            check_memory(f"agent.{model} weights", weights, 4, device, "smaller hidden_dims")
        # Allocated memory is taken only when it is written to, in the first iteration.
        check_memory(
            "agent num_steps_per_env", train_cfg["num_steps_per_env"], env.get_observations().bytes(),
            device, "fewer steps or environments",
        )  # fmt: skip
        # rsl_rl prints networks and observation sets.
        with contextlib.redirect_stdout(io.StringIO()) as printed, warnings.catch_warnings():
            # Of shared encoders.
            warnings.filterwarnings("ignore", message=".*duplicate parameters")
            super().__init__(env, train_cfg, log_dir, device)
        logger.debug("%s", printed.getvalue().rstrip())
        deduplicate_parameters(self.alg.optimizer)
        # Without it, the settings are left alone: runners and terms of packages may change them.
        points = self.cfg.get("annealing")
        name = "RslRlOnPolicyRunnerCfg.annealing"
        self._annealing = None if points is None else Schedule(name, points)
        # rsl_rl's PPO may have no desired divergence, its distillation has neither.
        values = {name: getattr(self.alg, name, None) for name in ("desired_kl", "entropy_coef")}
        self._annealed = {name: value for name, value in values.items() if value is not None}
        self.logger: RunLogger = RunLogger(
            log_dir=log_dir,
            cfg=self.cfg,
            env_cfg=self.env.cfg,
            num_envs=self.env.num_envs,
            is_distributed=self.is_distributed,
            gpu_world_size=self.gpu_world_size,
            gpu_global_rank=self.gpu_global_rank,
            device=self.device,
            reward_unit=reward_unit(self.env),
            episode_steps=time_limit(self.env),
        )
        self.task: str | None = None
        """Name of the task, recorded in checkpoints."""
        self.observers: list[TrainingObserver] = []
        self.stop_reason: str | None = None
        self.stop_signal: signal.Signals | None = None
        self.last_evaluation: EvaluationResult | None = None
        self._observations: TensorDict | None = None
        # Part of the identity of checkpoints: which states are of the same training.
        self._token = secrets.token_hex(4)
        self._state_to_resume: dict[str, Any] | None = None
        self._resumed_from = ""
        # Seed of the numbers drawn after a resume. None: the generators are restored.
        self._new_seed: int | None = None
        self.owes_evaluation = False
        """True if an evaluation is due after the last iteration, and was not finished; in checkpoints."""
        # Path and content of the checkpoint written last.
        self._written: tuple[str, dict[str, Any]] | None = None
        evaluation = EvaluationCfg.of(self.cfg.get("evaluation"))
        self._solved_check = SolvedCheck(env, self.alg, evaluation, int(self.cfg.get("seed", 0)))
        self._num_threads = self._resolve_threads()
        # Waiting OpenMP threads slow down the threads of the physics.
        on_cpu = torch.device(self.device).type == "cpu"
        self._num_collecting_threads = 1 if on_cpu else self._num_threads
        self._watch = RolloutWatch(self.env.unwrapped, self.alg)

    # Training loop.

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train until `num_learning_iterations` iterations are finished IN TOTAL.

        Iterations before a `load` count. SIGINT, SIGTERM and SIGHUP end training after the current
        iteration; a second signal, or the end of `grace`, gives that iteration up; a third has its
        usual effect. Evaluations end within a step, and a resumed run makes up for them. In all
        cases, as at the end and before evaluations, a checkpoint for exact resume is written and the
        policy exported. After an error, weights and optimizer of the last finished iteration are in
        a checkpoint that resumes in new episodes.

        Args:
            num_learning_iterations: Total number of iterations.
            init_at_random_ep_len: Start environments at random points of their episodes, so that
                they do not reset simultaneously. Without effect if episodes are resumed.

        Raises:
            RunFolderError: the run folder is not writable, raised before any training; or it was
                deleted or moved, and the run was saved next to it.
            CheckpointError: a checkpoint could not be written.
            DivergedError: the physics diverged in most environments, or weights became NaN.
            Interrupted: with several processes, the running iteration was given up.
            BrokenTermError: a reward or a termination stayed NaN in every environment.
            ValueError: the environment returned NaN, Weights & Biases did not start a run, a student
                has no teacher, or mini-batches outnumber samples.
        """
        self._check_settings()
        first, total, reason = self.current_learning_iteration, num_learning_iterations, ""
        with self._session() as stop, RunRescue(self._run_folder) as rescue:
            observations = self._initial_observations(init_at_random_ep_len)
            self._notify("on_start", first, total)
            owed = self.owes_evaluation
            if first > 0:
                is_solved = owed and self._evaluate_solved(first, stop)
                reason = self._agree_to_stop(is_solved, stop, is_last=first >= total)
            while not reason and (index := self.current_learning_iteration) < total:
                begin = time.perf_counter()
                last = self._snapshot() if self._is_main_process else {}
                if self._run_folder is not None and index > first:
                    rescue.learned = last
                try:
                    with (
                        stop.interruptible(self._is_main_process),
                        self._watch.explaining(self.alg),
                    ):
                        observations = self._rollout(observations)
                        collected = time.perf_counter()
                        losses = self._update(observations)
                except Interrupted as stopped:
                    self._give_up(last, stopped)
                    reason = "interrupted"
                    break
                learned = time.perf_counter()
                self._observations = observations
                self.current_learning_iteration = done = index + 1
                stats = self._report(losses, collected - begin, learned - collected, first, total)
                is_due = self._solved_check.should_evaluate(stats)
                self.owes_evaluation = is_due
                rescue.check_folder(self.save, f"model_{index}.pt")
                # Before the evaluation, which may take longer than there is time for.
                is_saving = is_due or stop.requested or done == total
                if self._run_folder is not None and (
                    is_saving or index % self.cfg["save_interval"] == 0
                ):
                    self._save_checkpoint()
                    rescue.learned = None
                is_solved = is_due and self._evaluate_solved(done, stop)
                reason = self._agree_to_stop(is_solved, stop, is_last=done >= total)
            rescue.learned = None
            # Without further iterations, too: the evaluation that a resumed run made up for.
            has_news = self.current_learning_iteration > first or owed or bool(reason)
            if has_news and self.current_learning_iteration > 0 and not self._is_written:
                self._save_checkpoint()
            if total <= first and not owed:
                logger.warning(
                    "Nothing to train: the checkpoint has finished %d iterations, and max_iterations "
                    "(in total) is %d.", first, total,
                )  # fmt: skip
            self.stop_reason = reason or "finished"

    def _check_settings(self) -> None:
        """Check what only training needs: runners are also built to play, in any number of environments."""
        if not getattr(self.alg, "teacher_loaded", True):
            raise ValueError(
                "Distillation: expected a teacher, got none; use --agent.teacher-checkpoint, or "
                "load_teacher."
            )
        check_mini_batches(self.env.num_envs, self.cfg)
        # Weights and gradients, and usually two moments.
        check_memory(
            "agent trained weights",
            self._num_weights,
            8,
            self.device,
            "smaller hidden_dims",
            usual=2.0,
        )

    @contextlib.contextmanager
    def _session(self) -> Generator[StopRequest]:
        """Prepare training within the block: progress, log files, signal handlers, threads."""
        if in_notebook() and not any(observer.shows_progress for observer in self.observers):
            self.observers.append(NotebookProgress(ProgressCfg.of_runner(self)))
        self.logger.init_logging_writer()
        self.stop_reason, self.stop_signal = "failed", None
        try:
            with (
                using_torch_threads(self._num_threads),
                StopRequest(
                    lambda name: self._notify("on_stop_requested", name), self.grace
                ) as stop,
            ):
                yield stop
        except KeyboardInterrupt:
            self.stop_reason = "interrupted"
            raise
        finally:
            self.logger.stop_logging_writer()
            self._solved_check.close()
            if (close := getattr(self.alg, "close", None)) is not None:
                close()
            self._notify("on_end", self.stop_reason)

    def _initial_observations(self, init_at_random_ep_len: bool) -> TensorDict:
        """Return the initial observations: resumed ones, or those of the environments."""
        self.alg.train_mode()
        # Enabled here instead of in the wrapper, which play and evaluation use as well.
        uses_ends = isinstance(self.alg, PPO) or getattr(
            self.alg, "takes_final_observations", False
        )
        if uses_ends and hasattr(self.env, "observe_ends"):
            self.env.observe_ends()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        if self._observations is not None:
            # `learn` was called before in this process: continue the episodes.
            return self._observations
        observations = self._resumed_observations()
        if self._new_seed is not None:
            # After the generators were restored.
            seed_rng(self._new_seed)
            self._new_seed = None
        if observations is None:
            if init_at_random_ep_len:
                lengths = self.env.episode_length_buf
                self.env.episode_length_buf = torch.randint_like(
                    lengths, high=max(int(self.env.max_episode_length), 1)
                )
            observations = self.env.get_observations().to(self.device)
        self._observations = observations
        return observations

    def _resumed_observations(self) -> TensorDict | None:
        """Restore episodes and random number generators of the loaded checkpoint, if any."""
        state, self._state_to_resume = self._state_to_resume, None
        if state is None:
            if self.current_learning_iteration > 0:
                logger.warning(
                    "Episodes and random numbers restart: not contained in the checkpoint."
                )
            return None
        # A checkpoint has the episodes of the first process only.
        reason = "several processes share the run." if self.is_distributed else ""
        if not reason:
            try:
                with naming_checkpoint(self._resumed_from, ValueError):
                    return restore_training_state(
                        state, self.env, self.alg, self.logger.load_state_dict, self.device
                    )
            except ValueError as error:
                reason = f"the saved state does not fit. {error}"
        # Otherwise every session would repeat the random numbers of the first.
        seed_rng(session_seed(int(self.cfg.get("seed", 0)), self.current_learning_iteration))
        with naming_checkpoint(self._resumed_from):
            left_out = restore_lasting_state(state, self.env, self.alg)
            self.logger.load_totals(state["logger"])
        start_episodes(self.env)
        logger.warning(
            "Weights, optimizer, iteration and curricula are resumed, but episodes and random numbers "
            "restart, because %s%s", reason, f" Not resumed: {', '.join(left_out)}." * bool(left_out),
        )  # fmt: skip
        return None

    def _rollout(self, observations: TensorDict) -> TensorDict:
        """Step the environments with the exploring policy; return the observations of the next action."""
        num_steps = self.cfg["num_steps_per_env"]
        checks_nan = self.cfg.get("check_for_nan", True)
        uses_rnd = bool(self.cfg["algorithm"].get("rnd_cfg"))
        with torch.inference_mode(), using_torch_threads(self._num_collecting_threads):
            self._watch.start()
            for _ in range(num_steps):
                actions = self.alg.act(observations).to(self.env.device)
                observations, rewards, dones, extras = self.env.step(actions)
                self._watch.update()
                if checks_nan:
                    check_nan(observations, rewards, dones)
                observations = observations.to(self.device)
                rewards, dones = rewards.to(self.device), dones.to(self.device)
                credited, infos = self._bootstrapped(observations, rewards, extras)
                self.alg.process_env_step(observations, credited, dones, infos)
                intrinsic = self.alg.intrinsic_rewards if uses_rnd else None
                self.logger.process_env_step(rewards, dones, extras, intrinsic)
            self._watch.check(num_steps)
        return observations

    def _bootstrapped(
        self, observations: TensorDict, rewards: torch.Tensor, extras: dict[str, Any]
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Return rewards and extras for the algorithm, with bootstrapped time-outs for PPO.

        At a time-out, rsl_rl's PPO adds gamma V(s), with the observation s before the step. With
        final observations s', gamma V(s') is added here, and `time_outs` is cleared for these.
        """
        is_ours = isinstance(self.alg, PPO) and "time_outs" in extras
        if not is_ours or "final_observations" not in extras:
            return rewards, extras
        final = extras["final_observations"].to(self.device)
        ids = extras["final_ids"].to(self.device)
        time_outs = extras["time_outs"].to(self.device)
        # The compiled critic would be recompiled for each number of time-outs.
        critic = self.alg._raw_critic
        if critic.is_recurrent:
            # The hidden state covers all environments, and the observations before the step.
            hidden_state = critic.get_hidden_state()
            all_observations = observations.clone()
            all_observations[ids] = final
            values = critic(all_observations)[ids]
            critic.reset(hidden_state=hidden_state)
        else:
            values = critic(final)
        # A wrapper may have cleared time-outs of episodes that also terminated.
        values = values.detach().squeeze(-1) * time_outs[ids]
        rewards = rewards.index_add(0, ids, (self.alg.gamma * values).to(rewards.dtype))
        return rewards, {**extras, "time_outs": time_outs.index_fill(0, ids, False)}

    def _update(self, observations: TensorDict) -> dict[str, float]:
        """Update the networks from the rollout, which ended with `observations`; return the losses.

        rsl_rl's distillation resets the hidden state of a recurrent teacher; here it is restored.
        """
        with torch.inference_mode():
            self.alg.compute_returns(observations)
        algorithm: Any = self.alg
        if self._annealing is not None:
            factor = self._annealing.at(self.current_learning_iteration)
            for name, value in self._annealed.items():
                setattr(algorithm, name, factor * value)
        teacher = getattr(algorithm, "teacher", None)
        if teacher is None or not teacher.is_recurrent:
            return algorithm.update()
        hidden_state = teacher.get_hidden_state()
        losses = algorithm.update()
        teacher.reset(hidden_state=hidden_state)
        # Updates write to these, and the teacher's were created in inference mode.
        algorithm.last_hidden_states = (algorithm.last_hidden_states[0], None)
        return losses

    def _report(
        self,
        losses: dict[str, float],
        collection_time: float,
        learning_time: float,
        first: int,
        total: int,
    ) -> IterationStats:
        """Write the statistics of the finished iteration, and tell the observers."""
        rnd = getattr(self.alg, "rnd", None)
        stats = self.logger.finish_iteration(
            iteration=self.current_learning_iteration - 1,
            first_iteration=first,
            total_iterations=total,
            collection_time=collection_time,
            learning_time=learning_time,
            losses=losses,
            learning_rate=self.alg.learning_rate,
            action_std=self.alg.get_policy().output_std.detach(),
            rnd_weight=None if rnd is None else rnd.weight,
            exploring=self._solved_check.exploring_metrics(),
        )
        self._notify("on_iteration", stats)
        self.logger.report_broken_losses(stats)
        return stats

    def _snapshot(self) -> dict[str, Any]:
        """Return the entries of a checkpoint; further training does not change them."""
        entries = {**copied(self.alg.save()), **self._progress()}
        return {**entries, "training_state": self._training_state()}

    def _give_up(self, last: dict[str, Any], stopped: Interrupted) -> None:
        """End the running iteration early, back in the state `last` before it.

        Raises:
            Interrupted: other processes still run the iteration. The state is saved.
        """
        self.stop_signal = stopped.number
        logger.warning(
            "%s: iteration %d is given up.",
            stopped.number.name,
            self.current_learning_iteration + 1,
        )
        self.alg.load(last, None, True)
        if isinstance(self.alg.storage, RolloutStorage):
            self.alg.storage.clear()
            self.alg.transition.clear()
        self.logger.drop_iteration()
        self._observations = restore_training_state(
            last["training_state"], self.env, self.alg, self.logger.load_state_dict, self.device
        )
        if self.is_distributed:
            if self.current_learning_iteration > 0 and not self._is_written:
                self._save_checkpoint()
            raise stopped

    def _agree_to_stop(self, is_solved: bool, stop: StopRequest, is_last: bool) -> str:
        """Return the reason to stop with the highest priority among all processes, or "".

        After the last iteration, a signal interrupts nothing but the evaluation that is owed.
        """
        code, is_owed = int(is_solved), self._is_main_process and self.owes_evaluation
        if stop.number is not None and (is_owed or not is_last):
            code = 1 + stop.number
        if self.is_distributed:
            # All processes must leave the loop at the same iteration.
            shared = torch.tensor(code, device=self.device)
            torch.distributed.all_reduce(shared, op=torch.distributed.ReduceOp.MAX)
            code = int(shared.item())
        if code > 1:
            self.stop_signal = signal.Signals(code - 1)
            return "interrupted"
        return "solved" if code else ""

    # Evaluation.

    def evaluate_in(self, env_cfg: ManagerBasedRlEnvCfg) -> None:
        """Evaluate in environments of `env_cfg`, because the training environments are easier.

        Such as `load_env_cfg(task, profile="cpu", evaluate=True)`.
        """
        self._solved_check.env_cfg = env_cfg

    def evaluate(self) -> EvaluationResult:
        """Score the policy in separate environments; the run is not affected."""
        self.last_evaluation = self._solved_check.evaluate()
        return self.last_evaluation

    def _evaluate_solved(self, done: int, stop: StopRequest) -> bool:
        """Evaluate the policy after `done` iterations; return True to stop training.

        Evaluates only in the first process; False in others, and if a signal stops the evaluation.
        """
        if not self._is_main_process:
            return False
        check, solved = self._solved_check, False
        try:
            with stop.interruptible():
                result = check.evaluate(lambda: stop.requested)
            self.last_evaluation = result
            is_good = check.is_solved_by(result)
            self._notify("on_evaluation", done, result, is_good)
            self.logger.write_evaluation(result, done - 1)
            if is_good and check.cfg.stop_when_solved:
                with stop.interruptible():
                    result = check.confirm(done, lambda: stop.requested)
                self.last_evaluation, solved = result, check.is_solved_by(result)
                self._notify("on_confirmation", done, result, solved)
                self.logger.write_evaluation(result, done - 1, "Confirmation")
        except (EvaluationStopped, Interrupted):
            return False
        check.last_iteration, self.owes_evaluation = done, False
        if self._is_written and self._written is not None:
            path, content = self._written
            save_checkpoint({**content, **self._evaluation_entries()}, path)
        return solved

    # Checkpoints.

    def save(self, path: str, infos=None) -> None:
        """Write a checkpoint for exact resume; only the first process writes.

        Args:
            path: Checkpoint file; the write is atomic.
            infos: Further plain data, returned by `load`.

        Raises:
            CheckpointError: the file could not be written; an earlier file at `path` is intact.
        """
        if not self._is_main_process:
            return
        checkpoint = {**self.alg.save(), **self._progress(infos)}
        checkpoint["training_state"] = self._training_state()
        saves_replay = self.cfg["algorithm"].get("save_replay", False)
        if saves_replay:
            # First, so that the newest checkpoint has a replay even if writing is interrupted.
            storage: Any = self.alg.storage
            ReplayFiles(path).write(storage, str(checkpoint["identity"]))
        save_checkpoint(checkpoint, path)
        self._written = str(path), checkpoint
        if saves_replay:
            ReplayFiles(path).remove_others()
        if self.cfg.get("upload_model", True):
            self.logger.save_model(path, max(self.current_learning_iteration - 1, 0))

    def load(
        self,
        path: str,
        load_cfg: dict | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict:
        """Load a checkpoint of mjlab or rsl_rl, legacy layouts included.

        Args:
            path: Checkpoint file.
            load_cfg: Parts to load (`actor`, `critic`, `student`, `teacher`, `optimizer`,
                `iteration`, `rnd`).
                None: all; `learn` then also resumes the environments and the random number
                generators, if the number of environments is the same, and else the curricula.
            strict: Require every parameter to fit.
            map_location: Without effect: tensors are moved to the device of the networks.

        Returns:
            The `infos` passed to `save`.

        Raises:
            CheckpointError: the file is missing, corrupt, hostile, malformed, or of a different
                network. Nothing was changed.
        """
        return self.load_content(load_checkpoint(path), path, load_cfg=load_cfg, strict=strict)

    def load_content(
        self,
        content: Mapping[str, Any],
        path: str | os.PathLike[str],
        *,
        load_cfg: dict | None = None,
        strict: bool = True,
    ) -> dict:
        """Load a checkpoint that was read by `load_checkpoint`; see `load`.

        Args:
            content: Content of the checkpoint; not modified.
            path: Checkpoint file: for messages, and to find its replay.
            load_cfg: Parts to load; None: all.
            strict: Require every parameter to fit.
        """
        groups, replay = self.cfg.get("obs_groups") or {}, None
        networks = [name for name in groups if load_cfg is None or load_cfg.get(name)]
        storage: Any = getattr(self.alg, "storage", None)
        # The algorithm comes last, because an error must leave everything unchanged.
        with naming_checkpoint(path):
            # torch's optimizers keep the loaded tensors, and write to them.
            checkpoint = migrate(copied(content))
            check_terms(checkpoint.get("sizes"), term_shapes(self.env, groups), networks, str(path))
            if load_cfg is None and isinstance(storage, ReplayStorage):
                replay = ReplayFiles(path).read(storage, checkpoint.get("identity"))
            finished = int(checkpoint.get("iterations_finished", checkpoint.get("iter", -1) + 1))
            infos = checkpoint.get("infos") or {}
            counter = (infos.get("env_state") or {}).get("common_step_counter")
            evaluated = int(checkpoint.get("last_evaluated", 0))
        if load_algorithm(self.alg, checkpoint, load_cfg, strict, str(path)):
            self.current_learning_iteration = finished
            self._solved_check.last_iteration = evaluated
            self.owes_evaluation = bool(checkpoint.get("owes_evaluation", False))
        if counter is not None:
            self.env.unwrapped.common_step_counter = counter
        self._state_to_resume = checkpoint.get("training_state") if load_cfg is None else None
        self._resumed_from = str(path)
        if replay is not None:
            storage.load_state_dict(replay)
        self._observations = self._written = None
        self._new_seed = None
        self._token = secrets.token_hex(4)
        return infos

    def override(self, settings: Mapping[str, Any]) -> None:
        """Let settings that differ from those of the loaded run act, from the next iteration on.

        Call it after `load`, on a runner built with these settings. `load` restores the state that
        training has changed: learning rates, other settings of the optimizer, alpha, standard
        deviations, random number generators. Here this state is set again; all other settings act
        already, as the runner was built with them.

        Args:
            settings: Values by dotted name of the agent config: `algorithm.learning_rate`,
                `algorithm.weight_decay`, `actor.distribution_cfg.init_std`, `seed`, ... A `seed` draws
                new numbers; -1 is no seed.

        Raises:
            UserError: the setting cannot act, because the networks were trained with another one.
        """
        algorithm: Any = self.alg
        for name, value in settings.items():
            part, _, rest = name.partition(".")
            if part == "obs_groups":
                raise UserError(
                    f"--agent.{name.replace('_', '-')}: expected the groups that the networks were "
                    f"trained on, got {value}; leave it out, or train a new run."
                )
            if name == "seed" and value >= 0:
                seed = process_seed(int(value), self.gpu_global_rank)
                self.cfg["seed"] = seed
                self._new_seed = session_seed(seed, self.current_learning_iteration)
                if hasattr(algorithm, "override"):
                    algorithm.override("seed", self._new_seed)
            elif part == "algorithm" and hasattr(algorithm, "override"):
                algorithm.override(rest, value)
            elif part == "algorithm":
                override_algorithm(algorithm, rest, value)
            elif rest == "distribution_cfg.init_std" and hasattr(algorithm, f"_raw_{part}"):
                set_deviation(getattr(algorithm, f"_raw_{part}"), part, value)

    def load_teacher(self, path: str) -> None:
        """Load the teacher of a distillation: the policy of a PPO checkpoint.

        Raises:
            CheckpointError: the file is missing, corrupt, hostile, malformed, or of a different
                network.
        """
        checkpoint = migrate(load_checkpoint(path))
        policy = {"teacher_state_dict": checkpoint.get("actor_state_dict")}
        load_algorithm(self.alg, policy, {"teacher": True}, True, str(path))

    @property
    def _checkpoint_path(self) -> str:
        """Path of the checkpoint of this iteration in the run folder."""
        name = f"model_{self.current_learning_iteration - 1}.pt"
        return os.path.join(self._run_folder or "", name)

    @property
    def _is_written(self) -> bool:
        """True if the checkpoint of this iteration is in the run folder."""
        return self._written is not None and self._written[0] == self._checkpoint_path

    def _save_checkpoint(self) -> None:
        """Write a checkpoint and the policy as ONNX into the run folder."""
        if self._run_folder is None:
            return
        path = self._checkpoint_path
        self.save(path)
        if not self.exports_on_save:
            self.export_policy(str(self._get_export_paths(path)[2]))
        self._notify("on_checkpoint", path)

    def _progress(self, infos: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the checkpoint entries of the run's progress."""
        done = self.current_learning_iteration
        counter = getattr(self.env.unwrapped, "common_step_counter", 0)
        return {
            # Also 0 if none is finished.
            "iter": max(done - 1, 0),
            "iterations_finished": done,
            "infos": {**(infos or {}), "env_state": {"common_step_counter": int(counter)}},
            **self._evaluation_entries(),
            # Of the state, not of the file: the same if it is saved again before the next iteration.
            "identity": f"{self._token}-{done}",
            "task": self.task,
            "sizes": term_shapes(self.env, self.cfg.get("obs_groups") or {}),
        }

    def _evaluation_entries(self) -> dict[str, Any]:
        """Return the checkpoint entries that an evaluation changes."""
        return {
            "last_evaluated": self._solved_check.last_iteration,
            "owes_evaluation": self.owes_evaluation,
        }

    def _training_state(self) -> dict[str, Any]:
        """Return the checkpoint entry that exact resume needs."""
        observations = self._observations
        if observations is None:
            observations = self.env.get_observations()
        state = self.logger.state_dict()
        return capture_training_state(self.env, self.alg, state, observations)

    # Export.

    def export_policy_to_onnx(
        self, path: str, filename: str = "policy.onnx", verbose: bool = False
    ) -> None:
        """Write the policy (normalizer, network, deterministic head) to `path`/`filename`.

        Opset 18, batch size 1; input `obs`, output `actions`, clipped to `clip_actions`. Image models
        have an additional input per image group, by name; recurrent models their hidden state.
        """
        model = self.alg.get_policy().as_onnx(verbose=verbose)
        # Environments of other packages may lack it.
        limit = getattr(self.env, "clip_actions", None)
        export_to_onnx(model, Path(path) / filename, verbose, limit)

    def export_policy(self, path: str | None = None) -> str | None:
        """Write the policy as ONNX with deployment metadata.

        Args:
            path: ONNX file; None: that of `_get_export_paths`.

        Returns:
            The file, or None without a run folder or if the export failed. Failures are logged: a
            run must not fail because its policy cannot be exported.
        """
        if path is None:
            if self._run_folder is None:
                return None
            checkpoint = os.path.join(self._run_folder, "model.pt")
            path = str(self._get_export_paths(checkpoint)[2])
        if not export_with_metadata(self.export_policy_to_onnx, self.onnx_metadata, path):
            return None
        if self.cfg.get("upload_model", True):
            self.logger.save_model(path, max(self.current_learning_iteration - 1, 0))
        return path

    @staticmethod
    def _get_export_paths(checkpoint_path: str) -> tuple[Path, str, Path]:
        """Return folder, file name and path of the policy exported with a checkpoint.

        `<folder>/<folder's name>.onnx`; subclasses override it to export elsewhere.
        """
        folder = Path(checkpoint_path).resolve().parent
        name = f"{folder.name}.onnx"
        return folder, name, folder / name

    def onnx_metadata(self) -> dict[str, Any]:
        """Return the metadata that `export_policy` writes; task runners add to it."""
        folder = self.logger.log_dir
        run = Path(folder).resolve().name if folder is not None else "local"
        policy: Any = self.alg.get_policy()
        images = list(getattr(policy, "obs_groups_2d", ()))
        metadata = dict(get_base_metadata(self.env.unwrapped, run, list(policy.obs_groups)))
        return {**metadata, "image_groups": images} if images else metadata

    # Processes, threads, observers.

    def _configure_multi_gpu(self) -> None:
        """Join the process group of the run, if any. Replaces rsl_rl's method, which supports only
        GPUs."""
        rank = process_rank()
        self.is_distributed = not rank.is_alone
        self.gpu_world_size = rank.world_size
        self.gpu_global_rank = rank.rank
        self.gpu_local_rank = rank.local_rank
        self.cfg["multi_gpu"] = None
        if self.is_distributed:
            join_processes(str(self.device))
            self.cfg["multi_gpu"] = {
                "global_rank": rank.rank,
                "local_rank": rank.local_rank,
                "world_size": rank.world_size,
            }

    @property
    def _is_main_process(self) -> bool:
        """True in the first process, the only one that writes files."""
        return self.gpu_global_rank == 0

    @property
    def _run_folder(self) -> str | None:
        """Run folder; None in processes that do not write files."""
        return self.logger.log_dir if self._is_main_process else None

    def _resolve_threads(self) -> int:
        if torch.device(self.device).type != "cpu":
            return torch.get_num_threads()
        # Algorithms that learn concurrently with the physics set the number of threads.
        if (num_threads := getattr(self.alg, "num_threads", None)) is not None:
            return num_threads
        rows = self.env.num_envs * self.cfg["num_steps_per_env"]
        parts = self.cfg["algorithm"].get("num_mini_batches", 1)
        return torch_threads(self._num_weights, rows // max(int(parts), 1))

    @property
    def _num_weights(self) -> int:
        """Number of trained weights."""
        groups = self.alg.optimizer.param_groups
        return sum(weight.numel() for group in groups for weight in group["params"])

    def _notify(self, event: str, *args: Any) -> None:
        for observer in self.observers:
            getattr(observer, event)(*args)


class ExportingOnPolicyRunner(MjlabOnPolicyRunner):
    """`MjlabOnPolicyRunner` that exports the policy with every checkpoint."""

    exports_on_save = True

    def save(self, path: str, infos=None) -> None:
        """Write a checkpoint, and the policy to `_get_export_paths`.

        The ONNX file has deployment metadata. A failed export is logged, and training continues.

        Args:
            path: Checkpoint file.
            infos: Further plain data, returned by `load`.

        Raises:
            CheckpointError: the checkpoint could not be written.
        """
        super().save(path, infos)
        if self._is_main_process:
            self.export_policy(str(self._get_export_paths(path)[2]))
