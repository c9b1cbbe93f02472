"""Choosing another checkpoint while the viewer runs."""

from __future__ import annotations

import html
import logging
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

if TYPE_CHECKING:
    from mjlab.viewer.base import PolicyProtocol

log = logging.getLogger(__name__)

_NONE_FOUND = "(none)"


@dataclass
class CheckpointManager:
    """Checkpoints of a run that the viewer can play."""

    current_name: str
    """Name of the checkpoint in use."""
    fetch_available: Callable[[], list[tuple[str, str]]]
    """Function that lists (name, age) of the checkpoints, oldest first. Called in a thread of the
    server."""
    load_checkpoint: Callable[[str], PolicyProtocol]
    """Function that returns the policy of a checkpoint by name. Called in the viewer's thread."""
    run_name: str | None = None
    """Name of the run. None: checkpoints are local files."""
    run_url: str | None = None
    """Address of the run's page."""
    run_status: str | None = None
    """Status of the run."""


def local_checkpoints(
    folder: Path, load_policy: Callable[[Path], PolicyProtocol], current: str = ""
) -> CheckpointManager:
    """Return a manager of the checkpoints (`*.pt`) in `folder`; `current` is the one in use."""

    def fetch_available() -> list[tuple[str, str]]:
        # The replay beside a checkpoint has no policy.
        files = [path for path in folder.glob("*.pt") if not path.name.startswith("replay_")]
        files.sort(key=lambda path: checkpoint_number(path.name))
        now = time.time()
        return [(file.name, format_time_ago(int(now - file.stat().st_mtime))) for file in files]

    return CheckpointManager(
        current_name=current,
        fetch_available=fetch_available,
        load_checkpoint=lambda name: load_policy(folder / name),
        run_name=str(folder),
    )


def checkpoint_number(name: str) -> int:
    """Return the number after the first underscore of a checkpoint's name, or 0."""
    match = re.match(r"[^_]*_(\d+)", name)
    return int(match.group(1)) if match else 0


def format_time_ago(seconds: int) -> str:
    """Return a time span as `12s ago`, `5m ago`, `2h ago` or `3d ago`."""
    for unit, length in (("d", 86400), ("h", 3600), ("m", 60)):
        if seconds >= length:
            return f"{int(seconds // length)}{unit} ago"
    return f"{max(int(seconds), 0)}s ago"


class CheckpointPanel:
    """List, Sync and Use Latest. What goes wrong is shown here and ends nothing."""

    def __init__(
        self,
        server: viser.ViserServer,
        manager: CheckpointManager,
        request_load: Callable[[str], None],
    ):
        """Add the panel to the current place in the page and list what there is.

        Args:
            server: The page's server.
            manager: Lists and loads checkpoints.
            request_load: Asks the main thread to load a checkpoint by name.
        """
        self._manager = manager
        self._request_load = request_load
        self._labels: dict[str, str] = {}
        # Setting the list's value calls its callback, as a person's choice does.
        self._silent = threading.local()
        gui = server.gui
        self._about = gui.add_markdown("")
        self._choice = gui.add_dropdown("Checkpoint", [_NONE_FOUND])
        self._message = gui.add_html("")
        latest = gui.add_button("Use Latest", icon=viser.Icon.PLAYER_TRACK_NEXT)
        sync = gui.add_button("Sync", icon=viser.Icon.REFRESH, hint="Look for new checkpoints.")
        self._choice.on_update(self._chosen)
        latest.on_click(lambda _: self._use_latest())
        sync.on_click(lambda _: self.refresh())
        self.refresh()
        self.select(manager.current_name)

    def refresh(self) -> None:
        """List the source again, keeping the choice where it still exists."""
        try:
            checkpoints = self._manager.fetch_available()
        except Exception as error:
            log.exception("Cannot list checkpoints.")
            self.show_error(f"Cannot list checkpoints: {error}")
            return
        self._about.content = _describe(self._manager)
        chosen = self._labels.get(self._choice.value)
        # The newest first: that is the one people look for.
        self._labels = {
            f"{name} ({age})" if age else name: name for name, age in reversed(checkpoints)
        }
        self._quietly("options", list(self._labels) or [_NONE_FOUND])
        self.select(chosen or self._manager.current_name)
        self._show(f"{len(checkpoints)} found.")

    def select(self, name: str) -> None:
        """Show `name` as the chosen one, without loading it."""
        for label, candidate in self._labels.items():
            if candidate == name:
                self._quietly("value", label)

    def show_loaded(self, name: str) -> None:
        """Say that `name` is in use."""
        self._manager.current_name = name
        self.select(name)
        self._show(f"Loaded {name}.")

    def show_error(self, message: str) -> None:
        """Say what went wrong."""
        self._show(message, color="#e03131")

    def _show(self, message: str, color: str = "inherit") -> None:
        self._message.content = (
            f'<div style="padding:0 1em;font-size:0.85em;color:{color}">'
            f"{html.escape(message)}</div>"
        )

    def _quietly(self, attribute: str, value: Any) -> None:
        self._silent.on = True
        try:
            setattr(self._choice, attribute, value)
        finally:
            self._silent.on = False

    def _chosen(self, _: Any) -> None:
        name = self._labels.get(self._choice.value)
        if name is not None and not getattr(self._silent, "on", False):
            self._request_load(name)

    def _use_latest(self) -> None:
        self.refresh()
        if self._labels:
            self._request_load(next(iter(self._labels.values())))


def _describe(manager: CheckpointManager) -> str:
    if manager.run_name is None:
        return "**Local checkpoints**"
    name = f"`{manager.run_name}`"
    if manager.run_url is not None:
        name = f"[{manager.run_name}]({manager.run_url})"
    status = "" if manager.run_status is None else f" ({manager.run_status})"
    return f"**Run:** {name}{status}"
