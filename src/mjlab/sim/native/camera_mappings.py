"""Where a point of a surface is in its texture, as MuJoCo's and Warp's renderers have it."""

from __future__ import annotations

from collections.abc import Callable

import torch

from mjlab.sim.native.camera_geoms import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    HFIELD,
    MESH,
    PLANE,
    SPHERE,
)

# The cosine above which a normal is that of an end of a cylinder.
_END = 0.7071
_TINY = 1e-6

Mapping = Callable[..., torch.Tensor]

# Each takes points (K, 3) and normals (K, 3) in the
# geom's frame, its size (K, 3), and the material's repetitions (K, 2) and whether these are per
# length (K,); and returns places (K, 2) in [0, 1).


def _wrap(u, v, repeat, offset=0.0) -> torch.Tensor:
    uv = torch.stack((u, v), dim=-1) * repeat + offset
    return uv - uv.floor()


def _scaled(repeat, uniform, lengths) -> torch.Tensor:
    """Return repetitions along a whole geom: as given, or that many for each unit of length."""
    return torch.where(uniform[:, None], repeat * lengths, repeat)


def _plane(point, normal, size, repeat, uniform) -> torch.Tensor:
    sides = size[:, :2]
    is_finite = sides > 0.0
    sign = torch.tensor([1.0, -1.0])
    along = torch.where(
        is_finite, (sign * point[:, :2] + sides) / (2.0 * sides.clamp(min=_TINY)),
        0.5 * sign * point[:, :2],
    )  # fmt: skip
    repeat = torch.where(is_finite & uniform[:, None], repeat * sides, repeat)
    offset = torch.where(is_finite.all(dim=-1, keepdim=True), 0.0, -0.5)
    return _wrap(along[:, 0], along[:, 1], repeat, offset)


def _azimuth(point) -> torch.Tensor:
    """Return the angle about z in turns, 0 to 1."""
    turns = torch.atan2(point[:, 1], point[:, 0]) / (2.0 * torch.pi)
    return torch.where(turns < 0.0, turns + 1.0, turns)


def _ellipsoid(point, normal, size, repeat, uniform) -> torch.Tensor:
    radii = size.clamp(min=_TINY)
    direction = point / radii
    direction = direction / direction.norm(dim=-1, keepdim=True).clamp(min=_TINY)
    v = 0.5 - torch.asin(direction[:, 2].clamp(-1.0, 1.0)) / torch.pi
    return _wrap(_azimuth(direction), v, _scaled(repeat, uniform, size[:, :2]))


def _sphere(point, normal, size, repeat, uniform) -> torch.Tensor:
    return _ellipsoid(point, normal, size[:, :1].expand(-1, 3), repeat, uniform)


def _cylinder(point, normal, size, repeat, uniform) -> torch.Tensor:
    radius, half = size[:, :1].clamp(min=_TINY), size[:, 1].clamp(min=_TINY)
    side = torch.stack((_azimuth(point), (half - point[:, 2]) / (2.0 * half)), dim=-1)
    end = 0.5 + 0.5 * point[:, :2] / radius
    uv = torch.where(normal[:, 2:].abs() > _END, end, side)
    return _wrap(*uv.unbind(dim=1), _scaled(repeat, uniform, size[:, :1]))


def _capsule(point, normal, size, repeat, uniform) -> torch.Tensor:
    radius, half, z = size[:, 0].clamp(min=_TINY), size[:, 1].clamp(min=_TINY), point[:, 2]
    on_cap = torch.asin(((z.abs() - half) / radius).clamp(0.0, 1.0)) * (2.0 / torch.pi)
    v = torch.where(z > half, 1.0 - on_cap, (half - z) / (2.0 * half))
    v = torch.where(z < -half, on_cap, v)
    return _wrap(_azimuth(point), v, _scaled(repeat, uniform, size[:, :1]))


def _box(point, normal, size, repeat, uniform) -> torch.Tensor:
    # Places from -1 to 1 along each side.
    x, y, z = (point / size.clamp(min=_TINY)).unbind(dim=1)
    across = normal.abs()
    on_z = (across[:, 2] >= across[:, 0]) & (across[:, 2] >= across[:, 1])
    on_x = ~on_z & (across[:, 0] >= across[:, 1])
    sign = torch.where(normal >= 0.0, 1.0, -1.0)
    u = torch.where(on_z, x, torch.where(on_x, sign[:, 0] * y, -sign[:, 1] * x))
    v = torch.where(on_z, -sign[:, 2] * y, -z)
    return _wrap(0.5 + 0.5 * u, 0.5 + 0.5 * v, _scaled(repeat, uniform, size[:, :2]))


def _hfield(point, normal, size, repeat, uniform) -> torch.Tensor:
    sides = size[:, :2].clamp(min=_TINY)
    along = 0.5 + 0.5 * torch.tensor([1.0, -1.0]) * point[:, :2] / sides
    return _wrap(along[:, 0], along[:, 1], _scaled(repeat, uniform, size[:, :2]))


def _mesh(point, normal, size, repeat, uniform) -> torch.Tensor:
    sides = size[:, :2]
    scaled = torch.where((sides > 0.0) & ~uniform[:, None], repeat / sides, repeat)
    return _wrap(0.5 * point[:, 0], -0.5 * point[:, 1], scaled, -0.5)


MAPPINGS: dict[int, Mapping] = {
    PLANE: _plane,
    SPHERE: _sphere,
    ELLIPSOID: _ellipsoid,
    CYLINDER: _cylinder,
    CAPSULE: _capsule,
    BOX: _box,
    HFIELD: _hfield,
    MESH: _mesh,
}


def sky_coordinates(direction: torch.Tensor, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return places (K,) in the strip of six faces that world directions (K, 3) point to.

    The cube is turned a quarter about x. Its faces are +x, -x, +y, -y, +z and -z.
    """
    x, y, z = direction[:, 0], direction[:, 2], -direction[:, 1]
    on_x = (x.abs() >= y.abs()) & (x.abs() >= z.abs())
    on_y = ~on_x & (y.abs() >= z.abs())
    main = torch.where(on_x, x, torch.where(on_y, y, z))
    sign = torch.where(main > 0.0, 1.0, -1.0)
    face = torch.where(on_x, 0.0, torch.where(on_y, 2.0, 4.0)) + (sign < 0.0)
    s = torch.where(on_x, -sign * z, torch.where(on_y, x, sign * x))
    t = torch.where(on_y, sign * z, -y)
    reach = main.abs().clamp(min=_TINY)
    # Colours of neighbouring faces in the strip do not mix.
    margin = 0.5 / width
    t = ((t / reach + 1.0) / 2.0).clamp(margin, 1.0 - margin)
    return (s / reach + 1.0) / 2.0, (face + t) / 6.0
