"""Terms of motion tracking and of `mjlab.envs.mdp`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.compat import older_names
from mjlab.envs.mdp import *  # noqa: F403
from mjlab.envs.mdp import __all__ as _library
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.sensor import ContactSensor
from mjlab.tasks.tracking.mdp import commands, metrics, observations, rewards, terminations
from mjlab.tasks.tracking.mdp.commands import *  # noqa: F403
from mjlab.tasks.tracking.mdp.metrics import *  # noqa: F403
from mjlab.tasks.tracking.mdp.observations import *  # noqa: F403
from mjlab.tasks.tracking.mdp.rewards import *  # noqa: F403
from mjlab.tasks.tracking.mdp.terminations import *  # noqa: F403
from mjlab.utils.lab_api.math import subtract_frame_transforms

if TYPE_CHECKING:
    from mjlab.viewer.debug_visualizer import DebugVisualizer as DebugVisualizer

__all__ = [
    "CommandTerm",
    "CommandTermCfg",
    "ContactSensor",
    "DebugVisualizer",
    "subtract_frame_transforms",
    *commands.__all__,
    *metrics.__all__,
    *observations.__all__,
    *rewards.__all__,
    *terminations.__all__,
    *(name for name in _library if name != "DebugVisualizer"),
]

__getattr__ = older_names(__name__, __all__)
