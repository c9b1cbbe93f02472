"""Import path until the importers are renamed; the home is `engine`."""

from mjlab.sim.engine import BACKGROUND as BACKGROUND
from mjlab.sim.engine import CAMERA_DATA_TYPES as CAMERA_DATA_TYPES
from mjlab.sim.engine import LENS_FIELDS as LENS_FIELDS
from mjlab.sim.engine import NUM_GEOM_GROUPS as NUM_GEOM_GROUPS
from mjlab.sim.engine import CameraDataType as CameraDataType
from mjlab.sim.engine import CameraView as CameraView
from mjlab.sim.engine import Images as Images
from mjlab.sim.engine import far_limit as far_limit
from mjlab.sim.engine import rendered_geoms as rendered_geoms
