"""Manager-based RL environment: N parallel simulations of one Markov decision process."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import suggests_attributes, translate_older
from mjlab.envs import curriculum_state, env_state
from mjlab.envs.cfg_checks import check_env_cfg, report_odd_times, report_start
from mjlab.envs.final_observations import final_observations
from mjlab.envs.mdp.events import reset_scene_to_default
from mjlab.envs.types import VecEnvObs, VecEnvStepReturn
from mjlab.managers import (
    ActionManager,
    ActionTermCfg,
    CommandManager,
    CommandTermCfg,
    CurriculumManager,
    CurriculumTermCfg,
    EventManager,
    EventMode,
    EventTermCfg,
    MetricsManager,
    MetricsTermCfg,
    NullCommandManager,
    NullCurriculumManager,
    NullMetricsManager,
    NullRecorderManager,
    ObservationGroupCfg,
    ObservationManager,
    RecorderManager,
    RecorderTermCfg,
    RewardManager,
    RewardTermCfg,
    SensorSwitches,
    Table,
    Tabular,
    TerminationManager,
    TerminationTermCfg,
)
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.sim.divergence import DivergenceLog
from mjlab.utils.errors import UnsupportedError, WrongStateError
from mjlab.utils.indexing import as_ids
from mjlab.utils.random import draw_seed, seed_rng
from mjlab.utils.screen import shown
from mjlab.utils.string import counted
from mjlab.viewer.viewer_config import ViewerConfig

if TYPE_CHECKING:
    import numpy as np

    from mjlab.viewer.debug_visualizer import DebugVisualizer


@dataclass(kw_only=True)
class ManagerBasedRlEnvCfg:
    """Task configuration: a scene, and named terms of the Markov decision process.

    A term set to None is disabled.
    """

    decimation: int
    """Number of physics substeps per environment step."""
    scene: SceneCfg
    """Entities, terrain, sensors, and number of environments."""
    observations: dict[str, ObservationGroupCfg] = field(default_factory=dict)
    """Observation groups by name, such as `actor` and `critic`."""
    actions: dict[str, ActionTermCfg] = field(default_factory=dict)
    """Action terms, in the order of the action vector."""
    events: dict[str, EventTermCfg] = field(
        default_factory=lambda: {
            "reset_scene_to_default": EventTermCfg(func=reset_scene_to_default, mode="reset")
        }
    )
    """Event terms, triggered at startup, reset, intervals or every step. Default: reset the scene to
    its default state. An empty dict resets to the model's `qpos0` only."""
    seed: int | None = None
    """Seed of all random number generators. None: sample a seed and store it here."""
    sim: SimulationCfg = field(default_factory=SimulationCfg)
    """Physics configuration."""
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    """Camera and size of rendered images."""
    episode_length_s: float = field(default=0.0, metadata=shown("task", "X"))
    """Maximum episode length (s)."""
    rewards: dict[str, RewardTermCfg] = field(default_factory=dict)
    """Reward terms."""
    terminations: dict[str, TerminationTermCfg] = field(default_factory=dict)
    """Termination terms."""
    commands: dict[str, CommandTermCfg] = field(default_factory=dict)
    """Command terms."""
    curriculum: dict[str, CurriculumTermCfg] = field(default_factory=dict)
    """Curriculum terms."""
    metrics: dict[str, MetricsTermCfg] = field(default_factory=dict)
    """Metric terms: logged, not rewarded."""
    recorders: dict[str, RecorderTermCfg] = field(default_factory=dict)
    """Recorder terms."""
    is_finite_horizon: bool = False
    """Treat the time limit as part of the task: time-outs are not bootstrapped."""
    auto_reset: bool = True
    """Reset terminated and truncated environments inside `step`."""
    scale_rewards_by_dt: bool = True
    """Multiply rewards by the control timestep (s)."""


