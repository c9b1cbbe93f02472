"""Robots of the motion tracking tasks, one package each."""
