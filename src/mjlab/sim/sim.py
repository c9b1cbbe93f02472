"""Public path of the simulation's names; their homes are `config` and `simulation`."""

from mjlab.sim.config import MujocoCfg as MujocoCfg
from mjlab.sim.config import SimulationCfg as SimulationCfg
from mjlab.sim.simulation import Simulation as Simulation
from mjlab.sim.variants import VARIANT_DEPENDENT_FIELDS as VARIANT_DEPENDENT_FIELDS
