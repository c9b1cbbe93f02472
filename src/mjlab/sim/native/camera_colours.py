"""Colours of the surfaces that rays meet, as MuJoCo Warp's renderer mixes them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import torch

from mjlab.sim.native.camera_geoms import CameraPose, GeomTable, PosedGeoms, ReadField
from mjlab.sim.native.camera_lights import Lighting, LightTable, Shadow
from mjlab.sim.native.camera_pixels import PixelRays
from mjlab.sim.native.camera_textures import TextureTable, of_materials

# What a geom without a material reflects, and the exponent of a shininess of 1.
_SPECULAR, _SHININESS = 0.5, 0.5
_MAX_EXPONENT = 128.0
# The colour of a geom that has none of its own, so that its material's colour shows.
_NO_COLOUR = (0.5, 0.5, 0.5, 1.0)


@dataclass
class MetSurfaces:
    """What n P rays met, in the frame of the camera."""

    rays: PixelRays
    distances: torch.Tensor
    """(n, P) along the rays."""
    normals: torch.Tensor
    """(n, P, 3)."""
    columns: torch.Tensor
    """(n, P) index of the geom in the table; G for nothing."""


@dataclass
class Finish:
    """How surfaces look, by geom: (n, G + 1), with n = 1 if all environments have the same."""

    rgb: torch.Tensor
    """(3, n, G + 1); black where there is nothing."""
    specular: torch.Tensor
    exponent: torch.Tensor
    emission: torch.Tensor
    material: torch.Tensor
    """Material, -1 for none."""

    def at(self, values: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Return values (n, G + 1) for the geoms `columns` (N, P)."""
        if len(values) > 1:
            columns = columns + torch.arange(len(columns))[:, None] * values.shape[1]
        return torch.take(values, columns)


class Shading:
    """Computes colours of what a camera sees of a model."""

    def __init__(self, model: mujoco.MjModel, table: GeomTable, use_textures: bool) -> None:
        """Take the materials, lights and (if wanted) textures of a model."""
        self._table = table
        self._ids = table.ids[:-1].long()
        self._has_materials = model.nmat > 0
        self._lights = LightTable(model)
        self._textures = TextureTable(model, table)
        self._use_textures = use_textures and model.ntex > 0 and model.nmat > 0

    def shade(
        self,
        met: MetSurfaces,
        geoms: PosedGeoms,
        camera: CameraPose,
        data: ReadField,
        model: ReadField,
        shadow: Shadow | None,
    ) -> torch.Tensor:
        """Return the colours of the rays, (n, P, 3) uint8.

        Args:
            met: What the rays met.
            geoms: The geoms that they can meet.
            camera: Where the camera is.
            data: Reads fields of `MjData`. model: Reads fields of `MjModel`.
            shadow: Casts shadow rays; None for no shadows.
        """
        finish = self._finish(model)
        rgb = [finish.at(channel, met.columns) for channel in finish.rgb]
        if self._use_textures:
            self._textures.paint(rgb, met, geoms, finish.material, model)
        lights = self._lights.read(data, model, camera)
        shines = (finish.specular > 0.0).any()
        exponent = finish.at(finish.exponent, met.columns) if shines else met.distances
        normals = met.normals.permute(2, 0, 1).contiguous()
        lighting = Lighting(met.rays, met.distances, normals, exponent, shadow)
        colours = [light.diffuse for light in lights.lights]
        colours += [light.specular for light in lights.lights]
        # Most lights are white, and all channels are the same then.
        channels = 1 if _is_grey([lights.ambient, *colours]) else 3
        brightness = torch.zeros(channels, *met.distances.shape)
        brightness += lights.ambient.t()[:channels, :, None]
        if finish.emission.any():
            brightness += finish.at(finish.emission, met.columns)
        gloss = torch.zeros_like(brightness) if shines else None
        for light in lights.lights:
            lighting.add(light, brightness, gloss, channels)
        if gloss is not None:
            gloss *= finish.at(finish.specular, met.columns)
        for i, channel in enumerate(rgb):
            channel *= brightness[i % channels]
            if gloss is not None:
                channel += gloss[i % channels]
            channel.clamp_(0.0, 1.0)
        self._textures.paint_sky(rgb, met, camera, len(self._table))
        return torch.stack([channel.mul_(255.0).to(torch.uint8) for channel in rgb], dim=-1)

    def _finish(self, model: ReadField) -> Finish:
        """Look up colours and materials of the geoms."""
        rgba = model("geom_rgba")[:, self._ids]
        material = model("geom_matid")[:, self._ids].long()
        own = (torch.full(material.shape, value) for value in (_SPECULAR, _SHININESS, 0.0))
        specular, shininess, emission = own
        rgb = list(rgba.unbind(dim=-1)[:3])
        if self._has_materials:
            has = material >= 0
            plain = (rgba == torch.tensor(_NO_COLOUR)).all(dim=-1)
            colours = model("mat_rgba").unbind(dim=-1)
            for i in range(3):
                rgb[i] = torch.where(has & plain, of_materials(colours[i], material), rgb[i])
            specular = torch.where(has, of_materials(model("mat_specular"), material), specular)
            shininess = torch.where(has, of_materials(model("mat_shininess"), material), shininess)
            emission = torch.where(has, of_materials(model("mat_emission"), material), emission)
        exponent = shininess * _MAX_EXPONENT
        specular = torch.where(exponent > 0.0, specular, 0.0)
        # One entry more for rays that meet nothing, which is black.
        rgb = torch.broadcast_tensors(*rgb)
        return Finish(
            torch.stack([_with(channel, 0.0) for channel in rgb]),
            _with(specular, 0.0),
            _with(exponent, 1.0),
            _with(emission, 0.0),
            _with(material, -1),
        )


def _with(values: torch.Tensor, last: float) -> torch.Tensor:
    """Append a column to values (n, G)."""
    return torch.nn.functional.pad(values, (0, 1), value=last)


def _is_grey(colours: list[torch.Tensor]) -> bool:
    return all(bool((colour == colour[..., :1]).all()) for colour in colours)
