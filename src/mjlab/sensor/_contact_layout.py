"""Where in `sensordata` a contact sensor's values are, and in which frame."""

from __future__ import annotations

from collections.abc import Iterable

import torch

FIELD_SIZES = {
    "found": 1,
    "force": 3,
    "torque": 3,
    "dist": 1,
    "pos": 3,
    "normal": 3,
    "tangent": 3,
}
"""Values of each field in one slot, in MuJoCo's order of the fields."""


class ContactLayout:
    """One block of `sensordata`: primary by primary, in each slot by slot, in each field by field."""

    def __init__(self, fields: Iterable[str], num_primaries: int, num_slots: int) -> None:
        wanted = set(fields)
        self.num_primaries = num_primaries
        self.num_slots = num_slots
        self.start = 0
        """Column of `sensordata` at which the block begins."""
        self._columns: dict[str, tuple[int, int]] = {}
        column = 0
        for name, size in FIELD_SIZES.items():
            if name in wanted:
                self._columns[name] = (column, size)
                column += size
        self._width_of_slot = column
        self.width = num_primaries * num_slots * column
        """Number of columns."""

    @property
    def field_bits(self) -> int:
        """The fields as MuJoCo's contact sensor takes them: one bit each."""
        return sum(1 << bit for bit, name in enumerate(FIELD_SIZES) if name in self._columns)

    def split(self, block: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return views of the fields of a block (..., width): (..., P S) or (..., P S, 3) each."""
        slots = block.unflatten(-1, (self.num_primaries * self.num_slots, self._width_of_slot))
        return {
            name: slots.select(-1, column) if size == 1 else slots.narrow(-1, column, size)
            for name, (column, size) in self._columns.items()
        }

    def found_first(self, block: torch.Tensor) -> torch.Tensor:
        """Return the view (..., P) of `found` in the first slot of each primary.

        Contacts fill the slots in order, so it tells whether there is any.
        """
        column, _ = self._columns["found"]
        return block[..., column :: self.num_slots * self._width_of_slot]


def to_world(vector: torch.Tensor, normal: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
    """Rotate (..., 3) from a contact frame, given by its first two axes, into the world frame.

    F_w = [n t n x t] F_c. Empty slots are zero before and after.
    """
    x, y, z = vector.unsqueeze(-1).unbind(-2)
    return x * normal + y * tangent + z * torch.linalg.cross(normal, tangent)
