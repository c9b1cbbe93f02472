"""The motion command, at its public path."""

from mjlab.tasks.tracking.mdp.motion_command import MotionCommand as MotionCommand
from mjlab.tasks.tracking.mdp.motion_command import MotionCommandCfg as MotionCommandCfg
from mjlab.tasks.tracking.mdp.motion_loader import MotionLoader as MotionLoader
