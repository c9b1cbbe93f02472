"""Process-wide torch settings, constant tensors, and number of threads."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Generator
from typing import Any

import torch

from mjlab.utils.processes import cores_per_process, environment_integer

# Multiply-adds of one mini-batch (forward) above which several threads pay off. Measured: two
# threads update 64x64 networks on 4096 rows (0.04e9) in 0.75 times the time of one thread on an idle
# machine, but in 5 to 40 times that time under load, because OpenMP threads wait for each other by
# spinning.
_WORTH_SEVERAL_THREADS = 0.4e9
_MOST_THREADS = 8
_TORCHRUN_VARIABLE = "TORCHELASTIC_RUN_ID"


def prepare_torch(device: str) -> None:
    """Set the current GPU and enable TF32 for a process that trains or plays on `device`."""
    configure_torch_backends()
    if torch.device(device).type == "cuda":
        # Otherwise events, and streams created without a device, are those of cuda:0.
        torch.cuda.set_device(torch.device(device))


def configure_torch_backends(allow_tf32: bool = True, deterministic: bool = False) -> None:
    """Set precision and determinism of GPU kernels.

    Args:
        allow_tf32: Round float32 matrix products and convolutions to TF32, for speed.
        deterministic: Use deterministic cuDNN algorithms, without benchmarking.
    """
    precision = "tf32" if allow_tf32 else "ieee"
    if hasattr(torch.backends.cuda.matmul, "fp32_precision"):
        # Flags since torch 2.9. Torch raises if they are mixed with the earlier flags.
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
    """Return a cached, read-only tensor of (nested tuples of) numbers.

    For config values: steps copy nothing to the device, and edited configs take effect.
    """
    # Inference tensors cannot be used in later computations with gradients.
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


@contextlib.contextmanager
def threads_for_policy(policy: Any, batch_size: int, device: Any) -> Generator[None]:
    """Set the number of torch threads within the block to suit inference of `policy`.

    Args:
        policy: A module, a method of a module, or a function; functions count as small.
        batch_size: Number of environments.
        device: Device of the policy. No effect for a GPU.

    Raises:
        ValueError: `MJLAB_TORCH_THREADS` or `OMP_NUM_THREADS` is not an integer >= 1.
    """
    if torch.device(device).type != "cpu":
        yield
        return
    module = getattr(policy, "__self__", policy)
    is_module = isinstance(module, torch.nn.Module)
    size = sum(parameter.numel() for parameter in module.parameters()) if is_module else 0
    with using_torch_threads(torch_threads(size, batch_size)):
        yield


@contextlib.contextmanager
def using_torch_threads(count: int) -> Generator[None]:
    """Set the number of torch threads to `count` within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def torch_threads(num_parameters: int, batch_size: int) -> int:
    """Return the number of threads for networks with `num_parameters` and `batch_size` rows.

    The number depends only on machine, networks and batch, not on the physics threads: sums are
    split among threads, so their number affects the last bits of the weights. Processes of a run
    on one machine share its cores. `MJLAB_TORCH_THREADS` overrides the number; `OMP_NUM_THREADS`
    limits it.
    """
    if os.environ.get("MJLAB_TORCH_THREADS"):
        return environment_integer("MJLAB_TORCH_THREADS", 1)
    if num_parameters * batch_size < _WORTH_SEVERAL_THREADS:
        return 1
    limit = environment_integer("OMP_NUM_THREADS", _MOST_THREADS)
    if os.environ.get("OMP_NUM_THREADS") == "1" and _TORCHRUN_VARIABLE in os.environ:
        # torchrun always sets OMP_NUM_THREADS for its workers; cores are divided here instead.
        limit = _MOST_THREADS
    return max(1, min(cores_per_process(), limit))


def to_device(value: Any, device: Any) -> Any:
    """Return `value` with all tensors in its dicts, lists and tuples on `device`."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {key: to_device(item, device) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(to_device(item, device) for item in value)
    return value
