"""Height of frames above the ground below them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import torch

from mjlab.sensor._one_sided_ground import OneSidedGround
from mjlab.sensor.raycast_sensor import RayCastData, RayCastSensor, RayCastSensorCfg

REDUCTIONS = ("min", "max", "mean", "none")


@dataclass
class TerrainHeightSensorCfg(RayCastSensorCfg):
    """Describes a sensor of heights above the ground."""

    reduction: str = "min"
    """What becomes of the rays of a frame: their `min`, `max` or `mean`, or `none` to keep all."""

    def build(self) -> TerrainHeightSensor:
        """Build the sensor."""
        return TerrainHeightSensor(self)


@dataclass
class TerrainHeightData(RayCastData):
    """What a terrain height sensor with F frames of n rays has measured."""

    heights: torch.Tensor
    """Metres from 0: (N, F), or (N, F, n) without a reduction."""


class TerrainHeightSensor(RayCastSensor):
    """A ray sensor that reports heights above the ground.

    The height of a ray is the frame's z less that of what the ray hits; 0 if the ray starts inside
    a solid (it hits a face that points down), or below a plane or height field, which rays do not
    see from there; and `max_distance` if there is nothing within reach.
    """

    cfg: TerrainHeightSensorCfg
    _transient = {"_ground"}

    def __init__(self, cfg: TerrainHeightSensorCfg) -> None:
        """Check the config.

        Raises:
            ValueError: an unknown reduction, and what `RayCastSensor` refuses.
        """
        super().__init__(cfg)
        if cfg.reduction not in REDUCTIONS:
            raise self._error(
                f"reduction={cfg.reduction!r} is unknown. Choose from: {', '.join(REDUCTIONS)}."
            )

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Generate the rays, and find frames and ground in the compiled model."""
        super().initialize(mj_model, model, data, device)
        self._ground = OneSidedGround(mj_model, data, self.include_geom_groups, device)

    @property
    def data(self) -> TerrainHeightData:
        """The sensor's current data."""
        data = super().data
        assert isinstance(data, TerrainHeightData)
        return data

    def _compute_data(self) -> TerrainHeightData:
        measured = self._measured()
        heights = self._heights_of_rays(measured)
        rays = heights.unflatten(1, (self.num_frames, self.num_rays_per_frame))
        reduced = _reduce(rays, self.cfg.reduction)
        return TerrainHeightData.with_frames(self._frame_mat.clone(), **measured, heights=reduced)

    def _heights_of_rays(self, measured: dict[str, torch.Tensor]) -> torch.Tensor:
        of_frame = self.num_frames, self.num_rays_per_frame
        hit_z = measured["hit_pos_w"][..., 2].unflatten(1, of_frame)
        heights = (self._frame_pos[..., 2:] - hit_z).flatten(1)
        heights = torch.where(self._normals[..., 2] < 0.0, 0.0, heights)
        missed = self._distances < 0.0
        heights = torch.where(missed, self.cfg.max_distance, heights)
        if len(self._ground) == 0:
            return heights
        if self._ground.is_level:
            below = self._ground.is_above_level(self._origins.flatten(0, 1)).view_as(missed)
            return torch.where(missed & below, 0.0, heights)
        if heights.device.type == "cpu":
            # Few rays miss, and asking whether any did costs nothing here. On a GPU it would wait.
            rows, columns = missed.nonzero(as_tuple=True)
            if len(rows):
                below = self._ground.is_above(self._origins[rows, columns], rows)
                heights[rows[below], columns[below]] = 0.0
            return heights
        envs = torch.arange(len(heights), device=heights.device).repeat_interleave(self.num_rays)
        below = self._ground.is_above(self._origins.flatten(0, 1), envs).view_as(missed)
        return torch.where(missed & below, 0.0, heights)


def _reduce(rays: torch.Tensor, reduction: str) -> torch.Tensor:
    """Reduce heights (N, F, n) over the rays of each frame."""
    if reduction == "none":
        return rays
    if reduction == "mean":
        return rays.mean(dim=-1)
    return rays.amin(dim=-1) if reduction == "min" else rays.amax(dim=-1)
