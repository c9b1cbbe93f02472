"""Import path until the importers are renamed; the homes are `engine` and `randomization`."""

from mjlab.sim.engine import ACCELERATION_FIELDS as ACCELERATION_FIELDS
from mjlab.sim.engine import COLLISION_MASKS as COLLISION_MASKS
from mjlab.sim.engine import INPUTS as INPUTS
from mjlab.sim.engine import RESULTS_ZERO_ON_RESET as RESULTS_ZERO_ON_RESET
from mjlab.sim.engine import ZERO_INPUTS as ZERO_INPUTS
from mjlab.sim.randomization import CONSTANTS_AT_QPOS0 as CONSTANTS_AT_QPOS0
from mjlab.sim.randomization import FIXED_CONSTANTS as FIXED_CONSTANTS
