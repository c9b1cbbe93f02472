"""Velocity joystick: sliders and keys of a viewer that command the environment in view."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    import viser

_STEP = 0.05
_MAX_BOUNDS = (0.1, 10.0)
# Slider labels of the command components.
_COMPONENTS = {
    "lin_vel_x": "Forward (m/s)",
    "lin_vel_y": "Left (m/s)",
    "ang_vel_z": "Turn left (rad/s)",
}


class VelocityJoystick:
    """Velocity set by hand. In the browser: one slider per component, and one for the limit of each."""

    def __init__(
        self,
        name: str,
        server: viser.ViserServer | None,
        ranges: Any,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
    ) -> None:
        """Start disabled, at zero; add the panel to the current GUI container.

        Args:
            name: Title of the panel.
            server: Viser server. None: no panel, for keys in MuJoCo's window.
            ranges: `UniformVelocityCommandCfg.Ranges`; slider limits are their largest magnitudes.
            get_env_idx: Returns the environment in view.
            on_change: Called after every change.
        """
        self._get_env_idx = get_env_idx
        self._on_change = on_change
        self._sliders: list[Any] = []
        self._replaced: tuple[int, torch.Tensor] | None = None
        limits = [_limit(getattr(ranges, component)) for component in _COMPONENTS]
        if server is None:
            self._enabled: Any = SimpleNamespace(value=False)
            self._sliders = [SimpleNamespace(value=0.0, min=-high, max=high) for high in limits]
        else:
            self._create_panel(name, server, limits)

    def _create_panel(self, name: str, server: viser.ViserServer, limits: list[float]) -> None:
        with server.gui.add_folder(name.capitalize()):
            self._enabled = server.gui.add_checkbox(
                "Enable",
                False,
                hint="Command the environment in view by these sliders. Moving one enables them.",
            )
            for label, limit in zip(_COMPONENTS.values(), limits, strict=True):
                self._sliders.append(server.gui.add_slider(label, -limit, limit, _STEP, 0.0))
                self._sliders[-1].on_update(self._moved)
            zero = server.gui.add_button("Zero")
            with server.gui.add_folder("More", expand_by_default=False):
                for label, slider, limit in zip(
                    _COMPONENTS.values(), self._sliders, limits, strict=True
                ):
                    self._add_maximum(server, label, slider, limit)
        self._enabled.on_update(self._changed)

        @zero.on_click
        def _(_event: Any) -> None:
            self._zero()

    def _add_maximum(
        self, server: viser.ViserServer, label: str, slider: Any, limit: float
    ) -> None:
        """Add a slider of the largest value of `slider`."""
        low, high = _MAX_BOUNDS
        maximum = server.gui.add_slider(f"Max {label[0].lower()}{label[1:]}", low, high, 0.1, limit)

        @maximum.on_update
        def _(_event: Any) -> None:
            slider.value = min(max(slider.value, -maximum.value), maximum.value)
            slider.min, slider.max = -maximum.value, maximum.value

    def steer(self, shares: tuple[float, float, float] | None, add: bool = True) -> None:
        """Enable the joystick and move it; see `CommandTerm.steer`."""
        if shares is None:
            is_stopped = all(slider.value == 0.0 for slider in self._sliders)
            self._enabled.value = not (self._enabled.value and is_stopped)
            self._zero()
            return
        self._enabled.value = True
        for slider, share in zip(self._sliders, shares, strict=True):
            moved = slider.value * add + share * slider.max
            # Without rounding, ten steps forth and back do not end at zero.
            slider.value = round(min(max(moved, slider.min), slider.max), 6)

    def restore(self, command: torch.Tensor) -> None:
        """Restore the row of `command`, (N, 3), that `write_to` overwrote last, if any."""
        if self._replaced is not None:
            index, row = self._replaced
            command[index] = row
            self._replaced = None

    def write_to(self, command: torch.Tensor) -> None:
        """Overwrite the row of the environment in view in `command`, (N, 3), if enabled."""
        index = self._get_env_idx()
        if self._enabled.value and 0 <= index < len(command):
            self._replaced = index, command[index].clone()
            values = [float(slider.value) for slider in self._sliders]
            command[index] = torch.tensor(values, dtype=command.dtype, device=command.device)

    def _zero(self) -> None:
        for slider in self._sliders:
            slider.value = 0.0

    def _moved(self, event: Any) -> None:
        # Enable on user input only; `Zero` and `Max` set sliders without a client.
        if event.client is not None and not self._enabled.value:
            self._enabled.value = True
        self._changed(event)

    def _changed(self, _event: Any) -> None:
        if self._on_change is not None:
            self._on_change()


def _limit(bounds: tuple[float, float]) -> float:
    """Return the largest magnitude of a range, within the bounds of the sliders."""
    low, high = _MAX_BOUNDS
    # Ranges may be negative or empty, sliders may not.
    return min(max(abs(bound) for bound in (*bounds, low)), high)
