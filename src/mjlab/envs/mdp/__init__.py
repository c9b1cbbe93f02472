"""Library of reusable MDP terms: observations, rewards, terminations, events, actions, ...

Domain randomization is in `mjlab.envs.mdp.dr`.
"""

from __future__ import annotations

from mjlab.compat import older_names
from mjlab.entity import Entity
from mjlab.envs.mdp import (
    actions,
    curriculums,
    dr,
    events,
    metrics,
    observations,
    pose_command,
    rewards,
    terminations,
)
from mjlab.envs.mdp.actions import *  # noqa: F403
from mjlab.envs.mdp.curriculums import *  # noqa: F403
from mjlab.envs.mdp.events import *  # noqa: F403
from mjlab.envs.mdp.events import sample_uniform
from mjlab.envs.mdp.metrics import *  # noqa: F403
from mjlab.envs.mdp.observations import *  # noqa: F403
from mjlab.envs.mdp.pose_command import *  # noqa: F403
from mjlab.envs.mdp.rewards import *  # noqa: F403
from mjlab.envs.mdp.rewards import resolve_matching_names_values
from mjlab.envs.mdp.terminations import *  # noqa: F403
from mjlab.envs.mdp.terminations import NanGuard
from mjlab.managers import RewardTermCfg, SceneEntityCfg
from mjlab.sensor import BuiltinSensor, RayCastSensor

__all__ = [
    "BuiltinSensor",
    "Entity",
    "NanGuard",
    "RayCastSensor",
    "RewardTermCfg",
    "SceneEntityCfg",
    "dr",
    "resolve_matching_names_values",
    "sample_uniform",
    *actions.__all__,
    *curriculums.__all__,
    *events.__all__,
    *metrics.__all__,
    *observations.__all__,
    *pose_command.__all__,
    *rewards.__all__,
    *terminations.__all__,
]

__getattr__ = older_names(__name__, __all__)
