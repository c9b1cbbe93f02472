"""Debug drawings of terms, with a switch for each that viewers offer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import viser

    from mjlab.viewer.debug_visualizer import DebugVisualizer


class DebugVisSwitches:
    """Mixin of managers whose terms may draw; all terms are on until switched off."""

    _hidden: frozenset[str] = frozenset()

    def get_visualizable_terms(self) -> list[tuple[str, Any]]:
        """Return the terms that can draw, as (name, object with `debug_vis`)."""
        raise NotImplementedError

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Let every term that can draw, and is switched on, draw."""
        for name, term in self.get_visualizable_terms():
            if name not in self._hidden:
                term.debug_vis(visualizer)

    def set_debug_vis(self, name: str, enabled: bool) -> None:
        """Switch the drawings of one term on or off.

        Raises `ValueError`, with the valid names, if no such term can draw.
        """
        names = [known for known, _ in self.get_visualizable_terms()]
        if name not in names:
            raise ValueError(f"No term {name!r} can draw. Terms that can: {names}.")
        self._hidden = self._hidden - {name} if enabled else self._hidden | {name}

    def create_debug_vis_gui(
        self, server: viser.ViserServer, on_change: Callable[[], None] | None = None
    ) -> None:
        """Add a check box for each term that can draw; `on_change` is called after a change."""
        for name, _ in self.get_visualizable_terms():
            self._add_checkbox(server, name, on_change)

    def _add_checkbox(
        self, server: viser.ViserServer, name: str, on_change: Callable[[], None] | None
    ) -> None:
        box = server.gui.add_checkbox(name, initial_value=name not in self._hidden)

        @box.on_update
        def _(_event: Any) -> None:
            self.set_debug_vis(name, box.value)
            if on_change is not None:
                on_change()


class TermFunctionSwitches(DebugVisSwitches):
    """The same for managers of a list of terms, where the function of a term is what may draw."""

    _term_names: list[str]
    _term_cfgs: list[Any]

    def get_visualizable_terms(self) -> list[tuple[str, Any]]:
        """Return the terms that can draw, as (name, function object)."""
        terms = zip(self._term_names, self._term_cfgs, strict=True)
        return [
            (name, cfg.func)
            for name, cfg in terms
            if callable(getattr(cfg.func, "debug_vis", None))
        ]


class SensorSwitches(DebugVisSwitches):
    """The same for the sensors of a scene."""

    def __init__(self, sensors: Mapping[str, Any]) -> None:
        """Take the sensors by name, as the scene has them."""
        self._sensors = sensors

    def get_visualizable_terms(self) -> list[tuple[str, Any]]:
        """Return the sensors that draw, as (name, sensor)."""
        return [(name, sensor) for name, sensor in self._sensors.items() if sensor.draws]
