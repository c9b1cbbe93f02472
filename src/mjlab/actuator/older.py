"""Delayed actuators as releases 1.1 and 1.2 spelled them; reached through `mjlab.compat` only."""

from __future__ import annotations

import dataclasses
from abc import ABCMeta
from typing import Any

from mjlab.actuator.actuator import Actuator, ActuatorCfg


class DelayedActuatorCfg:
    """`DelayedActuatorCfg(base_cfg=..., delay_max_lag=...)` returns `base_cfg` with these delays.

    Today every actuator config takes `delay_min_lag` and so on itself. The whole command is
    delayed, whichever part `delay_target` names.
    """

    def __new__(  # type: ignore[misc]
        cls,
        *,
        base_cfg: ActuatorCfg,
        delay_target: Any = "position",
        delay_min_lag: int = 0,
        delay_max_lag: int = 1,
        delay_hold_prob: float = 0.0,
        delay_update_period: int = 0,
        delay_per_env_phase: bool = True,
    ) -> ActuatorCfg:
        return dataclasses.replace(
            base_cfg,
            delay_min_lag=delay_min_lag,
            delay_max_lag=delay_max_lag,
            delay_hold_prob=delay_hold_prob,
            delay_update_period=delay_update_period,
            delay_per_env_phase=delay_per_env_phase,
        )


class _HasDelay(ABCMeta):
    def __instancecheck__(cls, instance: Any) -> bool:
        return isinstance(instance, Actuator) and instance.has_delay


class DelayedActuator(Actuator, metaclass=_HasDelay):
    """Any actuator that has a delay is an instance of this."""
