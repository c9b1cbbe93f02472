"""Browser viewer panel to drag a goal pose."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    import viser

_HANDLE_SIZE = 0.15
# Invisible change of a pose (m, and components of a quaternion).
_NO_CHANGE = 1e-5
# mjviser shifts the scene to center the tracked body. Children of this frame stay in world
# coordinates.
_WORLD = "/fixed_bodies"


class PosePanel:
    """Handle at the goal pose of the displayed environment, to move and to turn.

    The handle follows the command until the user drags it. From then on the goal of the displayed
    environment is held at the handle, until `Hold goal` is switched off.
    """

    def __init__(
        self,
        name: str,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
    ) -> None:
        """Add the panel to the current GUI container, and the handle to the scene.

        Args:
            name: Title of the panel.
            server: Viser server.
            get_env_idx: Returns the index of the displayed environment.
            on_change: Called after every change.
        """
        self._get_env_idx = get_env_idx
        self._on_change = on_change or (lambda: None)
        # Viser calls callbacks in other threads.
        self._lock = threading.Lock()
        self._shown: np.ndarray | None = None
        with server.gui.add_folder(name.replace("_", " ").capitalize()):
            self._held = server.gui.add_checkbox(
                "Hold goal",
                False,
                hint="Keep the goal of the displayed environment at the handle. Dragging the "
                "handle switches this on.",
            )
        self._handle = server.scene.add_transform_controls(
            f"{_WORLD}/{name}_handle", scale=_HANDLE_SIZE, depth_test=False
        )
        self._held.on_update(lambda _event: self._on_change())
        self._handle.on_update(self._dragged)

    def held(self, num_envs: int) -> tuple[int, torch.Tensor] | None:
        """Return the environment whose goal is held, and the pose (7,) in the world; None: no goal."""
        index = self._get_env_idx()
        if not (self._held.value and 0 <= index < num_envs):
            return None
        with self._lock:
            self._shown = np.concatenate((self._handle.position, self._handle.wxyz))
            return index, torch.as_tensor(self._shown, dtype=torch.float32)

    def show(self, poses: torch.Tensor) -> None:
        """Move the handle to the displayed environment's goal, of poses (N, 7) in the world."""
        index = self._get_env_idx()
        if self._held.value or not 0 <= index < len(poses):
            return
        pose = poses[index].cpu().numpy().astype(float)
        with self._lock:
            if self._shown is not None and np.allclose(pose, self._shown, atol=_NO_CHANGE):
                return
            self._shown = pose
            self._handle.position, self._handle.wxyz = tuple(pose[:3]), tuple(pose[3:])

    def _dragged(self, event: Any) -> None:
        # Moves by `show` have no client.
        if event.client is None:
            return
        self._held.value = True
        self._on_change()
