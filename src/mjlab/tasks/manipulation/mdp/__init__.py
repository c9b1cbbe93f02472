"""Terms of the manipulation tasks and of `mjlab.envs.mdp`."""

from mjlab.compat import older_names
from mjlab.envs.mdp import *  # noqa: F403
from mjlab.envs.mdp import __all__ as _library
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.sensor import CameraSensor, ContactSensor
from mjlab.tasks.manipulation.mdp import commands, grasp_starts, observations, rewards, terminations
from mjlab.tasks.manipulation.mdp.commands import *  # noqa: F403
from mjlab.tasks.manipulation.mdp.grasp_starts import *  # noqa: F403
from mjlab.tasks.manipulation.mdp.observations import *  # noqa: F403
from mjlab.tasks.manipulation.mdp.rewards import *  # noqa: F403
from mjlab.tasks.manipulation.mdp.terminations import *  # noqa: F403

__all__ = [
    "CameraSensor",
    "CommandTerm",
    "CommandTermCfg",
    "ContactSensor",
    *commands.__all__,
    *grasp_starts.__all__,
    *observations.__all__,
    *rewards.__all__,
    *terminations.__all__,
    *_library,
]

__getattr__ = older_names(__name__, __all__)
