"""Frames that terms command or control: a body, a site or a geom of an entity."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Literal, get_args

import torch

from mjlab.entity.data import compute_velocity_from_cvel
from mjlab.utils.errors import check_one_of
from mjlab.utils.lab_api.math import quat_from_matrix

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.sim import Simulation

FrameType = Literal["body", "site", "geom"]
"""Element type of a frame."""


class Frame:
    """Frame of one element of an entity, in the world.

    Values are of the age of `xpos`; see `EntityData`.

    Attributes:
        body: Id of the body that the frame is fixed to, in the model.
        pos: (N, 3) live position.
        rotation: Live orientation: (N, 4) quaternions of a body, (N, 3, 3) matrices of others.
    """

    def __init__(
        self, sim: Simulation, entity: Entity, owner: str, frame_type: FrameType, frame_name: str
    ) -> None:
        """Find the element. Of several matches, the first is used, with a warning.

        Args:
            sim: Simulation of the scene.
            entity: Entity of the element.
            owner: Name of the entity, for messages.
            frame_type: Element type.
            frame_name: Pattern of the element's name, matched in full.

        Raises:
            ValueError: unknown type, or the pattern matches nothing.
        """
        check_one_of("frame_type", frame_type, get_args(FrameType))
        find = {"body": entity.find_bodies, "site": entity.find_sites, "geom": entity.find_geoms}
        ids, names = find[frame_type](frame_name)
        if len(ids) != 1:
            text = (
                f"frame_name {frame_name!r}: expected to match exactly one {frame_type} of entity "
                f"{owner!r}, got {len(ids)}: {names}"
            )
            if not ids:
                raise ValueError(f"{text}.")
            warnings.warn(f"{text}; using {names[0]!r}.", UserWarning, stacklevel=3)
        model, data = sim.mj_model, sim.data
        element = int(getattr(entity.indexing, f"{frame_type}_ids")[ids[0]])
        if frame_type == "body":
            self.body, self.pos, self.rotation = (
                element,
                data.xpos[:, element],
                data.xquat[:, element],
            )
        else:
            self.body = int(getattr(model, f"{frame_type}_bodyid")[element])
            self.pos = getattr(data, f"{frame_type}_xpos")[:, element]
            self.rotation = getattr(data, f"{frame_type}_xmat")[:, element]
        self.element, self.frame_type = element, frame_type
        self._data, self._root = data, int(model.body_rootid[self.body])

    @property
    def quat(self) -> torch.Tensor:
        """(N, 4) orientation."""
        return self.rotation if self.rotation.ndim == 2 else quat_from_matrix(self.rotation)

    @property
    def velocity(self) -> torch.Tensor:
        """(N, 6) linear velocity of the frame's origin, angular velocity."""
        data = self._data
        return compute_velocity_from_cvel(
            self.pos, data.subtree_com[:, self._root], data.cvel[:, self.body]
        )
