"""MuJoCo's graphics library: one that cannot be used hurts only those who draw."""

from __future__ import annotations

import ctypes.util
import os
import subprocess
import sys

import pytest

DRAW = """
import mujoco
from mjlab.viewer import RenderingUnavailableError
from mjlab.viewer.offscreen_renderer import open_renderer
try:
    open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
except RenderingUnavailableError as error:
    print(error)
"""


def python(code: str, gl: str) -> str:
    told = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MUJOCO_GL": gl},
        capture_output=True,
        text=True,
    )
    assert told.returncode == 0, told.stderr
    return told.stdout.strip()


def test_a_library_that_mujoco_does_not_know_is_told_to_those_who_draw():
    code = "import mjlab, mujoco\nfrom mjlab.envs import ManagerBasedRlEnvCfg\n" + DRAW
    told = python(code, "nonsense")
    assert "MUJOCO_GL=nonsense" in told
    assert "egl" in told
    assert "\n" not in told


@pytest.mark.slow
def test_a_library_that_is_not_installed_is_told_to_those_who_draw():
    if ctypes.util.find_library("OSMesa") is not None:
        pytest.skip("OSMesa is installed")
    told = python("import mjlab\n" + DRAW, "osmesa")
    assert "MUJOCO_GL=osmesa" in told
    assert "not installed" in told


def test_rendering_that_is_switched_off_is_told_as_that():
    told = python("import mjlab\n" + DRAW, "off")
    assert "MUJOCO_GL=off" in told
    assert "disables rendering" in told


def test_other_values_are_left_alone():
    code = "import os, mjlab, mujoco; print(os.environ['MUJOCO_GL'])"
    assert python(code, "glfw") == "glfw"
