"""Delaying commands: all targets of a line together, so that they are always of the same age."""

from __future__ import annotations

import torch

from mjlab.actuator._columns import EnvIds
from mjlab.utils.buffers import DelayBuffer


def delay_command(
    buffer: DelayBuffer,
    position_target: torch.Tensor,
    velocity_target: torch.Tensor,
    effort_target: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Append a command, (N, n) three times, to a delay line, and return the delayed command.

    One line for all three keeps them together: they are always of the same age.
    """
    position, velocity, effort = delay_rows(
        buffer, (position_target, velocity_target, effort_target), None
    )
    return position, velocity, effort


def delay_rows(
    buffer: DelayBuffer, values: tuple[torch.Tensor, ...], env_ids: EnvIds
) -> tuple[torch.Tensor, ...]:
    """Return `values`, each (N, n_i), delayed together by one line.

    With `env_ids` these environments have just been reset: their lines start anew, filled with
    what they are given, and all other lines stay as they are. Only the rows `env_ids` of the
    result mean something then.
    """
    widths = [value.shape[1] for value in values]
    together = torch.cat(values, dim=1) if len(values) > 1 else values[0]
    if env_ids is None:
        buffer.append(together)
        return buffer.compute().split(widths, dim=1)
    if not buffer.is_initialized:
        # A line takes its shape from what is appended first; then all environments are new to it.
        buffer.append(torch.zeros_like(together))
        buffer.reset()
    buffer.backfill(together, env_ids)
    return buffer.peek().split(widths, dim=1)
