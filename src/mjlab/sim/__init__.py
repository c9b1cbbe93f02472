"""Physics: configuration, the `Simulation` facade, and the engine interface."""

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

# Lazy: every task imports the configs, and only a run needs the simulation and torch.
__getattr__ = lazy_names(__name__, _LAZY)
