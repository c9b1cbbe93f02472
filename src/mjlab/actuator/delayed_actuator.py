"""Legacy path of delayed actuators (releases 1.1 and 1.2). Any actuator config takes a delay."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
