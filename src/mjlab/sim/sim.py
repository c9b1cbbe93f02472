"""Public import path of the simulation; implemented in the other files of this folder."""

from mjlab.sim.config import MujocoCfg as MujocoCfg
from mjlab.sim.config import SimulationCfg as SimulationCfg
from mjlab.sim.randomization import VARIANT_DEPENDENT_FIELDS as VARIANT_DEPENDENT_FIELDS
from mjlab.sim.simulation import Simulation as Simulation
