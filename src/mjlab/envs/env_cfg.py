"""The configuration of an environment: everything that makes up a task."""

from __future__ import annotations

from dataclasses import dataclass, field

from mjlab.envs.mdp.events import reset_scene_to_default
from mjlab.managers.action_manager import ActionTermCfg
from mjlab.managers.command_manager import CommandTermCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.metrics_manager import MetricsTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg
from mjlab.managers.recorder_manager import RecorderTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim.config import SimulationCfg
from mjlab.viewer.viewer_config import ViewerConfig


def _default_events() -> dict[str, EventTermCfg | None]:
    return {
        "reset_scene_to_default": EventTermCfg(func=reset_scene_to_default, mode="reset"),
    }


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
    events: dict[str, EventTermCfg | None] = field(default_factory=_default_events)
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
