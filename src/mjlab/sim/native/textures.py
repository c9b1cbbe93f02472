"""Textures of surfaces and of the sky, with the mappings of MuJoCo's and Warp's renderers.

Components come first: a vector of K points is (3, K). A texture laid onto a mesh by coordinates of
its vertices shows as its mean color, because rays do not say which face of a mesh they meet.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from mjlab.sim.native.render import Geoms, ReadField, Surfaces

_T = mujoco.mjtGeom
PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(_T, f"mjGEOM_{name}"))
    for name in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_SKYBOX = int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)
# Planes painted one by one: all pixels of an image at once. On the YAM task, whose ground fills
# most of the image, rgb images are 1.9 times as fast as with the pixels of the ground picked out.
_MAX_PLANES = 2
# The cosine above which a normal is that of an end of a cylinder.
_END = 0.7071
_TINY = 1e-6


class Textures:
    """The textures of a model, in one table of texels."""

    def __init__(self, model: mujoco.MjModel, kinds: Tensor) -> None:
        """Take the textures of a model, for geoms of the types `kinds` (G + 1,), -1 for none."""
        self._kinds = kinds
        counts, texels = model.tex_width * model.tex_height, [np.zeros((0, 3), np.uint8)]
        for start, count, channels in zip(model.tex_adr, counts, model.tex_nchannel, strict=True):
            data = model.tex_data[start : start + count * channels].reshape(count, channels)
            texels.append(np.pad(data[:, :3], ((0, 0), (0, 3 - min(channels, 3)))))
        self._texels = torch.from_numpy(np.concatenate(texels).T.copy()).float().div_(255.0)
        self._starts = torch.from_numpy(np.cumsum(counts) - counts).int()
        # (3, ntex).
        self._means = self._texels.new_zeros(3, model.ntex)
        for i, part in enumerate(self._texels.split(counts.tolist(), dim=1)):
            self._means[:, i] = part.mean(dim=1)
        self._has_coordinates = torch.tensor([*(model.mesh_texcoordadr >= 0), False])
        self._width = torch.tensor(model.tex_width, dtype=torch.int32)
        self._height = torch.tensor(model.tex_height, dtype=torch.int32)
        skies = np.flatnonzero(model.tex_type == _SKYBOX)
        self._sky = int(skies[0]) if len(skies) else None

    def paint(
        self, rgb: Tensor, met: Surfaces, geoms: Geoms, material: Tensor, read: ReadField
    ) -> None:
        """Multiply the colors `rgb` (3, n, P) by the textures of materials.

        `material` is (1 or n, G + 1): the material of each geom, -1 for none.
        """
        texture = of_materials(read("mat_texid")[..., _RGB].long(), material, -1)
        painted = (texture >= 0).any(dim=0)
        if not painted.any():
            return
        repeat = of_materials(read("mat_texrepeat"), material, 1.0).permute(2, 0, 1)
        uniform = of_materials(read("mat_texuniform") != 0, material, False)
        is_plane = self._kinds == PLANE
        planes = (painted & is_plane).nonzero().flatten().tolist()
        if len(planes) <= _MAX_PLANES:
            for i in planes:
                is_here = (met.columns == i) & (texture[:, i, None] >= 0)
                if not is_here.any():
                    continue
                center = geoms.pos[:, i].t()[..., None]
                mat = geoms.mat[:, i].permute(1, 2, 0)[..., None]
                point = _turn_back(mat, met.points - center)
                size = geoms.size[:, i].t()[..., None]
                uv = _plane(point, point, size, repeat[:, :, i, None], uniform[:, i, None])
                color = self._sample(texture[:, i, None].clamp(min=0), uv)
                rgb *= torch.where(is_here, color, 1.0)
            texture = texture.masked_fill(is_plane, -1)
        env, pixel = (of_pixels(texture, met.columns) >= 0).nonzero(as_tuple=True)
        if not len(env):
            return
        column, n = met.columns[env, pixel], len(met.columns)
        texture = texture.expand(n, -1)[env, column]
        mat = geoms.mat[env, column].permute(1, 2, 0)
        given = (
            _turn_back(mat, met.points[:, env, pixel] - geoms.pos[env, column].t()),
            _turn_back(mat, met.normals[:, env, pixel]),
            geoms.size[env, column].t(),
            repeat.expand(2, n, -1)[:, env, column],
            uniform.expand(n, -1)[env, column],
        )
        uv, kinds = torch.empty(2, len(env)), self._kinds[column]
        for kind, mapping in _MAPPINGS.items():
            chosen = (kinds == kind).nonzero().squeeze(1)
            if len(chosen):
                uv[:, chosen] = mapping(*(values[..., chosen] for values in given))
        color = self._sample(texture, uv)
        if self._has_coordinates.any():
            mesh = geoms.dataid[env, column].masked_fill(kinds != MESH, -1).long()
            laid = self._has_coordinates[mesh]
            color[:, laid] = self._means[:, texture[laid]]
        rgb[:, env, pixel] *= color

    def paint_sky(self, rgb: Tensor, missed: Tensor, directions: Tensor) -> None:
        """Fill the colors `rgb` (3, n, P) of the rays `missed` (n, P) with the sky.

        `directions` are those of the rays that missed, (3, K), in the world.
        """
        if self._sky is not None:
            uv = _sky_coordinates(directions, int(self._width[self._sky]))
            rgb[:, missed] = self._sample(torch.tensor(self._sky), uv)

    def _sample(self, texture: Tensor, uv: Tensor) -> Tensor:
        """Return the colors (3, ...) at the places `uv` (2, ...) in [0, 1) of textures (...).

        Linear between the centers of texels, and constant beyond those of the outermost.
        """
        width, height = self._width[texture], self._height[texture]
        # A pose that is NaN has no place, and NaN would be an index out of range.
        x, y = uv.nan_to_num()
        x = (x * width - 0.5).clamp_(min=0.0).minimum(width - 1.0)
        y = (y * height - 0.5).clamp_(min=0.0).minimum(height - 1.0)
        left, top = x.int(), y.int()
        x, y = x - left, y - top
        right, bottom = (left + 1).minimum(width - 1), (top + 1).minimum(height - 1)
        rows = [self._starts[texture] + row * width for row in (top, bottom)]
        corners = [(row + side).flatten() for row in rows for side in (left, right)]
        colors = torch.empty(3, *x.shape)
        for texels, color in zip(self._texels, colors, strict=True):
            a, b, c, d = (texels.index_select(0, corner).view(x.shape) for corner in corners)
            torch.lerp(torch.lerp(a, b, x), torch.lerp(c, d, x), y, out=color)
        return colors


def of_materials(values: Tensor, material: Tensor, default: float | bool) -> Tensor:
    """Return values (a, nmat, ...) of materials (b, G): (max(a, b), G, ...).

    Geoms of material -1 get `default`.
    """
    none = values.new_full((len(values), 1, *values.shape[2:]), default)
    n = max(len(values), len(material))
    values = torch.cat((values, none), dim=1).expand(n, *[-1] * (values.ndim - 1))
    return values[torch.arange(n)[:, None], material.expand(n, -1)]


def of_pixels(values: Tensor, columns: Tensor) -> Tensor:
    """Return values (..., 1 or n, G + 1) of the geoms `columns` (n, P): (..., n, P)."""
    leading = values.shape[:-2]
    columns = columns.expand(*leading, *columns.shape)
    return values.expand(*columns.shape[:-1], -1).gather(-1, columns)


def _turn_back(mat: Tensor, vectors: Tensor) -> Tensor:
    """Turn vectors (3, ...) by the inverses of the rotations (3, 3, ...)."""
    x, y, z = vectors
    return torch.stack([mat[0, i] * x + mat[1, i] * y + mat[2, i] * z for i in range(3)])


# Mappings take points and normals (3, K) in the frames of geoms, the sizes of these (3, K), and the
# material's repetitions (2, K) and whether these are per length (K,). They return places (2, K) in
# [0, 1). Axes after the first may be others, if they can be broadcast.


def _wrap(u, v, repeat, offset=0.0) -> Tensor:
    uv = torch.stack((u, v)) * repeat + offset
    return uv - uv.floor()


def _scaled(repeat, uniform, lengths) -> Tensor:
    """Return repetitions along a whole geom: as given, or that many for each unit of length."""
    return torch.where(uniform, repeat * lengths, repeat)


def _azimuth(x, y) -> Tensor:
    """Return the angle about z in turns, 0 to 1."""
    turns = torch.atan2(y, x) / (2.0 * torch.pi)
    return torch.where(turns < 0.0, turns + 1.0, turns)


def _plane(point, normal, size, repeat, uniform) -> Tensor:
    is_finite = size[:2] > 0.0
    along = [
        torch.where(finite, (p + side) / (2.0 * side.clamp(min=_TINY)), 0.5 * p)
        for p, side, finite in zip((point[0], -point[1]), size[:2], is_finite, strict=True)
    ]
    repeat = torch.where(is_finite & uniform, repeat * size[:2], repeat)
    return _wrap(*along, repeat, torch.where(is_finite.all(dim=0), 0.0, -0.5))


def _ellipsoid(point, normal, size, repeat, uniform) -> Tensor:
    direction = point / size.clamp(min=_TINY)
    x, y, z = direction / direction.norm(dim=0).clamp(min=_TINY)
    v = 0.5 - torch.asin(z.clamp(-1.0, 1.0)) / torch.pi
    return _wrap(_azimuth(x, y), v, _scaled(repeat, uniform, size[:2]))


def _sphere(point, normal, size, repeat, uniform) -> Tensor:
    return _ellipsoid(point, normal, size[:1].expand_as(size), repeat, uniform)


def _cylinder(point, normal, size, repeat, uniform) -> Tensor:
    (x, y, z), (radius, half, _) = point, size.clamp(min=_TINY)
    is_end = normal[2].abs() > _END
    u = torch.where(is_end, 0.5 + 0.5 * x / radius, _azimuth(x, y))
    v = torch.where(is_end, 0.5 + 0.5 * y / radius, (half - z) / (2.0 * half))
    return _wrap(u, v, _scaled(repeat, uniform, size[0]))


def _capsule(point, normal, size, repeat, uniform) -> Tensor:
    (x, y, z), (radius, half, _) = point, size.clamp(min=_TINY)
    on_cap = torch.asin(((z.abs() - half) / radius).clamp(0.0, 1.0)) * (2.0 / torch.pi)
    v = torch.where(z > half, 1.0 - on_cap, (half - z) / (2.0 * half))
    v = torch.where(z < -half, on_cap, v)
    return _wrap(_azimuth(x, y), v, _scaled(repeat, uniform, size[0]))


def _box(point, normal, size, repeat, uniform) -> Tensor:
    # Places from -1 to 1 along each side.
    x, y, z = point / size.clamp(min=_TINY)
    across = normal.abs()
    on_z = (across[2] >= across[0]) & (across[2] >= across[1])
    on_x = ~on_z & (across[0] >= across[1])
    sign = torch.where(normal >= 0.0, 1.0, -1.0)
    u = torch.where(on_z, x, torch.where(on_x, sign[0] * y, -sign[1] * x))
    v = torch.where(on_z, -sign[2] * y, -z)
    return _wrap(0.5 + 0.5 * u, 0.5 + 0.5 * v, _scaled(repeat, uniform, size[:2]))


def _hfield(point, normal, size, repeat, uniform) -> Tensor:
    x, y = point[:2] / size[:2].clamp(min=_TINY)
    return _wrap(0.5 + 0.5 * x, 0.5 - 0.5 * y, _scaled(repeat, uniform, size[:2]))


def _mesh(point, normal, size, repeat, uniform) -> Tensor:
    scaled = torch.where((size[:2] > 0.0) & ~uniform, repeat / size[:2], repeat)
    return _wrap(0.5 * point[0], -0.5 * point[1], scaled, -0.5)


_MAPPINGS = {
    PLANE: _plane,
    SPHERE: _sphere,
    ELLIPSOID: _ellipsoid,
    CYLINDER: _cylinder,
    CAPSULE: _capsule,
    BOX: _box,
    HFIELD: _hfield,
    MESH: _mesh,
}
KINDS = frozenset(_MAPPINGS)
"""Types of geoms that cameras see."""


def _sky_coordinates(direction: Tensor, width: int) -> Tensor:
    """Return places (2, K) in the strip of six faces that world directions (3, K) point to.

    The cube is turned a quarter about x. Its faces are +x, -x, +y, -y, +z and -z.
    """
    x, y, z = direction[0], direction[2], -direction[1]
    on_x = (x.abs() >= y.abs()) & (x.abs() >= z.abs())
    on_y = ~on_x & (y.abs() >= z.abs())
    main = torch.where(on_x, x, torch.where(on_y, y, z))
    sign = torch.where(main > 0.0, 1.0, -1.0)
    face = torch.where(on_x, 0.0, torch.where(on_y, 2.0, 4.0)) + (sign < 0.0)
    s = torch.where(on_x, -sign * z, torch.where(on_y, x, sign * x))
    t = torch.where(on_y, sign * z, -y)
    reach = main.abs().clamp(min=_TINY)
    # Colors of neighboring faces in the strip do not mix.
    margin = 0.5 / width
    t = ((t / reach + 1.0) / 2.0).clamp(margin, 1.0 - margin)
    return torch.stack(((s / reach + 1.0) / 2.0, (face + t) / 6.0))
