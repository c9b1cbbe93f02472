"""Older names; see `mjlab.compat`."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
