"""Options of a part."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Options:
    """Device, size, output and time limit of a part."""

    device: str
    """Torch device of the Warp engine."""
    tiny: bool
    """Use sizes of a few seconds on a CPU."""
    output: Path
    """Folder of results."""
    seconds: float
    """Time limit of the part."""

    @property
    def on_cuda(self) -> bool:
        """True on a GPU."""
        return self.device.startswith("cuda")

    def sized(self, full: T, tiny: T) -> T:
        """Return the size to use."""
        return tiny if self.tiny else full
