"""On-policy runner: rollout, update, evaluation, checkpoints and exact resume.

`MjlabOnPolicyRunner.learn` is the training loop. Checkpoint files are written by
`mjlab.rl.checkpoint`, evaluations run by `mjlab.rl.evaluation`, policies exported by
`mjlab.rl.exporter_utils`.
"""

from __future__ import annotations

import contextlib
import copy
import io
import logging
import os
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from mjlab.rl.checkpoint import (
    RunRescue,
    capture_training_state,
    check_fits,
    load_algorithm,
    load_checkpoint,
    migrate,
    restore_training_state,
    save_checkpoint,
)
from mjlab.rl.distributed import join_processes
from mjlab.rl.divergence import RolloutWatch
from mjlab.rl.evaluation import EvaluationResult, SolvedCheck, reward_unit
from mjlab.rl.exporter_utils import export_to_onnx, export_with_metadata, get_base_metadata
from mjlab.rl.networks import (
    check_mini_batches,
    deduplicate_parameters,
    prepare_train_cfg,
    shared_parameters_allowed,
)
from mjlab.rl.replay import ReplayFiles, ReplayStorage
from mjlab.rl.run_logger import RunLogger, TrainingObserver
from mjlab.utils.processes import process_rank
from mjlab.utils.random import seed_rng, session_seed
from mjlab.utils.signals import StopRequest
from mjlab.utils.torch import torch_threads, using_torch_threads

logger = logging.getLogger(__name__)

# Reasons to leave the loop, in the order in which one outweighs another between processes.
_REASONS = ("", "solved", "interrupted")


