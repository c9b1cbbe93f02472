"""Frames of the scene that a sensor is attached to: bodies, sites and geoms."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.sensor._scene_names import find_in_scene
from mjlab.sensor.builtin_sensor import ObjRef
from mjlab.utils.string import name_list

if TYPE_CHECKING:
    from mjlab.entity import Entity

# Kind of frame: fields of MjData with position and orientation, and MuJoCo's type of the object.
_KINDS = {
    "body": ("xpos", "xmat", mujoco.mjtObj.mjOBJ_BODY),
    "site": ("site_xpos", "site_xmat", mujoco.mjtObj.mjOBJ_SITE),
    "geom": ("geom_xpos", "geom_xmat", mujoco.mjtObj.mjOBJ_GEOM),
}


def check_frames(frames: tuple[ObjRef, ...], entities: dict[str, Entity]) -> None:
    """Raise ValueError unless all `frames` are bodies, sites or geoms, of entities there are."""
    if not frames:
        raise ValueError("frame is empty; give one ObjRef or several.")
    for frame in frames:
        if frame.type not in _KINDS:
            raise ValueError(
                f"frame {frame.name!r} is of type {frame.type!r}; rays start at a body, a site or "
                "a geom."
            )
        if frame.entity and frame.entity not in entities:
            raise ValueError(
                f"frame {frame.name!r} refers to the entity {frame.entity!r}. The scene has: "
                f"{sorted(entities)}."
            )


def _find(frame: ObjRef, mj_model: mujoco.MjModel) -> int:
    """Return the id of a frame; ValueError with close names if there is none."""
    kind = _KINDS[frame.type][2]
    names = [
        mujoco.mj_id2name(mj_model, kind, i) or ""
        for i in range(getattr(mj_model, f"n{frame.type}"))
    ]
    full_name, offered = find_in_scene(frame, names)
    if full_name is not None:
        return names.index(full_name)
    close = difflib.get_close_matches(frame.name, offered, n=3)
    hint = f"Close names: {', '.join(close)}." if close else f"It has: {name_list(offered, [])}."
    owner = f"Entity {frame.entity!r}" if frame.entity else "The scene"
    raise ValueError(f"{owner} has no {frame.type} {frame.name!r}. {hint}")


class Frames:
    """Poses of several frames, in the order in which they were given."""

    def __init__(
        self, frames: tuple[ObjRef, ...], mj_model: mujoco.MjModel, data: Any, device: str
    ) -> None:
        """Find the frames; ValueError with close names for one that does not exist."""
        self._data = data
        self._parts: list[tuple[str, str, torch.Tensor, torch.Tensor]] = []
        self.body_ids: list[int] = []
        """The body that carries each frame."""
        ids = []
        for frame in frames:
            index = _find(frame, mj_model)
            ids.append(index)
            owners = {"site": mj_model.site_bodyid, "geom": mj_model.geom_bodyid}
            self.body_ids.append(index if frame.type == "body" else int(owners[frame.type][index]))
        for kind in dict.fromkeys(frame.type for frame in frames):
            places = [i for i, frame in enumerate(frames) if frame.type == kind]
            self._parts.append(
                (
                    *_KINDS[kind][:2],
                    torch.tensor(places, device=device),
                    torch.tensor([ids[i] for i in places], device=device),
                )
            )

    def read(self, pos: torch.Tensor, mat: torch.Tensor) -> None:
        """Copy current positions into `pos` (N, F, 3) and orientations into `mat` (N, F, 3, 3)."""
        for pos_field, mat_field, places, ids in self._parts:
            for out, field in ((pos, pos_field), (mat, mat_field)):
                values = getattr(self._data, field).index_select(1, ids)
                if len(self._parts) == 1:
                    out.copy_(values)
                else:
                    out.index_copy_(1, places, values)
