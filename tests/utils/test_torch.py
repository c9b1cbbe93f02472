"""Settings of torch, and constants."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.utils.torch import configure_torch_backends, constant_tensor, prepare_torch

backends: Any = torch.backends


@pytest.fixture(autouse=True)
def _settings():
    before = (backends.cudnn.deterministic, backends.cudnn.benchmark)
    precision = backends.cuda.matmul.fp32_precision
    yield
    backends.cudnn.deterministic, backends.cudnn.benchmark = before
    backends.cuda.matmul.fp32_precision = precision


@pytest.mark.parametrize(("allow", "precision"), [(True, "tf32"), (False, "ieee")])
def test_precision_is_set_everywhere(allow, precision):
    configure_torch_backends(allow_tf32=allow)
    for place in (backends.cuda.matmul, backends.cudnn.conv, backends.cudnn.rnn):
        assert place.fp32_precision == precision


@pytest.mark.parametrize("deterministic", [True, False])
def test_benchmarking_is_the_opposite_of_determinism(deterministic):
    configure_torch_backends(deterministic=deterministic)
    assert backends.cudnn.deterministic is deterministic
    assert backends.cudnn.benchmark is not deterministic


def test_a_process_has_its_own_gpu_as_the_current_one(monkeypatch):
    chosen = []
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    prepare_torch("cpu")
    prepare_torch("cuda:1")
    assert chosen == [torch.device("cuda:1")]
    assert backends.cuda.matmul.fp32_precision == "tf32"


def test_constants_are_made_once_and_serve_gradients_too():
    with torch.inference_mode():
        made = constant_tensor((1.0, 2.0), "cpu")
    assert constant_tensor((1.0, 2.0), "cpu") is made
    assert constant_tensor((1.0, 3.0), "cpu").tolist() == [1.0, 3.0]
    weight = torch.ones(2, requires_grad=True)
    (weight * made).sum().backward()
    assert weight.grad is not None
    assert weight.grad.tolist() == [1.0, 2.0]
