"""Viewer configuration. All task configs contain one, so importing it must stay cheap."""

from __future__ import annotations

import subprocess
import sys

from mjlab.viewer import ViewerConfig
from mjlab.viewer.viewer_config import OriginType


def test_importing_the_config_loads_neither_torch_nor_mujoco_nor_viser() -> None:
    code = (
        "import sys; from mjlab.viewer import ViewerConfig; ViewerConfig(); "
        "print([m for m in ('torch', 'mujoco', 'viser', 'numpy') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_origin_types_are_reached_through_the_config_class() -> None:
    assert ViewerConfig.OriginType is OriginType
    assert ViewerConfig().origin_type is ViewerConfig.OriginType.AUTO
    assert [member.name for member in OriginType] == ["AUTO", "WORLD", "ASSET_ROOT", "ASSET_BODY"]
