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
from typing import TYPE_CHECKING, Any, Protocol

import viser

if TYPE_CHECKING:
    from mjlab.viewer.base import PolicyProtocol

log = logging.getLogger(__name__)

_NONE_FOUND = "(none)"


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that can be chosen."""

    name: str
    """File name, which `load` takes."""
    modified: float | None = None
    """When it was written, in seconds since 1970."""

    def label(self, now: float) -> str:
        """Name and age, as the list shows it."""
        return self.name if self.modified is None else f"{self.name} ({age(now - self.modified)})"


class CheckpointSource(Protocol):
    """Where checkpoints come from: a run folder, a W&B run, ..."""

    @property
    def description(self) -> str:
        """Markdown that names the source, its status, a link."""
        ...

    def available(self) -> list[Checkpoint]:
        """What there is now, oldest first. Called outside the main thread."""
        ...

    def load(self, name: str) -> PolicyProtocol:
        """The policy of one of them. Called in the main thread."""
        ...


class LocalCheckpoints:
    """The `*.pt` files of a run folder."""

    def __init__(
        self,
        folder: Path,
        load_policy: Callable[[Path], PolicyProtocol],
        current: str | None = None,
    ):
        """List `folder`, load with `load_policy`; `current` is the file in use at the start."""
        self.folder = Path(folder)
        self.current = current
        self._load_policy = load_policy

    @property
    def description(self) -> str:
        return f"**Local:** `{self.folder}`"

    def available(self) -> list[Checkpoint]:
        files = sorted(self.folder.glob("*.pt"), key=lambda path: checkpoint_number(path.name))
        return [Checkpoint(path.name, path.stat().st_mtime) for path in files]

    def load(self, name: str) -> PolicyProtocol:
        return self._load_policy(self.folder / name)


def checkpoint_number(name: str) -> int:
    """The number after the first underscore of a checkpoint's name; 0 where there is none."""
    match = re.match(r"[^_]*_(\d+)", name)
    return int(match.group(1)) if match else 0


def age(seconds: float) -> str:
    """A time span as `12s ago`, `5m ago`, `2h ago` or `3d ago`."""
    for unit, length in (("d", 86400), ("h", 3600), ("m", 60)):
        if seconds >= length:
            return f"{int(seconds // length)}{unit} ago"
    return f"{max(int(seconds), 0)}s ago"


class CheckpointPanel:
    """List, Sync and Use Latest. What goes wrong is shown here and ends nothing."""

    def __init__(
        self,
        server: viser.ViserServer,
        source: CheckpointSource,
        request_load: Callable[[str], None],
    ):
        """Add the panel to the current place in the page and list what there is.

        Args:
            server: The page's server.
            source: Where checkpoints come from.
            request_load: Asks the main thread to load a checkpoint by name.
        """
        self._source = source
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
        self.select(getattr(source, "current", None))

    def refresh(self) -> None:
        """List the source again, keeping the choice where it still exists."""
        try:
            checkpoints = self._source.available()
            self._about.content = self._source.description
        except Exception as error:
            log.exception("Cannot list checkpoints.")
            self.show_error(f"Cannot list checkpoints: {error}")
            return
        now = time.time()
        chosen = self._labels.get(self._choice.value)
        # The newest first: that is the one people look for.
        self._labels = {item.label(now): item.name for item in reversed(checkpoints)}
        self._quietly("options", list(self._labels) or [_NONE_FOUND])
        self.select(chosen)
        self._show(f"{len(checkpoints)} found.")

    def select(self, name: str | None) -> None:
        """Show `name` as the chosen one, without loading it."""
        for label, candidate in self._labels.items():
            if candidate == name:
                self._quietly("value", label)

    def show_loaded(self, name: str) -> None:
        """Say that `name` is in use."""
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
