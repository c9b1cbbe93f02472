"""Reports that a simulation outgrew the memory that MuJoCo Warp allocated for it.

Warp allocates room for a given number of contacts and constraint rows, and drops what does not fit.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any

import mujoco_warp as mjwarp
import torch

if TYPE_CHECKING:
    from mjlab.sim.warp.engine import WarpEngine

logger = logging.getLogger(__name__)

# Dispatches of `step` between two looks at the overflow flags.
_CHECK_PERIOD = 64

SIZES = ("njmax", "nconmax", "contact_sensor_maxmatch")
"""Options of `SimulationCfg` that say how much memory there is."""

# By name of an `OverflowType`: the option to raise, and the quantity that exceeded it. Reaching an iteration
# limit of the solver is left out: native MuJoCo does not report it either.
_OUTGROWN = {
    "NEFC": ("njmax", "constraint rows"),
    "NJMAX_NNZ": ("njmax", "entries of the sparse constraint Jacobian"),
    "BROADPHASE": ("nconmax", "candidate collisions"),
    "NARROWPHASE": ("nconmax", "contacts"),
    "CCD": ("nconmax", "convex collisions"),
    "CONTACT_MATCH": ("contact_sensor_maxmatch", "contacts that match a sensor"),
}
# Overflows that no option prevents.
_OTHER = {
    "HFIELD": "one geom touched more height-field cells than can be kept. Use a coarser height "
    "field or smaller geoms",
    "NVMAX": "more active degrees of freedom than were allocated",
    "EPA_HORIZON": "a deep penetration was resolved approximately. Reduce the time step or simplify "
    "the collision geometry",
    "TACTILE": "a tactile sensor met more geoms than it keeps",
}


class OverflowWatch:
    """Logs, once a kind, that some environment exceeded a capacity, without waiting for the GPU.

    Every so many steps the flags of all environments are gathered, together with the sizes needed
    just then, and copied to the host in the background; they are read when they have arrived.
    """

    def __init__(self, engine: WarpEngine, flags: torch.Tensor) -> None:
        """Watch `flags` (N,) int32 of an engine, which Warp sets and does not clear."""
        self._engine, self._flags = engine, flags
        data, matches = engine.wp_data, engine.wp_model.opt.contact_sensor_maxmatch
        # Room for constraint rows and contacts per environment, and for matches of a sensor.
        sizes = data.njmax, data.naconmax // data.nworld, matches
        self._sizes = dict(zip(SIZES, sizes, strict=True))
        self._kinds = [kind for kind in mjwarp.OverflowType if kind.name in _OUTGROWN | _OTHER]
        self._reported: set[str] = set()
        self._bits = torch.tensor(self._kinds, dtype=torch.int32, device=flags.device)
        self._arrived = torch.zeros(len(self._kinds) + len(SIZES), dtype=torch.int32)
        if flags.is_cuda:
            self._arrived = self._arrived.pin_memory()
        self._event: Any = None
        self._steps = 0

    def tick(self) -> None:
        """Count a dispatch of `step`; look at the flags after the first and then now and then."""
        self._steps += 1
        if self._steps % _CHECK_PERIOD == 1:
            self.check(wait=False)

    def check(self, wait: bool) -> None:
        """Log what has exceeded its capacity; without `wait`, what is known by now."""
        if self._event is None or wait:
            found = (self._flags[:, None] & self._bits).amax(dim=0)
            values = torch.cat([found, self._engine.measure_sizes().to(torch.int32)])
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
                option, what = _OUTGROWN[kind.name]
                size, need = self._sizes[option], needed[option]
                # Twice what was not enough at some time, or a quarter more than is needed now.
                enough, hint = 2 * size, ", and to more if this comes again"
                if need > size:
                    enough, hint = 1.25 * need, f" or more ({need} are needed now)"
                message = (
                    f"more {what} than {option}={size} per environment allows; the excess was "
                    f"dropped. Set SimulationCfg.{option} to {8 * math.ceil(enough / 8)}{hint}"
                )
            logger.warning("MuJoCo Warp overflow in some environment: %s.", message)
