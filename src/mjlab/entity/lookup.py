"""Names of an entity's elements, and finding elements by regular expression."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco

from mjlab.entity.initial_state import short_name
from mjlab.utils.lab_api.string import resolve_matching_names

Found = tuple[list[int], list[str]]


class NamedElements:
    """What an entity has, by name.

    Names are without the prefix of the scene: the part after the last "/". Elements without a name
    are called "". Every `find_*` takes regular expressions that must match a whole name, and
    returns indices within the entity and names, in the entity's order, or, with `preserve_order`,
    pattern by pattern. With a subset of names to choose from, indices count in that subset.

    All raise `ValueError`, listing the candidates, if a pattern matches nothing or two patterns
    match one name.
    """

    _spec: mujoco.MjSpec
    _free_joint: mujoco.MjsJoint | None
    _joints: tuple[mujoco.MjsJoint, ...]

    def _names(self, kind: str) -> tuple[str, ...]:
        return _short_names(getattr(self._spec, kind))

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies, without the world."""
        return self._names("bodies")[1:]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, without a free joint."""
        return _short_names(self._joints)

    @property
    def all_joint_names(self) -> tuple[str, ...]:
        """Names of all joints, a free joint included."""
        return self._names("joints")

    @property
    def geom_names(self) -> tuple[str, ...]:
        """Names of the geoms."""
        return self._names("geoms")

    @property
    def site_names(self) -> tuple[str, ...]:
        """Names of the sites."""
        return self._names("sites")

    @property
    def tendon_names(self) -> tuple[str, ...]:
        """Names of the tendons."""
        return self._names("tendons")

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """Names of all actuators in the spec, also of those that no config lists."""
        return self._names("actuators")

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self._names("cameras")

    @property
    def light_names(self) -> tuple[str, ...]:
        """Names of the lights."""
        return self._names("lights")

    @property
    def material_names(self) -> tuple[str, ...]:
        """Names of the materials."""
        return self._names("materials")

    @property
    def texture_names(self) -> tuple[str, ...]:
        """Names of the textures."""
        return self._names("textures")

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Names of the contact pairs."""
        return self._names("pairs")

    @property
    def num_bodies(self) -> int:
        """Number of bodies, without the world."""
        return len(self.body_names)

    @property
    def num_joints(self) -> int:
        """Number of joints, without a free joint."""
        return len(self._joints)

    @property
    def num_geoms(self) -> int:
        """Number of geoms."""
        return len(self.geom_names)

    @property
    def num_sites(self) -> int:
        """Number of sites."""
        return len(self.site_names)

    @property
    def num_tendons(self) -> int:
        """Number of tendons."""
        return len(self.tendon_names)

    @property
    def num_actuators(self) -> int:
        """Number of actuators in the spec."""
        return len(self.actuator_names)

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return len(self.camera_names)

    @property
    def num_lights(self) -> int:
        """Number of lights."""
        return len(self.light_names)

    @property
    def num_materials(self) -> int:
        """Number of materials."""
        return len(self.material_names)

    @property
    def num_textures(self) -> int:
        """Number of textures."""
        return len(self.texture_names)

    @property
    def num_pairs(self) -> int:
        """Number of contact pairs."""
        return len(self.pair_names)

    def find_bodies(self, name_keys: str | Sequence[str], preserve_order: bool = False) -> Found:
        """Find bodies by name."""
        return _find("bodies", name_keys, self.body_names, None, preserve_order)

    def find_joints(
        self,
        name_keys: str | Sequence[str],
        joint_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find joints by name; the free joint is none of them."""
        return _find("joints", name_keys, self.joint_names, joint_subset, preserve_order)

    def find_geoms(
        self,
        name_keys: str | Sequence[str],
        geom_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find geoms by name."""
        return _find("geoms", name_keys, self.geom_names, geom_subset, preserve_order)

    def find_sites(
        self,
        name_keys: str | Sequence[str],
        site_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find sites by name."""
        return _find("sites", name_keys, self.site_names, site_subset, preserve_order)

    def find_tendons(
        self,
        name_keys: str | Sequence[str],
        tendon_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find tendons by name."""
        return _find("tendons", name_keys, self.tendon_names, tendon_subset, preserve_order)

    def find_actuators(
        self,
        name_keys: str | Sequence[str],
        actuator_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find actuators by name."""
        return _find("actuators", name_keys, self.actuator_names, actuator_subset, preserve_order)

    def find_cameras(
        self,
        name_keys: str | Sequence[str],
        camera_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find cameras by name."""
        return _find("cameras", name_keys, self.camera_names, camera_subset, preserve_order)

    def find_lights(
        self,
        name_keys: str | Sequence[str],
        light_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find lights by name."""
        return _find("lights", name_keys, self.light_names, light_subset, preserve_order)

    def find_materials(
        self,
        name_keys: str | Sequence[str],
        material_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find materials by name."""
        return _find("materials", name_keys, self.material_names, material_subset, preserve_order)

    def find_textures(
        self,
        name_keys: str | Sequence[str],
        texture_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find textures by name."""
        return _find("textures", name_keys, self.texture_names, texture_subset, preserve_order)

    def find_pairs(
        self,
        name_keys: str | Sequence[str],
        pair_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find contact pairs by name."""
        return _find("pairs", name_keys, self.pair_names, pair_subset, preserve_order)


def _short_names(elements: Sequence[Any]) -> tuple[str, ...]:
    return tuple(short_name(element.name) for element in elements)


def _find(
    kind: str,
    name_keys: str | Sequence[str],
    names: Sequence[str],
    subset: Sequence[str] | None,
    preserve_order: bool,
) -> Found:
    try:
        return resolve_matching_names(
            name_keys, names if subset is None else subset, preserve_order
        )
    except ValueError as error:
        raise ValueError(f"Cannot find {kind} by {name_keys!r}. {error}") from None
