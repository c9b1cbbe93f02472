"""Managers: the named terms of a task, by kind."""

from mjlab.managers.action_manager import ActionManager, ActionTerm, ActionTermCfg
from mjlab.managers.command_manager import (
    CommandManager,
    CommandTerm,
    CommandTermCfg,
    NullCommandManager,
)
from mjlab.managers.curriculum_manager import (
    CurriculumManager,
    CurriculumTermCfg,
    NullCurriculumManager,
)
from mjlab.managers.debug_vis import SensorSwitches
from mjlab.managers.event_manager import EventManager, EventMode, EventTermCfg
from mjlab.managers.manager_base import ManagerBase, ManagerTermBase, ManagerTermBaseCfg
from mjlab.managers.metrics_manager import MetricsManager, MetricsTermCfg, NullMetricsManager
from mjlab.managers.observation_manager import (
    ObservationGroupCfg,
    ObservationManager,
    ObservationTermCfg,
)
from mjlab.managers.recorder_manager import (
    NullRecorderManager,
    RecorderManager,
    RecorderTerm,
    RecorderTermCfg,
)
from mjlab.managers.reward_manager import RewardManager, RewardTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.termination_manager import TerminationManager, TerminationTermCfg
from mjlab.utils.tables import Table, Tabular

__all__ = [
    "ActionManager",
    "ActionTerm",
    "ActionTermCfg",
    "CommandManager",
    "CommandTerm",
    "CommandTermCfg",
    "CurriculumManager",
    "CurriculumTermCfg",
    "EventManager",
    "EventMode",
    "EventTermCfg",
    "ManagerBase",
    "ManagerTermBase",
    "ManagerTermBaseCfg",
    "MetricsManager",
    "MetricsTermCfg",
    "NullCommandManager",
    "NullCurriculumManager",
    "NullMetricsManager",
    "NullRecorderManager",
    "ObservationGroupCfg",
    "ObservationManager",
    "ObservationTermCfg",
    "RecorderManager",
    "RecorderTerm",
    "RecorderTermCfg",
    "RewardManager",
    "RewardTermCfg",
    "SceneEntityCfg",
    "SensorSwitches",
    "Table",
    "Tabular",
    "TerminationManager",
    "TerminationTermCfg",
]
