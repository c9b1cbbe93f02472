"""The environment: one decision process over N parallel simulations, built from managers."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Generator
from dataclasses import dataclass, field
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.envs import env_state
from mjlab.envs.divergence import DivergenceLog
from mjlab.envs.mdp.events import reset_scene_to_default
from mjlab.envs.mdp.terminations import time_out
from mjlab.envs.types import VecEnvObs, VecEnvStepReturn
from mjlab.managers import (
    ActionManager,
    CommandManager,
    CurriculumManager,
    EventManager,
    MetricsManager,
    NullCommandManager,
    NullCurriculumManager,
    NullMetricsManager,
    NullRecorderManager,
    ObservationManager,
    RecorderManager,
    RewardManager,
    TerminationManager,
)
from mjlab.managers.action_manager import ActionTermCfg
from mjlab.managers.command_manager import CommandTermCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.lookup import Lookup, look_up
from mjlab.managers.manager_base import SensorSwitches
from mjlab.managers.metrics_manager import MetricsTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg
from mjlab.managers.recorder_manager import RecorderTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.term_checks import check_real
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim.config import SimulationCfg
from mjlab.sim.engine import resolve_engine_name
from mjlab.sim.memory import LEAST_BYTES, check_memory
from mjlab.sim.simulation import Simulation
from mjlab.utils import spaces
from mjlab.utils.errors import UnsupportedError, WrongStateError, check_count
from mjlab.utils.indexing import as_ids
from mjlab.utils.random import draw_seed, seed_rng
from mjlab.viewer.viewer_config import ViewerConfig

if TYPE_CHECKING:
    from mjlab.viewer.debug_visualizer import DebugVisualizer
    from mjlab.viewer.offscreen_renderer import OffscreenRenderer


@dataclass(kw_only=True)
class ManagerBasedRlEnvCfg:
    """A task: a scene, and named terms for each part of the decision process.

    A term set to None is switched off.
    """

    decimation: int
    """Physics substeps per environment step."""
    scene: SceneCfg
    """Entities, terrain and sensors, and the number of environments."""
    observations: dict[str, ObservationGroupCfg | None] = field(default_factory=dict)
    """Observation groups by name, such as `actor` and `critic`."""
    actions: dict[str, ActionTermCfg | None] = field(default_factory=dict)
    """Action terms; their order is the order of the action vector."""
    events: dict[str, EventTermCfg | None] = field(
        default_factory=lambda: {
            "reset_scene_to_default": EventTermCfg(func=reset_scene_to_default, mode="reset")
        }
    )
    """What happens at startup, reset, intervals or every step. By default a reset puts the scene
    into its default state; an empty dict resets to the model's `qpos0` only."""
    seed: int | None = None
    """Seed of every random number; None draws one, which is stored here."""
    sim: SimulationCfg = field(default_factory=SimulationCfg)
    """Physics."""
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    """Camera and size of rendered images."""
    episode_length_s: float = 0.0
    """Length of an episode, in seconds."""
    rewards: dict[str, RewardTermCfg | None] = field(default_factory=dict)
    """Reward terms."""
    terminations: dict[str, TerminationTermCfg | None] = field(default_factory=dict)
    """Termination terms."""
    commands: dict[str, CommandTermCfg | None] = field(default_factory=dict)
    """Command terms."""
    curriculum: dict[str, CurriculumTermCfg | None] = field(default_factory=dict)
    """Curriculum terms."""
    metrics: dict[str, MetricsTermCfg | None] = field(default_factory=dict)
    """Metric terms: logged, never rewarded."""
    recorders: dict[str, RecorderTermCfg | None] = field(default_factory=dict)
    """Recorder terms."""
    is_finite_horizon: bool = False
    """True if the time limit is part of the task: a time-out is then not bootstrapped."""
    auto_reset: bool = True
    """Whether `step` resets environments that are done."""
    scale_rewards_by_dt: bool = True
    """Whether rewards are multiplied by the environment step, in seconds."""


