"""The commands of the manipulation tasks."""

from mjlab.compat import older_names
from mjlab.tasks.manipulation.mdp.lifting_command import LiftingCommand as LiftingCommand
from mjlab.tasks.manipulation.mdp.lifting_command import LiftingCommandCfg as LiftingCommandCfg
from mjlab.tasks.manipulation.mdp.multi_cube_command import (
    MultiCubeLiftingCommand as MultiCubeLiftingCommand,
)
from mjlab.tasks.manipulation.mdp.multi_cube_command import (
    MultiCubeLiftingCommandCfg as MultiCubeLiftingCommandCfg,
)

__getattr__ = older_names(__name__)
