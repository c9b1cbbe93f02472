"""Robots of the velocity task, one package each."""
