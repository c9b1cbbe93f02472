"""Textures of surfaces and of the sky, with the mappings of MuJoCo's and Warp's renderers.

A texture that is laid onto a mesh by coordinates of its vertices shows as its mean colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

from mjlab.sim.native.camera_geoms import (
    MESH,
    PLANE,
    CameraPose,
    GeomTable,
    PosedGeoms,
    ReadField,
)
from mjlab.sim.native.camera_mappings import MAPPINGS, sky_coordinates

if TYPE_CHECKING:
    from mjlab.sim.native.camera_colours import MetSurfaces

_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_SKYBOX = int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)
# So many planes at most are painted one by one.
_MOST_PLANES = 2


@dataclass
class _TexturedGeoms:
    """How textures lie on geoms: (1 or n, G, ...), for some with an entry more."""

    texture: torch.Tensor
    """Texture, -1 for none."""
    repeat: torch.Tensor
    """(..., 2) repetitions."""
    uniform: torch.Tensor
    """Whether these are per length."""
    size: torch.Tensor
    """(..., 3) sizes of the geoms."""


class TextureTable:
    """All textures of a model in one table of texels."""

    def __init__(self, model: mujoco.MjModel, table: GeomTable) -> None:
        """Take the textures of a model, for the geoms of `table`."""
        self._kinds = table.kinds
        texels, starts = [np.zeros((0, 3), np.uint8)], [0]
        for i in range(model.ntex):
            channels, start = int(model.tex_nchannel[i]), int(model.tex_adr[i])
            count = int(model.tex_width[i] * model.tex_height[i])
            data = model.tex_data[start : start + count * channels].reshape(count, channels)
            rgb = np.zeros((count, 3), np.uint8)
            rgb[:, : min(channels, 3)] = data[:, :3]
            texels.append(rgb)
            starts.append(starts[-1] + count)
        self._texels = torch.from_numpy(np.concatenate(texels).T.copy()).float().div_(255.0)
        self._starts = torch.tensor(starts, dtype=torch.int32)
        self._means = (
            torch.stack([self._texels[:, a:b].mean(dim=1) for a, b in pairwise(starts)])
            if (model.ntex)
            else self._texels
        )
        self._has_coordinates = torch.tensor([*(model.mesh_texcoordadr >= 0), False])
        self._width = torch.tensor(model.tex_width, dtype=torch.int32)
        self._height = torch.tensor(model.tex_height, dtype=torch.int32)
        skies = np.flatnonzero(model.tex_type == _SKYBOX)
        self._sky = int(skies[0]) if len(skies) else None

    @property
    def has_sky(self) -> bool:
        """Whether there is a skybox."""
        return self._sky is not None

    def paint(
        self,
        rgb: list[torch.Tensor],
        met: MetSurfaces,
        geoms: PosedGeoms,
        material: torch.Tensor,
        model: ReadField,
    ) -> None:
        """Multiply the colours `rgb`, three of (n, P), with the textures of the materials.

        `material` is (1 or n, G + 1): the material of each geom, -1 for none.
        """
        n = len(met.columns)
        texid = model("mat_texid")[..., _RGB].long()
        texture = of_materials(texid, material).masked_fill(material < 0, -1)
        painted = (texture >= 0).any(dim=0)
        if not painted.any():
            return
        finish = _TexturedGeoms(
            texture,
            _rows_of_materials(model("mat_texrepeat"), material),
            _rows_of_materials(model("mat_texuniform")[..., None] != 0, material).squeeze(-1),
            geoms.size,
        )
        # Points on rays, by component.
        points = met.rays.directions.permute(2, 0, 1) * met.distances
        if met.rays.offsets is not None:
            points = points + met.rays.offsets.permute(2, 0, 1)
        is_plane = torch.cat((self._kinds == PLANE, torch.tensor([False])))
        planes = (painted & is_plane).nonzero().flatten().tolist()
        if len(planes) <= _MOST_PLANES:
            for column in planes:
                self._paint_plane(rgb, column, points, met, geoms, finish)
            texture = texture.masked_fill(is_plane, -1)
        of_pixel = torch.take(texture, met.columns + _row_starts(texture, n)).view(-1)
        place = (of_pixel >= 0).nonzero().squeeze(1)
        if len(place):
            self._paint_some(rgb, place, of_pixel[place], points, met, geoms, finish)

    def _paint_plane(
        self,
        rgb: list[torch.Tensor],
        column: int,
        points: torch.Tensor,
        met: MetSurfaces,
        geoms: PosedGeoms,
        finish: _TexturedGeoms,
    ) -> None:
        """Paint the pixels of one plane; the ground may be most of what there is."""
        is_here = met.columns == column
        if not is_here.any():
            return
        mat = geoms.mat[:, column]
        centre = _turn_back(mat, geoms.pos[:, column])
        local = [
            torch.addcmul(
                points[0] * mat[:, 0, i, None] - centre[:, i, None], points[1], mat[:, 1, i, None]
            ).addcmul_(points[2], mat[:, 2, i, None])
            for i in range(2)
        ]
        rays = met.columns.shape[1]
        size, repeat, uniform, texture = (
            _for_pixels(values[:, column], rays)
            for values in (finish.size, finish.repeat, finish.uniform, finish.texture)
        )
        uv = MAPPINGS[PLANE](torch.stack(local).view(2, -1).t(), None, size, repeat, uniform)
        colour = self._sample(texture.clamp(min=0), *uv.unbind(dim=1)).t().view(3, *is_here.shape)
        is_here = is_here & (finish.texture[:, column, None] >= 0)
        for channel, values in zip(rgb, colour, strict=True):
            channel *= torch.where(is_here, values, 1.0)

    def _paint_some(
        self,
        rgb: list[torch.Tensor],
        place: torch.Tensor,
        texture: torch.Tensor,
        points: torch.Tensor,
        met: MetSurfaces,
        geoms: PosedGeoms,
        finish: _TexturedGeoms,
    ) -> None:
        """Paint the pixels `place` of the flattened (n, P) with the textures `texture` (K,)."""
        rays = met.columns.shape[1]
        env, column = place.div(rays, rounding_mode="floor"), met.columns.view(-1)[place]
        of_geom = env * geoms.pos.shape[1] + column
        mat = geoms.mat.flatten(0, 1).flatten(1).t().contiguous()[:, of_geom]
        centre = geoms.pos.flatten(0, 1).t().contiguous()[:, of_geom]
        local = _turn_back_parts(mat, points.flatten(1)[:, place] - centre)
        normal = _turn_back_parts(mat, met.normals.view(-1, 3)[place].t())
        size = _of_geoms(finish.size, env, column)
        repeat = _of_geoms(finish.repeat, env, column)
        uniform = _of_geoms(finish.uniform, env, column)
        uv = torch.empty(len(place), 2)
        kinds = self._kinds[column]
        for kind, mapping in MAPPINGS.items():
            chosen = (kinds == kind).nonzero().squeeze(1)
            if len(chosen):
                parts = (values[chosen] for values in (local, normal, size, repeat, uniform))
                uv[chosen] = mapping(*parts)
        colour = self._sample(texture, uv[:, 0], uv[:, 1])
        if self._has_coordinates.any():
            # Rays do not say which face of a mesh they meet.
            mesh = _of_geoms(geoms.dataid, env, column).masked_fill(kinds != MESH, -1).long()
            laid = self._has_coordinates[mesh]
            colour[laid] = self._means[texture[laid]]
        for channel, values in zip(rgb, colour.unbind(dim=1), strict=True):
            channel.view(-1)[place] *= values

    def paint_sky(
        self, rgb: list[torch.Tensor], met: MetSurfaces, camera: CameraPose, nothing: int
    ) -> None:
        """Fill the colours of rays that met nothing, whose column is `nothing`, with the sky."""
        if self._sky is None:
            return
        rays = met.columns.shape[1]
        place = (met.columns.view(-1) == nothing).nonzero().squeeze(1)
        if not len(place):
            return
        env = place.div(rays, rounding_mode="floor")
        directions = _turn(camera.mat[env], _at(met.rays.directions, place, rays))
        u, v = sky_coordinates(directions, int(self._width[self._sky]))
        colour = self._sample(torch.full_like(place, self._sky), u, v)
        for channel, values in zip(rgb, colour.unbind(dim=1), strict=True):
            channel.view(-1)[place] = values

    def _sample(self, texture: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """Return colours (K, 3) at the places u, v (K,) in [0, 1) of textures (K,).

        Linear between the centres of texels, and constant beyond those of the outermost.
        """
        width, height = self._width[texture], self._height[texture]
        x = (u * width - 0.5).clamp_(min=0.0).minimum(width - 1.0)
        y = (v * height - 0.5).clamp_(min=0.0).minimum(height - 1.0)
        left, top = x.int(), y.int()
        x, y = x - left, y - top
        right, bottom = (left + 1).minimum(width - 1), (top + 1).minimum(height - 1)
        first, last = (self._starts[texture] + row * width for row in (top, bottom))
        corners = [(row + side) for row in (first, last) for side in (left, right)]
        channels = []
        for texels in self._texels:
            a, b, c, d = (torch.index_select(texels, 0, corner) for corner in corners)
            channels.append(torch.lerp(torch.lerp(a, b, x), torch.lerp(c, d, x), y))
        return torch.stack(channels, dim=0).t()


def _row_starts(values: torch.Tensor, n: int) -> torch.Tensor:
    """Return what to add to columns (n, P), so that they index values (1 or n, G) as a whole."""
    rows = torch.arange(n) if len(values) > 1 else torch.zeros(n, dtype=torch.int64)
    return rows[:, None] * values.shape[1]


def _at(values: torch.Tensor, place: torch.Tensor, rays: int) -> torch.Tensor:
    """Return values (1 or n, P, 3) at places of the flattened (n, P)."""
    return values.reshape(-1, 3)[place if len(values) > 1 else place % rays]


def _of_geoms(values: torch.Tensor, env: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Return values (1 or n, G, ...) of geoms `column` (K,) in environments `env` (K,)."""
    return values.flatten(0, 1)[column if len(values) == 1 else env * values.shape[1] + column]


