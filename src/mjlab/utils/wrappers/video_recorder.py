"""Video recording of environments.

`VideoRecorder` wraps an environment and writes clips; `ClipWriter` writes one file atomically.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from mjlab.envs import ManagerBasedRlEnv
from mjlab.utils.errors import check_one_of
from mjlab.utils.os import create_locked, remove_temporary_files, rename_locked, temporary_path
from mjlab.utils.signals import NEW_GROUP
from mjlab.viewer.offscreen_renderer import RenderingUnavailableError

if TYPE_CHECKING:
    import torch

log = logging.getLogger(__name__)

_DEFAULT_FPS = 30.0
_CODECS = {
    ".mp4": "-an -c:v libx264 -pix_fmt yuv420p -crf 20 -movflags +faststart",
    # One palette for the whole clip keeps colors from flickering.
    ".gif": "-an -vf split[a][b];[a]palettegen[p];[b][p]paletteuse",
}


class VideoRecorder(ManagerBasedRlEnv):
    """Environment wrapper that records video clips.

    The recorder can replace the environment everywhere: all attributes except those of the recorder
    are read from, and written to, the environment.

    Triggers are evaluated before each step; a clip starts if a trigger returns True and no clip is
    being recorded. The frame is rendered after the step. A clip ends after `video_length` frames, or
    with None at the end of environment 0's episode. It also ends if stepping fails or the recorder is
    closed, so recorded frames are never lost. If this machine cannot render, the recorder logs this
    once and continues stepping (`unavailable_reason`).
    """

    def __init__(
        self,
        env: ManagerBasedRlEnv,
        video_folder: str | Path,
        episode_trigger: Callable[[int], bool] | None = None,
        step_trigger: Callable[[int], bool] | None = None,
        video_length: int | None = None,
        name_prefix: str = "rl-video",
        disable_logger: bool = False,
    ):
        """Wrap `env`.

        Args:
            env: Environment with `render_mode="rgb_array"`.
            video_folder: Folder for `<prefix>-step-<n>.mp4` and `<prefix>-episode-<n>.mp4`.
            episode_trigger: Function of the index (from 0) of environment 0's episode, called once
                per episode; True records the episode.
            step_trigger: Function of the step index (from 0), called before every step; True
                starts a clip.
            video_length: Frames per clip; below 1, one frame with a warning. None: record until the
                end of environment 0's episode.
            name_prefix: Prefix of file names.
            disable_logger: Do not log the names of written files.

        Raises:
            ValueError: No trigger.
        """
        if episode_trigger is None and step_trigger is None:
            raise ValueError(
                "VideoRecorder: expected an episode_trigger or a step_trigger, got neither."
            )
        if video_length is not None and video_length < 1:
            warnings.warn(
                f"VideoRecorder video_length: expected at least 1 frame, got {video_length}; clips of one "
                "frame are recorded.",
                UserWarning,
                stacklevel=2,
            )
        self.video_folder = Path(video_folder)
        self.written: list[Path] = []
        self.unavailable_reason: str | None = None
        self._episode_trigger = episode_trigger
        self._step_trigger = step_trigger
        self._video_length = video_length
        self._name_prefix = name_prefix
        self._disable_logger = disable_logger
        self._clip: ClipWriter | None = None
        self._step_count = 0
        self._episode_count = 0
        self._episode_steps = 0
        self._asked_episode = -1
        # Set last: attributes set before belong to the recorder, all others to the environment.
        self.env = env

    def __getattribute__(self, name: str) -> Any:
        # Not __getattr__: properties inherited from the environment class would be found first and
        # evaluated on the recorder.
        own = object.__getattribute__(self, "__dict__")
        if name in own or name in vars(VideoRecorder) or name.startswith("__"):
            return object.__getattribute__(self, name)
        return getattr(object.__getattribute__(self, "env"), name)

    def __setattr__(self, name: str, value: Any) -> None:
        own = vars(self)
        if name in own or name in vars(VideoRecorder) or "env" not in own:
            object.__setattr__(self, name, value)
        else:
            setattr(self.env, name, value)

    @property
    def unwrapped(self) -> ManagerBasedRlEnv:
        """The environment without any wrapper."""
        return self.env.unwrapped

    def step(self, action: torch.Tensor) -> Any:
        """Step the environment, and record a frame if due."""
        self._start_due_clip()
        try:
            result = self.env.step(action)
            self._take_frame()
        except BaseException:
            self._finish_clip()
            raise
        self._count_step(bool(result[2][0]) or bool(result[3][0]))
        return result

    def reset(self, **kwargs: Any) -> Any:
        """Reset the environment. Ends a clip of one episode."""
        if self._episode_steps > 0 and kwargs.get("env_ids") is None:
            self._count_step(episode_over=True, stepped=False)
        return self.env.reset(**kwargs)

    def render(
        self, camera: str | int | None = None, env_idx: int | None = None
    ) -> np.ndarray | None:
        """Return the environment's rendering."""
        given: dict[str, Any] = {"camera": camera, "env_idx": env_idx}
        return self.env.render(**{name: one for name, one in given.items() if one is not None})

    def close(self) -> None:
        """Finish the clip being recorded, then close the environment."""
        try:
            self._finish_clip()
        finally:
            self.env.close()

    def _start_due_clip(self) -> None:
        if self._clip is not None or self.unavailable_reason is not None:
            return
        suffix = None
        if self._step_trigger is not None and self._step_trigger(self._step_count):
            suffix = f"step-{self._step_count}"
        # Once per episode, because clips shorter than the episode would otherwise be recorded
        # repeatedly to the same file.
        elif self._episode_trigger is not None and self._asked_episode != self._episode_count:
            self._asked_episode = self._episode_count
            if self._episode_trigger(self._episode_count):
                suffix = f"episode-{self._episode_count}"
        if suffix is not None:
            fps = (getattr(self.env, "metadata", None) or {}).get("render_fps") or _DEFAULT_FPS
            path = self.video_folder / f"{self._name_prefix}-{suffix}.mp4"
            self._clip = ClipWriter(path, float(fps))

    def _take_frame(self) -> None:
        if self._clip is None:
            return
        try:
            frame = self.env.render()
            if frame is not None:
                image = np.asarray(frame)
                # Batched images, (n, H, W, 3): record environment 0.
                self._clip.add(image[0] if image.ndim == 4 else image)
        except RenderingUnavailableError as error:
            self.unavailable_reason = str(error)
            self._finish_clip()
            log.warning("No video is recorded. %s", error)
        except OSError as error:
            # A full disk must not end a training run.
            log.error("Incomplete video. %s", error)
            self._finish_clip()

    def _count_step(self, episode_over: bool, stepped: bool = True) -> None:
        if stepped:
            self._step_count += 1
            self._episode_steps += 1
        if episode_over:
            self._episode_count += 1
            self._episode_steps = 0
        if self._clip is None:
            return
        full = self._video_length is not None and self._clip.num_frames >= self._video_length
        if full or (self._video_length is None and episode_over):
            self._finish_clip()

    def _finish_clip(self) -> None:
        clip, self._clip = self._clip, None
        if clip is None:
            return
        try:
            path = clip.close()
        except OSError as error:
            log.error("The video is lost. %s", error)
            return
        if path is not None:
            self.written.append(path)
            if not self._disable_logger:
                log.info("Wrote %d frames to %s.", clip.num_frames, path)


