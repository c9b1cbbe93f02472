"""Browser viewer panel to drag the goal."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    import viser

_SLIDER_STEP = 0.01
# Slider range beyond the range of goals (m).
_BEYOND = 0.1
_HANDLE_SIZE = 0.12
# Invisible distance of the handle from its goal (m).
_NO_DISTANCE = 1e-5
# mjviser shifts the scene to center the tracked body. Children of this frame stay in world
# coordinates.
_WORLD = "/fixed_bodies"


class GoalPanel:
    """Handle at the goal of the displayed environment, and a slider per coordinate.

    The handle follows the command until the user drags it or moves a slider. From then on the goal
    of the displayed environment is held at the handle, until `Hold goal` is switched off.
    Coordinates are relative to the environment's origin.
    """

    def __init__(
        self,
        name: str,
        server: viser.ViserServer,
        ranges: Any,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
    ) -> None:
        """Add the panel to the current GUI container, and the handle to the scene.

        Args:
            name: Title of the panel.
            server: Viser server.
            ranges: Ranges of goals, attributes `x`, `y` and `z`.
            get_env_idx: Returns the index of the displayed environment.
            on_change: Called after every change.
        """
        self._get_env_idx = get_env_idx
        self._on_change = on_change or (lambda: None)
        # Viser calls callbacks in other threads.
        self._lock = threading.Lock()
        self._origin = np.zeros(3)
        self._shown: np.ndarray | None = None
        with server.gui.add_folder(name.replace("_", " ").capitalize()):
            self._held = server.gui.add_checkbox(
                "Hold goal",
                False,
                hint="Keep the goal of the displayed environment at the handle. Dragging the "
                "handle or moving a slider switches this on.",
            )
            self._sliders = []
            for axis in ("x", "y", "z"):
                low, high = getattr(ranges, axis)
                slider = server.gui.add_slider(
                    axis, low - _BEYOND, high + _BEYOND, _SLIDER_STEP, (low + high) / 2.0
                )
                slider.on_update(self._moved)
                self._sliders.append(slider)
        self._handle = server.scene.add_transform_controls(
            f"{_WORLD}/{name}_handle", scale=_HANDLE_SIZE, disable_rotations=True, depth_test=False
        )
        self._held.on_update(lambda _event: self._on_change())
        self._handle.on_update(self._dragged)

    def write_to(self, goals: torch.Tensor, origins: torch.Tensor) -> int | None:
        """Move the displayed environment's goal to the handle if held, else the handle to the goal.

        Args:
            goals: (N, 3) goals in the world; the row of a held goal is overwritten.
            origins: (N, 3) environment origins.

        Returns the index of the environment whose goal is held, or None.
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
        """Move handle and sliders to a goal in the world if it changed."""
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
            # The next `_show` then skips the dragged handle, unless the sliders clipped the goal.
            self._shown = np.asarray(self._handle.position, dtype=float)
            self._set_sliders(self._shown - self._origin)
        self._on_change()

    def _moved(self, event: Any) -> None:
        # Slider updates from the command have no client.
        if event.client is None:
            return
        if not self._held.value:
            self._held.value = True
        self._on_change()
