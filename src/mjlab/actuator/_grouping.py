"""What the two kinds of actuator groups share: who may join one, and who shares a delay line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjlab.actuator.actuator import Actuator
    from mjlab.utils.buffers import DelayBuffer

_METHODS = ("compute", "compute_after_reset", "get_command", "apply_delay", "apply_controls")


def acts_like(actuator: Actuator, base: type[Actuator]) -> bool:
    """Return whether the actuator's class left alone what a group does in place of a `base`."""
    return all(getattr(type(actuator), name) is getattr(base, name) for name in _METHODS)


def delay_settings(actuator: Actuator) -> tuple[Any, ...]:
    """Return what has to agree for actuators to share a delay line."""
    cfg = actuator.cfg
    return (
        type(actuator),
        actuator.transmission_type,
        cfg.delay_min_lag,
        cfg.delay_max_lag,
        cfg.delay_hold_prob,
        cfg.delay_update_period,
        cfg.delay_per_env_phase,
    )


def share_line(members: Sequence[Actuator], num_envs: int, device: str) -> DelayBuffer:
    """Make one delay line for actuators with equal settings, and have the first one reset it."""
    line = members[0].make_delay_buffer(num_envs, device)
    for k, actuator in enumerate(members):
        actuator.join_group(line, resets_delay=k == 0)
    return line
