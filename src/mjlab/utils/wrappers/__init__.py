"""Wrappers around an environment."""

from mjlab.utils.wrappers.video_recorder import VideoRecorder as VideoRecorder
