"""Download module of mjlab 1.6; demo assets are now bundled with the package."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
