"""The module where releases 1.1 and 1.2 had delayed actuators; today any actuator can be."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
