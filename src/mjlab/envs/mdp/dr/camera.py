"""Randomization of cameras."""

from __future__ import annotations

from mjlab.envs.mdp.dr._terms import field_term, rotation_term

cam_fovy = field_term("cam_fovy")
cam_intrinsic = field_term("cam_intrinsic")
cam_pos = field_term("cam_pos")
cam_quat = rotation_term("cam_quat")
