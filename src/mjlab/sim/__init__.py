"""Physics: configuration, the `Simulation` facade, and the engine seam below it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.sim.config import MujocoCfg as MujocoCfg
from mjlab.sim.config import SimulationCfg as SimulationCfg

if TYPE_CHECKING:
    from mjlab.sim.sim_data import TorchArray as TorchArray
    from mjlab.sim.sim_data import WarpBridge as WarpBridge
    from mjlab.sim.simulation import Simulation as Simulation

_LAZY = {
    "Simulation": "mjlab.sim.simulation",
    "TorchArray": "mjlab.sim.sim_data",
    "WarpBridge": "mjlab.sim.sim_data",
}


def __getattr__(name: str) -> Any:
    # Configs are imported by every task, the simulation only by a run: torch loads with the run.
    if name in _LAZY:
        import importlib

        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
