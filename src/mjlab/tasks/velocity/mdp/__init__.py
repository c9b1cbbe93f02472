"""MDP terms of the velocity task, and all terms of `mjlab.envs.mdp`."""

from mjlab.compat import older_names
from mjlab.envs.mdp import *  # noqa: F403
from mjlab.envs.mdp import __all__ as _library
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.sensor import ContactSensor, RayCastSensor, TerrainHeightSensor
from mjlab.tasks.velocity.mdp import (
    curriculums,
    gait,
    observations,
    rewards,
    stepping,
    terminations,
    terrain_utils,
    velocity_command,
)
from mjlab.tasks.velocity.mdp.curriculums import *  # noqa: F403
from mjlab.tasks.velocity.mdp.gait import *  # noqa: F403
from mjlab.tasks.velocity.mdp.observations import *  # noqa: F403
from mjlab.tasks.velocity.mdp.rewards import *  # noqa: F403
from mjlab.tasks.velocity.mdp.stepping import *  # noqa: F403
from mjlab.tasks.velocity.mdp.terminations import *  # noqa: F403
from mjlab.tasks.velocity.mdp.terrain_utils import *  # noqa: F403
from mjlab.tasks.velocity.mdp.velocity_command import *  # noqa: F403

__all__ = [
    "CommandTerm",
    "CommandTermCfg",
    "ContactSensor",
    "RayCastSensor",
    "TerrainHeightSensor",
    *curriculums.__all__,
    *gait.__all__,
    *observations.__all__,
    *rewards.__all__,
    *stepping.__all__,
    *terminations.__all__,
    *terrain_utils.__all__,
    *velocity_command.__all__,
    *(name for name in _library if name != "RayCastSensor"),
]

__getattr__ = older_names(__name__, __all__)
