"""Boxes and borders that sub-terrains share."""

from __future__ import annotations
