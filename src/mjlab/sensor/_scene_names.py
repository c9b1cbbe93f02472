"""Names in the scene of what an `ObjRef` refers to."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjlab.sensor.builtin_sensor import ObjRef

# The scene attaches its terrain without a prefix.
_TERRAIN = "terrain"


def find_in_scene(ref: ObjRef, names: Iterable[str]) -> tuple[str | None, list[str]]:
    """Look for what `ref` refers to among the `names` that elements of its kind have in the scene.

    Returns its name in the scene, None if there is no such element; and the names that the owner
    has to offer, without its prefix.
    """
    prefix = f"{ref.entity}/" if ref.entity else ""
    offered = {name.removeprefix(prefix): name for name in names if name.startswith(prefix)}
    if ref.entity == _TERRAIN:
        # A name with a prefix belongs to another entity. Where there is no terrain, an entity may
        # be called so, and has its prefix.
        offered = {name: name for name in names if name and "/" not in name} | offered
    offered.pop("", None)
    return offered.get(ref.name), list(offered)
