"""Writing one video file, whole or not at all."""

from __future__ import annotations

import atexit
import contextlib
import subprocess
import tempfile
from pathlib import Path
from typing import IO

import numpy as np

from mjlab.utils.os import (
    create_locked,
    remove_temporary_files,
    rename_locked,
    temporary_path,
)

_CODECS = {
    ".mp4": "-an -c:v libx264 -pix_fmt yuv420p -crf 20 -movflags +faststart",
    # One palette for the whole clip keeps colours from flickering.
    ".gif": "-an -vf split[a][b];[a]palettegen[p];[b][p]paletteuse",
}


class ClipWriter:
    """Streams frames into an mp4 or gif that appears under its name only once it is complete.

    The file is finished by `close`, also when the program ends without calling it. Frames go to
    the encoder (the ffmpeg that the package imageio-ffmpeg brings) at once, so that a long clip
    needs no memory. Without frames there is no file.
    """

    def __init__(self, path: Path, fps: float):
        """Prepare a clip.

        Args:
            path: Where the finished file goes; its folder is made if needed.
            fps: Frames per second of the clip.

        Raises:
            ValueError: The name does not end in .mp4 or .gif.
        """
        if path.suffix not in _CODECS:
            raise ValueError(f"{path.name!r} has to end in one of {', '.join(_CODECS)}.")
        self.path = path
        self.fps = fps
        self.num_frames = 0
        # The encoder writes into it, and this process holds its lock.
        self._partial: IO[bytes] | None = None
        self._encoder: subprocess.Popen[bytes] | None = None
        self._messages: IO[bytes] | None = None
        self._shape: tuple[int, ...] = ()

    def add(self, frame: np.ndarray) -> None:
        """Append a frame (height, width, 3), uint8 or float in [0, 1]; all must be of one size.

        Raises:
            ValueError: The frame is no RGB image, or of another size than the first.
            OSError: The encoder or the disk refused it.
        """
        image = _even_uint8(frame)
        if self._encoder is None:
            self._open(image)
        assert self._encoder is not None
        assert self._encoder.stdin is not None
        if image.shape != self._shape:
            raise ValueError(
                f"Frame {self.num_frames} of {self.path.name} has the shape {image.shape}; "
                f"the first one had {self._shape}."
            )
        try:
            self._encoder.stdin.write(image.tobytes())
        except OSError as error:
            raise OSError(
                f"Cannot write the video {self.path}: {self._complaint(error)}"
            ) from error
        self.num_frames += 1

    def close(self) -> Path | None:
        """Finish the file and return its path, or None where there is nothing (more) to finish.

        Raises:
            OSError: The encoder or the disk failed; the unfinished file is removed.
        """
        encoder, self._encoder = self._encoder, None
        if encoder is None or encoder.stdin is None:
            return None
        atexit.unregister(self.close)
        # An encoder that is gone already says why by its exit status.
        with contextlib.suppress(OSError):
            encoder.stdin.close()
        assert self._partial is not None
        if encoder.wait() != 0:
            self._partial.close()
            Path(self._partial.name).unlink(missing_ok=True)
            raise OSError(
                f"Cannot write the video {self.path}: {self._complaint(encoder.returncode)}"
            )
        rename_locked(self._partial, self.path)
        return self.path

    def _open(self, image: np.ndarray) -> None:
        import imageio_ffmpeg

        self._shape = image.shape
        self.path.parent.mkdir(parents=True, exist_ok=True)
        remove_temporary_files(self.path.parent)
        self._partial = create_locked(temporary_path(self.path))
        # A pipe for its messages could fill up and block it.
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115
        height, width = image.shape[:2]
        raw = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {self.fps:g} -i -"
        self._encoder = subprocess.Popen(
            [
                imageio_ffmpeg.get_ffmpeg_exe(),
                *("-loglevel", "error", "-y"),
                *raw.split(),
                *_CODECS[self.path.suffix].split(),
                *("-f", self.path.suffix.removeprefix(".")),
                self._partial.name,
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._messages,
            # A Ctrl+C is for the program, which then finishes the clip.
            start_new_session=True,
        )
        atexit.register(self.close)

    def _complaint(self, fallback: object) -> str:
        """What the encoder said, or else `fallback`."""
        if self._messages is None:
            return str(fallback)
        self._messages.seek(0)
        text = " ".join(self._messages.read().decode(errors="replace").split())
        return text or str(fallback)


def _even_uint8(frame: np.ndarray) -> np.ndarray:
    """The frame as bytes, its last row or column repeated where their number is odd.

    H.264 stores colour at half resolution, which needs even sides.
    """
    image = np.asarray(frame)
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"A frame has the shape (height, width, 3); this one has {image.shape}.")
    if np.issubdtype(image.dtype, np.floating):
        image = np.round(np.clip(image, 0.0, 1.0) * 255.0)
    image = image.astype(np.uint8)
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return image
