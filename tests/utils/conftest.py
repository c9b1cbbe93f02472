"""Fixtures shared by the tests of files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

_OTHER_USER = 54321


@pytest.fixture
def plant(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path, Path | None], None]:
    """Make a folder, or a link to a target, that belongs to another user."""

    def make(path: Path, target: Path | None = None) -> None:
        if target is None:
            path.mkdir()
        else:
            path.symlink_to(target)
        # Only root can give a file away; others become the other user.
        if os.geteuid() == 0:
            os.chown(path, _OTHER_USER, _OTHER_USER, follow_symlinks=False)
        else:
            monkeypatch.setattr(os, "geteuid", lambda: _OTHER_USER)

    return make
