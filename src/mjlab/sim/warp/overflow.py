"""Overflow reports: contacts and constraint rows beyond MuJoCo Warp's capacities.

Warp allocates memory for a fixed number of contacts and constraint rows, and drops the excess.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import mujoco_warp as mjwarp
import torch

logger = logging.getLogger(__name__)

# Number of `step` dispatches between checks of the overflow flags.
_CHECK_PERIOD = 64

SIZES = ("njmax", "nconmax", "contact_sensor_maxmatch")
"""Capacity options of `SimulationCfg`."""

# Option to increase and quantity that exceeded it, by name of `OverflowType`. Iteration limits of
# the solver are omitted: native MuJoCo does not report them either.
_CAPACITIES = {
    "NEFC": ("njmax", "constraint rows"),
    "NJMAX_NNZ": ("njmax", "entries of the sparse constraint Jacobian"),
    "BROADPHASE": ("nconmax", "candidate collisions"),
    "NARROWPHASE": ("nconmax", "contacts"),
    "CCD": ("nconmax", "convex collisions"),
    "CONTACT_MATCH": ("contact_sensor_maxmatch", "contacts that match a sensor"),
}
# Overflows without an option to increase.
_OTHER = {
    "HFIELD": "a geom touched too many height-field cells. Use a coarser height field or smaller "
    "geoms",
    "NVMAX": "more active degrees of freedom than were allocated",
    "EPA_HORIZON": "a deep penetration was resolved approximately. Reduce the timestep or simplify "
    "the collision geometry",
    "TACTILE": "a tactile sensor touched more geoms than it can store",
}


class OverflowWatch:
    """Overflow logger: one warning per kind, without waiting for the GPU.

    Every `_CHECK_PERIOD` steps, the flags of all environments and the sizes currently needed are
    copied to the host in the background, and read once the copy is complete.
    """

    def __init__(
        self,
        flags: torch.Tensor,
        sizes: tuple[int, ...],
        measure_sizes: Callable[[], torch.Tensor],
    ) -> None:
        """Watch the overflow flags of all environments. Warp sets flags and never clears them.

        Args:
            flags: Bits of `OverflowType`, (N,) int32.
            sizes: Capacities of `SIZES`.
            measure_sizes: Function that returns the current requirement of each of `SIZES`, (3,).
        """
        self._flags, self._measure_sizes = flags, measure_sizes
        self._sizes = dict(zip(SIZES, sizes, strict=True))
        self._kinds = [kind for kind in mjwarp.OverflowType if kind.name in _CAPACITIES | _OTHER]
        self._reported: set[str] = set()
        self._bits = torch.tensor(self._kinds, dtype=torch.int32, device=flags.device)
        self._arrived = torch.zeros(len(self._kinds) + len(SIZES), dtype=torch.int32)
        if flags.is_cuda:
            self._arrived = self._arrived.pin_memory()
        self._event: Any = None
        self._steps = 0

    def tick(self) -> None:
        """Count a dispatch of `step`; check the flags after the first, then periodically."""
        self._steps += 1
        if self._steps % _CHECK_PERIOD == 1:
            self.check(wait=False)

    def check(self, wait: bool) -> None:
        """Log exceeded capacities; without `wait`, only those already copied to the host."""
        if self._event is None or wait:
            found = (self._flags[:, None] & self._bits).amax(dim=0)
            values = torch.cat([found, self._measure_sizes().to(torch.int32)])
            self._arrived.copy_(values, non_blocking=True)
            if self._flags.is_cuda:
                self._event = torch.cuda.current_stream(self._flags.device).record_event()
                if wait:
                    self._event.synchronize()
        if self._event is None or self._event.query():
            self._event = None
            self._report()

    def _report(self) -> None:
        values = self._arrived.tolist()
        needed = dict(zip(SIZES, values[len(self._kinds) :], strict=True))
        for kind, found in zip(self._kinds, values, strict=False):
            if not found or kind.name in self._reported:
                continue
            self._reported.add(kind.name)
            message = _OTHER.get(kind.name)
            if message is None:
                option, quantity = _CAPACITIES[kind.name]
                size, need = self._sizes[option], needed[option]
                # Twice the exceeded capacity, or a quarter more than the current need.
                enough, hint = 2 * size, ", and more if the overflow recurs"
                if need > size:
                    enough, hint = 1.25 * need, f" or more ({need} are needed now)"
                message = (
                    f"more {quantity} than {option}={size} per environment allows; the excess was "
                    f"dropped. Set SimulationCfg.{option} to {8 * math.ceil(enough / 8)}{hint}"
                )
            logger.warning("MuJoCo Warp overflow in some environment: %s.", message)
