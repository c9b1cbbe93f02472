"""Helpers that keep the names and conventions of the Isaac Lab utilities."""
