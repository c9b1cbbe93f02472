"""Import path until the importers are renamed; the home is `randomization`."""

from mjlab.sim.randomization import VARIANT_DEPENDENT_FIELDS as VARIANT_DEPENDENT_FIELDS
from mjlab.sim.randomization import VariantColumns as VariantColumns
from mjlab.sim.randomization import VariantInfo as VariantInfo
from mjlab.sim.randomization import VariantValues as VariantValues