@suggests_attributes
class ManagerBasedRlEnv(Tabular):
    """N environments stepped in parallel. All tensors have a leading dimension N.

    Call `reset` before the first `step`: the constructor leaves the model's initial state.

    Attributes:
        observes_ends: Return the final observations of truncated episodes from `step`. Default
            False; learners that bootstrap from final observations set it.
        observes_failures: With `observes_ends`, also return the final observations of terminated
            episodes. Default False; adapters to interfaces with final observations set it.
    """

    is_vector_env = True

    def __init__(
        self,
        cfg: ManagerBasedRlEnvCfg,
        device: str,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        """Build scene, simulation and managers of `cfg` on `device` (`cpu`, `cuda:0`, ...).

        A `device` of None is the first GPU, or the CPU if there is none. `render_mode` is None or
        `rgb_array`. Additional keyword arguments are ignored.

        Raises:
            ValueError: invalid config, named by field.
            EngineUnavailableError: the engine does not support the device or cannot run on this
                machine.
        """
        check_env_cfg(cfg)
        translate_older(cfg)
        if device is None:
            device = "cuda:0" if torch.cuda.is_available() else "cpu"
        # Checked before the scene creates tensors on a device that the engine does not support.
        Simulation.check(cfg.scene.num_envs, cfg.sim, device)
        self.cfg = cfg
        self._built_settings = env_state.settings_of(cfg)
        cfg.seed = self.seed(-1 if cfg.seed is None else cfg.seed)
        self.render_mode = render_mode
        self.metadata: dict[str, Any] = {"render_modes": [None, "rgb_array"]}
        self.extras: dict[str, Any] = {}
        self.obs_buf: VecEnvObs = {}
        self._device = device
        self.scene = Scene(cfg.scene, device=device)
        self.scene.report_overruled_options(cfg.sim.mujoco)
        self.sim = Simulation(
            self.num_envs,
            cfg.sim,
            device=device,
            spec=self.scene.spec,
            variant_info=self.scene.collect_variant_info(),
        )
        self.scene.initialize(self.sim.mj_model, self.sim.model, self.sim.data)
        self.scene.check_terrain_scans(self.sim.mj_model)
        if self.scene.world_cameras:
            self.sim.expand_model_fields(("cam_pos",))
            self.scene.place_cameras(self.sim.model)
        self.sim.add_forward_callback(self.scene.invalidate_sensor_caches)
        if self.scene.sensor_context is not None:
            self.sim.set_sensor_context(self.scene.sensor_context)

        self.observes_ends = self.observes_failures = False
        self.common_step_counter = 0
        self._holds_common_steps = False
        # Value of the counter after the last step or load; it differs if the user has set the counter.
        self._stepped_to = 0
        # State before the first reset, and its edits by curriculum term.
        self._built_state: dict[str, Any] = {}
        self._term_edits: dict[str, Any] = {}
        self._sim_step_counter = 0
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=device)
        self._pending_reset = torch.zeros(self.num_envs, dtype=torch.bool, device=device)
        self.diverged = torch.zeros(self.num_envs, dtype=torch.bool, device=device)
        self._nan_resets = torch.zeros(self.num_envs, dtype=torch.long, device=device)
        self._divergence_log = DivergenceLog(self.sim)
        self._renderer = None
        self._renderer_is_open = False
        if render_mode == "rgb_array":
            from mjlab.viewer.offscreen_renderer import OffscreenRenderer

            self._renderer = OffscreenRenderer(
                model=self.sim.mj_model,
                cfg=cfg.viewer,
                scene=self.scene,
                sim_model=self.sim.model,
                expanded_fields=self.sim.expanded_fields,
            )
        self.metadata["render_fps"] = 1.0 / self.step_dt
        self.load_managers()
        report_odd_times(self)
        report_start(self)
        # Expanding model fields invalidated the simulation's graphs.
        self.sim.create_graph()
        self.setup_manager_visualizers()
        self.sensor_visualizers = SensorSwitches(self.scene.sensors)

    # Properties.

    @property
    def num_envs(self) -> int:
        """Number of environments N."""
        return self.scene.num_envs

    @property
    def device(self) -> str:
        """Torch device of all tensors."""
        return self._device

    # Cached: terms read it every step, and reading it from MuJoCo takes longer than many a term.
    @functools.cached_property
    def physics_dt(self) -> float:
        """Physics timestep (s)."""
        return float(self.sim.mj_model.opt.timestep)

    @property
    def step_dt(self) -> float:
        """Control timestep (s): physics timestep times decimation."""
        return self.physics_dt * self.cfg.decimation

    @property
    def max_episode_length_s(self) -> float:
        """Maximum episode length (s)."""
        return self.cfg.episode_length_s

    @property
    def max_episode_length(self) -> int:
        """Maximum episode length (environment steps)."""
        # The tolerance keeps 0.14 s / 0.02 s = 7.0000000000000001 at 7 steps.
        return math.ceil(self.max_episode_length_s / self.step_dt - 1e-6)

    @property
    def nan_resets(self) -> torch.Tensor:
        """Number of episodes that ended because the physics diverged, (N,) int64."""
        return self._nan_resets

    @property
    def unwrapped(self) -> ManagerBasedRlEnv:
        """This environment, without wrappers."""
        return self

    def __repr__(self) -> str:
        count = counted(self.num_envs, "environment")
        return f"<{type(self).__name__}: {count} on {self.device}; {self.describe_time()}>"

    def describe_time(self) -> str:
        """Return timesteps and episode length in words."""
        steps = f"steps of {self.step_dt:.4g} s ({self.cfg.decimation} x {self.physics_dt:.4g} s)"
        # Tasks without a time limit set an episode length of years.
        if self.max_episode_length_s >= 1e6:
            return f"{steps}, episodes without limit"
        length = f"{self.max_episode_length_s:g} s ({self.max_episode_length} steps)"
        return f"{steps}, episodes of {length}"

    def tables(self) -> list[Table]:
        """Return the tables of all managers, entities and sensors; empty ones too."""
        managers = (
            *(self.observation_manager, self.action_manager, self.command_manager),
            *(self.reward_manager, self.termination_manager, self.event_manager),
            *(self.curriculum_manager, self.metrics_manager, self.recorder_manager),
        )
        return [table for part in (*managers, self.scene) for table in part.tables()]

    # Construction.

    def load_managers(self) -> None:
        """Build all managers, in the order of their dependencies."""
        cfg = self.cfg
        # Events come first: the model fields they randomize must be expanded before anything stores
        # references to these fields.
        self.event_manager = EventManager(cfg.events, self)
        self.sim.expand_model_fields(self.event_manager.domain_randomization_fields)
        self.sim.expand_constants(self.event_manager.recompute_level)
        self.command_manager = (
            CommandManager(cfg.commands, self) if cfg.commands else NullCommandManager()
        )
        self.action_manager = ActionManager(cfg.actions, self)
        self.observation_manager = ObservationManager(cfg.observations, self)
        self.termination_manager = TerminationManager(cfg.terminations, self)
        self.reward_manager = RewardManager(cfg.rewards, self, scale_by_dt=cfg.scale_rewards_by_dt)
        self.curriculum_manager = (
            CurriculumManager(cfg.curriculum, self) if cfg.curriculum else NullCurriculumManager()
        )
        self.metrics_manager = (
            MetricsManager(cfg.metrics, self) if cfg.metrics else NullMetricsManager()
        )
        self.recorder_manager = (
            RecorderManager(cfg.recorders, self) if cfg.recorders else NullRecorderManager()
        )
        self.single_observation_space = self.observation_manager.single_space
        self.observation_space = self.observation_manager.space
        self.single_action_space = self.action_manager.single_space
        self.action_space = self.action_manager.space
        # Targets that are constant within a step are written once.
        self._acts_between_substeps = self.action_manager.needs_substep or any(
            entity.needs_substep for entity in self.scene.entities.values()
        )
        # If nothing acts between substeps, the engine runs all substeps in one call and records
        # the fields that sensors need from each substep; see `mjlab.actuator.actuator`.
        self._steps_as_one = not (
            self._acts_between_substeps
            or self.scene.needs_substep
            or self.metrics_manager.needs_substep
        )
        self._recorded_fields = self.scene.recorded_fields
        modes: tuple[EventMode, ...] = ("step", "interval")
        self._step_modes = [m for m in modes if m in self.event_manager.available_modes]
        if "startup" in self.event_manager.available_modes:
            self.event_manager.apply(mode="startup")

    def setup_manager_visualizers(self) -> None:
        """Collect the managers with debug visualization."""
        self.manager_visualizers: dict[str, Any] = {}
        if self.command_manager.active_terms:
            self.manager_visualizers["command_manager"] = self.command_manager
        self.manager_visualizers["event_manager"] = self.event_manager
        self.manager_visualizers["reward_manager"] = self.reward_manager

    # The loop.

    @torch.no_grad()
    def reset(
        self,
        *,
        seed: int | None = None,
        env_ids: torch.Tensor | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[VecEnvObs, dict[str, Any]]:
        """Start new episodes in `env_ids` (None: all); return observations and extras.

        `env_ids` is anything that indexes a tensor: integers, a mask, a slice. A `seed` reseeds
        every random number generator. All environments are observed, but only `env_ids` advance the
        state of observation terms; see `ObservationManager.compute`. Forces and accelerations are
        current in `env_ids`, and those of the last substep in other environments, as after `step`;
        before the first substep they are current everywhere.
        """
        all_ids = torch.arange(self.num_envs, device=self.device)
        ids = all_ids if env_ids is None else all_ids[env_ids].flatten()
        if seed is not None:
            self.seed(seed)
        curriculum_state.begin(self)
        self._clear_extras()
        stepped = ids[self.episode_length_buf[ids] > 0]
        if len(stepped) > 0:
            self.recorder_manager.record_pre_reset(stepped)
        moved = self.scene.take_moved_envs()
        self._reset_idx(ids)
        self.curriculum_manager.after_term = None
        self._forward(ids, moved)
        self.command_manager.compute(dt=0.0, env_ids=ids)
        # Commands update what they move.
        self.scene.forget_moved_envs()
        self.sim.sense()
        self.obs_buf = self.observation_manager.compute(update_history=True, env_ids=ids)
        self.recorder_manager.record_post_reset(ids)
        return self.obs_buf, self.extras

    @torch.no_grad()
    def step(self, action: torch.Tensor) -> VecEnvStepReturn:
        """Advance all environments by one environment step, without gradients.

        Terminations, rewards, metrics and events read quantities of the last substep, commands and
        observations current ones; `docs/explanation/concepts.md` has the order and the age of each
        quantity. The physics of environments in `diverged` diverged: their episodes terminate with
        zero reward. See `observes_ends` for the final observations in `extras`.

        Args:
            action: Float tensor, (N, A); arrays and lists are converted. NaN and infinite values
                are logged once (on a GPU: in training only).

        Returns:
            Observations (of the new episode in environments that were reset); reward (N,);
            terminated (N,) and truncated (N,) bool; extras, with `extras["log"]`. The next step
            overwrites only the extras.
        """
        if not self.cfg.auto_reset:
            self._check_no_reset_is_due()
        self._clear_extras()
        self.action_manager.process_action(action)
        self._run_physics()
        self._advance_counters()
        self._compute_terminations()
        self._compute_rewards()
        self.metrics_manager.compute()
        for mode in self._step_modes:
            self.event_manager.apply(mode=mode, dt=self.step_dt)
        moved = self.scene.take_moved_envs()
        if self.observes_ends and self.cfg.auto_reset:
            self.extras |= final_observations(self, moved)
        reset_ids = self._reset_ended()
        self._forward(reset_ids, moved)
        self._compute_commands(reset_ids)
        self.sim.sense()
        self.obs_buf = self.observation_manager.compute(update_history=True)
        self._record(reset_ids)
        # Copies, because libraries stack the results of a rollout at its end.
        return (
            self.obs_buf,
            self.reward_buf.clone(),
            self.reset_terminated.clone(),
            self.reset_time_outs.clone(),
            self.extras,
        )

    @contextlib.contextmanager
    def curricula_held(self) -> Generator[None]:
        """Hold step counter, curriculum terms and terrain levels within this context.

        For evaluations. If the counter was set since the last step, curriculum terms are called
        once, to follow it.
        """
        with contextlib.ExitStack() as stack:
            if self.scene.terrain is not None:
                stack.enter_context(self.scene.terrain.levels_held())
            if self.common_step_counter != self._stepped_to:
                self.curriculum_manager.compute(as_ids(None, self.num_envs, self.device))
            stack.enter_context(self.curriculum_manager.held())
            stack.callback(setattr, self, "_holds_common_steps", self._holds_common_steps)
            self._holds_common_steps = True
            yield

    def get_observations(self) -> VecEnvObs:
        """Return the observations of the last step or reset."""
        return self.observation_manager.compute()

    # Phases of a step.

    def _check_no_reset_is_due(self) -> None:
        """Raise `RuntimeError` if an environment is done and was not reset."""
        if self._pending_reset.any():
            ids = self._pending_reset.nonzero().flatten().tolist()
            raise WrongStateError(
                f"step: environments {ids[:10]}{' ...' if len(ids) > 10 else ''} are done and were "
                "not reset; call env.reset(env_ids=...) first, or set auto_reset=True in the config."
            )

    def _clear_extras(self) -> None:
        self.extras["log"] = {}
        for name in ("final_observations", "final_ids"):
            self.extras.pop(name, None)

    def _run_physics(self) -> None:
        self._divergence_log.begin_step()
        substeps = self.cfg.decimation
        if self._steps_as_one:
            self._sim_step_counter += substeps
            self.action_manager.apply_action()
            self.scene.write_data_to_sim()
            recorded = self.sim.step(substeps, self._recorded_fields)
            self.scene.update(self.physics_dt, recorded, substeps)
            return
        for substep in range(substeps):
            self._sim_step_counter += 1
            if substep == 0 or self._acts_between_substeps:
                self.action_manager.apply_action()
                self.scene.write_data_to_sim()
            self.sim.step()
            self.scene.update(dt=self.physics_dt)
            self.metrics_manager.compute_substep()

    def _advance_counters(self) -> None:
        self.episode_length_buf += 1
        if not self._holds_common_steps:
            self.common_step_counter += 1
            self._stepped_to = self.common_step_counter

    def _compute_terminations(self) -> None:
        """Evaluate the terminations; episodes whose physics diverged terminate."""
        manager = self.termination_manager
        self.diverged.copy_(self.sim.bad_states())
        self.reset_buf = manager.compute()
        self.reset_terminated = manager.terminated
        self.reset_time_outs = manager.time_outs
        # In place: the manager's `terminated` and `dones` are these tensors.
        self.reset_terminated.logical_or_(self.diverged)
        self.reset_buf.logical_or_(self.diverged)
        self._nan_resets += self.diverged
        self.extras["log"]["Simulation/nan_resets"] = self.diverged.sum()
        self.extras["log"]["Simulation/nan_terminations"] = manager.bad_values.count

    def _compute_rewards(self) -> None:
        manager = self.reward_manager
        self.reward_buf = manager.compute(dt=self.step_dt)
        # The manager zeroes its terms; subclasses of it may add rewards.
        self.reward_buf.masked_fill_(self.diverged, 0.0)
        self.extras["log"]["Simulation/nan_rewards"] = manager.bad_values.count

    def _reset_ended(self) -> torch.Tensor:
        """Reset the environments that are done, with `auto_reset`; return their ids."""
        ids = self.reset_buf.nonzero().flatten()
        if len(ids) == 0:
            return ids
        self._divergence_log.report(self.diverged, self.common_step_counter)
        if not self.cfg.auto_reset:
            self._pending_reset |= self.reset_buf
            return ids[:0]
        self.recorder_manager.record_pre_reset(ids)
        self._reset_idx(ids)
        return ids

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        # The curriculum runs first, because it reads the final state of the episode.
        self.curriculum_manager.compute(env_ids=env_ids)
        self.sim.reset(env_ids)
        self.scene.reset(env_ids)
        if "reset" in self.event_manager.available_modes:
            self.event_manager.apply(
                mode="reset",
                env_ids=env_ids,
                global_env_step_count=self._sim_step_counter // self.cfg.decimation,
            )
        if any(entity.seeds_lengths for entity in self.scene.entities.values()):
            self.sim.forward(env_ids, stage="pos")
        for entity in self.scene.entities.values():
            entity.seed_position_targets(env_ids)
        log = self.extras["log"]
        for manager in (
            self.observation_manager,
            self.action_manager,
            self.reward_manager,
            self.metrics_manager,
            self.curriculum_manager,
            self.command_manager,
            self.event_manager,
            self.termination_manager,
        ):
            log.update(manager.reset(env_ids))
        self.episode_length_buf[env_ids] = 0
        self._pending_reset[env_ids] = False
        self.scene.write_data_to_sim(env_ids)

    def _forward(self, reset_ids: torch.Tensor, moved: torch.Tensor | None) -> None:
        """Make positions and velocities current, and forces too in environments that were placed.

        Args:
            reset_ids: Environments that were reset.
            moved: Environments moved before the resets, (N,) bool. None: no environment. Excludes
                moves by resets, covered by `reset_ids`: reading them would synchronize with the GPU.
        """
        if self.scene.world_cameras:
            self.scene.place_cameras(self.sim.model)
        full = reset_ids
        if moved is not None:
            full = moved.index_fill(0, reset_ids, True).nonzero().flatten()
        # Before the first substep, the data holds no forces to preserve.
        if len(full) == self.num_envs or self._sim_step_counter == 0:
            self.sim.forward()
            return
        self.sim.forward(stage="vel")
        if len(full) > 0:
            self.sim.forward(full)

    def _compute_commands(self, reset_ids: torch.Tensor) -> None:
        dt: float | torch.Tensor = self.step_dt
        if len(reset_ids) > 0:
            # Commands of new episodes do not advance in time.
            dt = torch.full_like(self.reward_buf, dt)
            dt[reset_ids] = 0.0
        self.command_manager.compute(dt=dt)
        # Moves by resets are up to date after `_forward`; commands update their own moves.
        self.scene.forget_moved_envs()

    def _record(self, reset_ids: torch.Tensor) -> None:
        if len(reset_ids) > 0:
            self.recorder_manager.record_post_reset(reset_ids)
        self.recorder_manager.record_post_step()

    # Seeds, rendering, saving, closing.

    @staticmethod
    def seed(seed: int = -1) -> int:
        """Seed every random number generator and return the seed; -1 samples a seed."""
        if seed == -1:
            seed = draw_seed()
        seed_rng(seed)
        return seed

    def render(
        self, camera: str | int | None = None, env_idx: int | None = None
    ) -> np.ndarray | None:
        """Return an RGB image, (height, width, 3) uint8, in mode `rgb_array`, else None.

        Args:
            camera: Camera of the model. None: the view of the config.
            env_idx: Environment to show without neighbors. None: those of the config.

        Raises:
            RenderingUnavailableError: this machine cannot render; the message names the packages
                to install.
        """
        if self.render_mode in (None, "human"):
            return None
        if self.render_mode != "rgb_array" or self._renderer is None:
            raise UnsupportedError(
                f"Render mode {self.render_mode!r} is not supported; use 'rgb_array' or None."
            )
        # Initialized lazily, so that machines without rendering can train.
        if not self._renderer_is_open:
            self._renderer.initialize()
            self._renderer_is_open = True
        self._renderer.update(self.sim, self.update_visualizers, camera, env_idx)
        return self._renderer.render()

    def update_visualizers(self, visualizer: DebugVisualizer) -> None:
        """Draw the debug visualization of managers and sensors."""
        for part in (*self.manager_visualizers.values(), self.sensor_visualizers):
            part.debug_vis(visualizer)

    def state_dict(self) -> dict[str, Any]:
        """Return all run-time state, for bitwise exact resume, except random numbers.

        Save these beside it: `mjlab.utils.random.rng_state` returns the states of the global
        generators, and `set_rng_state` restores them. Checkpoints of the runner hold both.
        """
        return env_state.state_dict(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`. Raises `ValueError` if task or number of environments differ."""
        env_state.load_state_dict(self, state)

    def curriculum_state(self) -> dict[str, Any]:
        """Return the part of `state_dict` that outlives episodes, for any number of environments.

        The part holds step counters, edits of term configs (weights, parameters, command ranges),
        changed attributes of terms and of the environment, changed settings (`episode_length_s`),
        and terrain levels.
        """
        return curriculum_state.curriculum_state(self)

    def load_curriculum_state(self, state: dict[str, Any]) -> list[str]:
        """Restore a `curriculum_state`, and return the names of parts that do not fit this task.

        Rows of environments, such as terrain levels, are spread over `num_envs` in order. Episodes
        are those of before: `reset` starts new ones, within `curriculum_manager.held()`.
        """
        return curriculum_state.load_curriculum_state(self, state)

    def curricula_in_use(self) -> dict[str, Any]:
        """Return the changes made by curricula, by path in the config: numbers, and lists of numbers.

        Attributes of terms and of the environment follow the same naming (`env.<name>`); numbers that
        curriculum terms log, and nothing else shows, are `Curriculum/<term>`.
        """
        return curriculum_state.curricula_in_use(self)

    def close(self) -> None:
        """Close the renderer, the recorders and the simulation."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.recorder_manager.close()
        self.sim.close()
