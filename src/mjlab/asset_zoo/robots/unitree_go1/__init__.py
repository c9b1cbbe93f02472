"""Unitree Go1: quadruped with twelve joints."""
