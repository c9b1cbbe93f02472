"""Reports that a simulation outgrew the memory that MuJoCo Warp allocated for it.

Warp allocates room for a given number of contacts and constraint rows, and drops what does not fit.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import torch

logger = logging.getLogger(__name__)

# Dispatches of `step` between two looks at the overflow flags.
_CHECK_PERIOD = 64

SIZES = ("njmax", "nconmax", "contact_sensor_maxmatch")
"""Options of `SimulationCfg` that say how much memory there is."""

OVERFLOW_MESSAGES: dict[str, tuple[str, str]] = {
    "NEFC": ("more constraint rows than njmax={njmax}; the excess was dropped", "njmax"),
    "NJMAX_NNZ": (
        "the sparse constraint Jacobian outgrew njmax={njmax}; the excess was dropped",
        "njmax",
    ),
    "BROADPHASE": (
        "more candidate collisions than nconmax={nconmax} per environment allows; the excess was "
        "dropped",
        "nconmax",
    ),
    "NARROWPHASE": (
        "more contacts than nconmax={nconmax} per environment allows; the excess was dropped",
        "nconmax",
    ),
    "CCD": (
        "more convex collisions than nconmax={nconmax} per environment allows; the excess was "
        "dropped",
        "nconmax",
    ),
    "CONTACT_MATCH": (
        "a contact sensor matched more contacts than contact_sensor_maxmatch="
        "{contact_sensor_maxmatch}; what it reports is wrong",
        "contact_sensor_maxmatch",
    ),
    "HFIELD": (
        "one geom touched more height-field cells than can be kept. Use a coarser height field or "
        "smaller geoms",
        "",
    ),
    "NVMAX": ("more active degrees of freedom than were allocated", ""),
    "EPA_HORIZON": (
        "a deep penetration was resolved approximately. Reduce the time step or simplify the "
        "collision geometry",
        "",
    ),
    "TACTILE": ("a tactile sensor met more geoms than it keeps", ""),
}
"""By name of a `mujoco_warp.OverflowType`: what happened, and the option to raise, if there is one.
Reaching an iteration limit of the solver is left out: native MuJoCo does not report it either."""


class OverflowWatch:
    """Logs, once a kind, that some environment exceeded a capacity, without waiting for the GPU.

    Every so many steps the flags of all environments are gathered, together with the sizes needed
    just then, and copied to the host in the background; they are read when they have arrived.
    """

    def __init__(
        self,
        flags: torch.Tensor,
        bits: dict[str, int],
        capacities: dict[str, int],
        measure: Callable[[], torch.Tensor],
    ) -> None:
        """Watch `flags` (N,), whose bits are named by `bits`.

        Args:
            flags: (N,) int32, which Warp sets and nobody clears.
            bits: The bit of each `OverflowType`, by name.
            capacities: What there is of each of `SIZES`.
            measure: Returns (3,) int32: what is needed now of each of `SIZES`.
        """
        self._flags = flags
        self._capacities = capacities
        self._measure = measure
        self._kinds = [name for name in OVERFLOW_MESSAGES if name in bits]
        self._reported: set[str] = set()
        self._bits = torch.tensor([bits[name] for name in self._kinds], dtype=torch.int32)
        self._arrived = torch.zeros(len(self._bits) + len(SIZES), dtype=torch.int32)
        self._event: Any = None
        if flags.is_cuda:
            self._bits = self._bits.to(flags.device)
            self._arrived = self._arrived.pin_memory()
        self._steps = 0

    def tick(self) -> None:
        """Count a dispatch of `step`; look at the flags after the first and then now and then."""
        self._steps += 1
        if self._steps % _CHECK_PERIOD == 1:
            self.check(wait=False)

    def check(self, wait: bool) -> None:
        """Log what has exceeded its capacity; without `wait`, what is known by now."""
        if not self._flags.is_cuda:
            self._arrived = self._gather()
            self._report()
            return
        if self._event is None or wait:
            self._arrived.copy_(self._gather(), non_blocking=True)
            self._event = torch.cuda.current_stream(self._flags.device).record_event()
            if wait:
                self._event.synchronize()
        if self._event.query():
            self._event = None
            self._report()

    def _gather(self) -> torch.Tensor:
        found = (self._flags[:, None] & self._bits).amax(dim=0)
        return torch.cat([found, self._measure().to(torch.int32)])

    def _report(self) -> None:
        values = self._arrived.tolist()
        needed = dict(zip(SIZES, values[len(self._kinds) :], strict=True))
        for name, found in zip(self._kinds, values, strict=False):
            if not found or name in self._reported:
                continue
            self._reported.add(name)
            what, option = OVERFLOW_MESSAGES[name]
            message = what.format(**self._capacities)
            if option:
                advice = _advice(self._capacities[option], needed[option])
                message += f". Set SimulationCfg.{option} to {advice}"
            logger.warning("MuJoCo Warp overflow in some environment: %s.", message)


def _advice(capacity: int, needed: int) -> str:
    """Return the size to set: a quarter more than is needed now, or twice what was not enough."""
    if needed > capacity:
        return f"{_rounded_up(1.25 * needed)} or more ({needed} are needed now)"
    return f"{_rounded_up(2 * capacity)}, and to more if this comes again"


def _rounded_up(size: float) -> int:
    return 8 * math.ceil(size / 8)


def contacts_per_environment(
    environments: torch.Tensor, count: torch.Tensor, num_envs: int
) -> torch.Tensor:
    """Return the largest number of contacts in one environment, () int64.

    Args:
        environments: (C,) environment of each contact that there is room for.
        count: (1,) number of contacts, which may be more than C.
        num_envs: Number of environments N.
    """
    exists = torch.arange(len(environments), device=environments.device) < count
    rows = environments.long().clamp(0, num_envs - 1)
    totals = torch.zeros(num_envs, dtype=torch.int64, device=environments.device)
    return totals.scatter_add_(0, rows, exists.long()).amax()
