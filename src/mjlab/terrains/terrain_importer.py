"""The module where release 1.1 had the terrain importer."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
