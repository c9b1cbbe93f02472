"""Names that came with release 1.3."""

from mjlab.actuator import CommandField
from mjlab.actuator.actuator import CommandField as _FROM_BASE
from mjlab.actuator.builtin_group import BuiltinActuatorType
from mjlab.actuator.xml_actuator import CommandField as _FROM_XML
from mjlab.scripts.train import get_wandb_checkpoint_path
from mjlab.tasks.velocity.mdp.rewards import TerrainHeightSensor
from mjlab.viewer.viser import MjlabViserScene
from mjlab.viewer.viser.reward_bar_panel import RewardBarPanel
from mjlab.viewer.viser.viewer import CheckpointManager, ViserPlayViewer, format_time_ago

assert CommandField == _FROM_BASE == _FROM_XML
assert callable(get_wandb_checkpoint_path)
assert callable(format_time_ago)

TYPES = (BuiltinActuatorType, RewardBarPanel, TerrainHeightSensor)
DRAWING = (MjlabViserScene.add_arrow, MjlabViserScene.clear_debug_all, MjlabViserScene.meansize)


def make_page(env, policy, names: list[str]) -> ViserPlayViewer:
    """Return a page on which the user chooses between checkpoints."""
    checkpoints = CheckpointManager(
        current_name=names[-1],
        fetch_available=lambda: [(name, "just now") for name in names],
        load_checkpoint=lambda name: policy,
    )
    return ViserPlayViewer(env, policy, checkpoint_manager=checkpoints)
