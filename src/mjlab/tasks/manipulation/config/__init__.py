"""Robots of the manipulation tasks, one package each."""
