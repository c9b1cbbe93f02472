"""Bundles, each written once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from bundles import write_demo, write_random


@pytest.fixture(scope="session")
def bundle(tmp_path_factory) -> Callable[[str], Path]:
    """Return a function that writes the bundle of a bundled policy, or of a random one of a task."""
    written: dict[str, Path] = {}

    def make(name: str) -> Path:
        if name not in written:
            folder = tmp_path_factory.mktemp("bundles") / "bundle"
            written[name] = (
                write_demo(name, folder) if "-" not in name else write_random(name, folder)
            )
        return written[name]

    return make
