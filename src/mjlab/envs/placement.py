"""Report of fixed bases that are not placed at the origins of their environments."""

from __future__ import annotations

import warnings

import mujoco

from mjlab.entity import Entity
from mjlab.scene import Scene

# Geoms of a ground, which all environments share.
_GROUND = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


class PlacementReport:
    """Warns, once, of fixed bases at the world's origin while terms read `Scene.env_origins`.

    A fixed base stays at its initial position, the same in all environments, until an event places
    it. Distances between it and positions relative to `env_origins` are then wrong.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._terrain = scene, scene.terrain
        self._is_done = self._was_reset = self._were_kept = False

    def begin(self, resets: bool = False) -> None:
        """Forget earlier reads of the origins, e.g. by a viewer. Called before terms."""
        if self._terrain is not None:
            self._terrain.origins_were_read = False
        self._was_reset |= resets

    def end_building(self) -> None:
        """Note reads by constructors of terms, which may keep the origins. Called after `begin`."""
        self._were_kept = self._terrain is not None and self._terrain.origins_were_read

    def end(self) -> None:
        """Warn if terms read the origins since `begin`. Called after all terms."""
        if self._is_done or self._terrain is None or not self._was_reset:
            return
        if not (self._terrain.origins_were_read or self._were_kept):
            return
        self._is_done = True
        names = unplaced_bases(self._scene)
        if names:
            warnings.warn(
                f"The fixed base of {', '.join(map(repr, names))} is at the same position in all "
                "environments, but terms read scene.env_origins; place it with an event of mode "
                "'reset', such as mdp.reset_scene_to_default, or mdp.reset_root_state_uniform with "
                f"pose_range={{}} and asset_cfg=SceneEntityCfg({names[0]!r}). Scenery that all environments "
                "share can stay.",
                UserWarning,
                stacklevel=6,  # Caller of `step` or `reset`: past a context manager and a decorator.
            )


def unplaced_bases(scene: Scene) -> list[str]:
    """Return the entities whose fixed base is at its initial position although origins differ.

    The terrain, and entities with a plane or a height field, are shared by all environments.
    """
    origins = scene.terrain.env_origins if scene.terrain is not None else None
    if origins is None or not origins.any():
        return []
    return [
        name
        for name, entity in scene.entities.items()
        if entity is not scene.terrain and entity.is_fixed_base and not _is_placed(entity)
    ]


def _is_placed(entity: Entity) -> bool:
    if any(geom.type in _GROUND for geom in entity.spec.geoms):
        return True
    moved = entity.data.root_link_pos_w - entity.data.default_root_state[:, :3]
    return bool((moved.abs() > 1e-4).any())
