"""Module that packages of releases 1.1 and 1.2 import; `mjviser.conversions` replaces it."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
