"""Random delay of a batched signal."""

from __future__ import annotations

import torch

from mjlab.utils.buffers.circular_buffer import BatchIds, CircularBuffer
from mjlab.utils.errors import check_count, check_in_range
from mjlab.utils.state import stateful


@stateful
class DelayBuffer:
    """Delays a signal, (batch_size, ...), by a random integer number of steps.

    Each step: `append` a frame, then `compute` the delayed frame. Lags are uniform integers in
    [min_lag, max_lag], sampled at construction, at reset, and whenever a row is due: at every
    `compute`, or at every `update_period`-th one. A row that is due keeps its lag with probability
    `hold_prob`. Lags beyond the first frame give the first frame.
    """

    # Settings come from the config; a resumed run may change them on purpose.
    _transient = frozenset(
        {
            "_min_lag",
            "_max_lag",
            "_batch_size",
            "_per_env",
            "_hold_prob",
            "_update_period",
            "_num_phases",
            "_num_draws",
            "_draw_device",
        }
    )

    def __init__(
        self,
        min_lag: int = 0,
        max_lag: int = 3,
        batch_size: int = 1,
        device: str = "cpu",
        per_env: bool = True,
        hold_prob: float = 0.0,
        update_period: int = 0,
        per_env_phase: bool = True,
        generator: torch.Generator | None = None,
    ) -> None:
        """Create an empty buffer.

        Args:
            min_lag: Minimum lag, in steps.
            max_lag: Maximum lag, in steps.
            batch_size: Number of rows.
            device: Device of the frames.
            per_env: Sample a separate lag per row. False: one lag for all rows.
            hold_prob: Probability of keeping the lag when due.
            update_period: Steps between lag samples. 0: sample at every step.
            per_env_phase: Rows are due at different steps. Without `per_env`, all rows share one
                random phase.
            generator: Random number generator. None: torch's default generator.

        Raises `ValueError` for lags, probability or period out of range.
        """
        check_count("min_lag", min_lag, minimum=0)
        check_count("max_lag", max_lag, minimum=min_lag)
        check_in_range("hold_prob", hold_prob, 0.0, 1.0)
        check_count("update_period", update_period, minimum=0)
        self._min_lag = min_lag
        self._max_lag = max_lag
        self._batch_size = batch_size
        self._device = device
        self._per_env = per_env
        self._hold_prob = hold_prob
        self._update_period = update_period
        self._num_phases = max(1, update_period) if per_env_phase else 1
        self._generator = generator
        # A generator samples only on its own device.
        self._draw_device = device if generator is None else generator.device
        self._buffer = CircularBuffer(max_lag + 1, batch_size, device)
        # Sampled lags: one per row, or a single one for all rows.
        self._num_draws = batch_size if per_env else 1
        self._drawn_lags = self._draw(min_lag, max_lag + 1)
        self._phase = self._draw(0, self._num_phases)
        self._step_count = torch.zeros_like(self._drawn_lags)
        # Lags in use differ from sampled lags only after `set_lags`.
        self._current_lags = self._drawn_lags.expand(batch_size).clone()

    @property
    def is_initialized(self) -> bool:
        """True once a frame has been appended."""
        return self._buffer.is_initialized

    @property
    def empty_rows(self) -> torch.Tensor:
        """True for rows without a frame since their reset, (batch_size,) bool."""
        return self._buffer.empty_rows

    @property
    def current_lags(self) -> torch.Tensor:
        """Lags in use, (batch_size,) int64."""
        return self._current_lags

    def append(self, data: torch.Tensor) -> None:
        """Append a frame, (batch_size, ...). Raises `ValueError` for a wrong shape."""
        self._buffer.append(data)

    def backfill(self, data: torch.Tensor, batch_ids: BatchIds) -> None:
        """Reset the rows `batch_ids` and fill them with their rows of `data`, (batch_size, ...).

        This is the first step of these rows: `backfill` and `peek` have the same effect on them as
        `append` and `compute`. Other rows are unchanged. Raises `RuntimeError` before the first
        `append`.
        """
        self._buffer.backfill(data, batch_ids)
        if self._per_env:
            self._step_count[batch_ids] = 1

    def compute(self) -> torch.Tensor:
        """Resample lags of rows that are due, and return the delayed frame, (batch_size, ...)."""
        if self._min_lag < self._max_lag:
            lags = self._draw(self._min_lag, self._max_lag + 1)
            due: torch.Tensor | None = None
            if self._update_period > 0:
                due = (self._step_count + self._phase) % self._update_period == 0
            if self._hold_prob > 0:
                draw = torch.rand(
                    self._num_draws,
                    dtype=torch.float32,
                    generator=self._generator,
                    device=self._draw_device,
                )
                moved = draw.to(self._device) >= self._hold_prob
                due = moved if due is None else due & moved
            self._step_count += 1
            for held in (self._drawn_lags, self._current_lags):
                held.copy_(lags if due is None else torch.where(due, lags, held))
        return self.peek()

    def peek(self) -> torch.Tensor:
        """Return the delayed frame, (batch_size, ...), without resampling lags.

        Raises `RuntimeError` before the first `append`.
        """
        return self._buffer[self._current_lags]

    def reset(self, batch_ids: BatchIds | None = None) -> None:
        """Clear the frames of `batch_ids` (None: all) and resample their lags.

        Without `per_env`, all rows share the lag: only a reset of all rows resamples it.
        """
        rows = slice(None) if batch_ids is None else batch_ids
        self._buffer.reset(rows)
        if self._per_env:
            self._drawn_lags[rows] = self._draw(self._min_lag, self._max_lag + 1)[rows]
            self._phase[rows] = self._draw(0, self._num_phases)[rows]
            self._step_count[rows] = 0
        elif isinstance(rows, slice) and rows == slice(None):
            self._drawn_lags.copy_(self._draw(self._min_lag, self._max_lag + 1))
            self._phase.copy_(self._draw(0, self._num_phases))
            self._step_count.zero_()
        self._current_lags[rows] = self._drawn_lags.expand(self._batch_size)[rows]

    def set_lags(self, lags: torch.Tensor, batch_ids: BatchIds | None = None) -> None:
        """Set lags, clamped to [min_lag, max_lag], until the next resampling.

        Args:
            lags: A scalar, or one lag per row in `batch_ids`.
            batch_ids: Rows. None: all.
        """
        rows = slice(None) if batch_ids is None else batch_ids
        lags = torch.as_tensor(lags, device=self._device)
        self._current_lags[rows] = lags.to(torch.int64).clamp(self._min_lag, self._max_lag)

    def _draw(self, low: int, high: int) -> torch.Tensor:
        """Sample integers in [low, high): one per row, or one for all rows."""
        if high - low == 1:
            return torch.full((self._num_draws,), low, dtype=torch.int64, device=self._device)
        return torch.randint(
            low, high, (self._num_draws,), generator=self._generator, device=self._draw_device
        ).to(self._device)
