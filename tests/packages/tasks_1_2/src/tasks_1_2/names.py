"""Names that came with release 1.2."""

from mjlab import MJLAB_SRC_PATH
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import MJLAB_SRC_PATH as _SAME_PATH
from mjlab.envs.mdp.events import apply_body_impulse
from mjlab.tasks.velocity.mdp import quat_mul
from mjlab.viewer.native.viewer import NativeMujocoViewer
from mjlab.viewer.viser import ViserMujocoScene
from mjlab.viewer.viser.camera_viewer import ViserCameraViewer
from mjlab.viewer.viser.conversions import create_site_mesh, merge_geoms_global, merge_sites
from mjlab.viewer.viser.overlays import (
    ViserCameraOverlays,
    ViserContactOverlays,
    ViserDebugOverlays,
    ViserTermOverlays,
)
from mjlab.viewer.viser.viewer import UpdateReason, ViserPlayViewer

assert MJLAB_SRC_PATH == _SAME_PATH
assert callable(quat_mul)
assert {"ACTION", "ENV_SWITCH", "SCENE_REQUEST"} <= set(UpdateReason.__members__)

MESHES = (create_site_mesh, merge_geoms_global, merge_sites, ViserMujocoScene.create)
OVERLAYS = (
    ViserCameraOverlays,
    ViserCameraViewer,
    ViserContactOverlays,
    ViserDebugOverlays,
    ViserTermOverlays,
)
IMPULSE_ARROW = apply_body_impulse.VizCfg(rgba=(1.0, 0.5, 0.0, 1.0), scale=0.01)


class RoverWindow(NativeMujocoViewer):
    """Window with debug drawing that the user can switch off."""

    _show_debug_vis = True
    updates = 0

    def _update_debug_visualizers(self, viewer) -> None:
        if self._show_debug_vis:
            super()._update_debug_visualizers(viewer)

    def _update_stats(self) -> None:
        super()._update_stats()
        self.updates += 1


class RoverPage(ViserPlayViewer):
    """Page that counts the updates of its status."""

    updates = 0

    def _update_stats(self) -> None:
        super()._update_stats()
        self.updates += 1
