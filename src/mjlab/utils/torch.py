"""Settings of torch that hold for the whole process, and tensors that do."""

from __future__ import annotations

import functools
from typing import Any

import torch


def prepare_torch(device: str) -> None:
    """Configure torch for a process that trains or plays on `device`: its current GPU, and TF32."""
    configure_torch_backends()
    if torch.device(device).type == "cuda":
        # Events, and streams that are asked for without a device, are otherwise those of cuda:0.
        torch.cuda.set_device(torch.device(device))


def configure_torch_backends(allow_tf32: bool = True, deterministic: bool = False) -> None:
    """Set precision and determinism of GPU kernels.

    Args:
        allow_tf32: Let matrix products and convolutions of float32 round to TF32, which is faster.
        deterministic: Let cuDNN choose deterministic algorithms, and not by timing them.
    """
    precision = "tf32" if allow_tf32 else "ieee"
    if hasattr(torch.backends.cuda.matmul, "fp32_precision"):
        # The switches of torch 2.9 on. Torch refuses to mix them with the earlier ones.
        torch.backends.cuda.matmul.fp32_precision = precision
        cudnn: Any = torch.backends.cudnn
        cudnn.conv.fp32_precision = precision
        cudnn.rnn.fp32_precision = precision
    else:
        torch.backends.cuda.matmul.allow_tf32 = allow_tf32
        torch.backends.cudnn.allow_tf32 = allow_tf32
    torch.backends.cudnn.deterministic = deterministic
    torch.backends.cudnn.benchmark = not deterministic


@functools.lru_cache(maxsize=1024)
def constant_tensor(
    values: tuple[Any, ...],
    device: torch.device | str,
    dtype: torch.dtype = torch.float32,
) -> torch.Tensor:
    """Return a tensor of (nested tuples of) numbers; every call returns the same one, to be read only.

    For numbers of configs: a step copies nothing to the device, and edited configs are seen.
    """
    # An inference tensor could not take part in later computations with gradients.
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)
