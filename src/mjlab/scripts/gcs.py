"""The module where 1.6 fetched what its demo needs; here that ships with the package."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
