"""Operators of ONNX in torch, as far as exported policies use them.

Each takes the operator's inputs in order (None for one that is left out) and its attributes by
name. https://onnx.ai/onnx/operators/
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch.nn import functional

Operator = Callable[..., torch.Tensor | tuple[torch.Tensor, ...]]

# ONNX's numbers of types that a graph may cast to.
_TYPES = {1: torch.float32, 6: torch.int32, 7: torch.int64, 9: torch.bool, 11: torch.float64}
_PAD_MODES = {"constant": "constant", "reflect": "reflect", "edge": "replicate", "wrap": "circular"}


def _gemm(
    a: torch.Tensor,
    b: torch.Tensor,
    c: torch.Tensor | None = None,
    alpha: float = 1.0,
    beta: float = 1.0,
    transA: int = 0,
    transB: int = 0,
) -> torch.Tensor:
    product = alpha * ((a.mT if transA else a) @ (b.mT if transB else b))
    return product if c is None else product + beta * c


def _clip(
    x: torch.Tensor, low: torch.Tensor | None = None, high: torch.Tensor | None = None
) -> torch.Tensor:
    return x if low is None and high is None else torch.clamp(x, low, high)


def identity(x: torch.Tensor) -> torch.Tensor:
    """Return `x`."""
    return x


def _leaky_relu(x: torch.Tensor, alpha: float = 0.01) -> torch.Tensor:
    return functional.leaky_relu(x, alpha)


def _selu(x: torch.Tensor, alpha: float = 1.67326319, gamma: float = 1.05070102) -> torch.Tensor:
    return gamma * functional.elu(x, alpha)


def _concat(*parts: torch.Tensor, axis: int) -> torch.Tensor:
    return torch.cat(parts, dim=axis)


# Images: batches of (1, channels, height, width).


def _both_sides(x: torch.Tensor, pads: list[int], value: float) -> tuple[torch.Tensor, list[int]]:
    """Return what torch needs to pad by `pads` (top, left, bottom, right): the same on both sides."""
    top, left, bottom, right = pads
    if (top, left) == (bottom, right):
        return x, [top, left]
    return functional.pad(x, (left, right, top, bottom), value=value), [0, 0]


def _conv(
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None = None,
    *,
    kernel_shape: list[int] | None = None,
    pads: list[int] = [0, 0, 0, 0],  # noqa: B006
    strides: list[int] = [1, 1],  # noqa: B006
    dilations: list[int] = [1, 1],  # noqa: B006
    group: int = 1,
) -> torch.Tensor:
    x, padding = _both_sides(x, pads, 0.0)
    return functional.conv2d(x, weight, bias, strides, padding, dilations, group)


def _max_pool(
    x: torch.Tensor,
    *,
    kernel_shape: list[int],
    pads: list[int] = [0, 0, 0, 0],  # noqa: B006
    strides: list[int] = [1, 1],  # noqa: B006
    dilations: list[int] = [1, 1],  # noqa: B006
    ceil_mode: int = 0,
) -> torch.Tensor:
    x, padding = _both_sides(x, pads, -math.inf)
    return functional.max_pool2d(x, kernel_shape, strides, padding, dilations, bool(ceil_mode))


def _global_average_pool(x: torch.Tensor) -> torch.Tensor:
    return x.mean((-2, -1), keepdim=True)


def _layer_norm(
    x: torch.Tensor,
    scale: torch.Tensor,
    bias: torch.Tensor | None = None,
    *,
    axis: int = -1,
    epsilon: float = 1e-5,
    stash_type: int = 1,
) -> torch.Tensor:
    return functional.layer_norm(x, x.shape[axis:], scale, bias, epsilon)


def _pad(
    x: torch.Tensor,
    pads: torch.Tensor,
    value: torch.Tensor | None = None,
    *,
    mode: str = "constant",
) -> torch.Tensor:
    amounts = pads.tolist()
    before, after = amounts[: x.ndim], amounts[x.ndim :]
    # torch counts from the last dimension, and in these modes pads images only.
    sides = [side for k in (-1, -2) for side in (before[k], after[k])]
    if any(before[:-2] + after[:-2]):
        raise ValueError(f"Only height and width can be padded, not by {amounts}.")
    return functional.pad(x, sides, _PAD_MODES[mode], 0.0 if value is None else value.item())


# Memory: sequences of (steps, batch, inputs), in one direction.


def _lstm(
    x: torch.Tensor,
    weight: torch.Tensor,
    recurrence: torch.Tensor,
    bias: torch.Tensor | None = None,
    lengths: None = None,
    hidden: torch.Tensor | None = None,
    cell: torch.Tensor | None = None,
    *,
    hidden_size: int,
) -> tuple[torch.Tensor, ...]:
    zeros = x.new_zeros(1, x.shape[1], hidden_size)
    h, c = ((zeros if state is None else state).squeeze(0) for state in (hidden, cell))
    outputs = []
    for now in x.unbind(0):
        gates = now @ weight[0].mT + h @ recurrence[0].mT
        if bias is not None:
            of_input, of_memory = bias[0].chunk(2)
            gates = gates + of_input + of_memory
        i, o, f, g = gates.chunk(4, dim=-1)
        c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h = torch.sigmoid(o) * torch.tanh(c)
        outputs.append(h)
    return torch.stack(outputs).unsqueeze(1), h.unsqueeze(0), c.unsqueeze(0)


def _gru(
    x: torch.Tensor,
    weight: torch.Tensor,
    recurrence: torch.Tensor,
    bias: torch.Tensor | None = None,
    lengths: None = None,
    hidden: torch.Tensor | None = None,
    *,
    hidden_size: int,
    linear_before_reset: int = 0,
) -> tuple[torch.Tensor, ...]:
    if not linear_before_reset:
        raise ValueError("GRU: expected linear_before_reset=1, as torch exports it, got 0.")
    h = (x.new_zeros(1, x.shape[1], hidden_size) if hidden is None else hidden).squeeze(0)
    of_input, of_memory = (0.0, 0.0) if bias is None else bias[0].chunk(2)
    outputs = []
    for now in x.unbind(0):
        z, r, n = (now @ weight[0].mT + of_input).chunk(3, dim=-1)
        z_h, r_h, n_h = (h @ recurrence[0].mT + of_memory).chunk(3, dim=-1)
        z = torch.sigmoid(z + z_h)
        h = (1.0 - z) * torch.tanh(n + torch.sigmoid(r + r_h) * n_h) + z * h
        outputs.append(h)
    return torch.stack(outputs).unsqueeze(1), h.unsqueeze(0)


# Shapes.


def _flatten(x: torch.Tensor, axis: int = 1) -> torch.Tensor:
    return x.reshape(math.prod(x.shape[:axis]), -1)


def _reshape(x: torch.Tensor, shape: torch.Tensor, allowzero: int = 0) -> torch.Tensor:
    wanted = shape.tolist()
    if not allowzero:
        wanted = [x.shape[k] if size == 0 else size for k, size in enumerate(wanted)]
    return x.reshape(wanted)


def _shape(x: torch.Tensor, start: int = 0, end: int | None = None) -> torch.Tensor:
    return torch.tensor(x.shape[start:end])


def _slice(
    x: torch.Tensor,
    starts: torch.Tensor,
    ends: torch.Tensor,
    axes: torch.Tensor | None = None,
    steps: torch.Tensor | None = None,
) -> torch.Tensor:
    first = starts.tolist()
    chosen = list(range(len(first))) if axes is None else axes.tolist()
    strides = [1] * len(first) if steps is None else steps.tolist()
    for start, end, axis, step in zip(first, ends.tolist(), chosen, strides, strict=True):
        if step < 0:
            # Torch walks forward only.
            size = x.shape[axis]
            kept = range(size)[start : None if end < -size else end : step]
            x = x.index_select(axis, torch.tensor(list(kept), device=x.device))
        else:
            x = x[(slice(None),) * (axis % x.ndim) + (slice(start, end, step),)]
    return x


def _unsqueeze(x: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
    wanted = axes.tolist()
    rank = x.ndim + len(wanted)
    for axis in sorted(axis % rank for axis in wanted):
        x = x.unsqueeze(axis)
    return x


def _squeeze(x: torch.Tensor, axes: torch.Tensor | None = None) -> torch.Tensor:
    return x.squeeze() if axes is None else x.squeeze(tuple(axes.tolist()))


def _transpose(x: torch.Tensor, perm: list[int] | None = None) -> torch.Tensor:
    return x.permute(perm if perm is not None else list(range(x.ndim))[::-1])


def _reduce_sum(
    x: torch.Tensor,
    axes: torch.Tensor | None = None,
    keepdims: int = 1,
    noop_with_empty_axes: int = 0,
) -> torch.Tensor:
    if axes is None or axes.numel() == 0:
        return x if noop_with_empty_axes else x.sum(list(range(x.ndim)), keepdim=bool(keepdims))
    return x.sum(axes.tolist(), keepdim=bool(keepdims))


def _softmax(x: torch.Tensor, axis: int = -1) -> torch.Tensor:
    return torch.softmax(x, dim=axis)


def _constant_of_shape(shape: torch.Tensor, value: torch.Tensor | None = None) -> torch.Tensor:
    value = torch.zeros(1) if value is None else value
    return value.reshape(()).expand(shape.tolist()).clone()


def _cast(x: torch.Tensor, to: int) -> torch.Tensor:
    return x.to(_TYPES[to])


ROW_WISE: Mapping[str, Operator] = {
    "Add": torch.add,
    "Clip": _clip,
    "Concat": _concat,
    "Constant": identity,
    "Div": torch.div,
    "Elu": functional.elu,
    "Erf": torch.erf,
    "Gemm": _gemm,
    "Identity": identity,
    "LeakyRelu": _leaky_relu,
    "MatMul": torch.matmul,
    "Mul": torch.mul,
    "Neg": torch.neg,
    "Relu": torch.relu,
    "Selu": _selu,
    "Sigmoid": torch.sigmoid,
    "Softplus": functional.softplus,
    "Sub": torch.sub,
    "Tanh": torch.tanh,
}
"""Operators that treat each row by itself, so that a graph made for one row takes many."""

OPERATORS: Mapping[str, Operator] = {
    **ROW_WISE,
    "Cast": _cast,
    "ConstantOfShape": _constant_of_shape,
    "Conv": _conv,
    "Flatten": _flatten,
    "GRU": _gru,
    "GlobalAveragePool": _global_average_pool,
    "LSTM": _lstm,
    "LayerNormalization": _layer_norm,
    "MaxPool": _max_pool,
    "Pad": _pad,
    "ReduceSum": _reduce_sum,
    "Reshape": _reshape,
    "Shape": _shape,
    "Slice": _slice,
    "Softmax": _softmax,
    "Squeeze": _squeeze,
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
}
"""All operators that are known."""


def tensor_value(tensor: Any) -> torch.Tensor:
    """Return an ONNX tensor as one of torch."""
    from onnx import numpy_helper

    return torch.from_numpy(numpy_helper.to_array(tensor).copy())


def attribute_value(attribute: Any) -> Any:
    """Return the value of an ONNX attribute: a number, a string, a list of them, or a tensor."""
    from onnx import TensorProto, helper

    value = helper.get_attribute_value(attribute)
    if isinstance(value, TensorProto):
        return tensor_value(value)
    return value.decode() if isinstance(value, bytes) else value
