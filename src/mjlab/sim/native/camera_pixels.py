"""Rays through the pixels of an image, in the frame of the camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import mujoco
import torch

# A tile is about so many pixels long and wide: fewer geoms are in sight of a smaller tile, and
# each tile costs something by itself.
_TILE = 8


@dataclass
class PixelRays:
    """Rays (n, P) of a camera, sorted into tiles; n is 1 where all environments share them.

    The camera looks along -z of its frame, with x to the right and y up.
    """

    directions: torch.Tensor
    """(n, P, 3) unit vectors."""
    offsets: torch.Tensor | None
    """(n, P, 3) where rays start, if the projection is orthographic; None: at the origin."""
    planes: torch.Tensor
    """(n, F, 3) inward normals of the planes between which rays are: columns, then rows."""
    plane_offsets: torch.Tensor
    """(n, F) signed distances of the origin from the planes; 0 but for orthographic cameras."""

    @cached_property
    def cosines(self) -> torch.Tensor:
        """(n, P) cosines of the angles between rays and optical axis."""
        return -self.directions[..., 2].contiguous()


class PixelGrid:
    """The pixels of an image, sorted into `rows` x `columns` tiles of `rays` pixels each."""

    def __init__(self, width: int, height: int) -> None:
        """Sort the pixels of an image; tiles that reach beyond it repeat its last pixels."""
        self.width, self.height = width, height
        tile_width, tile_height = _tile_size(width), _tile_size(height)
        self.columns, self.rows = -(-width // tile_width), -(-height // tile_height)
        self.rays = tile_width * tile_height
        x = torch.arange(self.columns * tile_width).clamp(max=width - 1)
        y = torch.arange(self.rows * tile_height).clamp(max=height - 1)
        shape = (self.rows, tile_height, self.columns, tile_width)
        pixels = (y[:, None] * width + x[None, :]).view(shape).transpose(1, 2).reshape(-1)
        self.x, self.y = pixels % width, pixels // width
        # Where each pixel of the image is among the rays. One that is repeated is in several.
        place = torch.empty(width * height, dtype=torch.int64)
        place[pixels] = torch.arange(len(pixels))
        self._place = place
        self._x_edges = _edges(width, tile_width, self.columns)
        self._y_edges = _edges(height, tile_height, self.rows)

    @property
    def num_tiles(self) -> int:
        """Number of tiles."""
        return self.rows * self.columns

    @property
    def num_rays(self) -> int:
        """Number of rays P of all tiles."""
        return self.num_tiles * self.rays

    def copy_to_image(self, values: torch.Tensor, out: torch.Tensor) -> None:
        """Copy values of rays (n, P, ...) to an image (n, height, width, ...)."""
        torch.index_select(values, 1, self._place, out=out.view(len(out), -1, *out.shape[3:]))

    def perspective(
        self, fovy: torch.Tensor, intrinsic: torch.Tensor, sensorsize: torch.Tensor
    ) -> PixelRays:
        """Return rays through the centres of the pixels of a pinhole camera.

        A camera with a sensor has the field of view of the part of it that has the image's shape.

        Args:
            fovy: (n, 1) vertical field of view, in degrees; for a camera without a sensor.
            intrinsic: (n, 4) focal lengths and principal point, x and y.
            sensorsize: (2,) width and height.
        """
        left, right, bottom, top = self._frustum(fovy, intrinsic, sensorsize)
        u = (self.x + 0.5) / self.width
        v = (self.y + 0.5) / self.height
        x, y = left + (right - left) * u, top + (bottom - top) * v
        directions = torch.stack((x, y, -torch.ones_like(x)), dim=-1)
        directions /= directions.norm(dim=-1, keepdim=True)
        x, y = left + (right - left) * self._x_edges, top + (bottom - top) * self._y_edges
        one, none = torch.ones_like(x), torch.zeros_like(x)
        sides = torch.cat((_planes(one, none, x, 0), _planes(-one, none, -x, 1)), dim=1)
        one, none = torch.ones_like(y), torch.zeros_like(y)
        # The first row of an image is the one that is highest.
        ends = torch.cat((_planes(none, -one, -y, 0), _planes(none, one, y, 1)), dim=1)
        planes = torch.cat((sides, ends), dim=1)
        return PixelRays(directions, None, planes, torch.zeros(planes.shape[:2]))

    def _frustum(
        self, fovy: torch.Tensor, intrinsic: torch.Tensor, sensorsize: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the sides (n, 1) of the image at the distance 1: left, right, bottom, top."""
        aspect = self.width / self.height
        sensor_width, sensor_height = sensorsize.tolist()
        if sensor_height == 0.0:
            half_height = torch.tan(torch.deg2rad(0.5 * fovy))
            half_width = half_height * aspect
            return -half_width, half_width, -half_height, half_height
        sensor_width, sensor_height = (
            min(sensor_width, sensor_height * aspect),
            min(sensor_height, sensor_width / aspect),
        )
        fx, fy, cx, cy = intrinsic[..., None].unbind(dim=1)
        return (
            (cx - 0.5 * sensor_width) / fx,
            (cx + 0.5 * sensor_width) / fx,
            -(cy + 0.5 * sensor_height) / fy,
            (0.5 * sensor_height - cy) / fy,
        )

    def orthographic(self, extent: torch.Tensor) -> PixelRays:
        """Return parallel rays through the centres of pixels of images `extent` (n, 1) high."""
        width = extent * self.width / self.height
        x = width * ((self.x + 0.5) / self.width - 0.5)
        y = extent * (0.5 - (self.y + 0.5) / self.height)
        offsets = torch.stack((x, y, torch.zeros_like(x)), dim=-1)
        directions = torch.tensor([0.0, 0.0, -1.0]).expand(len(extent), x.shape[1], 3).contiguous()
        x, y = width * (self._x_edges - 0.5), extent * (0.5 - self._y_edges)
        none, one = torch.zeros_like(x), torch.ones_like(x)
        sides = torch.cat((_planes(one, none, none, 0), _planes(-one, none, none, 1)), dim=1)
        none, one = torch.zeros_like(y), torch.ones_like(y)
        ends = torch.cat((_planes(none, -one, none, 0), _planes(none, one, none, 1)), dim=1)
        distances = torch.cat((-x[:, 0::2], x[:, 1::2], y[:, 0::2], -y[:, 1::2]), dim=1)
        return PixelRays(directions, offsets, torch.cat((sides, ends), dim=1), distances)


