"""Native shading: lights, materials, textures and skybox.

Lights use the formulas of MuJoCo Warp's renderer, textures the mappings of MuJoCo and Warp.
Components come first: a vector of K points is (3, K). Textures mapped by vertex coordinates of a
mesh show their mean color, because ray hits do not include the mesh face.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

_T = mujoco.mjtGeom
PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(_T, f"mjGEOM_{name}"))
    for name in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
_TINY = 1e-6

ReadField = Callable[[str], Tensor]
"""Reader of `MjData` and `MjModel` fields by name, (n, ...); (1, ...) if shared by environments."""


@dataclass
class Geoms:
    """G geoms of n environments in the camera frame."""

    pos: Tensor
    """Position, (n, G, 3)."""
    quat: Tensor
    """Orientation, (n, G, 4)."""
    mat: Tensor
    """Orientation, (n, G, 3, 3)."""
    size: Tensor
    """Size, (n, G, 3)."""
    center: Tensor
    """Center of the bounding box in the geom frame, (n, G, 3)."""
    half: Tensor
    """Half extents of the bounding box, (n, G, 3)."""
    dataid: Tensor
    """Height field or mesh id, (n, G) int32. -1: none."""
    material: Tensor
    """Material id, (1 or n, G). -1: none."""
    rgba: Tensor
    """Color, (1 or n, G, 4)."""
    exists: Tensor
    """True for present geoms that are not fully transparent, (n, G) bool."""


@dataclass
class Surfaces:
    """Hits of n x P rays in the camera frame."""

    directions: Tensor
    """Unit vectors along the rays, (3, 1 or n, P)."""
    points: Tensor
    """Positions, (3, n, P)."""
    normals: Tensor
    """Unit normals, (3, n, P)."""
    columns: Tensor
    """Index of the geom among rendered geoms, (n, P). G: miss."""


# Lights.

# Specular and shininess of geoms without material; specular exponent at shininess 1.
_SPECULAR, _SHININESS, _MAX_EXPONENT = 0.5, 0.5, 128.0
# Fraction of light that reaches shadowed surfaces; ambient light of models without lights.
_IN_SHADOW, _WITHOUT_LIGHTS = 0.3, 0.3
# Offset of shadow rays above the surface and before the light (m).
_ABOVE, _BEFORE = 1e-4, 1e-3
# Distance of directional lights (m).
_ENDLESS = 1e8
_SPOT = int(mujoco.mjtLightType.mjLIGHT_SPOT)
_DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)


class Shading:
    """Surface colors by the formulas of MuJoCo Warp's renderer.

    A light adds its diffuse color times the cosine between normal and light direction, and its
    specular color times a power of the cosine between normal and halfway vector (Blinn-Phong).
    """

    def __init__(self, model: mujoco.MjModel, kinds: Tensor, use_textures: bool) -> None:
        """Load lights and, with `use_textures`, textures, for geoms of types `kinds`, (G,)."""
        self._num_lights, self._headlight = model.nlight, model.vis.headlight
        self._textures = Textures(model, torch.nn.functional.pad(kinds, (0, 1), value=-1))
        self._use_textures = use_textures and model.ntex > 0 and model.nmat > 0

    def shade(
        self,
        met: Surfaces,
        geoms: Geoms,
        pos: Tensor,
        mat: Tensor,
        read: ReadField,
        shadow: Callable[[Tensor, Tensor, Tensor], Tensor] | None,
    ) -> Tensor:
        """Return ray colors, (n, P, 3) uint8.

        Args:
            met: Surfaces hit by rays.
            geoms: Rendered geoms.
            pos: Camera position, (n, 3).
            mat: Camera orientation, (n, 3, 3).
            read: Field reader.
            shadow: Occlusion test: origins (3, n, P), directions (3, n, P), distances (n, P) ->
                (n, P) bool. None: no shadows.
        """
        # Extra entry for misses.
        material = torch.nn.functional.pad(geoms.material, (0, 1), value=-1)
        rgb = torch.nn.functional.pad(geoms.rgba.permute(2, 0, 1)[:3], (0, 1))
        rgb = of_pixels(rgb, met.columns)
        if self._use_textures:
            self._textures.paint(rgb, met, geoms, material, read)
        exponent = of_materials(read("mat_shininess"), material, _SHININESS) * _MAX_EXPONENT
        reflected = of_materials(read("mat_specular"), material, _SPECULAR)
        reflected = torch.where(exponent > 0.0, reflected, 0.0)
        emission = of_materials(read("mat_emission"), material, 0.0)
        brightness = torch.zeros_like(rgb)
        if emission.any():
            brightness += of_pixels(emission, met.columns)
        ambient = torch.full((3,), 0.0 if self._num_lights else _WITHOUT_LIGHTS)
        if self._headlight.active:
            ambient = torch.tensor(self._headlight.ambient, dtype=torch.float32)
        own = read("light_ambient") * (read("light_active") != 0)[..., None]
        brightness += (ambient + own.sum(dim=1)).t()[..., None]
        shines = bool(reflected.any())
        if shines:
            exponent, gloss = of_pixels(exponent, met.columns), torch.zeros_like(rgb)
            facing = -_dot(met.normals, met.directions)
        for diffuse, specular, direction, distance, strength, casts_shadow in self._lights(
            met.points, pos, mat, read
        ):
            cosine = _dot(met.normals, direction).clamp_(min=0.0)
            if shadow is not None and casts_shadow.any():
                origins = met.points + _ABOVE * met.normals
                hidden = shadow(origins, direction.expand_as(origins), distance - _BEFORE)
                hidden &= casts_shadow & (cosine > 0.0)
                strength = strength * torch.where(hidden, _IN_SHADOW, 1.0)
            brightness.addcmul_(cosine * strength, diffuse)
            if shines and specular.any():
                # |L + V|^2 = 2 + 2 L.V, so the halfway vector itself is not computed.
                length = (2.0 - 2.0 * _dot(met.directions, direction)).clamp_(min=1e-12)
                halfway = (cosine + facing).div_(length.sqrt_()).clamp_(0.0, 1.0)
                halfway = halfway.pow_(exponent).masked_fill_(cosine <= 0.0, 0.0)
                gloss.addcmul_(halfway.mul_(strength), specular)
        rgb *= brightness
        if shines:
            rgb += gloss.mul_(of_pixels(reflected, met.columns))
        missed = met.columns == geoms.pos.shape[1]
        rgb.clamp_(0.0, 1.0).masked_fill_(missed, 0.0)
        env, pixel = missed.nonzero(as_tuple=True)
        if len(env):
            directions = met.directions.expand_as(met.points)[:, env, pixel]
            world = (mat[env] @ directions.t()[..., None]).squeeze(-1).t()
            self._textures.paint_sky(rgb, missed, world)
        return torch.stack(rgb.mul_(255.0).to(torch.uint8).unbind(), dim=-1)

    def _lights(
        self, points: Tensor, pos: Tensor, mat: Tensor, read: ReadField
    ) -> Iterator[tuple[Tensor, ...]]:
        """Yield the values of each active light at the points, (3, n, P).

        Axes n and P may be 1. Yields:
            Diffuse and specular color, (3, n, 1).
            Unit vector to the light, (3, n, P), and distance (m), (n, P).
            Attenuation factor, (n, P).
            True if the light casts shadows, (n, 1) bool.
        """
        endless, one = torch.full((1, 1), _ENDLESS), torch.ones(1, 1)
        for i in range(self._num_lights):

            def own(name: str, i: int = i) -> Tensor:
                return read(f"light_{name}")[:, i, None]

            active = own("active") != 0
            diffuse = (own("diffuse").squeeze(1) * active).t()[..., None]
            specular = (own("specular").squeeze(1) * active).t()[..., None]
            if not (diffuse.any() or specular.any()):
                continue
            axis = (read("light_xdir")[:, i, None] @ mat).permute(2, 0, 1)
            direction, distance, strength = -axis, endless, one
            is_far = own("type") == _DIRECTIONAL
            if not is_far.all():
                to_light = ((read("light_xpos")[:, i] - pos)[:, None] @ mat).permute(2, 0, 1)
                to_light = to_light - points
                distance = _dot(to_light, to_light).sqrt_()
                # At the light itself the direction would be zero, and MuJoCo raises for such rays.
                to_light = torch.where(distance > 0.0, to_light / distance, direction)
                constant, linear, squared = own("attenuation").permute(2, 0, 1)
                strength = 1.0 / (constant + distance * (linear + distance * squared))
                strength.masked_fill_(strength.isinf(), 0.0)
                is_spot = own("type") == _SPOT
                if is_spot.any():
                    on_axis = -_dot(axis, to_light)
                    spot = on_axis.clamp(min=0.0).pow(own("exponent"))
                    spot.masked_fill_(on_axis < torch.deg2rad(own("cutoff")).cos(), 0.0)
                    strength = strength * torch.where(is_spot, spot, 1.0)
                direction = torch.where(is_far, direction, to_light)
                distance = torch.where(is_far, endless, distance)
                strength = torch.where(is_far, one, strength)
            yield diffuse, specular, direction, distance, strength, own("castshadow") != 0
        if self._headlight.active:
            diffuse, specular = (
                torch.tensor(color, dtype=torch.float32).view(3, 1, 1)
                for color in (self._headlight.diffuse, self._headlight.specular)
            )
            # The headlight shines along the optical axis.
            direction = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1)
            yield diffuse, specular, direction, endless, one, torch.tensor(False)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Return dot products over the first dimension."""
    return torch.addcmul(a[0] * b[0], a[1], b[1]).addcmul_(a[2], b[2])


