"""The last few frames of a batched signal."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mjlab.utils.errors import WrongStateError, check_count
from mjlab.utils.state import stateful

BatchIds = Sequence[int] | torch.Tensor | slice


@stateful
class CircularBuffer:
    """A ring of the last `max_len` frames of a signal of shape (batch_size, ...).

    The shape and type of a frame are those of the first one appended. The first frame of a row,
    after construction or `reset`, fills all its slots: before there is a history, the signal is
    taken to have been constant.
    """

    _transient = frozenset({"_rows", "_max_len", "_batch_size"})

    def __init__(self, max_len: int, batch_size: int, device: str) -> None:
        """Make an empty buffer. Raises `ValueError` if `max_len` is less than 1."""
        check_count("max_len", max_len)
        self._max_len = max_len
        self._batch_size = batch_size
        self._device = device
        # Slots first, so that writing one frame touches one contiguous block.
        self._buffer: torch.Tensor | None = None
        self._pointer = -1
        self._num_pushes = torch.zeros(batch_size, dtype=torch.int64, device=device)
        # Known without asking the device. May say True where no row is empty, never the reverse.
        self._may_have_empty_rows = True
        self._rows = torch.arange(batch_size, device=device)

    @property
    def batch_size(self) -> int:
        """Number of rows."""
        return self._batch_size

    @property
    def device(self) -> str:
        """Device of the frames."""
        return self._device

    @property
    def max_length(self) -> int:
        """Number of frames kept."""
        return self._max_len

    @property
    def current_length(self) -> torch.Tensor:
        """Frames pushed since the last reset, at most `max_length`; (batch_size,) int64."""
        return self._num_pushes.clamp(max=self._max_len)

    @property
    def is_initialized(self) -> bool:
        """Whether a frame has been appended, so that shape and type are known."""
        return self._buffer is not None

    @property
    def buffer(self) -> torch.Tensor:
        """A copy of the frames, oldest first; (batch_size, max_length, ...).

        Raises `RuntimeError` before the first `append`.
        """
        ring = self._ring("read")
        frames = ring.new_empty((self._batch_size, self._max_len, *ring.shape[2:]))
        num_older = self._max_len - 1 - self._pointer
        frames[:, :num_older] = ring[self._pointer + 1 :].transpose(0, 1)
        frames[:, num_older:] = ring[: self._pointer + 1].transpose(0, 1)
        return frames

    def __getitem__(self, key: torch.Tensor | int) -> torch.Tensor:
        """Return a copy of the frame `key` pushes back (0: the newest), (batch_size, ...).

        Args:
            key: One lag, or one for each row, (batch_size,). A lag that goes back further than a
                row does gives its oldest frame; a negative one the newest.

        Raises `RuntimeError` before the first `append`, `ValueError` for a wrong number of lags.
        """
        ring = self._ring("read")
        # The first frame of a row fills all its slots, so lags need not be bounded row by row.
        if not isinstance(key, torch.Tensor):
            lag = min(max(key, 0), self._max_len - 1)
            return ring[(self._pointer - lag) % self._max_len].clone()
        if key.shape not in ((), (1,), (self._batch_size,)):
            raise ValueError(
                f"Got lags of shape {tuple(key.shape)}; expected one lag, or one for each of the "
                f"{self._batch_size} rows."
            )
        lags = key.to(self._device).clamp(0, self._max_len - 1)
        return ring[(self._pointer - lags) % self._max_len, self._rows]

    def append(self, data: torch.Tensor) -> None:
        """Push a frame of shape (batch_size, ...). Raises `ValueError` for another shape."""
        if self._buffer is None:
            self._check_batch(data)
            # A first frame under `inference_mode` must not forbid later ones without it.
            with torch.inference_mode(False):
                self._buffer = torch.zeros(
                    (self._max_len, *data.shape), dtype=data.dtype, device=self._device
                )
        elif data.shape != self._buffer.shape[1:]:
            raise ValueError(
                f"Got a frame of shape {tuple(data.shape)}; the first one had "
                f"{tuple(self._buffer.shape[1:])}."
            )
        self._pointer = (self._pointer + 1) % self._max_len
        if self._may_have_empty_rows:
            # A mask, because finding the empty rows would make a GPU wait.
            empty = (self._num_pushes == 0).view(1, -1, *(1,) * (data.dim() - 1))
            torch.where(empty, data.to(self._buffer).unsqueeze(0), self._buffer, out=self._buffer)
            self._may_have_empty_rows = False
        self._buffer[self._pointer] = data
        self._num_pushes += 1

    def backfill(self, data: torch.Tensor, batch_ids: BatchIds) -> None:
        """Start the rows `batch_ids` anew with their rows of `data`, (batch_size, ...).

        Every slot of those rows gets the frame, and they count as pushed once. Other rows do not
        change. Raises `RuntimeError` before the first `append`.
        """
        ring = self._ring("backfill")
        self._check_batch(data)
        ring[:, batch_ids] = data[batch_ids].to(ring)
        self._num_pushes[batch_ids] = 1

    def reset(self, batch_ids: BatchIds | None = None) -> None:
        """Forget the frames of the given rows (None: all). They read as zero until the next."""
        rows = slice(None) if batch_ids is None else batch_ids
        if self._buffer is not None:
            self._buffer[:, rows] = 0
        self._num_pushes[rows] = 0
        self._may_have_empty_rows = True

    def _ring(self, purpose: str) -> torch.Tensor:
        if self._buffer is None:
            raise WrongStateError(f"Cannot {purpose} a buffer nothing has been appended to.")
        return self._buffer

    def _check_batch(self, data: torch.Tensor) -> None:
        if data.dim() == 0 or data.shape[0] != self._batch_size:
            raise ValueError(
                f"Got data of shape {tuple(data.shape)}; its first size must be the batch size "
                f"{self._batch_size}."
            )
