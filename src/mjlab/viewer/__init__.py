"""Viewers: Viser, native MuJoCo window, offscreen rendering, video.

Names are imported on first use, so that a config can import `ViewerConfig` without loading
MuJoCo, torch or viser.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.utils.wrappers.video_recorder import VideoRecorder as VideoRecorder
    from mjlab.viewer.base import BaseViewer as BaseViewer
    from mjlab.viewer.base import EnvProtocol as EnvProtocol
    from mjlab.viewer.base import PolicyProtocol as PolicyProtocol
    from mjlab.viewer.base import VerbosityLevel as VerbosityLevel
    from mjlab.viewer.base import run_headless as run_headless
    from mjlab.viewer.native import NativeMujocoViewer as NativeMujocoViewer
    from mjlab.viewer.offscreen_renderer import OffscreenRenderer as OffscreenRenderer
    from mjlab.viewer.offscreen_renderer import (
        RenderingUnavailableError as RenderingUnavailableError,
    )
    from mjlab.viewer.viewer_config import ViewerConfig as ViewerConfig
    from mjlab.viewer.viser import ViserPlayViewer as ViserPlayViewer

_HOMES = {
    "BaseViewer": "mjlab.viewer.base",
    "EnvProtocol": "mjlab.viewer.base",
    "PolicyProtocol": "mjlab.viewer.base",
    "VerbosityLevel": "mjlab.viewer.base",
    "RenderingUnavailableError": "mjlab.viewer.offscreen_renderer",
    "run_headless": "mjlab.viewer.base",
    "NativeMujocoViewer": "mjlab.viewer.native",
    "OffscreenRenderer": "mjlab.viewer.offscreen_renderer",
    "VideoRecorder": "mjlab.utils.wrappers.video_recorder",
    "ViewerConfig": "mjlab.viewer.viewer_config",
    "ViserPlayViewer": "mjlab.viewer.viser",
}

__all__ = sorted(_HOMES)

__getattr__ = lazy_names(__name__, _HOMES)
