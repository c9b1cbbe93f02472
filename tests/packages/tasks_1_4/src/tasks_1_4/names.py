"""Names that came with release 1.4."""

from mjlab.entity.variants import VariantMetadata, allocate_worlds
from mjlab.envs.mdp.events import _sample_se3_range
from mjlab.viewer.model_sync import VIEWER_INERTIAL_FIELDS, VIEWER_MODEL_FIELDS

assert callable(_sample_se3_range)
assert sorted(allocate_worlds((1.0, 1.0), 4)) == [0, 0, 1, 1]
assert VariantMetadata
assert {"body_mass", "body_ipos"} <= set(VIEWER_INERTIAL_FIELDS)
assert "geom_rgba" in VIEWER_MODEL_FIELDS
