"""Settings of torch that hold for the whole process, and tensors that do."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Generator
from typing import Any

import torch

from mjlab.utils.processes import cores_per_process

# Multiply-adds of one mini-batch (forward) above which several threads pay off. Measured: two
# threads update 64x64 networks on 4096 rows (0.04e9) in 0.75 of the time of one thread on a quiet
# machine, but in 5 to 40 times of it when anything else runs, because the threads of OpenMP wait
# for each other by spinning.
_WORTH_SEVERAL_THREADS = 0.4e9
_MOST_THREADS = 8
_TORCHRUN_VARIABLE = "TORCHELASTIC_RUN_ID"


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


@contextlib.contextmanager
def threads_for_policy(policy: Any, batch_size: int, device: Any) -> Generator[None]:
    """Let torch use as many threads within the block as playing `policy` is worth.

    Args:
        policy: A module, a method of one, or any function; one that is no module counts as small.
        batch_size: Rows of an observation: the number of environments.
        device: Where the policy runs. On a GPU nothing is changed.

    Raises:
        ValueError: `MJLAB_TORCH_THREADS` or `OMP_NUM_THREADS` is no positive whole number.
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
    """Let torch use `count` threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def torch_threads(num_parameters: int, batch_size: int) -> int:
    """Return the number of threads for networks of this many parameters and rows per mini-batch.

    It depends on the machine, the networks and the batch only, never on the threads of the
    physics: sums are split among threads, so their number decides the last bits of the weights.
    Several processes of a run on one machine share its cores. `MJLAB_TORCH_THREADS` overrides it;
    `OMP_NUM_THREADS` limits it.
    """
    if override := os.environ.get("MJLAB_TORCH_THREADS"):
        return _positive("MJLAB_TORCH_THREADS", override)
    if num_parameters * batch_size < _WORTH_SEVERAL_THREADS:
        return 1
    limit = os.environ.get("OMP_NUM_THREADS")
    if limit == "1" and _TORCHRUN_VARIABLE in os.environ:
        # torchrun sets this for all that it starts, unasked; the cores are shared out here.
        limit = None
    most = _positive("OMP_NUM_THREADS", limit) if limit else _MOST_THREADS
    return max(1, min(cores_per_process(), most))


def _positive(name: str, value: str) -> int:
    if not value.isdigit() or int(value) < 1:
        raise ValueError(f"{name} is {value!r}; it must be a positive whole number.")
    return int(value)
