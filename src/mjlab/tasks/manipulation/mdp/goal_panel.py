"""A handle in the browser viewer by which a person drags the goal."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    import viser

_AXES = ("x", "y", "z")
_SLIDER_STEP = 0.01
# How much further than the range of goals the sliders go, in metres.
_BEYOND = 0.1
_HANDLE_SIZE = 0.12
# Nobody sees that a handle is so far from its goal, in metres.
_NO_DISTANCE = 1e-5
# mjviser shifts the scene to keep what the camera follows in the middle. What does not move by
# itself hangs below this frame, in world coordinates.
_WORLD = "/fixed_bodies"


class GoalPanel:
    """A handle at the goal of the environment in view, and a slider for each coordinate.

    The handle follows the command until a person drags it or moves a slider. From then on the goal
    is where the person has put it, in whichever environment is in view, until `Hold goal` is
    switched off. Coordinates are those from the environment's origin.
    """

    def __init__(
        self,
        name: str,
        server: viser.ViserServer,
        ranges: Any,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
    ) -> None:
        """Add the panel to the current place in the page, and the handle to its scene.

        Args:
            name: Title of the panel.
            server: The page's server.
            ranges: What goals are drawn from, by coordinate: `x`, `y` and `z`.
            get_env_idx: Returns the environment in view.
            on_change: Called after every change.
        """
        self._get_env_idx = get_env_idx
        self._on_change = on_change
        # The page's callbacks come in other threads.
        self._lock = threading.Lock()
        self._origin = np.zeros(3)
        self._shown: np.ndarray | None = None
        with server.gui.add_folder(name.replace("_", " ").capitalize()):
            self._held = server.gui.add_checkbox(
                "Hold goal",
                False,
                hint="Keep the goal of the environment in view at the handle. Dragging the handle "
                "in the scene, or moving a slider, switches this on.",
            )
            self._sliders = [self._add_slider(server, axis, ranges) for axis in _AXES]
        self._handle = server.scene.add_transform_controls(
            f"{_WORLD}/{name}_handle", scale=_HANDLE_SIZE, disable_rotations=True, depth_test=False
        )
        self._held.on_update(self._changed)
        self._handle.on_update(self._dragged)

    def _add_slider(self, server: viser.ViserServer, axis: str, ranges: Any) -> Any:
        low, high = getattr(ranges, axis)
        slider = server.gui.add_slider(
            axis, low - _BEYOND, high + _BEYOND, _SLIDER_STEP, (low + high) / 2.0
        )
        slider.on_update(self._moved)
        return slider

    def write_to(self, goals: torch.Tensor, origins: torch.Tensor) -> int | None:
        """Put the goal of the environment in view at the handle if it is held, else the reverse.

        Args:
            goals: (N, 3) goals in the world, of which one row may be overwritten.
            origins: (N, 3) origins of the environments.

        Returns the environment whose goal is held, if any.
        """
        index = self._get_env_idx()
        if not 0 <= index < len(goals):
            return None
        with self._lock:
            self._origin = origins[index].cpu().numpy().astype(float)
            if not self._held.value:
                self._show(goals[index].cpu().numpy().astype(float))
                return None
            goal = self._origin + [float(slider.value) for slider in self._sliders]
            goals[index] = torch.as_tensor(goal, dtype=goals.dtype, device=goals.device)
            self._show(goal)
            return index

    def _show(self, goal: np.ndarray) -> None:
        """Put handle and sliders at a goal in the world, unless they are there."""
        if self._shown is not None and np.allclose(goal, self._shown, atol=_NO_DISTANCE):
            return
        self._shown = goal
        self._handle.position = tuple(goal)
        if not self._held.value:
            self._set_sliders(goal - self._origin)

    def _set_sliders(self, goal: np.ndarray) -> None:
        for slider, value in zip(self._sliders, goal, strict=True):
            slider.value = float(np.clip(value, slider.min, slider.max))

    def _dragged(self, event: Any) -> None:
        if event.client is None:
            return
        with self._lock:
            self._held.value = True
            # Not sent back to whoever drags it, unless it has gone further than the sliders.
            self._shown = np.asarray(self._handle.position, dtype=float)
            self._set_sliders(self._shown - self._origin)
        self._changed(event)

    def _moved(self, event: Any) -> None:
        # Sliders are also moved to follow the command, and that is no person.
        if event.client is None:
            return
        if not self._held.value:
            self._held.value = True
        self._changed(event)

    def _changed(self, _event: Any) -> None:
        if self._on_change is not None:
            self._on_change()
