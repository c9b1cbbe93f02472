"""Import path until the importers are renamed; the home is `simulation`."""

from mjlab.sim.simulation import FieldView as FieldView
from mjlab.sim.simulation import SharedField as SharedField
