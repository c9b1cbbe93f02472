"""Robots that come with the library, ready to be put into a scene."""