class MjlabOnPolicyRunner(OnPolicyRunner):
    """Trains a policy with rsl_rl's algorithms.

    Unlike rsl_rl's runner it counts iterations in total: `learn(10)` does the same, bit for bit,
    as `learn(5)`, `load` in a new process, and `learn(10)`. `current_learning_iteration` is the
    number of iterations finished. Progress goes to `observers` instead of the console.

    After `learn`, `stop_reason` is `finished`, `solved`, `interrupted` (SIGINT or SIGTERM) or
    `failed`, and `last_evaluation` the last evaluation's result, if there was one. Of a run that was
    solved, that is the evaluation that confirmed it.
    """

    # Any: an environment has more than rsl_rl's `VecEnv` says (`unwrapped`).
    env: Any

    # Set by subclasses whose `save` exports the policy itself.
    exports_on_save = False

    def __init__(
        self, env: VecEnv, train_cfg: dict, log_dir: str | None = None, device: str = "cpu"
    ) -> None:
        """Build networks and algorithm.

        Args:
            env: The environments.
            train_cfg: A `RslRlOnPolicyRunnerCfg` as a dict; it is edited here and by rsl_rl.
            log_dir: Folder of the run. None: nothing is written.
            device: Device of the networks.

        Raises:
            ValueError: a network cannot take the observations that `obs_groups` gives it, or
                `symmetry_cfg` has no function that makes mirror images.
        """
        prepare_train_cfg(env, train_cfg)
        # rsl_rl prints networks and observation sets.
        with contextlib.redirect_stdout(io.StringIO()) as printed, shared_parameters_allowed():
            super().__init__(env, train_cfg, log_dir, device)
        logger.debug("%s", printed.getvalue().rstrip())
        deduplicate_parameters(self.alg.optimizer)
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
        )
        self.observers: list[TrainingObserver] = []
        self.stop_reason: str | None = None
        self.last_evaluation: EvaluationResult | None = None
        self._observations: TensorDict | None = None
        self._state_to_resume: dict[str, Any] | None = None
        # An evaluation is due after the last iteration, and was left out to stop sooner.
        self._owes_evaluation = False
        self._solved_check = SolvedCheck(
            env, self.alg, self.cfg.get("evaluation") or {}, int(self.cfg.get("seed", 0))
        )
        self._num_threads = self._resolve_threads()
        # Beside the threads of the physics, waiting ones of OpenMP cost more than they bring.
        on_cpu = torch.device(self.device).type == "cpu"
        self._num_collecting_threads = 1 if on_cpu else self._num_threads
        self._watch = RolloutWatch(self.env.unwrapped)

    # Training loop.

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train until `num_learning_iterations` iterations are finished IN TOTAL.

        Iterations before a `load` count. SIGINT, SIGTERM and SIGHUP end training after the running
        iteration; a second one ends the process. Then as at the end a checkpoint that resumes exactly
        is written, and the policy exported. After an error, weights and optimizer of the last finished
        iteration are in a checkpoint, which resumes in new episodes.

        Args:
            num_learning_iterations: Total number of iterations.
            init_at_random_ep_len: Start environments at random points of their episodes, so that
                they do not all reset together. Has no effect where episodes are resumed.

        Raises:
            RunFolderError: the run folder cannot be written to, raised before any training; or it is
                gone, and the run was saved beside it.
            CheckpointError: a checkpoint could not be written.
            DivergedError: the physics diverged in most environments, or training failed because of it.
            BrokenTermError: a reward or a termination stayed NaN in every environment.
            ValueError: the environment returned NaN, Weights & Biases started no run, a student has no
                teacher, or there are more mini-batches than samples.
        """
        if not getattr(self.alg, "teacher_loaded", True):
            raise ValueError(
                "Distillation: expected a teacher, got none; give its checkpoint by "
                "--agent.teacher-checkpoint, or call load_teacher."
            )
        # Not when the runner is built, which playing does in any number of environments.
        check_mini_batches(self.env.num_envs, self.cfg)
        first, total, reason = self.current_learning_iteration, num_learning_iterations, ""
        num_steps, save_interval = self.cfg["num_steps_per_env"], self.cfg["save_interval"]
        check_every_step = self.cfg.get("check_for_nan", True)
        uses_rnd = bool(self.cfg["algorithm"].get("rnd_cfg"))
        with self._session() as stop, RunRescue(self._run_folder) as rescue:
            observations = self._initial_observations(init_at_random_ep_len)
            self._notify("on_start", first, total)
            if first < total:
                owed, self._owes_evaluation = self._owes_evaluation, False
                reason = self._agree_to_stop(owed and self._evaluate_solved(first))
            while not reason and (iteration := self.current_learning_iteration) < total:
                begin = time.perf_counter()
                if self._run_folder is not None and iteration > first:
                    rescue.learned = {**copy.deepcopy(self.alg.save()), **self._progress()}
                with self._watch.explaining(self.alg.get_policy()):
                    with torch.inference_mode():
                        with using_torch_threads(self._num_collecting_threads):
                            self._watch.start()
                            for _ in range(num_steps):
                                actions = self.alg.act(observations).to(self.env.device)
                                observations, rewards, dones, extras = self.env.step(actions)
                                self._watch.update()
                                if check_every_step:
                                    check_nan(observations, rewards, dones)
                                observations = observations.to(self.device)
                                rewards, dones = rewards.to(self.device), dones.to(self.device)
                                credited, told = self._bootstrapped(observations, rewards, extras)
                                self.alg.process_env_step(observations, credited, dones, told)
                                intrinsic = self.alg.intrinsic_rewards if uses_rnd else None
                                self.logger.process_env_step(rewards, dones, extras, intrinsic)
                            self._watch.check(num_steps)
                        collected = time.perf_counter()
                        self.alg.compute_returns(observations)
                    losses = self._update()
                learned = time.perf_counter()
                self._observations = observations
                self.current_learning_iteration = iteration + 1
                stats = self.logger.finish_iteration(
                    iteration=iteration,
                    first_iteration=first,
                    total_iterations=total,
                    collection_time=collected - begin,
                    learning_time=learned - collected,
                    losses=losses,
                    learning_rate=self.alg.learning_rate,
                    action_std=self.alg.get_policy().output_std.detach(),
                    rnd_weight=rnd.weight if (rnd := getattr(self.alg, "rnd", None)) else None,
                )
                self._notify("on_iteration", stats)
                self.logger.report_broken_losses(stats)
                rescue.check_folder(self.save, f"model_{iteration}.pt")
                is_due = self._solved_check.should_evaluate(iteration + 1, stats.mean_step_reward)
                # Skip the evaluation, until the run is resumed, if a stop was requested.
                interrupted = stop.requested
                self._owes_evaluation = is_due and interrupted
                is_solved = is_due and not interrupted and self._evaluate_solved(iteration + 1)
                reason = self._agree_to_stop(is_solved, interrupted)
                if not reason and iteration + 1 < total and iteration % save_interval == 0:
                    self._save_checkpoint()
            rescue.learned = None
            # A run that is solved as it is resumed leaves a checkpoint as others do.
            if self.current_learning_iteration > first or reason == "solved":
                self._save_checkpoint()
            elif total <= first:
                logger.warning(
                    "Nothing to train: the checkpoint has finished %d iterations, and "
                    "max_iterations, which counts them in, is %d.", first, total,
                )  # fmt: skip
            self.stop_reason = reason or "finished"

    @contextlib.contextmanager
    def _session(self) -> Generator[StopRequest]:
        """Be ready to train within the block: files open, signals caught, threads set."""
        self.logger.init_logging_writer()
        self.stop_reason = "failed"
        try:
            with (
                using_torch_threads(self._num_threads),
                StopRequest(lambda name: self._notify("on_stop_requested", name)) as stop,
            ):
                yield stop
        finally:
            self.logger.stop_logging_writer()
            self._solved_check.close()
            if (close := getattr(self.alg, "close", None)) is not None:
                close()
            self._notify("on_end", self.stop_reason)

    def _initial_observations(self, init_at_random_ep_len: bool) -> TensorDict:
        """Return the observations to start from: resumed ones, or those of the environments."""
        self.alg.train_mode()
        # Here and not in the wrapper, which playing and evaluating use as well.
        takes_final = isinstance(self.alg, PPO) or getattr(
            self.alg, "takes_final_observations", False
        )
        if takes_final and hasattr(self.env, "observe_ends"):
            self.env.observe_ends()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        if self._observations is not None:
            # `learn` was called before in this process: the environments are where they were.
            return self._observations
        observations = self._resumed_observations()
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
        """Restore episodes and generators of the checkpoint that was loaded, if there are any."""
        state, self._state_to_resume = self._state_to_resume, None
        if state is None:
            if self.current_learning_iteration > 0:
                logger.warning("Episodes and random numbers start anew: the checkpoint has none.")
            return None
        if self.is_distributed:
            # A checkpoint has the episodes of the first process only.
            logger.warning(
                "Episodes and random numbers start anew, because several processes share the run."
            )
            self.logger.load_totals(state["logger"])
            # Otherwise, every session would draw the numbers of the first one again.
            seed_rng(session_seed(int(self.cfg.get("seed", 0)), self.current_learning_iteration))
            return None
        try:
            return restore_training_state(
                state, self.env, self.alg, self.logger.load_state_dict, self.device
            )
        except ValueError as error:
            logger.warning(
                "Weights, optimizer and iteration are resumed, but episodes and random numbers "
                "start anew, because the saved state does not fit. %s", error,
            )  # fmt: skip
            return None

    def _bootstrapped(
        self, observations: TensorDict, rewards: torch.Tensor, extras: dict[str, Any]
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Return rewards and extras for the algorithm, in which PPO's time-outs are bootstrapped.

        At a time-out rsl_rl's PPO adds gamma V(s), s being the observation before the step. With
        final observations s', gamma V(s') is added here, and these time-outs are marked no more.
        """
        is_ours = isinstance(self.alg, PPO) and "time_outs" in extras
        if not is_ours or "final_observations" not in extras:
            return rewards, extras
        final = extras["final_observations"].to(self.device)
        ids = extras["final_ids"].to(self.device)
        time_outs = extras["time_outs"].to(self.device)
        # Not the compiled critic, which would be compiled for each number of time-outs.
        critic = self.alg._raw_critic
        if critic.is_recurrent:
            # The hidden state is of all environments, and has seen the observations before the step.
            hidden_state = critic.get_hidden_state()
            everywhere = observations.clone()
            everywhere[ids] = final
            values = critic(everywhere)[ids]
            critic.reset(hidden_state=hidden_state)
        else:
            values = critic(final)
        # A wrapper may have found that an episode terminated after all.
        values = values.detach().squeeze(-1) * time_outs[ids]
        rewards = rewards.index_add(0, ids, (self.alg.gamma * values).to(rewards.dtype))
        return rewards, {**extras, "time_outs": time_outs.index_fill(0, ids, False)}

    def _update(self) -> dict[str, float]:
        """Learn from what was collected; return the losses.

        rsl_rl's distillation lets a teacher with memory forget what it has seen. It goes on here.
        """
        algorithm: Any = self.alg
        teacher = getattr(algorithm, "teacher", None)
        if teacher is None or not teacher.is_recurrent:
            return algorithm.update()
        remembered = teacher.get_hidden_state()
        losses = algorithm.update()
        teacher.reset(hidden_state=remembered)
        # An update writes to this one, which the teacher's cannot take, made in inference mode.
        algorithm.last_hidden_states = (algorithm.last_hidden_states[0], None)
        return losses

    def _agree_to_stop(self, is_solved: bool, interrupted: bool = False) -> str:
        """Return the weightiest reason to stop of all processes, or ""."""
        code = 2 if interrupted else int(is_solved)
        if self.is_distributed:
            # All processes have to leave the loop at the same iteration.
            shared = torch.tensor(code, device=self.device)
            torch.distributed.all_reduce(shared, op=torch.distributed.ReduceOp.MAX)
            code = int(shared.item())
        return _REASONS[code]

    # Evaluation.

    def evaluate(self) -> EvaluationResult:
        """Score the policy in environments of its own; the run itself is not touched."""
        self.last_evaluation = self._solved_check.evaluate()
        return self.last_evaluation

    def _evaluate_solved(self, iteration: int) -> bool:
        """Evaluate the policy after `iteration` iterations; return whether to stop for it.

        Only in the first process: False in others.
        """
        if not self._is_main_process:
            return False
        check = self._solved_check
        check.last_iteration = iteration
        result = self.evaluate()
        is_good = check.is_solved_by(result)
        self._notify("on_evaluation", iteration, result, is_good)
        self.logger.write_evaluation(result, iteration - 1)
        if not (is_good and check.stops_training):
            return False
        self.last_evaluation = result = check.confirm(iteration)
        solved = check.is_solved_by(result)
        self._notify("on_confirmation", iteration, result, solved)
        self.logger.write_evaluation(result, iteration - 1, "Confirmation")
        return solved

    # Checkpoints.

    def save(self, path: str, infos=None) -> None:
        """Write a checkpoint from which training resumes exactly; only the first process writes.

        Args:
            path: Where to; the file appears whole or not at all.
            infos: Further plain data, which `load` returns.

        Raises:
            CheckpointError: it could not be written; an earlier file at `path` is intact.
        """
        if not self._is_main_process:
            return
        observations = self._observations
        if observations is None:
            observations = self.env.get_observations()
        checkpoint = {**self.alg.save(), **self._progress(infos)}
        checkpoint["training_state"] = capture_training_state(
            self.env, self.alg, self.logger.state_dict(), observations
        )
        replay = self._replay if self.cfg["algorithm"].get("save_replay") else None
        if replay is not None:
            # First, so that the newest checkpoint always has one, whenever writing is interrupted.
            ReplayFiles(path).write(replay)
        save_checkpoint(checkpoint, path)
        if replay is not None:
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
        """Load a checkpoint, also one of rsl_rl or of an older layout.

        Args:
            path: The file.
            load_cfg: Which parts to load (`actor`, `critic`, `student`, `teacher`, `optimizer`,
                `iteration`, `rnd`);
                None loads all, and `learn` then resumes the environments and the random number
                generators too, if there are as many environments.
            strict: Whether every parameter has to fit.
            map_location: Without effect: tensors go where the networks are.

        Returns:
            The `infos` given to `save`.

        Raises:
            CheckpointError: the file is missing, corrupt, hostile, malformed, or of another
                network; nothing was changed then.
        """
        checkpoint = migrate(load_checkpoint(path), str(path))
        if load_algorithm(self.alg, checkpoint, load_cfg, strict, str(path)):
            finished = checkpoint.get("iterations_finished", checkpoint.get("iter", -1) + 1)
            self.current_learning_iteration = finished
            self._solved_check.last_iteration = checkpoint.get("last_evaluated", 0)
            self._owes_evaluation = checkpoint.get("owes_evaluation", False)
        infos = checkpoint.get("infos") or {}
        counter = (infos.get("env_state") or {}).get("common_step_counter")
        if counter is not None:
            self.env.unwrapped.common_step_counter = counter
        self._state_to_resume = checkpoint.get("training_state") if load_cfg is None else None
        if load_cfg is None and self._replay is not None:
            ReplayFiles(path).read(self._replay)
        self._observations = None
        return infos

    def load_teacher(self, path: str) -> None:
        """Load the teacher of a distillation: the policy of a checkpoint of PPO.

        Raises:
            CheckpointError: the file is missing, corrupt, hostile, malformed, or of another network.
        """
        checkpoint = migrate(load_checkpoint(path), str(path))
        policy = checkpoint.get("actor_state_dict")
        algorithm: Any = self.alg
        check_fits(algorithm._raw_teacher, policy, name="teacher", path=str(path))
        algorithm.load({"actor_state_dict": policy}, {"teacher": True}, strict=True)

    def _save_checkpoint(self) -> None:
        """Write a checkpoint into the run folder, and the policy as ONNX beside it."""
        if self._run_folder is None:
            return
        path = os.path.join(self._run_folder, f"model_{self.current_learning_iteration - 1}.pt")
        self.save(path)
        if not self.exports_on_save:
            self.export_policy(str(self._get_export_paths(path)[2]))
        self._notify("on_checkpoint", path)

    def _progress(self, infos: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the entries of a checkpoint that say how far the run has got."""
        done = self.current_learning_iteration
        counter = getattr(self.env.unwrapped, "common_step_counter", 0)
        return {
            # rsl_rl calls the last finished iteration "iter"; it cannot tell none from one.
            "iter": max(done - 1, 0),
            "iterations_finished": done,
            "infos": {**(infos or {}), "env_state": {"common_step_counter": int(counter)}},
            "last_evaluated": self._solved_check.last_iteration,
            "owes_evaluation": self._owes_evaluation,
        }

    # Export.

    def export_policy_to_onnx(
        self, path: str, filename: str = "policy.onnx", verbose: bool = False
    ) -> None:
        """Write the policy (normalizer, network, deterministic head) to `path`/`filename`.

        Opset 18, batch size 1; input `obs`, output `actions`. Image models have one input more for
        each group of images, by its name; recurrent ones have their state.
        """
        model = self.alg.get_policy().as_onnx(verbose=verbose)
        export_to_onnx(model, Path(path) / filename, verbose)

    def export_policy(self, path: str | None = None) -> str | None:
        """Write the policy as ONNX with all that a deployment needs to know.

        Args:
            path: The file; None: that of `_get_export_paths`.

        Returns:
            The file, or None if there is no run folder or the export failed. Failures are logged:
            a run is not lost because its policy has no ONNX form.
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
        """Return folder, file name and path of the policy exported beside a checkpoint.

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
        """Join the other processes of the run, if there are any. In place of rsl_rl's, which knows
        GPUs only."""
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
        """True in the first process, which alone writes files."""
        return self.gpu_global_rank == 0

    @property
    def _run_folder(self) -> str | None:
        """Run folder; None in processes that write nothing."""
        return self.logger.log_dir if self._is_main_process else None

    @property
    def _replay(self) -> ReplayStorage | None:
        storage: Any = getattr(self.alg, "storage", None)
        return storage if isinstance(storage, ReplayStorage) else None

    def _resolve_threads(self) -> int:
        if torch.device(self.device).type != "cpu":
            return torch.get_num_threads()
        # An algorithm that learns beside the physics says how many it leaves.
        if (own := getattr(self.alg, "num_threads", None)) is not None:
            return own
        parameters = sum(
            parameter.numel()
            for group in self.alg.optimizer.param_groups
            for parameter in group["params"]
        )
        rows = self.env.num_envs * self.cfg["num_steps_per_env"]
        parts = self.cfg["algorithm"].get("num_mini_batches", 1)
        return torch_threads(parameters, rows // max(int(parts), 1))

    def _notify(self, event: str, *args: Any) -> None:
        for observer in self.observers:
            getattr(observer, event)(*args)


class ExportingOnPolicyRunner(MjlabOnPolicyRunner):
    """Trains as `MjlabOnPolicyRunner` does, and exports the policy whenever it saves."""

    exports_on_save = True

    def save(self, path: str, infos=None) -> None:
        """Write a checkpoint, and the policy where `_get_export_paths` says.

        The ONNX file carries what a deployment needs to know. An export that fails is logged, and
        training goes on.

        Args:
            path: Where to write the checkpoint.
            infos: Further plain data, which `load` returns.

        Raises:
            CheckpointError: the checkpoint could not be written.
        """
        super().save(path, infos)
        if self._is_main_process:
            self.export_policy(str(self._get_export_paths(path)[2]))
