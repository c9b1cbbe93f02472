"""Light on surfaces, in the frame of a camera: the formulas of MuJoCo Warp's renderer.

A light adds its diffuse colour times the cosine between surface and light, and its specular colour
times a power of the cosine between the surface and the direction halfway to the eye. Both are
attenuated with the distance, and in a spot with the angle to its axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import torch

from mjlab.sim.native.camera_geoms import CameraPose, ReadField
from mjlab.sim.native.camera_pixels import PixelRays

_SPOT = int(mujoco.mjtLightType.mjLIGHT_SPOT)
_DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
# Part of a light that reaches what is in its shadow, and ambient light where there is no light.
_IN_SHADOW = 0.3
_WITHOUT_LIGHTS = 0.3
# Shadow rays start so far (metres) above the surface, and end so far before the light.
_ABOVE, _BEFORE = 1e-4, 1e-3
_ENDLESS = 1e8

Shadow = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
"""Whether something is in the way: origins (n, P, 3), directions, distances (n, P) to (n, P) bool."""


@dataclass
class Light:
    """One light in n environments, in the frame of the camera; (n, 1) tensors, n may be 1."""

    pos: torch.Tensor
    """(n, 3)."""
    direction: torch.Tensor
    """(n, 3) unit vector along which it shines."""
    diffuse: torch.Tensor
    """(n, 3)."""
    specular: torch.Tensor
    """(n, 3)."""
    attenuation: torch.Tensor
    """(n, 3) coefficients of 1, distance and distance squared."""
    is_directional: torch.Tensor
    is_spot: torch.Tensor
    cos_cutoff: torch.Tensor
    exponent: torch.Tensor
    casts_shadow: torch.Tensor


@dataclass
class Lights:
    """What lights a scene."""

    lights: list[Light]
    ambient: torch.Tensor
    """(n, 3)."""


class LightTable:
    """The lights of a model, and the headlight of its camera."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Take the lights of a model."""
        self._count = model.nlight
        headlight = model.vis.headlight
        self._headlight: Light | None = None
        self._ambient = torch.zeros(1, 3)
        if headlight.active:
            self._ambient = torch.tensor(headlight.ambient, dtype=torch.float32)[None]
            self._headlight = _headlight(headlight.diffuse, headlight.specular)
        elif not model.nlight:
            self._ambient = torch.full((1, 3), _WITHOUT_LIGHTS)

    def read(self, data: ReadField, model: ReadField, camera: CameraPose) -> Lights:
        """Return the lights in the frame of `camera`, without those that shine nowhere."""
        lights, ambient = [], self._ambient
        if self._count:
            active = model("light_active") != 0
            own = model("light_ambient") * active[..., None]
            ambient = ambient + own.sum(dim=1)
            positions = camera.to_camera(data("light_xpos") - camera.pos[:, None])
            directions = camera.to_camera(data("light_xdir"))
            for i in range(self._count):
                diffuse = model("light_diffuse")[:, i] * active[:, i, None]
                specular = model("light_specular")[:, i] * active[:, i, None]
                if not (diffuse.any() or specular.any()):
                    continue
                kind = model("light_type")[:, i, None]
                lights.append(
                    Light(
                        pos=positions[:, i],
                        direction=directions[:, i],
                        diffuse=diffuse,
                        specular=specular,
                        attenuation=model("light_attenuation")[:, i],
                        is_directional=kind == _DIRECTIONAL,
                        is_spot=kind == _SPOT,
                        cos_cutoff=torch.deg2rad(model("light_cutoff")[:, i, None]).cos(),
                        exponent=model("light_exponent")[:, i, None],
                        casts_shadow=model("light_castshadow")[:, i, None] != 0,
                    )
                )
        if self._headlight is not None:
            lights.append(self._headlight)
        return Lights(lights, ambient)


def _headlight(diffuse, specular) -> Light:
    """Return the light that shines along the optical axis."""
    no = torch.zeros(1, 1, dtype=torch.bool)
    return Light(
        pos=torch.zeros(1, 3),
        direction=torch.tensor([[0.0, 0.0, -1.0]]),
        diffuse=torch.tensor(diffuse, dtype=torch.float32)[None],
        specular=torch.tensor(specular, dtype=torch.float32)[None],
        attenuation=torch.tensor([[1.0, 0.0, 0.0]]),
        is_directional=~no,
        is_spot=no,
        cos_cutoff=torch.zeros(1, 1),
        exponent=torch.zeros(1, 1),
        casts_shadow=no,
    )


