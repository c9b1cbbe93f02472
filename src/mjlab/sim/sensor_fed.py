"""Import path until the importers are renamed; the home is `engine`."""

from mjlab.sim.engine import check_sensor_fed as refuse_without_sensor  # noqa: F401
