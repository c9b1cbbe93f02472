"""Module path of the terrain importer in release 1.1."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
