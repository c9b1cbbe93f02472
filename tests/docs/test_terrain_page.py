"""Code, table and picture of `docs/how-to/terrains.md`."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import mujoco
import numpy as np

from mjlab.terrains import TerrainEntity, TerrainGenerator
from mjlab.terrains.config import ALL_TERRAIN_PRESETS

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEXT = (DOCS / "how-to" / "terrains.md").read_text(encoding="utf-8")


def test_the_code_of_the_page_builds_its_terrain(tmp_path, monkeypatch):
    """All blocks, one after the other, then the generator that they have put together."""
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    for block in re.findall(r"^```python\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL):
        exec(compile(block, "terrains.md", "exec", dont_inherit=True), names)
    generator = TerrainGenerator(names["generator"])
    spec = mujoco.MjSpec()
    generator.compile(spec)
    assert spec.compile().ngeom > 100
    assert generator.flat_patches["spawn"].shape == (10, 5, 20, 3)
    np.testing.assert_array_equal(generator.terrain_origins[:, 3, 2], 0.0)
    hills = TerrainEntity(names["hills"], "cpu")
    assert hills.compile().hfield_nrow.tolist() == [161]
    assert hills.terrain_origins.shape == (1, 49, 3)


def test_the_table_has_every_preset():
    rows = re.findall(r"^\| (`.*?) \|", TEXT, re.MULTILINE)
    listed = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert [name for name in listed if name in ALL_TERRAIN_PRESETS] == list(ALL_TERRAIN_PRESETS)


def test_the_picture_is_there_and_small():
    picture = DOCS / "images" / "terrains.png"
    assert f"../images/{picture.name}" in TEXT
    data = picture.read_bytes()
    assert len(data) < 400_000
    assert struct.unpack(">II", data[16:24])[0] == 1280, "see tools/make_pictures.py"
