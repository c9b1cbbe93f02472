"""The ground on which environments stand."""

from mjlab.compat import older_names
from mjlab.terrains.terrain_entity import TerrainEntity as TerrainEntity
from mjlab.terrains.terrain_entity import TerrainEntityCfg as TerrainEntityCfg

__getattr__ = older_names(__name__)
