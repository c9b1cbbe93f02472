"""Debug visualizer: drawing interface passed to `debug_vis` of terms and sensors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    import mujoco

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each in [0, 1]."""

DEFAULT_AXIS_COLORS = ((0.9, 0.0, 0.0), (0.0, 0.9, 0.0), (0.0, 0.0, 0.9))
"""Colors of the x, y and z arrows of a frame."""

MIN_LENGTH = 1e-6
"""Arrows and cylinders shorter than this (m) have no direction and are not drawn."""


class DebugVisualizer(ABC):
    """Draws primitives over the scene. Poses are in the world frame, lengths in m.

    Drawings last for one displayed frame: the viewer clears them and calls `debug_vis` again.
    `label` documents an item in the code; viewers do not show it. `add_legend` explains colors.
    Subclasses define `meansize`, `add_ghost_mesh`, `clear`, `_place` and `_connect`.
    """

    env_idx: int = 0
    """Environment in view."""
    show_all_envs: bool = False
    """Draw for all environments, not only for the one in view."""

    def get_env_indices(self, num_envs: int) -> Iterable[int]:
        """Return the environments to draw: all, the one in view, or none if it does not exist."""
        if self.show_all_envs:
            return range(num_envs)
        return (self.env_idx,) if 0 <= self.env_idx < num_envs else ()

    @property
    @abstractmethod
    def meansize(self) -> float:
        """Typical size of a body in the model (m), to scale drawings."""

    def add_arrow(
        self,
        start: np.ndarray,
        end: np.ndarray,
        color: Color,
        width: float = 0.015,
        label: str | None = None,
    ) -> None:
        """Draw an arrow between two points (3,); `width` is the radius of the shaft."""
        self._connect("arrow", start, end, width, color)

    def add_sphere(
        self, center: np.ndarray, radius: float, color: Color, label: str | None = None
    ) -> None:
        """Draw a sphere."""
        self._place("sphere", center, np.full(3, radius), np.eye(3), color)

    def add_cylinder(
        self,
        start: np.ndarray,
        end: np.ndarray,
        radius: float,
        color: Color,
        label: str | None = None,
    ) -> None:
        """Draw a cylinder with flat ends centered on two points (3,)."""
        self._connect("cylinder", start, end, radius, color)

    def add_ellipsoid(
        self,
        center: np.ndarray,
        size: np.ndarray,
        mat: np.ndarray,
        color: Color,
        label: str | None = None,
    ) -> None:
        """Draw an ellipsoid with semi-axes `size` (3,) along the columns of `mat` (3, 3)."""
        self._place("ellipsoid", center, size, mat, color)

    def add_box(
        self,
        center: np.ndarray,
        size: np.ndarray,
        mat: np.ndarray,
        color: Color,
        label: str | None = None,
    ) -> None:
        """Draw a box with half-extents `size` (3,) along the columns of `mat` (3, 3)."""
        self._place("box", center, size, mat, color)

    @abstractmethod
    def add_ghost_mesh(
        self,
        qpos: np.ndarray,
        model: mujoco.MjModel,
        mocap_pos: np.ndarray | None = None,
        mocap_quat: np.ndarray | None = None,
        alpha: float = 0.5,
        label: str | None = None,
    ) -> None:
        """Draw the moving bodies of `model` at configuration `qpos` (nq,), transparent.

        A mocap position (3,) or quaternion (4,) sets mocap body 0; shapes (nmocap, 3) and
        (nmocap, 4) set all mocap bodies.
        """

    def add_legend(self, color: Color, meaning: str) -> None:  # noqa: B027
        """Explain a color of this frame's drawings. Viewers without a legend ignore this."""

    @abstractmethod
    def clear(self) -> None:
        """Remove everything drawn."""

    def add_frame(
        self,
        position: np.ndarray,
        rotation_matrix: np.ndarray,
        scale: float = 0.3,
        label: str | None = None,
        axis_radius: float = 0.01,
        alpha: float = 1.0,
        axis_colors: tuple[tuple[float, float, float], ...] | None = None,
    ) -> None:
        """Draw a coordinate frame as three arrows of length `scale`."""
        position = np.asarray(position, dtype=float)
        rotation = np.asarray(rotation_matrix, dtype=float).reshape(3, 3)
        for axis, (red, green, blue) in enumerate(axis_colors or DEFAULT_AXIS_COLORS):
            end = position + scale * rotation[:, axis]
            self.add_arrow(position, end, (red, green, blue, alpha), axis_radius, label)

    def _place(
        self,
        shape: Literal["sphere", "ellipsoid", "box"],
        center: np.ndarray,
        size: np.ndarray,
        mat: np.ndarray,
        color: Color,
    ) -> None:
        """Draw a shape with half-extents `size` (3,) along the columns of `mat` (3, 3)."""
        raise NotImplementedError(f"{type(self).__name__} must define _place, or each add_*.")

    def _connect(
        self,
        shape: Literal["arrow", "cylinder"],
        start: np.ndarray,
        end: np.ndarray,
        radius: float,
        color: Color,
    ) -> None:
        """Draw a shape between two points (3,)."""
        raise NotImplementedError(f"{type(self).__name__} must define _connect, or each add_*.")


class NullDebugVisualizer:
    """Visualizer that ignores all drawing calls."""

    def __init__(self, env_idx: int = 0, meansize: float = 0.1):
        self.env_idx = env_idx
        self.show_all_envs = False
        self._meansize = meansize

    @property
    def meansize(self) -> float:
        return self._meansize

    def get_env_indices(self, num_envs: int) -> Iterable[int]:
        return (self.env_idx,) if 0 <= self.env_idx < num_envs else ()

    def clear(self, *args, **kwargs) -> None:
        """Draw nothing."""

    add_arrow = add_frame = add_sphere = add_cylinder = add_ellipsoid = add_box = clear
    add_ghost_mesh = add_legend = clear


def pose_ghost(
    data: mujoco.MjData,
    qpos: np.ndarray,
    mocap_pos: np.ndarray | None,
    mocap_quat: np.ndarray | None,
) -> None:
    """Write a ghost's configuration into `data`; mocap poses are for body 0 or for all bodies."""
    data.qpos[:] = qpos
    if mocap_pos is not None:
        positions = np.atleast_2d(mocap_pos)
        data.mocap_pos[: len(positions)] = positions
    if mocap_quat is not None:
        rotations = np.atleast_2d(mocap_quat)
        data.mocap_quat[: len(rotations)] = rotations
