"""Physics: configuration, the `Simulation` facade, and the engine seam below it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.sim.config import MujocoCfg as MujocoCfg
from mjlab.sim.config import SimulationCfg as SimulationCfg
from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.sim.sim_data import TorchArray as TorchArray
    from mjlab.sim.sim_data import WarpBridge as WarpBridge
    from mjlab.sim.simulation import Simulation as Simulation

_LAZY = {
    "Simulation": "mjlab.sim.simulation",
    "TorchArray": "mjlab.sim.sim_data",
    "WarpBridge": "mjlab.sim.sim_data",
}

# Configs are imported by every task, the simulation only by a run: torch loads with the run.
__getattr__ = lazy_names(__name__, _LAZY)