class ManagerBasedRlEnv:
    """N environments stepped together. All tensors have a leading dimension N.

    Call `reset` before the first `step`: the constructor leaves the model's initial state.

    Attributes:
        observes_ends: Have `step` return the observations in which episodes run out of time. False
            at first; learners that bootstrap from them switch it on.
        observes_failures: With `observes_ends`, return also those in which episodes terminate. False
            at first; adapters to interfaces that have them switch it on.
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

        `render_mode` is None or `rgb_array`. Further keyword arguments are ignored.

        Raises:
            ValueError: whatever is wrong with the config, by name, before any stepping; or the
                device does not exist.
            EngineUnavailableError: the engine cannot serve the device, or cannot run here.
        """
        check_env_cfg(cfg)
        check_device(device)
        # Refused before tensors go to a device that the engine does not serve.
        resolve_engine_name(cfg.sim.engine, device)
        self.cfg = cfg
        cfg.seed = self.seed(-1 if cfg.seed is None else cfg.seed)
        self.render_mode = render_mode
        self.metadata: dict[str, Any] = {"render_modes": [None, "rgb_array"]}
        self.extras: dict[str, Any] = {}
        self.obs_buf: VecEnvObs = {}
        self._device = device
        # Origins are made with the scene, before the sizes of the model are known.
        check_memory(cfg.scene.num_envs, LEAST_BYTES, device)
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
        self.sim.add_forward_callback(self.scene.invalidate_sensor_caches)
        if self.scene.sensor_context is not None:
            self.sim.set_sensor_context(self.scene.sensor_context)

        self.observes_ends = self.observes_failures = False
        self.common_step_counter = 0
        self._holds_common_steps = False
        self._sim_step_counter = 0
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=device)
        self._pending_reset = torch.zeros(self.num_envs, dtype=torch.bool, device=device)
        self.diverged = torch.zeros(self.num_envs, dtype=torch.bool, device=device)
        self._nan_resets = torch.zeros(self.num_envs, dtype=torch.long, device=device)
        self._divergence_log = DivergenceLog(self.sim)
        # Time that passes for commands in a step with resets. Kept, because torch counts no writes to
        # a tensor made under `inference_mode`, and by these a `Lookup` knows that it is valid.
        self._command_dts = torch.zeros(self.num_envs, dtype=torch.float32, device=device)
        self._ended, self._observed = Lookup(), Lookup()
        self._looks_ahead = torch.device(device).type == "cuda"
        self._renderer: OffscreenRenderer | None = None
        self._renderer_is_open = False
        if render_mode == "rgb_array":
            self._renderer = self._create_renderer()
        self.metadata["render_fps"] = 1.0 / self.step_dt
        self.load_managers()
        # Expanding model fields dropped the graphs that the simulation was built with.
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

    # Kept, because asking MuJoCo takes longer than many a term, which ask for it in every step.
    @functools.cached_property
    def physics_dt(self) -> float:
        """Physics time step, in seconds."""
        return float(self.sim.mj_model.opt.timestep)

    @property
    def step_dt(self) -> float:
        """Environment step, in seconds: the physics time step times the decimation."""
        return self.physics_dt * self.cfg.decimation

    @property
    def max_episode_length_s(self) -> float:
        """Length of an episode, in seconds."""
        return self.cfg.episode_length_s

    @property
    def max_episode_length(self) -> int:
        """Length of an episode, in environment steps."""
        # The small number keeps 0.14 s / 0.02 s, which is 7.0000000000000001, at 7 steps.
        return math.ceil(self.max_episode_length_s / self.step_dt - 1e-6)

    @property
    def nan_resets(self) -> torch.Tensor:
        """Number of episodes that ended because the physics diverged, (N,) int64."""
        return self._nan_resets

    @property
    def unwrapped(self) -> ManagerBasedRlEnv:
        """This environment, below any wrapper."""
        return self

    # Construction.

    def _create_renderer(self) -> OffscreenRenderer:
        from mjlab.viewer.offscreen_renderer import OffscreenRenderer

        return OffscreenRenderer(
            model=self.sim.mj_model,
            cfg=self.cfg.viewer,
            scene=self.scene,
            sim_model=self.sim.model,
            expanded_fields=self.sim.expanded_fields,
        )

    def load_managers(self) -> None:
        """Build all managers, in the order in which they depend on each other."""
        cfg = self.cfg
        # Events come first: the model fields that they randomize have to be expanded before
        # anything keeps a reference to them.
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
        self._configure_spaces()
        # What is the same in all substeps of a step is written once.
        self._acts_between_substeps = self.action_manager.needs_substep or any(
            entity.needs_substep for entity in self.scene.entities.values()
        )
        # Without anything that acts between substeps, the engine runs all of them in one go and
        # records what sensors need of each.
        self._steps_as_one = not (
            self._acts_between_substeps
            or self.scene.needs_substep
            or self.metrics_manager.needs_substep
        )
        if "startup" in self.event_manager.available_modes:
            self.event_manager.apply(mode="startup")

    def setup_manager_visualizers(self) -> None:
        """Collect the managers that can draw into a viewer."""
        self.manager_visualizers: dict[str, Any] = {}
        if self.command_manager.active_terms:
            self.manager_visualizers["command_manager"] = self.command_manager
        self.manager_visualizers["event_manager"] = self.event_manager
        self.manager_visualizers["reward_manager"] = self.reward_manager

    def _configure_spaces(self) -> None:
        groups: dict[str, spaces.Space] = {}
        for name, term_names in self.observation_manager.active_terms.items():
            dims: Any = self.observation_manager.group_obs_dim[name]
            if self.observation_manager.group_obs_concatenate[name]:
                groups[name] = spaces.Box(shape=tuple(dims))
            else:
                boxes: list[spaces.Space] = [spaces.Box(shape=tuple(dim)) for dim in dims]
                groups[name] = spaces.Dict(spaces=dict(zip(term_names, boxes, strict=True)))
        self.single_observation_space = spaces.Dict(spaces=groups)
        self.single_action_space = spaces.Box(shape=(self.action_manager.total_action_dim,))
        self.observation_space = spaces.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = spaces.batch_space(self.single_action_space, self.num_envs)

    # The loop.

    def reset(
        self,
        *,
        seed: int | None = None,
        env_ids: torch.Tensor | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[VecEnvObs, dict[str, Any]]:
        """Start new episodes in `env_ids` (None: all); return observations and extras.

        A `seed` reseeds every random number generator. Observations are those of all
        environments; only those of `env_ids` advance their delay and history buffers. Forces and
        accelerations are current in `env_ids`, and those of the last substep in the others, as
        after `step`; before the first substep they are current everywhere.

        Raises:
            ValueError: `env_ids` out of range, not integers, or a mask of another length.
        """
        env_ids = as_reset_ids(env_ids, self.num_envs, self.device)
        if seed is not None:
            self.seed(seed)
        self._clear_extras()
        stepped = env_ids[self.episode_length_buf[env_ids] > 0]
        if len(stepped) > 0:
            self.recorder_manager.record_pre_reset(stepped)
        moved = self.scene.take_moved_envs()
        self._reset_idx(env_ids)
        self.scene.write_data_to_sim(env_ids)
        self._forward(env_ids, moved)
        self._compute_commands(dt=0.0, env_ids=env_ids)
        self.sim.sense()
        self.obs_buf = self.observation_manager.compute(update_history=True, env_ids=env_ids)
        self.recorder_manager.record_post_reset(env_ids)
        return self.obs_buf, self.extras

    def step(self, action: torch.Tensor) -> VecEnvStepReturn:
        """Advance all environments by one environment step.

        The order is: process actions; `decimation` physics substeps; terminations and rewards;
        step and interval events; resets of environments that are done; `forward`; commands;
        observations. On both engines:

        - Terminations, rewards, metrics, step and interval events read what the last substep
          computed: `qpos` and `qvel` are current, and derived quantities (`xpos`, `cvel`,
          `sensordata`, contacts, forces) are those from which that substep started.
        - Commands and observations read current positions and velocities and what derives from
          them: poses and velocities of links, position and velocity sensors, rays, images.
        - Quantities of the acceleration stage (contact and constraint forces, contact sensors,
          `qacc`, `actuator_force`, accelerometers, force and torque sensors) stay those of the last
          substep, which acted on the robot: `forward` goes no further than `stage="vel"`.
        - A full `forward` gives them in environments that were reset, so that nothing of the old
          episode is seen, and in those in which an event placed something (root pose, joint
          positions or mocap pose, by a writer of `Entity`). Contact histories and air times begin
          with the first substep after a reset.

        Where the physics diverged (positions, velocities or accelerations that are not finite, or
        beyond MuJoCo's `mjMAXVAL` of 1e10), the episode terminates, and the reward of the step is zero.
        `diverged` (N,) bool are these environments, `nan_resets` (N,) counts their episodes.

        A command that writes positions, and a term that writes `sim.data` itself, runs
        `sim.forward(env_ids)`, on the environments concerned.

        With `observes_ends` and `auto_reset`, steps in which episodes run out of time (truncated and
        not terminated) observe these k environments before they are reset; with `observes_failures`
        too, all that end, but those whose physics diverged.
        `extras["final_observations"]` is what `step` would have returned for them had the episodes
        gone on, group to (k, ...), and `extras["final_ids"]` are their ids (k,), ascending. Only
        commands are those that acted in the step: they have neither advanced nor been redrawn.
        Other steps have neither entry. Trajectories do not depend on the switch.

        Args:
            action: (N, A) float tensor; an array or a list is converted.

        Returns:
            Observations (of the new episode where an environment was reset); reward (N,);
            terminated (N,) and truncated (N,) bool; extras, with `extras["log"]`. All but the
            observations are overwritten by the next step.

        Raises:
            ValueError: an action of another shape, of no numbers, or one that is not finite.
            RuntimeError: without `auto_reset`, an environment that is done was not reset.
        """
        if not self.cfg.auto_reset and self._pending_reset.any():
            ids = self._pending_reset.nonzero().flatten().tolist()
            raise WrongStateError(
                f"Environments {ids[:10]}{' ...' if len(ids) > 10 else ''} are done and were not "
                "reset. Call env.reset(env_ids=...) first, or set auto_reset=True in the config."
            )
        self._clear_extras()
        self.action_manager.process_action(as_action(action, self.device))
        self._run_physics()
        self.episode_length_buf += 1
        if not self._holds_common_steps:
            self.common_step_counter += 1

        self._evaluate_step()
        self._look_ahead()
        self._divergence_log.end_step(self.diverged, self.common_step_counter)
        for mode in ("step", "interval"):
            if mode in self.event_manager.available_modes:
                self.event_manager.apply(mode=mode, dt=self.step_dt)

        moved = self.scene.take_moved_envs()
        if self.observes_ends and self.cfg.auto_reset:
            self._observe_ends(moved)
        reset_ids = self._reset_done_envs()
        command_dt: float | torch.Tensor = self.step_dt
        if len(reset_ids) > 0:
            # No time has passed for commands where an episode has just begun.
            command_dt = self._command_dts.fill_(command_dt).index_fill_(0, reset_ids, 0.0)
            if self._looks_ahead:
                # Resets redrew their timers. Here the GPU has less left to do than after `forward`.
                look_up(self.command_manager.plan_lookups(command_dt))
        self._forward(reset_ids, moved)
        self._compute_commands(dt=command_dt)
        self.sim.sense()
        self.obs_buf = self.observation_manager.compute(update_history=True)
        if self.cfg.auto_reset:
            if len(reset_ids) > 0:
                self.recorder_manager.record_post_reset(reset_ids)
        else:
            self._pending_reset |= self.reset_buf
        self.recorder_manager.record_post_step()
        return (
            self.obs_buf,
            self.reward_buf,
            self.reset_terminated,
            self.reset_time_outs,
            self.extras,
        )

    @contextlib.contextmanager
    def common_steps_held(self) -> Generator[None]:
        """Within this context steps do not count as steps of training.

        `common_step_counter` stands still, and with it the curricula that go by it. For evaluations.
        """
        held, self._holds_common_steps = self._holds_common_steps, True
        try:
            yield
        finally:
            self._holds_common_steps = held

    def get_observations(self) -> VecEnvObs:
        """Return the observations of the last step or reset."""
        return self.observation_manager.compute()

    def _run_physics(self) -> None:
        self._divergence_log.begin_step()
        substeps = self.cfg.decimation
        if self._steps_as_one:
            self._sim_step_counter += substeps
            self.action_manager.apply_action()
            self.scene.write_data_to_sim()
            recorded = self.sim.step(substeps, self.scene.recorded_fields)
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

    def _evaluate_step(self) -> None:
        """Compute terminations, rewards and metrics; end the episodes whose physics diverged."""
        self.diverged.copy_(self.sim.bad_states())
        for manager in (self.termination_manager, self.reward_manager):
            manager.nonfinite.begin_step(self.diverged, self.common_step_counter)
        self.reset_buf = self.termination_manager.compute()
        self.reset_terminated = self.termination_manager.terminated
        self.reset_time_outs = self.termination_manager.time_outs
        self.reset_terminated |= self.diverged
        self.reset_buf |= self.diverged
        self._nan_resets += self.diverged
        self.reward_buf = self.reward_manager.compute(dt=self.step_dt)
        # Also what a subclass of the manager adds.
        self.reward_buf.masked_fill_(self.diverged, 0.0)
        log = self.extras["log"]
        log["Simulation/nan_resets"] = self.diverged.sum()
        log["Simulation/nan_rewards"] = self.reward_manager.nonfinite.count
        log["Simulation/nan_terminations"] = self.termination_manager.nonfinite.count
        self.metrics_manager.excluded = self.diverged
        self.metrics_manager.compute()

    def _look_ahead(self) -> None:
        """On a GPU, look up in one wait which environments end, and are due for events and commands.

        On the CPU a look-up costs least where it is needed.
        """
        if not self._looks_ahead:
            return
        lookups = [
            *self.event_manager.plan_lookups(self.step_dt),
            *self.command_manager.plan_lookups(self.step_dt),
            *self._divergence_log.plan_lookups(self.diverged),
        ]
        if self.cfg.auto_reset:
            lookups.append(self._ended.plan(self.reset_buf, self.reset_buf))
            if self.observes_ends:
                ended, excluded = self._observed_ends()
                lookups.append(self._observed.plan(ended & ~excluded, ended, excluded))
        look_up(lookups)

    def _clear_extras(self) -> None:
        self.extras["log"] = {}
        for name in ("final_observations", "final_ids"):
            self.extras.pop(name, None)

    def _observe_ends(self, moved: torch.Tensor | None) -> None:
        """Put the observations of episodes that end into `extras`; see `step`.

        What resets and curricula read (derived quantities, rays, images, random numbers) is left as
        it would be without.

        Args:
            moved: (N,) bool, environments in which an event placed something; None for nowhere.
        """
        ended, excluded = self._observed_ends()
        ids = self._observed.take(ended, excluded)
        if ids is None:
            ids = (ended & ~excluded).nonzero().flatten()
        if len(ids) == 0:
            return
        with self.sim.looking_ahead(ids):
            if moved is not None and len(placed := ids[moved[ids]]) > 0:
                self.sim.forward(placed)
            self.sim.sense(ids)
            observations = self.observation_manager.preview()
        self.extras["final_observations"] = {
            name: value[ids]
            if isinstance(value, torch.Tensor)
            else {term: part[ids] for term, part in value.items()}
            for name, value in observations.items()
        }
        self.extras["final_ids"] = ids

    def _observed_ends(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (N,) bool masks: the ends that are observed are those in the first, not in the second."""
        if self.observes_failures:
            return self.reset_buf, self.diverged
        return self.reset_time_outs, self.reset_terminated

    def _reset_done_envs(self) -> torch.Tensor:
        """Reset environments that are done, under `auto_reset`; return their ids."""
        if not self.cfg.auto_reset:
            return self.reset_buf.new_empty(0, dtype=torch.long)
        reset_ids = self._ended.take(self.reset_buf)
        if reset_ids is None:
            reset_ids = self.reset_buf.nonzero().flatten()
        if len(reset_ids) > 0:
            self.recorder_manager.record_pre_reset(reset_ids)
            self._reset_idx(reset_ids)
            self.scene.write_data_to_sim(reset_ids)
        return reset_ids

    def _forward(self, reset_ids: torch.Tensor, moved: torch.Tensor | None) -> None:
        """Make derived quantities current as far as `step` says.

        Args:
            reset_ids: Environments that were reset.
            moved: (N,) bool, those in which something was placed before the resets (what resets
                place is in `reset_ids`, and looking would wait for the GPU); None for nowhere.
        """
        full = reset_ids
        if moved is not None:
            full = moved.index_fill(0, reset_ids, True).nonzero().flatten()
        # Before the first substep there is nothing to keep.
        if len(full) == self.num_envs or self._sim_step_counter == 0:
            self.sim.forward()
        elif len(full) > 0:
            self.sim.forward_after_reset(full)
        else:
            self.sim.forward(stage="vel")

    def _compute_commands(
        self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None
    ) -> None:
        self.command_manager.compute(dt=dt, env_ids=env_ids)
        # What resets placed is current by now, and commands see to what they place by themselves.
        self.scene.take_moved_envs()

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        # The curriculum runs first, because it judges the state in which the episode ended.
        self.curriculum_manager.compute(env_ids=env_ids)
        self.sim.reset(env_ids)
        self.scene.reset(env_ids)
        if "reset" in self.event_manager.available_modes:
            self.event_manager.apply(
                mode="reset",
                env_ids=env_ids,
                global_env_step_count=self._sim_step_counter // self.cfg.decimation,
            )
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

    # Seeds, rendering, saving, closing.

    @staticmethod
    def seed(seed: int = -1) -> int:
        """Seed every random number generator; -1 draws a seed. Returns the seed used."""
        if seed == -1:
            seed = draw_seed()
        seed_rng(seed)
        return seed

    def render(self, camera: str | int | None = None) -> np.ndarray | None:
        """Return an RGB image (height, width, 3) of uint8 in mode `rgb_array`, else None.

        `camera` names a camera of the model; None takes the view of the config.

        Raises:
            RenderingUnavailableError: this machine cannot render; the message says what to install.
        """
        if self.render_mode in (None, "human"):
            return None
        if self.render_mode != "rgb_array" or self._renderer is None:
            raise UnsupportedError(
                f"Render mode {self.render_mode!r} is not supported; use 'rgb_array' or None."
            )
        # Opened late, so that a machine that cannot render can still train.
        if not self._renderer_is_open:
            self._renderer.initialize()
            self._renderer_is_open = True
        self._renderer.update(self.sim, debug_vis_callback=self.update_visualizers, camera=camera)
        return self._renderer.render()

    def update_visualizers(self, visualizer: DebugVisualizer) -> None:
        """Let managers and sensors draw into `visualizer`."""
        for part in (*self.manager_visualizers.values(), self.sensor_visualizers):
            part.debug_vis(visualizer)

    def state_dict(self) -> dict[str, Any]:
        """Return all run-time state, so that a run can resume bit for bit."""
        return env_state.state_dict(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`; raises ValueError if it comes from another task or size."""
        env_state.load_state_dict(self, state)

    def close(self) -> None:
        """Close the renderer, the recorders and the simulation."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.recorder_manager.close()
        self.sim.close()


def check_env_cfg(cfg: ManagerBasedRlEnvCfg) -> None:
    """Refuse values that could only fail later.

    Raises:
        ValueError: naming the field, what was given and what is allowed.
    """
    check_count("scene.num_envs", cfg.scene.num_envs)
    check_count("decimation", cfg.decimation)
    timestep = cfg.sim.mujoco.timestep
    if not (isinstance(timestep, Real) and timestep > 0):
        raise ValueError(f"sim.mujoco.timestep: expected a number > 0 (s), got {timestep!r}.")
    for name, entity in cfg.scene.entities.items():
        if entity is None:
            raise ValueError(
                f"scene.entities[{name!r}] is None; an entity cannot be switched off like a term. "
                f"Give an EntityCfg, or remove it: del cfg.scene.entities[{name!r}]."
            )
    length = cfg.episode_length_s
    if not (isinstance(length, Real) and math.isfinite(length) and length >= 0):
        raise ValueError(f"episode_length_s: expected a finite number >= 0 (s), got {length!r}.")
    for name, term in cfg.terminations.items():
        if length == 0 and term is not None and term.func is time_out:
            raise ValueError(
                f"episode_length_s is 0, so the termination {name!r} would fire at every step. "
                "Set episode_length_s to the length of an episode in seconds, or remove the term."
            )


def check_device(device: Any) -> None:
    """Refuse a device on which no tensor could be made.

    Raises:
        ValueError: no name of a CPU or CUDA device, or a CUDA device that is not there.
    """
    allowed = "Use 'cpu', 'cuda', or 'cuda:<index>'."
    try:
        parsed = torch.device(device) if isinstance(device, str) else None
    except RuntimeError:
        parsed = None
    if parsed is None or parsed.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {device!r}, which is not a device name. {allowed}")
    if parsed.type != "cuda":
        return
    if not torch.cuda.is_available():
        raise ValueError(
            f"device is {device!r}, but PyTorch finds no CUDA here. Use 'cpu', or install an "
            "NVIDIA driver and a PyTorch with CUDA."
        )
    count = torch.cuda.device_count()
    if (parsed.index or 0) >= count:
        raise ValueError(
            f"device is {device!r}, but the indices of the GPUs here are 0 to {count - 1}."
        )


def as_action(action: Any, device: str) -> torch.Tensor:
    """Return an action as a tensor on `device`; arrays and lists of numbers become float32.

    Raises:
        ValueError: it is neither a tensor nor an array of numbers.
        TypeError: it is a tensor of complex numbers, or without data.
    """
    if isinstance(action, torch.Tensor):
        check_real(action, str, "The action")
        return action.to(device)
    try:
        # Copied, because torch warns about arrays that it may not write to.
        return torch.as_tensor(np.array(action), dtype=torch.float32, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"The action is a {type(action).__name__} that does not convert to a tensor ({error}). "
            "Give a float tensor, array or list of shape (environments, components)."
        ) from error


def as_reset_ids(env_ids: Any, num_envs: int, device: str) -> torch.Tensor:
    """Return the environments to reset as a 1-D int64 tensor on `device`.

    Args:
        env_ids: None for all, a slice, a bool mask (num_envs,), or indices in any integer type.
        num_envs: Number of environments.
        device: Device of the result.

    Raises:
        ValueError: a mask of another length, indices that are no integers or out of range.
    """
    if env_ids is None or isinstance(env_ids, slice):
        return as_ids(env_ids, num_envs, device)
    expected = (
        f"env_ids must be integers from 0 to {num_envs - 1}, a bool mask of length {num_envs}, a "
        "slice, or None for all environments"
    )
    try:
        ids = torch.as_tensor(env_ids, device=device).flatten()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{expected}; got {env_ids!r}.") from error
    if ids.dtype == torch.bool:
        if len(ids) != num_envs:
            raise ValueError(f"{expected}; got a mask of length {len(ids)}.")
        return ids.nonzero().flatten()
    # An empty list becomes a float tensor.
    if ids.numel() == 0:
        return ids.long()
    if ids.is_floating_point() or ids.is_complex():
        raise ValueError(f"{expected}; got numbers of type {ids.dtype}.")
    ids = ids.long()
    wrong = ids[(ids < 0) | (ids >= num_envs)]
    if len(wrong) > 0:
        raise ValueError(f"{expected}; got {wrong[:10].tolist()}{' ...' * (len(wrong) > 10)}.")
    return ids
