"""The motion command, at its public path."""

from mjlab.compat import older_names
from mjlab.tasks.tracking.mdp.motion_command import MotionCommand as MotionCommand
from mjlab.tasks.tracking.mdp.motion_command import MotionCommandCfg as MotionCommandCfg
from mjlab.tasks.tracking.mdp.motion_loader import MotionLoader as MotionLoader

__getattr__ = older_names(__name__)
