"""Names that packages for release 1.5 pass on."""

from mjlab.envs import VecEnvObs
from mjlab.managers.observation_manager import ObservationManager
from mjlab.scripts.train import get_wandb_checkpoint_path, launch_training, run_train
from mjlab.tasks.tracking.tracking_env_cfg import VELOCITY_RANGE
from mjlab.viewer.base import BaseViewer, VerbosityLevel

TYPES = (BaseViewer, ObservationManager, VecEnvObs, VerbosityLevel)
assert all(callable(f) for f in (get_wandb_checkpoint_path, launch_training, run_train))
assert len(VELOCITY_RANGE) == 6