# Textures.

_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_SKYBOX = int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)
# Maximum number of planes textured one by one, on all pixels of an image. On the YAM task, where
# the ground fills most of the image, rgb images are 1.9 times as fast as with ground pixels
# selected.
_MAX_PLANES = 2
# Cosine above which a normal belongs to an end of a cylinder.
_END = 0.7071


class Textures:
    """Textures of a model in one table of texels."""

    def __init__(self, model: mujoco.MjModel, kinds: Tensor) -> None:
        """Load the textures of a model, for geoms of types `kinds`, (G + 1,). -1: none."""
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
        """Multiply the colors `rgb`, (3, n, P), by the textures of materials.

        `material` is the material of each geom, (1 or n, G + 1). -1: none.
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
                point = _rotate_inverse(mat, met.points - center)
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
        inputs = (
            _rotate_inverse(mat, met.points[:, env, pixel] - geoms.pos[env, column].t()),
            _rotate_inverse(mat, met.normals[:, env, pixel]),
            geoms.size[env, column].t(),
            repeat.expand(2, n, -1)[:, env, column],
            uniform.expand(n, -1)[env, column],
        )
        uv, kinds = torch.empty(2, len(env)), self._kinds[column]
        for kind, mapping in _MAPPINGS.items():
            chosen = (kinds == kind).nonzero().squeeze(1)
            if len(chosen):
                uv[:, chosen] = mapping(*(values[..., chosen] for values in inputs))
        color = self._sample(texture, uv)
        if self._has_coordinates.any():
            mesh = geoms.dataid[env, column].masked_fill(kinds != MESH, -1).long()
            laid = self._has_coordinates[mesh]
            color[:, laid] = self._means[:, texture[laid]]
        rgb[:, env, pixel] *= color

    def paint_sky(self, rgb: Tensor, missed: Tensor, directions: Tensor) -> None:
        """Set the colors `rgb`, (3, n, P), of the rays `missed`, (n, P) bool, to the skybox.

        `directions` are world-frame directions of these rays, (3, K).
        """
        if self._sky is not None:
            uv = _sky_coordinates(directions, int(self._width[self._sky]))
            rgb[:, missed] = self._sample(torch.tensor(self._sky), uv)

    def _sample(self, texture: Tensor, uv: Tensor) -> Tensor:
        """Return colors, (3, ...), of textures, (...), at coordinates `uv` in [0, 1), (2, ...).

        Linear interpolation between texel centers, constant beyond the outermost.
        """
        width, height = self._width[texture], self._height[texture]
        # Coordinates of NaN poses would be indices out of range.
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
    """Return material values per geom: (a, nmat, ...) at (b, G) -> (max(a, b), G, ...).

    Geoms with material -1 get `default`.
    """
    none = values.new_full((len(values), 1, *values.shape[2:]), default)
    n = max(len(values), len(material))
    values = torch.cat((values, none), dim=1).expand(n, *[-1] * (values.ndim - 1))
    return values[torch.arange(n)[:, None], material.expand(n, -1)]


def of_pixels(values: Tensor, columns: Tensor) -> Tensor:
    """Return geom values per pixel: (..., 1 or n, G + 1) at `columns` (n, P) -> (..., n, P)."""
    leading = values.shape[:-2]
    columns = columns.expand(*leading, *columns.shape)
    return values.expand(*columns.shape[:-1], -1).gather(-1, columns)


def _rotate_inverse(mat: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors, (3, ...), by the inverses of rotations, (3, 3, ...)."""
    x, y, z = vectors
    return torch.stack([mat[0, i] * x + mat[1, i] * y + mat[2, i] * z for i in range(3)])


