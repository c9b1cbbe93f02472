"""Stand-ins for managers without terms: they do nothing, so that callers need not ask."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import torch

if TYPE_CHECKING:
    import viser

    from mjlab.viewer.debug_visualizer import DebugVisualizer


class NullManager:
    """What all stand-ins share."""

    def __init__(self) -> None:
        self.active_terms: list[str] = []
        self.cfg = None

    def __str__(self) -> str:
        return f"<{type(self).__name__}> with 0 active terms"

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, Any]:
        """Return nothing to log."""
        return {}

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return no terms."""
        return []


class NullCommandManager(NullManager):
    """Stands in where there are no commands."""

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Do nothing."""

    def plan_lookups(self, dt: float | torch.Tensor) -> list[Any]:
        """Return no look-ups."""
        return []

    def get_command(self, name: str) -> None:
        """Return None."""

    def get_term(self, name: str) -> None:
        """Return None."""

    def get_term_cfg(self, name: str) -> None:
        """Return None."""

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw nothing."""

    def create_debug_vis_gui(
        self, server: viser.ViserServer, on_change: Callable[[], None] | None = None
    ) -> None:
        """Add nothing."""

    def create_gui(
        self,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add nothing."""

    def on_viewer_pause(self, paused: bool) -> None:
        """Do nothing."""

    def apply_gui_reset(self, env_ids: torch.Tensor) -> bool:
        """Return that nothing was written."""
        return False


class NullCurriculumManager(NullManager):
    """Stands in where there is no curriculum."""

    def compute(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Do nothing."""


class NullMetricsManager(NullManager):
    """Stands in where there are no metrics."""

    needs_substep = False
    excluded: torch.Tensor | None = None

    def compute(self) -> None:
        """Do nothing."""

    def compute_substep(self) -> None:
        """Do nothing."""


class NullRecorderManager(NullManager):
    """Stands in where there are no recorders."""

    def __contains__(self, name: str) -> bool:
        return False

    def get_term(self, name: str) -> NoReturn:
        """Raise `KeyError`: there are no recorders."""
        raise KeyError(f"There is no recorder {name!r}: the task has none.")

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        """Do nothing."""

    def record_post_reset(self, env_ids: torch.Tensor) -> None:
        """Do nothing."""

    def record_post_step(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
