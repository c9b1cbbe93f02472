"""Shared model fields cannot be written by any torch operation."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from mjlab.sim.simulation import SharedField

WRITES: dict[str, Callable[[torch.Tensor], object]] = {
    "out": lambda field: torch.add(torch.zeros(len(field), 2), 5.0, out=field),
    "out of its own": lambda field: torch.mul(field, 5.0, out=field),
    "out of a view": lambda field: torch.mul(field[0], 5.0, out=field[0]),
    "one of several": lambda field: torch.max(
        torch.full((len(field), 2, 1), 5.0),
        dim=2,
        out=(field, torch.zeros(len(field), 2, dtype=torch.long)),
    ),
    "in place": lambda field: field.mul_(5.0),
    "augmented": lambda field: field.__iadd__(5.0),
    "item": lambda field: field.__setitem__(0, 5.0),
}


# With one environment the tensor has no repeated memory, so torch itself would allow the write.
@pytest.mark.parametrize("nworld", [1, 3])
@pytest.mark.parametrize("write", WRITES.values(), ids=WRITES)
def test_a_write_is_refused_by_name(write, nworld):
    value = torch.ones(2)
    field = SharedField.make(value, nworld, "body_mass")
    with pytest.raises(RuntimeError, match=r"'body_mass' is shared.*expand_model_fields"):
        write(field)
    assert torch.equal(value, torch.ones(2))


def test_results_go_into_tensors_of_others():
    field = SharedField.make(torch.ones(2), 3, "body_mass")
    target = torch.zeros(3, 2)
    torch.mul(field, 2.0, out=target)
    assert torch.equal(target, torch.full((3, 2), 2.0))


def test_results_without_elements_are_plain_tensors():
    # E.g. joint limits of a model without joints: no memory, so all addresses are equal.
    field = SharedField.make(torch.empty(0, 2), 3, "jnt_range")
    limits = field.clone()
    assert type(limits) is torch.Tensor
    limits[..., 0].masked_fill_(torch.ones(3, 0, dtype=torch.bool), -torch.inf)
