"""Geoms in the frame of a camera, and which of them are in sight of each tile of its image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from mjlab.sim.native.camera_pixels import PixelGrid, PixelRays
from mjlab.sim.rendering import rendered_geoms
from mjlab.utils.lab_api.math import matrix_from_quat, quat_conjugate, quat_from_matrix, quat_mul

_T = mujoco.mjtGeom
PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(_T, f"mjGEOM_{name}"))
    for name in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
RENDERED_KINDS = (PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH)

# Half extents (metres) of what has no end; larger numbers lose the small ones beside them.
_ENDLESS = 1e8
# How half extents follow from sizes.
_EXTENTS = {
    PLANE: ((1, 0, 0), (0, 1, 0), (0, 0, 0)),
    SPHERE: ((1, 0, 0), (1, 0, 0), (1, 0, 0)),
    CAPSULE: ((1, 0, 0), (1, 0, 0), (1, 1, 0)),
    ELLIPSOID: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    CYLINDER: ((1, 0, 0), (1, 0, 0), (0, 1, 0)),
    BOX: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
}
# What rounding may hide of a geom: relative to its extents and distance, and in metres.
_SLACK, _SLACK_METRES = 1e-5, 1e-6

ReadField = Callable[[str], torch.Tensor]
"""A field by name, of the environments in question: (n, ...), or (1, ...) if they share it."""


@dataclass
class CameraPose:
    """Where a camera is in n environments."""

    pos: torch.Tensor
    """(n, 3) world position."""
    mat: torch.Tensor
    """(n, 3, 3) world orientation."""

    def to_camera(self, vectors: torch.Tensor) -> torch.Tensor:
        """Turn world vectors (n, k, 3) into the camera's frame."""
        return vectors @ self.mat


@dataclass
class PosedGeoms:
    """G geoms in the frame of a camera, in n environments; n is 1 for what they share."""

    pos: torch.Tensor
    """(n, G, 3)."""
    quat: torch.Tensor
    """(n, G, 4)."""
    mat: torch.Tensor
    """(n, G, 3, 3)."""
    size: torch.Tensor
    """(1 or n, G, 3)."""
    dataid: torch.Tensor
    """(1 or n, G) int32: height field or mesh, or -1."""
    exists: torch.Tensor
    """(n, G) bool: an environment may lack what others have."""


