"""The commands of the manipulation tasks."""

from mjlab.tasks.manipulation.mdp.lifting_command import LiftingCommand as LiftingCommand
from mjlab.tasks.manipulation.mdp.lifting_command import LiftingCommandCfg as LiftingCommandCfg
from mjlab.tasks.manipulation.mdp.multi_cube_command import (
    MultiCubeLiftingCommand as MultiCubeLiftingCommand,
)
from mjlab.tasks.manipulation.mdp.multi_cube_command import (
    MultiCubeLiftingCommandCfg as MultiCubeLiftingCommandCfg,
)
