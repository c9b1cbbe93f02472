"""Families of trials of `make torture`, one a file; see `trials.py` for what a family has."""
