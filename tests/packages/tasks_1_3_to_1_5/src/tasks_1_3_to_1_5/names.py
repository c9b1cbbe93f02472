"""Names that came with releases 1.3 to 1.5."""

from mjlab.actuator import CommandField
from mjlab.actuator.actuator import CommandField as _FROM_BASE
from mjlab.actuator.builtin_group import BuiltinActuatorType
from mjlab.actuator.xml_actuator import CommandField as _FROM_XML
from mjlab.entity.variants import VariantMetadata, allocate_worlds
from mjlab.envs import VecEnvObs
from mjlab.envs.mdp.events import _sample_se3_range
from mjlab.managers.observation_manager import ObservationManager
from mjlab.scripts.train import get_wandb_checkpoint_path, launch_training, run_train
from mjlab.tasks.tracking.tracking_env_cfg import VELOCITY_RANGE
from mjlab.tasks.velocity.mdp.rewards import TerrainHeightSensor
from mjlab.viewer.base import BaseViewer, VerbosityLevel
from mjlab.viewer.model_sync import VIEWER_INERTIAL_FIELDS, VIEWER_MODEL_FIELDS
from mjlab.viewer.viser import MjlabViserScene
from mjlab.viewer.viser.reward_bar_panel import RewardBarPanel
from mjlab.viewer.viser.viewer import CheckpointManager, ViserPlayViewer, format_time_ago

TYPES = (BaseViewer, BuiltinActuatorType, ObservationManager, RewardBarPanel, TerrainHeightSensor)
TYPES += (VariantMetadata, VecEnvObs, VerbosityLevel)
FUNCTIONS = (_sample_se3_range, format_time_ago, get_wandb_checkpoint_path)
FUNCTIONS += (launch_training, run_train)
DRAWING = (MjlabViserScene.add_arrow, MjlabViserScene.clear_debug_all, MjlabViserScene.meansize)

assert all(callable(f) for f in FUNCTIONS)
assert CommandField == _FROM_BASE == _FROM_XML
assert sorted(allocate_worlds((1.0, 1.0), 4)) == [0, 0, 1, 1]
assert {"body_mass", "body_ipos"} <= set(VIEWER_INERTIAL_FIELDS)
assert "geom_rgba" in VIEWER_MODEL_FIELDS
assert len(VELOCITY_RANGE) == 6


def make_page(env, policy, names: list[str]) -> ViserPlayViewer:
    """Return a page on which the user chooses between checkpoints."""
    checkpoints = CheckpointManager(
        current_name=names[-1],
        fetch_available=lambda: [(name, "just now") for name in names],
        load_checkpoint=lambda name: policy,
    )
    return ViserPlayViewer(env, policy, checkpoint_manager=checkpoints)