class ClipWriter:
    """Streams frames to an mp4 or gif file that appears under its name only when complete.

    `close` finishes the file; it also runs at program exit. Frames are sent to the encoder (ffmpeg
    of the package imageio-ffmpeg) immediately, so memory does not grow with the clip. Without
    frames, no file is written.
    """

    def __init__(self, path: Path, fps: float):
        """Create a writer. The file is opened at the first frame.

        Args:
            path: Path of the finished file; missing folders are created.
            fps: Frames per second.

        Raises:
            ValueError: The name does not end in .mp4 or .gif.
        """
        check_one_of(f"suffix of {path.name!r}", path.suffix, _CODECS)
        self.path = path
        self.fps = fps
        self.num_frames = 0
        # The encoder writes to this file; this process holds its lock.
        self._partial: IO[bytes] | None = None
        self._encoder: subprocess.Popen[bytes] | None = None
        self._messages: IO[bytes] | None = None
        self._shape: tuple[int, ...] = ()

    def add(self, frame: np.ndarray) -> None:
        """Append a frame, (height, width, 3), uint8 or float in [0, 1]. All frames have the same size.

        Raises:
            ValueError: The frame is not an RGB image, or its size differs from the first frame.
            OSError: The encoder or the disk failed.
        """
        image = _even_uint8(frame)
        if self._encoder is None:
            self._open(image)
        assert self._encoder is not None
        assert self._encoder.stdin is not None
        if image.shape != self._shape:
            raise ValueError(
                f"Frame {self.num_frames} of {self.path.name}: expected shape {self._shape} of the "
                f"first frame, got {image.shape}."
            )
        try:
            self._encoder.stdin.write(image.tobytes())
        except OSError as error:
            raise OSError(
                f"Cannot write the video {self.path}: {self._encoder_message(error)}"
            ) from error
        self.num_frames += 1

    def close(self) -> Path | None:
        """Finish the file and return its path. Returns None if already closed or without frames.

        Raises:
            OSError: The encoder or the disk failed; the unfinished file is removed.
        """
        encoder, self._encoder = self._encoder, None
        if encoder is None or encoder.stdin is None:
            return None
        atexit.unregister(self.close)
        # If the encoder has already ended, its exit status gives the reason.
        with contextlib.suppress(OSError):
            encoder.stdin.close()
        assert self._partial is not None
        if encoder.wait() != 0:
            self._partial.close()
            Path(self._partial.name).unlink(missing_ok=True)
            raise OSError(
                f"Cannot write the video {self.path}: {self._encoder_message(encoder.returncode)}"
            )
        rename_locked(self._partial, self.path)
        return self.path

    def _open(self, image: np.ndarray) -> None:
        import imageio_ffmpeg

        self._shape = image.shape
        self.path.parent.mkdir(parents=True, exist_ok=True)
        remove_temporary_files(self.path.parent)
        self._partial = create_locked(temporary_path(self.path))
        # Not a pipe: a full pipe would block the encoder.
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115
        height, width = image.shape[:2]
        flags = (
            f"-loglevel error -y -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {self.fps:g} -i - "
            f"{_CODECS[self.path.suffix]} -f {self.path.suffix.removeprefix('.')}"
        )
        self._encoder = subprocess.Popen(
            [imageio_ffmpeg.get_ffmpeg_exe(), *flags.split(), self._partial.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._messages,
            # This program finishes the clip after Ctrl-C.
            creationflags=NEW_GROUP,
            start_new_session=True,
        )
        atexit.register(self.close)

    def _encoder_message(self, fallback: object) -> str:
        """Return the encoder's output, or `fallback` if empty."""
        if self._messages is None:
            return str(fallback)
        self._messages.seek(0)
        text = " ".join(self._messages.read().decode(errors="replace").split())
        return text or str(fallback)


def _even_uint8(frame: np.ndarray) -> np.ndarray:
    """Return the frame as uint8, with an odd last row or column repeated.

    H.264 stores color at half resolution and requires even sizes.
    """
    image = np.asarray(frame)
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"Frame: expected shape (height, width, 3), got {image.shape}.")
    if np.issubdtype(image.dtype, np.floating):
        image = np.round(np.clip(image, 0.0, 1.0) * 255.0)
    image = image.astype(np.uint8)
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return image
