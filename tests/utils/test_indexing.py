"""Environment ids and columns in every form that tensors are indexed with."""

from __future__ import annotations

import pytest
import torch

from mjlab.utils.indexing import (
    as_columns,
    as_ids,
    num_selected,
    read_columns,
    write_columns,
)

MASK = torch.tensor([True, False, False, True])


@pytest.mark.parametrize(
    ("env_ids", "expected"),
    [
        (None, [0, 1, 2, 3]),
        (slice(1, 3), [1, 2]),
        (MASK, [0, 3]),
        (torch.tensor([2, 0], dtype=torch.int32), [2, 0]),
        ([], []),
    ],
)
def test_environment_ids_become_int64_whatever_their_form(env_ids, expected):
    ids = as_ids(env_ids, 4, "cpu")
    assert ids.dtype == torch.int64
    assert ids.tolist() == expected


def test_a_mask_of_another_length_is_an_error():
    with pytest.raises(IndexError):
        as_ids(MASK, 5, "cpu")


@pytest.mark.parametrize(
    ("ids", "expected"),
    [((2, 3, 4), slice(2, 5)), ([], slice(0, 0)), (3, slice(3, 4)), (range(2), slice(0, 2))],
)
def test_consecutive_columns_become_a_slice(ids, expected):
    assert as_columns(ids, "cpu") == expected


@pytest.mark.parametrize("ids", [[2, 1], [0, 2], [1, 1], [-1]])
def test_other_columns_become_int64_ids(ids):
    columns = as_columns(ids, "cpu")
    assert isinstance(columns, torch.Tensor)
    assert columns.dtype == torch.int64
    assert columns.tolist() == ids


def test_columns_of_inference_mode_have_gradients():
    with torch.inference_mode():
        as_columns([7, 5], "cpu")
    source = torch.ones(1, 8, requires_grad=True)
    read_columns(source, as_columns([7, 5], "cpu")).sum().backward()
    assert source.grad is not None
    assert source.grad.sum() == 2


@pytest.mark.parametrize("columns", [[0, 1], [2, 0]])
@pytest.mark.parametrize("env_ids", [None, slice(1, 3), MASK, torch.tensor([3, 1])])
def test_what_is_written_into_columns_is_read_from_them(columns, env_ids):
    target, values = torch.zeros(4, 3), torch.arange(1.0, 9.0).view(4, 2)
    index = as_columns(columns, "cpu")
    write_columns(target, index, values, env_ids)
    ids = as_ids(env_ids, 4, "cpu")
    others = [i for i in range(4) if i not in ids.tolist()]
    assert torch.equal(read_columns(target, index)[ids], values[ids])
    assert not target[others].any()


@pytest.mark.parametrize(("ids", "count"), [(2, 1), ([0, 2], 2), (slice(1, None), 4)])
def test_selected_elements_are_counted(ids, count):
    assert num_selected(ids, 5) == count
