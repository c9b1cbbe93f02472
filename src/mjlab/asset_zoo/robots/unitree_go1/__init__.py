"""The Unitree Go1, a quadruped with twelve joints."""