class Lens:
    """The rays of one camera: computed once, or anew where environments differ in them."""

    def __init__(self, model: mujoco.MjModel, camera_id: int, grid: PixelGrid) -> None:
        """Take the camera `camera_id` of a model, and pixels."""
        self._grid, self._id = grid, camera_id
        projection = int(model.cam_projection[camera_id])
        self.is_orthographic = projection == int(mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC)
        self._sensorsize = torch.tensor(model.cam_sensorsize[camera_id], dtype=torch.float32)
        self.rays = self._make(
            torch.tensor([[model.cam_fovy[camera_id]]], dtype=torch.float32),
            torch.tensor(model.cam_intrinsic[camera_id : camera_id + 1], dtype=torch.float32),
        )
        """The rays of all environments, unless these differ in `LENS_FIELDS`."""

    def _make(self, fovy: torch.Tensor, intrinsic: torch.Tensor) -> PixelRays:
        if self.is_orthographic:
            return self._grid.orthographic(fovy)
        return self._grid.perspective(fovy, intrinsic, self._sensorsize)

    def rays_of(self, model: Callable[[str], torch.Tensor]) -> PixelRays:
        """Return the rays of n environments, whose fields of `MjModel` the function `model` reads."""
        fovy, intrinsic = model("cam_fovy"), model("cam_intrinsic")
        return self._make(fovy[:, self._id, None], intrinsic[:, self._id])


def _tile_size(length: int) -> int:
    """Return about `_TILE`, such that the tiles along `length` pixels are nearly full."""
    count = max(1, round(length / _TILE))
    return -(-length // count)


def _edges(length: int, tile: int, count: int) -> torch.Tensor:
    """Return the first and last pixel centre of each tile, (2 count,), as parts of the length."""
    first = torch.arange(count) * tile
    last = (first + tile - 1).clamp(max=length - 1)
    return (torch.stack((first, last), dim=1).view(-1) + 0.5) / length


def _planes(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, which: int) -> torch.Tensor:
    """Return every second of the normals (n, count, 3), from the one `which`."""
    return torch.stack((x, y, z), dim=-1)[:, which::2]