# Texture mappings: points and normals in the geom frame (3, K), geom sizes (3, K), and texrepeat
# (2, K) and texuniform (K,) of the material -> texture coordinates in [0, 1), (2, K). Axes after
# the first may have any broadcastable shape.


def _wrap(u, v, repeat, offset=0.0) -> Tensor:
    uv = torch.stack((u, v)) * repeat + offset
    return uv - uv.floor()


def _scaled(repeat, uniform, lengths) -> Tensor:
    """Return texture repetitions along a geom: `repeat`, per unit length if `uniform`."""
    return torch.where(uniform, repeat * lengths, repeat)


def _azimuth(x, y) -> Tensor:
    """Return the angle about z in turns, in [0, 1)."""
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
    # Coordinates in [-1, 1] along each side.
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
"""Geom types that cameras render."""


def _sky_coordinates(direction: Tensor, width: int) -> Tensor:
    """Return skybox coordinates, (2, K), of world directions, (3, K), in the strip of six faces.

    The cube is rotated by 90 degrees about x. Faces in order: +x, -x, +y, -y, +z, -z.
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
    # Clamp, so that colors of neighboring faces do not mix.
    margin = 0.5 / width
    t = ((t / reach + 1.0) / 2.0).clamp(margin, 1.0 - margin)
    return torch.stack(((s / reach + 1.0) / 2.0, (face + t) / 6.0))