def _for_pixels(values: torch.Tensor, rays: int) -> torch.Tensor:
    """Return values (1 or n, ...) of environments for all their pixels; one if all are the same."""
    if (values == values[:1]).all():
        return values[:1]
    return values.repeat_interleave(rays, dim=0)


def _rows_of_materials(values: torch.Tensor, material: torch.Tensor) -> torch.Tensor:
    """Return values (a, nmat, k) of materials (b, G): (max(a, b), G, k)."""
    return torch.stack([of_materials(part, material) for part in values.unbind(dim=-1)], dim=-1)


def of_materials(values: torch.Tensor, material: torch.Tensor) -> torch.Tensor:
    """Return values (a, nmat) of materials (b, G): (max(a, b), G); any for the material -1."""
    n = max(len(values), len(material))
    return values.expand(n, -1).gather(1, material.clamp(min=0).expand(n, -1))


def _turn(mat: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    return (mat @ vectors[..., None]).squeeze(-1)


def _turn_back(mat: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    return (vectors[..., None, :] @ mat).squeeze(-2)


def _turn_back_parts(mat: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Return vectors (3, K) turned back by matrices (9, K), as (K, 3)."""
    x, y, z = vectors
    return torch.stack([x * mat[i] + y * mat[3 + i] + z * mat[6 + i] for i in range(3)]).t()
