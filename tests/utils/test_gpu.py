"""Choice of GPUs, on a machine whose GPUs are made up."""

from __future__ import annotations

import pytest
import torch

from mjlab.utils.gpu import egl_device_id, select_gpus


@pytest.fixture
def machine(monkeypatch):
    """Return a function that sets the number of GPUs and what the variable says."""

    def configure(count: int, visible: str | None = None) -> None:
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        if visible is not None:
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)

    return configure


@pytest.mark.parametrize(
    ("visible", "gpu_ids", "expected"),
    [
        (None, None, (None, 0)),
        (None, [0], ([0], 1)),
        (None, [2, 1], ([2, 1], 2)),
        (None, "all", ([0, 1, 2, 3], 4)),
        ("3,5", [0], ([3], 1)),
        ("3,5", "all", ([3, 5], 2)),
        ("MIG-a,MIG-b", [1], (["MIG-b"], 1)),
        ("", [0], (None, 0)),
        ("", "all", (None, 0)),
        ("-1", [0], (None, 0)),
        (None, [], (None, 0)),
        ("3,5", [-1], ([5], 1)),
    ],
)
def test_ids_are_positions_among_the_visible(machine, visible, gpu_ids, expected):
    machine(4, visible)
    assert select_gpus(gpu_ids) == expected


@pytest.mark.parametrize("gpu_ids", [[0], [0, 1], "all"])
def test_without_a_gpu_the_cpu_is_used(machine, gpu_ids):
    """The defect: the default [0] failed with an IndexError."""
    machine(0)
    assert select_gpus(gpu_ids) == (None, 0)


@pytest.mark.parametrize(("visible", "gpu_ids"), [(None, [0, 2]), ("6,7", [2]), ("6,7", [-3])])
def test_positions_out_of_range_are_refused_with_the_valid_ones(machine, visible, gpu_ids):
    machine(2, visible)
    with pytest.raises(ValueError, match=rf"GPU \[{gpu_ids[-1]}\].*\[0, 1\]"):
        select_gpus(gpu_ids)


@pytest.mark.parametrize(
    ("visible", "index", "expected"),
    [(None, 1, 1), ("3", 0, 3), ("6,2", 1, 2), ("6,2", 2, None), ("MIG-a", 0, None), ("", 0, None)],
)
def test_rendering_goes_to_the_gpu_as_the_machine_numbers_it(machine, visible, index, expected):
    """The defect: with GPU 3 alone visible, GPU 0 rendered."""
    machine(4, visible)
    assert egl_device_id(index) == expected
