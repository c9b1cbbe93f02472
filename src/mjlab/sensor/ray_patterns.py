"""Ray patterns: origins and directions of the rays of one frame.

A pattern returns offsets (m) and unit directions in the aligned frame of a ray sensor, (n, 3) each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import torch

from mjlab.utils.errors import check_exists, check_fields_positive
from mjlab.utils.memory import check_memory

Rays = tuple[torch.Tensor, torch.Tensor]
"""Offsets (m) and unit directions in the aligned frame, (n, 3) each."""
_DOWN = (0.0, 0.0, -1.0)


@dataclass
class GridPatternCfg:
    """Parallel rays from a rectangular grid in the frame's xy plane.

    Rays start at `-size / 2 + k resolution`, up to `size / 2` plus a margin of half a `resolution`,
    x fastest. So the grid is centered if `size` is a multiple of `resolution`.
    """

    size: tuple[float, float] = (1.0, 1.0)
    """Extent along x and y (m). 0: a single row."""
    resolution: float = 0.1
    """Distance between neighboring rays (m)."""
    direction: tuple[float, float, float] = _DOWN
    """Direction of all rays, not necessarily normalized."""

    def generate_rays(self, mj_model: mujoco.MjModel | None, device: str) -> Rays:
        """Return offsets and directions; ray `row * columns + column`, x along a row."""
        check_fields_positive(self, "resolution")
        # All k with k d < side + d / 2. The margin keeps rounding from adding a ray.
        counts = [max(1, math.ceil(side / self.resolution + 0.5 - 1e-9)) for side in self.size]
        _check_memory("GridPatternCfg", math.prod(counts), "a larger resolution")
        axes = []
        for side, count in zip(self.size, counts, strict=True):
            steps = torch.arange(count, dtype=torch.float64) * self.resolution - side / 2
            axes.append(steps.to(device, torch.float32))
        grid_y, grid_x = torch.meshgrid(axes[1], axes[0], indexing="ij")
        offsets = torch.stack((grid_x, grid_y, torch.zeros_like(grid_x)), dim=-1).flatten(0, 1)
        return offsets, _parallel(self.direction, len(offsets), device)


@dataclass
class PinholeCameraPatternCfg:
    """Rays through the centers of the pixels of a pinhole camera that looks along -z, with +y up.

    Row 0 is the top row; rays are in row-major order, left to right.
    """

    width: int = 16
    """Image width (pixels)."""
    height: int = 12
    """Image height (pixels)."""
    fovy: float = 45.0
    """Vertical field of view (deg)."""
    _camera_name: str | None = None

    @classmethod
    def from_mujoco_camera(cls, camera_name: str) -> PinholeCameraPatternCfg:
        """Return a pattern with the resolution and intrinsics of a camera, by its full scene name.

        Focal length, sensor size and principal point apply if the camera defines them. The camera
        pose is ignored; the sensor's `frame` defines the pose.
        """
        return cls(_camera_name=camera_name)

    @classmethod
    def from_intrinsic_matrix(
        cls, intrinsic_matrix: list[float], width: int, height: int
    ) -> PinholeCameraPatternCfg:
        """Return a pattern with the vertical field of view `2 atan(height / (2 fy))`.

        Args:
            intrinsic_matrix: (fx, 0, cx, 0, fy, cy, 0, 0, 1) (pixels). Only fy is used.
            width: Image width (pixels).
            height: Image height (pixels).
        """
        fovy = 2.0 * math.degrees(math.atan(height / (2.0 * intrinsic_matrix[4])))
        return cls(width=width, height=height, fovy=fovy)

    def generate_rays(self, mj_model: mujoco.MjModel | None, device: str) -> Rays:
        """Return zero offsets and directions; ray `row * width + column`.

        Raises:
            ValueError: unknown camera.
        """
        width, height, half_x, half_y, center = self._image_plane(mj_model)
        _check_memory("PinholeCameraPatternCfg", width * height, "a smaller image")
        u = (torch.arange(width, dtype=torch.float64) + 0.5) * 2.0 / width - 1.0
        v = 1.0 - (torch.arange(height, dtype=torch.float64) + 0.5) * 2.0 / height
        grid_v, grid_u = torch.meshgrid(v, u, indexing="ij")
        x, y = grid_u * half_x + center[0], grid_v * half_y + center[1]
        directions = torch.stack((x, y, -torch.ones_like(x)), dim=-1).flatten(0, 1)
        directions = torch.nn.functional.normalize(directions, dim=-1).to(device, torch.float32)
        return torch.zeros_like(directions), directions

    def _image_plane(
        self, mj_model: mujoco.MjModel | None
    ) -> tuple[int, int, float, float, tuple[float, float]]:
        """Return image width and height (pixels), half extents and center at distance 1."""
        width, height, fovy = self.width, self.height, self.fovy
        if self._camera_name is not None:
            assert mj_model is not None
            names = [mj_model.camera(i).name for i in range(mj_model.ncam)]
            check_exists("camera", self._camera_name, names)
            camera = names.index(self._camera_name)
            width, height = mj_model.cam_resolution[camera].tolist()
            fovy = float(mj_model.cam_fovy[camera])
            sensor_x, sensor_y = mj_model.cam_sensorsize[camera].tolist()
            if sensor_y != 0.0:
                fx, fy, cx, cy = mj_model.cam_intrinsic[camera].tolist()
                # Sign convention of the principal point: MuJoCo's camera frustum.
                center = (cx / fx, -cy / fy)
                return width, height, sensor_x / (2 * fx), sensor_y / (2 * fy), center
        half_y = math.tan(math.radians(fovy) / 2.0)
        return width, height, half_y * width / height, half_y, (0.0, 0.0)


@dataclass
class Ring:
    """Ring of parallel rays, counterclockwise from the x axis."""

    radius: float = 0.1
    """Radius (m)."""
    num_samples: int = 8
    """Number of rays."""


@dataclass
class RingPatternCfg:
    """Parallel rays from concentric rings in the frame's xy plane: center first, then by ring."""

    Ring = Ring

    rings: tuple[Ring, ...]
    """Rings in ray order."""
    include_center: bool = True
    """Add a ray at the frame's origin."""
    direction: tuple[float, float, float] = _DOWN
    """Direction of all rays, not necessarily normalized."""

    @classmethod
    def single_ring(
        cls,
        radius: float = 0.1,
        num_samples: int = 8,
        include_center: bool = True,
        direction: tuple[float, float, float] = _DOWN,
    ) -> RingPatternCfg:
        """Return a pattern with one ring."""
        return cls((Ring(radius, num_samples),), include_center, direction)

    def generate_rays(self, mj_model: mujoco.MjModel | None, device: str) -> Rays:
        """Return offsets and directions: center, then ring by ring."""
        count = sum(ring.num_samples for ring in self.rings)
        _check_memory("RingPatternCfg", count, "fewer samples")
        points = [(0.0, 0.0, 0.0)] if self.include_center else []
        for ring in self.rings:
            for k in range(ring.num_samples):
                angle = 2.0 * math.pi * k / ring.num_samples
                points.append((ring.radius * math.cos(angle), ring.radius * math.sin(angle), 0.0))
        offsets = torch.tensor(points, dtype=torch.float32, device=device).reshape(-1, 3)
        return offsets, _parallel(self.direction, len(points), device)


PatternCfg = GridPatternCfg | PinholeCameraPatternCfg | RingPatternCfg


def _check_memory(owner: str, count: int, cure: str) -> None:
    # Offset and direction in single precision.
    check_memory(f"{owner} rays", count, 24, "cpu", cure)


def _parallel(direction: tuple[float, ...], count: int, device: str) -> torch.Tensor:
    vector = torch.tensor(direction, dtype=torch.float64)
    # One row per ray, the layout of patterns of diverging rays.
    return (vector / vector.norm()).to(device, torch.float32).repeat(count, 1)
