"""Public path of `VideoRecorder`, whose home is `mjlab.viewer.video_recorder`."""

from mjlab.viewer.video_recorder import VideoRecorder as VideoRecorder
