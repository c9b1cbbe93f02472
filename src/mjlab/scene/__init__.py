"""Scenes: terrain, entities and sensors composed into one `MjSpec`."""

from mjlab.scene.scene import Scene as Scene
from mjlab.scene.scene import SceneCfg as SceneCfg
