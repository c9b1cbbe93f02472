"""Families of trials of `make torture`, one per file; see `trials.py` for the contents of a family."""