class GeomTable:
    """The geoms of some groups, from the last of the model to the first.

    Of surfaces at the same distance the first one is seen, which is that of the later geom.
    """

    def __init__(self, model: mujoco.MjModel, groups: tuple[int, ...]) -> None:
        """Take the geoms of `groups` of a model."""
        ids = rendered_geoms(model, groups)[::-1]
        self.ids = torch.tensor([*ids, -1], dtype=torch.int32)
        """(G + 1,) ids in the model; the last entry stands for nothing."""
        self._index = torch.tensor(ids, dtype=torch.int64)
        self.kinds = torch.tensor(model.geom_type[ids], dtype=torch.int32)
        """(G,) types."""
        self._bodies = torch.tensor(model.geom_bodyid[ids], dtype=torch.int64)
        self.present = [kind for kind in RENDERED_KINDS if (self.kinds == kind).any()]
        """Types that there are."""
        self._columns = {kind: (self.kinds == kind).nonzero().flatten() for kind in self.present}
        rules = [_EXTENTS.get(int(kind), ((0, 0, 0),) * 3) for kind in self.kinds]
        self._rules = torch.tensor(rules, dtype=torch.float32).view(-1, 3, 3)
        self._boxes = {MESH: _mesh_boxes(model), HFIELD: _hfield_boxes(model)}

    def __len__(self) -> int:
        return len(self._index)

    def pose(self, data: ReadField, model: ReadField, camera: CameraPose) -> PosedGeoms:
        """Place the geoms in the frame of `camera`, by fields of `MjData` and `MjModel`."""
        body_quat = data("xquat")[:, self._bodies]
        local_pos, local_quat = model("geom_pos"), model("geom_quat")
        local_quat = local_quat[:, self._index].expand_as(body_quat)
        to_camera = quat_conjugate(quat_from_matrix(camera.mat))[:, None].expand_as(body_quat)
        in_camera = quat_mul(to_camera, body_quat)
        turned = matrix_from_quat(in_camera) @ local_pos[:, self._index, :, None]
        pos = camera.to_camera(data("xpos")[:, self._bodies] - camera.pos[:, None])
        quat = quat_mul(in_camera, local_quat)
        geoms = PosedGeoms(
            pos=pos + turned.squeeze(-1),
            quat=quat,
            mat=matrix_from_quat(quat),
            size=model("geom_size")[:, self._index],
            dataid=model("geom_dataid")[:, self._index],
            exists=torch.ones(quat.shape[:2], dtype=torch.bool),
        )
        # Where environments hold different things, one that is not there has no shape or no size.
        for kind, columns in self._columns.items():
            if kind in (MESH, HFIELD):
                geoms.exists[:, columns] &= geoms.dataid[:, columns] >= 0
            elif kind != PLANE:
                geoms.exists[:, columns] &= geoms.size[:, columns, 0] > 0.0
        return geoms

    def _not_around(self, geoms: PosedGeoms) -> torch.Tensor:
        """Return which geoms (n, G) a pinhole camera sees from outside.

        Back faces are culled, so that it does not see those that it is in. Meshes are not looked
        at here.
        """
        outside = geoms.exists.clone()
        local = -(geoms.pos[..., None, :] @ geoms.mat).squeeze(-2)
        for kind, columns in self._columns.items():
            if kind in _IS_INSIDE:
                size = geoms.size[:, columns]
                outside[:, columns] &= ~_IS_INSIDE[kind](local[:, columns], size)
        return outside

    def in_sight(self, geoms: PosedGeoms, rays: PixelRays, grid: PixelGrid) -> torch.Tensor:
        """Return (n, rows, columns, G) bool: what rays of each tile may meet.

        A box around a geom is in sight of a tile unless it lies beyond one of the tile's sides.
        """
        centre, half = self._bounds(geoms)
        middle = geoms.pos if centre is None else geoms.pos + _turn(geoms.mat, centre)
        planes = rays.planes.transpose(1, 2)
        axes = geoms.mat.transpose(-1, -2).reshape(len(geoms.mat), -1, 3)
        along = _product(axes, planes).abs_().unflatten(1, (-1, 3))
        reach = (along * half[..., None]).sum(dim=2)
        reach *= 1.0 + _SLACK
        reach += _product(middle, planes) + rays.plane_offsets[:, None]
        reach += _SLACK_METRES + _SLACK * middle.abs().amax(dim=-1, keepdim=True)
        inside = reach >= 0.0
        visible = geoms.exists if rays.offsets is not None else self._not_around(geoms)
        inside &= visible[..., None]
        n, columns = grid.columns, inside[..., : 2 * grid.columns]
        rows = inside[..., 2 * n :]
        by_column = columns[..., :n] & columns[..., n:]
        by_row = rows[..., : grid.rows] & rows[..., grid.rows :]
        by_column, by_row = by_column.transpose(1, 2), by_row.transpose(1, 2)
        return by_row[:, :, None] & by_column[:, None]

    def _bounds(self, geoms: PosedGeoms) -> tuple[torch.Tensor | None, torch.Tensor]:
        """Return centres (None: all zero) and half extents, (1 or n, G, 3) each."""
        half = (self._rules @ geoms.size[..., None]).squeeze(-1)
        centre = None
        for kind in (MESH, HFIELD):
            if kind not in self._columns:
                continue
            centre = torch.zeros_like(half) if centre is None else centre
            columns = self._columns[kind]
            ids = geoms.dataid[:, columns].clamp(min=0).long()
            if len(ids) > len(half):
                half, centre = half.repeat(len(ids), 1, 1), centre.repeat(len(ids), 1, 1)
            middles, halves = self._boxes[kind]
            centre[:, columns], half[:, columns] = middles[ids], halves[ids]
        if PLANE in self._columns:
            columns = self._columns[PLANE]
            sides = half[:, columns, :2]
            half[:, columns, :2] = sides.masked_fill(sides <= 0.0, _ENDLESS)
        return centre, half


def _turn(mat: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    return (mat @ vectors[..., None]).squeeze(-1)


def _product(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Return (n, k, 3) times (1 or n, 3, F); with one factor for all in a single product."""
    return left @ right[0] if len(right) == 1 else left @ right


def _mesh_boxes(model: mujoco.MjModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Return centres and half extents (nmesh, 3) of the meshes in their own frames."""
    low, high = np.zeros((model.nmesh, 3)), np.zeros((model.nmesh, 3))
    for i in range(model.nmesh):
        start = model.mesh_vertadr[i]
        vertices = model.mesh_vert[start : start + model.mesh_vertnum[i]]
        low[i], high[i] = vertices.min(axis=0), vertices.max(axis=0)
    return _as_box(low, high)


def _hfield_boxes(model: mujoco.MjModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Return centres and half extents (nhfield, 3) of height fields: from base to top."""
    size = model.hfield_size
    low = np.stack((-size[:, 0], -size[:, 1], -size[:, 3]), axis=-1)
    return _as_box(low, size[:, :3])


def _as_box(low: np.ndarray, high: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    middle, half = (low + high) / 2, (high - low) / 2
    return torch.tensor(middle, dtype=torch.float32), torch.tensor(half, dtype=torch.float32)


# Whether points (n, k, 3) in the frames of geoms are inside of them, by their sizes (1 or n, k, 3).


def _in_ellipsoid(point: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    return (point / size).square().sum(dim=-1) < 1.0


def _in_sphere(point: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    return point.square().sum(dim=-1) < size[..., 0].square()


def _in_capsule(point: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    beyond = (point[..., 2].abs() - size[..., 1]).clamp(min=0.0)
    return point[..., :2].square().sum(dim=-1) + beyond.square() < size[..., 0].square()


def _in_cylinder(point: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    in_circle = point[..., :2].square().sum(dim=-1) < size[..., 0].square()
    return in_circle & (point[..., 2].abs() < size[..., 1])


def _in_box(point: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    return (point.abs() < size).all(dim=-1)


_IS_INSIDE = {
    SPHERE: _in_sphere,
    CAPSULE: _in_capsule,
    ELLIPSOID: _in_ellipsoid,
    CYLINDER: _in_cylinder,
    BOX: _in_box,
}
