"""Names and signatures of release 1.6 that viewers and tools of packages rely on."""

import inspect

from mjlab.viewer.native.keys import KEY_COMMA, KEY_ENTER, KEY_RIGHT, KEY_SPACE
from mjlab.viewer.native.viewer import NativeMujocoViewer, PlotCfg
from mjlab.viewer.viser import MjlabViserScene, RewardBarPanel, ViserTermPlotter
from mjlab.viewer.viser.camera_viewer import ViserCameraViewer
from mjlab.viewer.viser.overlays import ViserCameraOverlays, ViserTermOverlays
from mjlab.viewer.viser.viewer import CheckpointManager, UpdateReason, ViserPlayViewer

TYPES = (CheckpointManager, PlotCfg, ViserCameraOverlays, ViserCameraViewer, ViserTermOverlays)
_SERVER, _ENV, _POLICY, _MODEL = object(), object(), object(), object()

inspect.signature(RewardBarPanel).bind(_SERVER, ["point"], 0.02, max_terms=5)
inspect.signature(ViserTermPlotter).bind(_SERVER, ["point"], "Reward", history_length=50)
inspect.signature(ViserPlayViewer).bind(_ENV, _POLICY, checkpoint_manager=None)
inspect.signature(MjlabViserScene).bind(_SERVER, _MODEL, 4, sim_model=None)
assert UpdateReason.ENV_SWITCH


class PointWindow(NativeMujocoViewer):
    """Window with keys of its own."""

    def __init__(self, env, policy):
        super().__init__(env, policy, key_callback=self.on_key)
        self.pressed: list[str] = []

    def on_key(self, key: int) -> None:
        known = {KEY_SPACE: "pause", KEY_ENTER: "reset", KEY_RIGHT: "step", KEY_COMMA: "previous"}
        self.pressed.append(known.get(key, "unknown"))
