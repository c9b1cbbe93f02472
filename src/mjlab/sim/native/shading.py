"""Colors of surfaces and of the sky on the native engine: lights, materials and textures.

Lights follow the formulas of MuJoCo Warp's renderer, textures the mappings of MuJoCo's and Warp's.
Components come first: a vector of K points is (3, K). A texture laid onto a mesh by coordinates of
its vertices shows as its mean color, because rays do not say which face of a mesh they meet.
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
"""A field of `MjData` or `MjModel` by name, of n environments: (n, ...), (1, ...) if they share it."""


@dataclass
class Geoms:
    """G geoms in the frame of the camera, in n environments."""

    pos: Tensor
    """Position, (n, G, 3)."""
    quat: Tensor
    """Orientation, (n, G, 4)."""
    mat: Tensor
    """Orientation, (n, G, 3, 3)."""
    size: Tensor
    """Size, (n, G, 3)."""
    center: Tensor
    """Center of a box around the geom, in the frame of the geom, (n, G, 3)."""
    half: Tensor
    """Half extents of the box, (n, G, 3)."""
    dataid: Tensor
    """Height field or mesh, or -1, (n, G) int32."""
    material: Tensor
    """Material, -1 for none, (1 or n, G)."""
    rgba: Tensor
    """Color, (1 or n, G, 4)."""
    exists: Tensor
    """True where an environment has the geom and it is not fully transparent, (n, G) bool."""


@dataclass
class Surfaces:
    """Hits of n x P rays, in the camera frame."""

    directions: Tensor
    """Unit vectors along the rays, (3, 1 or n, P)."""
    points: Tensor
    """Positions, (3, n, P)."""
    normals: Tensor
    """Unit normals, (3, n, P)."""
    columns: Tensor
    """Number of the geom among those that are rendered, (n, P); G for nothing."""


# Lights.

# What a geom without a material reflects, and its shininess; the exponent of a shininess of 1.
_SPECULAR, _SHININESS, _MAX_EXPONENT = 0.5, 0.5, 128.0
# Part of a light that reaches what is in its shadow, and ambient light where there is no light.
_IN_SHADOW, _WITHOUT_LIGHTS = 0.3, 0.3
# Shadow rays start so far (metres) above the surface, and end so far before the light.
_ABOVE, _BEFORE = 1e-4, 1e-3
# Distance (m) of lights that have no place.
_ENDLESS = 1e8
_SPOT = int(mujoco.mjtLightType.mjLIGHT_SPOT)
_DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)


class Shading:
    """Colors of surfaces, by the formulas of MuJoCo Warp's renderer.

    A light adds its diffuse color times the cosine between surface and light, and its specular color
    times a power of the cosine between the surface and the direction halfway to the eye.
    """

    def __init__(self, model: mujoco.MjModel, kinds: Tensor, use_textures: bool) -> None:
        """Take the lights and (if wanted) textures of a model, for geoms of types `kinds` (G,)."""
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
        """Return the colors of the rays, (n, P, 3) uint8.

        Args:
            met: What the rays met.
            geoms: The geoms that they can meet.
            pos: Position of the camera, (n, 3). mat: Its orientation, (n, 3, 3).
            read: Reads fields.
            shadow: Whether something is in the way: origins (3, n, P), directions, distances (n, P)
                to (n, P) bool. None for no shadows.
        """
        # One entry more, for rays that met nothing.
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
                # |L + V|^2 = 2 + 2 L.V, so that the direction halfway is never needed itself.
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
        """Yield what each light that shines somewhere is at the points (3, n, P).

        Axes n and P may be 1. Yields:
            Diffuse and specular color, (3, n, 1).
            Unit vector to the light, (3, n, P), and distance (m), (n, P).
            Part that arrives, (n, P).
            Whether it casts shadows, (n, 1) bool.
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
                # MuJoCo raises for a ray without a direction, as one would be at the light itself.
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
            # It shines along the optical axis.
            direction = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1)
            yield diffuse, specular, direction, endless, one, torch.tensor(False)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the products of vectors whose components come first."""
    return torch.addcmul(a[0] * b[0], a[1], b[1]).addcmul_(a[2], b[2])


# Textures.

_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_SKYBOX = int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)
# Planes painted one by one: all pixels of an image at once. On the YAM task, whose ground fills
# most of the image, rgb images are 1.9 times as fast as with the pixels of the ground picked out.
_MAX_PLANES = 2
# The cosine above which a normal is that of an end of a cylinder.
_END = 0.7071


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
