"""The scene: terrain, entities and sensors in one MuJoCo spec."""

from mjlab.scene.scene import Scene as Scene
from mjlab.scene.scene import SceneCfg as SceneCfg
