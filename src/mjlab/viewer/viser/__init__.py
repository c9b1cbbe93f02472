"""Browser viewer, based on viser and mjviser."""

from __future__ import annotations

from mjlab.compat import older_names
from mjlab.viewer.viser.reward_bar_panel import RewardBarPanel as RewardBarPanel
from mjlab.viewer.viser.scene import MjlabViserScene as MjlabViserScene
from mjlab.viewer.viser.scene import MjlabViserScene as ViserMujocoScene  # noqa: F401 (both names)
from mjlab.viewer.viser.term_plotter import ViserTermPlotter as ViserTermPlotter
from mjlab.viewer.viser.viewer import ViserPlayViewer as ViserPlayViewer

__getattr__ = older_names(__name__)