class Lighting:
    """How much light falls on the points that rays meet, and is reflected to the eye."""

    def __init__(
        self,
        rays: PixelRays,
        distances: torch.Tensor,
        normals: torch.Tensor,
        shininess: torch.Tensor,
        shadow: Shadow | None,
    ) -> None:
        """Take n P points.

        Args:
            rays: The rays.
            distances: (n, P) to the points, along the rays.
            normals: (3, n, P) of the surfaces.
            shininess: (n, P) exponents of highlights.
            shadow: Casts shadow rays; None for no shadows.
        """
        self._distances, self._normals, self._shininess = distances, normals, shininess
        self._directions = rays.directions.permute(2, 0, 1).contiguous()
        self._offsets = None if rays.offsets is None else rays.offsets.permute(2, 0, 1)
        self._shadow = shadow
        # Cosine between the surface and the direction to the eye.
        self._facing = -_dot(normals, self._directions)

    def add(
        self, light: Light, diffuse: torch.Tensor, specular: torch.Tensor | None, channels: int
    ) -> None:
        """Add what a light contributes to `diffuse` and `specular`, (channels, n, P) each."""
        cosine, to_light, strength, reach = self._towards(light)
        cosine.clamp_(min=0.0)
        if self._shadow is not None and light.casts_shadow.any():
            strength = self._shade(light, cosine, reach, strength)
        weight = cosine if strength is None else cosine * strength
        for i in range(channels):
            diffuse[i] += weight * light.diffuse[:, i, None]
        if specular is None or not light.specular.any():
            return
        # |L + V|^2 = 2 + 2 L.V, so that the direction halfway to the eye is never needed itself.
        length = to_light.add_(1.0).mul_(2.0).clamp_(min=1e-12).sqrt_()
        halfway = (cosine + self._facing).div_(length).clamp_(0.0, 1.0)
        gloss = halfway.pow_(self._shininess)
        gloss.masked_fill_(cosine <= 0.0, 0.0)
        if strength is not None:
            gloss *= strength
        for i in range(channels):
            specular[i] += gloss * light.specular[:, i, None]

    def _towards(
        self, light: Light
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Return how a light is seen from the points, (n, P) each.

        These are the cosine between surface and light; the cosine between the directions to the
        light and to the eye; what part of the light arrives, None for all; and its distance, None
        where it has none.
        """
        axis = _by_component(light.direction)
        along = _dot(self._directions, axis)
        cosine = -_dot(self._normals, axis)
        if light.is_directional.all():
            return cosine, along.expand_as(cosine).clone(), None, None
        pos = _by_component(light.pos)
        if self._offsets is not None:
            pos = pos - self._offsets
        # To a point on a ray: the point less the light, along the ray and along the axis.
        ahead = _dot(pos, self._directions) - self._distances
        reach = _dot(pos, pos) - _dot(pos, self._directions).square() + ahead.square()
        reach = reach.clamp_(min=0.0).sqrt_()
        inverse = reach.clamp(min=1e-9).reciprocal_()
        near_cosine = (_dot(self._normals, pos) + self._facing * self._distances) * inverse
        strength = self._attenuation(light, reach)
        if light.is_spot.any():
            on_axis = (along * self._distances - _dot(pos, axis)) * inverse
            spot = on_axis.clamp(min=0.0).pow(light.exponent)
            spot.masked_fill_(on_axis < light.cos_cutoff, 0.0)
            strength = strength * torch.where(light.is_spot, spot, 1.0)
        to_eye = -ahead * inverse
        if not light.is_directional.any():
            return near_cosine, to_eye, strength, reach
        far = light.is_directional
        return (
            torch.where(far, cosine, near_cosine),
            torch.where(far, along, to_eye),
            torch.where(far, 1.0, strength),
            torch.where(far, _ENDLESS, reach),
        )

    def _attenuation(self, light: Light, reach: torch.Tensor) -> torch.Tensor:
        constant, linear, squared = light.attenuation[..., None].unbind(dim=1)
        if (constant == 1.0).all() and not linear.any() and not squared.any():
            return torch.ones_like(reach)
        total = constant + reach * (linear + reach * squared)
        return torch.where(total == 0.0, 0.0, 1.0 / total)

    def _shade(
        self,
        light: Light,
        cosine: torch.Tensor,
        reach: torch.Tensor | None,
        strength: torch.Tensor | None,
    ) -> torch.Tensor:
        """Return `strength` with less where something is between the points and the light."""
        assert self._shadow is not None
        points = self._directions * self._distances
        if self._offsets is not None:
            points = points + self._offsets
        points = points + _ABOVE * self._normals
        if reach is None:
            towards = -_by_component(light.direction).expand_as(points)
            limit = torch.full_like(cosine, _ENDLESS)
        else:
            towards = _by_component(light.pos) - points
            towards = towards / towards.square().sum(dim=0).sqrt().clamp(min=1e-9)
            far = light.is_directional
            towards = torch.where(far, -_by_component(light.direction), towards)
            limit = torch.where(far, _ENDLESS, reach - _BEFORE)
        hidden = self._shadow(points.permute(1, 2, 0), towards.permute(1, 2, 0), limit)
        hidden &= light.casts_shadow & (cosine > 0.0)
        return torch.where(hidden, _IN_SHADOW, 1.0) * (1.0 if strength is None else strength)


def _by_component(vectors: torch.Tensor) -> torch.Tensor:
    """Return vectors (n, 3) as (3, n, 1)."""
    return vectors.t()[..., None]


def _dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the products of vectors whose components come first."""
    return torch.addcmul(a[0] * b[0], a[1], b[1]).addcmul_(a[2], b[2])
