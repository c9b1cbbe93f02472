"""Batched ring buffer."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mjlab.utils.errors import WrongStateError, check_count
from mjlab.utils.memory import check_memory
from mjlab.utils.state import stateful

BatchIds = Sequence[int] | torch.Tensor | slice


@stateful
class CircularBuffer:
    """Ring buffer of the last `max_len` frames of a signal, (batch_size, ...).

    The first frame appended sets the shape and type of frames. The first frame of a row, after
    construction or `reset`, fills all slots of the row: earlier values are assumed constant.
    """

    _transient = frozenset({"_rows", "_max_len", "_batch_size"})

    def __init__(self, max_len: int, batch_size: int, device: str) -> None:
        """Create an empty buffer. Raises `ValueError` if `max_len` < 1."""
        check_count("max_len", max_len)
        self._max_len = max_len
        self._batch_size = batch_size
        self._device = device
        # Slots first, so that writing a frame touches one contiguous block.
        self._buffer: torch.Tensor | None = None
        self._pointer = -1
        self._num_pushes = torch.zeros(batch_size, dtype=torch.int64, device=device)
        # Host-side flag that avoids a device synchronization. May be True without empty rows, never
        # False with empty rows.
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
        """Number of frames since the last reset, at most `max_length`, (batch_size,) int64."""
        return self._num_pushes.clamp(max=self._max_len)

    @property
    def is_initialized(self) -> bool:
        """True once a frame has been appended, so that shape and type are known."""
        return self._buffer is not None

    @property
    def empty_rows(self) -> torch.Tensor:
        """True for rows without a frame since their reset, (batch_size,) bool."""
        return self._num_pushes == 0

    @property
    def buffer(self) -> torch.Tensor:
        """Copy of the frames, oldest first, (batch_size, max_length, ...).

        Raises `RuntimeError` before the first `append`.
        """
        ring = self._ring("read")
        frames = ring.new_empty((self._batch_size, self._max_len, *ring.shape[2:]))
        num_older = self._max_len - 1 - self._pointer
        frames[:, :num_older] = ring[self._pointer + 1 :].transpose(0, 1)
        frames[:, num_older:] = ring[: self._pointer + 1].transpose(0, 1)
        return frames

    def __getitem__(self, key: torch.Tensor | int) -> torch.Tensor:
        """Return a copy of the frame with lag `key` (0: newest), (batch_size, ...).

        Args:
            key: Lag: a scalar, or one per row, (batch_size,). Lags beyond a row's history give its
                oldest frame, negative lags the newest.

        Raises `RuntimeError` before the first `append`, `ValueError` for a wrong number of lags.
        """
        ring = self._ring("read")
        # The first frame of a row fills all its slots, so lags need no bound per row.
        if not isinstance(key, torch.Tensor):
            lag = min(max(key, 0), self._max_len - 1)
            return ring[(self._pointer - lag) % self._max_len].clone()
        if key.shape not in ((), (1,), (self._batch_size,)):
            raise ValueError(
                f"CircularBuffer lags: expected a scalar or shape ({self._batch_size},), got shape "
                f"{tuple(key.shape)}."
            )
        lags = key.to(self._device).clamp(0, self._max_len - 1)
        return ring[(self._pointer - lags) % self._max_len, self._rows]

    def append(self, data: torch.Tensor) -> None:
        """Append a frame, (batch_size, ...). Raises `ValueError` for a wrong first shape."""
        if self._buffer is None:
            self._check_batch(data)
            check_memory(
                "CircularBuffer max_len", self._max_len, data.nbytes, str(data.device),
                "a shorter history or delay",
            )  # fmt: skip
            # If the first frame is appended under `inference_mode`, later appends outside it must work.
            with torch.inference_mode(False):
                self._buffer = torch.zeros(
                    (self._max_len, *data.shape), dtype=data.dtype, device=self._device
                )
        self._pointer = (self._pointer + 1) % self._max_len
        if self._may_have_empty_rows:
            # A mask, because indexing empty rows would synchronize the GPU.
            empty = (self._num_pushes == 0).view(1, -1, *(1,) * (self._buffer.dim() - 2))
            frame = data.to(self._buffer).expand(self._buffer.shape[1:])
            torch.where(empty, frame.unsqueeze(0), self._buffer, out=self._buffer)
            self._may_have_empty_rows = False
        self._buffer[self._pointer] = data
        self._num_pushes += 1

    def backfill(self, data: torch.Tensor, batch_ids: BatchIds) -> None:
        """Reset the rows `batch_ids` and fill them with their rows of `data`, (batch_size, ...).

        All slots of these rows get the frame, and `current_length` is 1. Other rows are unchanged.
        Raises `RuntimeError` before the first `append`.
        """
        ring = self._ring("backfill")
        self._check_batch(data)
        ring[:, batch_ids] = data[batch_ids].to(ring)
        self._num_pushes[batch_ids] = 1

    def reset(self, batch_ids: BatchIds | None = None) -> None:
        """Clear the frames of `batch_ids` (None: all). Cleared rows read as zero until `append`."""
        rows = slice(None) if batch_ids is None else batch_ids
        if self._buffer is not None:
            self._buffer[:, rows] = 0
        self._num_pushes[rows] = 0
        self._may_have_empty_rows = True

    def _ring(self, purpose: str) -> torch.Tensor:
        if self._buffer is None:
            raise WrongStateError(f"Cannot {purpose} an empty buffer; call append first.")
        return self._buffer

    def _check_batch(self, data: torch.Tensor) -> None:
        if data.dim() == 0 or data.shape[0] != self._batch_size:
            raise ValueError(
                f"CircularBuffer data: expected leading size {self._batch_size} (batch size), got shape "
                f"{tuple(data.shape)}."
            )
