"""Debug visualization of terms and sensors, enabled one by one in viewers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from mjlab.utils.errors import check_exists

if TYPE_CHECKING:
    import viser

    from mjlab.viewer.debug_visualizer import DebugVisualizer


class DebugVisSwitches:
    """Mixin of managers with debug visualization. All terms are enabled by default."""

    _hidden: frozenset[str] = frozenset()

    def get_visualizable_terms(self) -> list[tuple[str, Any]]:
        """Return the drawable terms, as (name, object with `debug_vis`)."""
        raise NotImplementedError

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw all enabled terms."""
        for name, term in self.get_visualizable_terms():
            if name not in self._hidden:
                term.debug_vis(visualizer)

    def set_debug_vis(self, name: str, enabled: bool) -> None:
        """Enable or disable the debug visualization of a term.

        Raises `ValueError`, listing the drawable terms, if `name` is not drawable.
        """
        check_exists("drawable term", name, [known for known, _ in self.get_visualizable_terms()])
        self._hidden = self._hidden - {name} if enabled else self._hidden | {name}

    def create_debug_vis_gui(
        self, server: viser.ViserServer, on_change: Callable[[], None] | None = None
    ) -> None:
        """Add a checkbox per drawable term; `on_change` is called after a change."""
        for name, _ in self.get_visualizable_terms():
            box = server.gui.add_checkbox(name, initial_value=name not in self._hidden)

            def switch(_event: Any, name: str = name, box: Any = box) -> None:
                self.set_debug_vis(name, box.value)
                if on_change is not None:
                    on_change()

            box.on_update(switch)


class TermFunctionSwitches(DebugVisSwitches):
    """`DebugVisSwitches` for managers of a list of terms; the term functions draw."""

    _term_names: list[str]
    _term_cfgs: list[Any]

    def get_visualizable_terms(self) -> list[tuple[str, Any]]:
        """Return the drawable terms, as (name, function object)."""
        terms = zip(self._term_names, self._term_cfgs, strict=True)
        return [
            (name, cfg.func)
            for name, cfg in terms
            if callable(getattr(cfg.func, "debug_vis", None))
        ]


class SensorSwitches(DebugVisSwitches):
    """`DebugVisSwitches` for the sensors of a scene."""

    def __init__(self, sensors: Mapping[str, Any]) -> None:
        """Store a reference to the scene's sensors by name."""
        self._sensors = sensors

    def get_visualizable_terms(self) -> list[tuple[str, Any]]:
        """Return the sensors with debug visualization, as (name, sensor)."""
        return [(name, sensor) for name, sensor in self._sensors.items() if sensor.draws]
