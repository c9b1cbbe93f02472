"""Wrappers around an environment."""

from mjlab.viewer.video_recorder import VideoRecorder as VideoRecorder
