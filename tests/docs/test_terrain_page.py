"""Code, table and picture of `docs/how-to/terrains.md`."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import mujoco

from mjlab.terrains import TerrainEntity, TerrainGenerator
from mjlab.terrains.config import ALL_TERRAIN_PRESETS

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEXT = (DOCS / "how-to" / "terrains.md").read_text(encoding="utf-8")


def test_the_code_of_the_page_builds_its_terrain(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    patches, hills = [], []
    for block in re.findall(r"^```python\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL):
        names: dict = {"__name__": "page"}
        exec(compile(block, "terrains.md", "exec", dont_inherit=True), names)
        if "generator" in names:
            names["generator"].num_rows = 2
            generator = TerrainGenerator(names["generator"])
            spec = mujoco.MjSpec()
            generator.compile(spec)
            assert spec.compile().ngeom > 10
            patches += [generator.flat_patches["spawn"]] if generator.flat_patches else []
        hills += [names["hills"]] if "hills" in names else []
    assert [array.shape[2:] for array in patches] == [(20, 3)]
    (ground,) = (TerrainEntity(cfg, "cpu") for cfg in hills)
    assert ground.compile().hfield_nrow.tolist() == [161]
    assert ground.terrain_origins.shape == (1, 49, 3)


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
