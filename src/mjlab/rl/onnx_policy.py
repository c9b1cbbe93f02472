"""Playing an exported policy: the graph of the ONNX file, computed by torch.

So no ONNX runtime has to be installed, and one file plays in any number of environments, although
it is exported for one. It covers networks of fully connected layers. Recurrent and convolutional
ones are refused; their checkpoints can be played.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch.nn import functional

from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.exporter_utils import get_base_metadata, metadata_texts

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

_Operator = Callable[..., torch.Tensor]

# What has to be the same where a policy was trained and where it is played. Numbers are compared
# with a tolerance, because mjlab 1.6 writes three decimals.
_INTERFACE = (
    "observation_names",
    "observation_dims",
    "observation_terms_scale",
    "observation_terms_history_length",
    "action_target_names",
    "action_scale",
    "action_offset",
    "default_joint_pos",
    "step_dt",
)
_RELATIVE_TOLERANCE = 0.01
_ABSOLUTE_TOLERANCE = 6e-4


class OnnxPolicyError(CheckpointError):
    """Raised for a file that is no policy that can be played here; the text says why."""


@dataclass(frozen=True)
class _Step:
    """One node of the graph."""

    operator: _Operator
    inputs: tuple[str, ...]
    output: str
    attributes: dict[str, Any]


class OnnxPolicy(torch.nn.Module):
    """A policy that was exported to ONNX, for any number of environments.

    Called with observations, it returns actions (N, num_actions).

    Attributes:
        metadata: What the file says about itself; see `mjlab.rl.exporter_utils`.
        num_observations: Size of the observation of one environment.
        num_actions: Size of the action of one environment.
    """

    def __init__(self, path: str | Path, device: str = "cpu") -> None:
        """Read the file.

        Args:
            path: The ONNX file.
            device: Torch device to compute on.

        Raises:
            OnnxPolicyError: the file is missing, no ONNX file, or has other than one input and one
                output, or an operator that is not known here.
        """
        super().__init__()
        self.path = Path(path)
        model = _load(self.path)
        self.metadata: dict[str, str] = {item.key: item.value for item in model.metadata_props}
        self._constants = torch.nn.ParameterDict()
        self._names: dict[str, str] = {}
        for initializer in model.graph.initializer:
            self._add_constant(initializer.name, initializer)
        inputs = [item for item in model.graph.input if item.name not in self._names]
        if len(inputs) != 1 or len(model.graph.output) != 1:
            raise OnnxPolicyError(
                f"The policy {self.path} has the inputs {[item.name for item in inputs]} and the "
                f"outputs {[item.name for item in model.graph.output]}; one of each can be played "
                "here. Play the checkpoint (model_<iteration>.pt) instead."
            )
        self._input, self._output = inputs[0].name, model.graph.output[0].name
        self.num_observations = _last_dim(inputs[0])
        self.num_actions = _last_dim(model.graph.output[0])
        self._steps = [self._read(node) for node in model.graph.node]
        self.requires_grad_(False)
        self.to(device)

    def forward(self, observations: Any) -> torch.Tensor:
        """Return actions (N, num_actions).

        Args:
            observations: The environment's groups of observations, of which the one that the
                policy was trained with is taken; or a tensor (N, num_observations).
        """
        if not isinstance(observations, torch.Tensor):
            observations = observations[self.metadata.get("observation_group", "actor")]
        values = {self._input: observations}
        for name, key in self._names.items():
            values[name] = self._constants[key]
        for step in self._steps:
            inputs = [values[name] if name else None for name in step.inputs]
            values[step.output] = step.operator(*inputs, **step.attributes)
        return values[self._output]

    def check_fits(self, env: ManagerBasedRlEnv) -> None:
        """Refuse an environment with other observations or actions than those of the training.

        Raises:
            OnnxPolicyError: something differs; the text names all of it.
        """
        wanted = metadata_texts(get_base_metadata(env, ""))
        differences = [
            f"{key}: the policy has {self.metadata[key]}, the environment {wanted[key]}"
            for key in _INTERFACE
            if key in self.metadata and not _alike(self.metadata[key], wanted.get(key, ""))
        ]
        sizes = env.action_manager.total_action_dim
        if sizes != self.num_actions:
            differences.append(f"actions: the policy has {self.num_actions}, not {sizes}")
        if differences:
            raise OnnxPolicyError(
                f"The policy {self.path} was trained for another environment. "
                + "; ".join(differences)
                + "."
            )

    def _add_constant(self, name: str, value: Any) -> None:
        from onnx import numpy_helper

        tensor = torch.from_numpy(numpy_helper.to_array(value).copy())
        # Names of an ONNX graph hold dots and slashes, which torch forbids.
        self._names[name] = key = f"c{len(self._names)}"
        self._constants[key] = torch.nn.Parameter(tensor, requires_grad=False)

    def _read(self, node: Any) -> _Step:
        from onnx import helper

        attributes = {item.name: helper.get_attribute_value(item) for item in node.attribute}
        if node.op_type == "Constant":
            self._add_constant(node.output[0], attributes["value"])
            return _Step(_identity, (node.output[0],), node.output[0], {})
        if node.op_type not in _OPERATORS:
            raise OnnxPolicyError(
                f"The policy {self.path} uses the operator {node.op_type}, which is not known "
                f"here; known are {sorted(_OPERATORS)}. Play the checkpoint "
                "(model_<iteration>.pt) instead."
            )
        return _Step(_OPERATORS[node.op_type], tuple(node.input), node.output[0], attributes)


def load_onnx_policy(path: Path, env: Any, device: str) -> OnnxPolicy:
    """Return the policy in `path`, which fits the wrapped environment `env`.

    Raises:
        OnnxPolicyError: it cannot be played, or not in this environment.
    """
    policy = OnnxPolicy(path, device)
    policy.check_fits(env.unwrapped)
    return policy


def _load(path: Path) -> Any:
    import onnx

    try:
        model = onnx.load(str(path))
    except FileNotFoundError as error:
        raise OnnxPolicyError(f"There is no policy {path}.") from error
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        raise OnnxPolicyError(f"{path} is not an ONNX file that can be read: {reason}") from error
    if not model.graph.node:
        raise OnnxPolicyError(f"{path} is not an ONNX file that can be read: it has no graph.")
    return model


def _last_dim(value: Any) -> int:
    return int(value.type.tensor_type.shape.dim[-1].dim_value)


def _alike(one: str, other: str) -> bool:
    """Whether two properties say the same: words exactly, numbers nearly."""
    ours, theirs = one.replace(";", ",").split(","), other.replace(";", ",").split(",")
    if len(ours) == 1 and len(theirs) > 1:
        # One number for all components.
        ours *= len(theirs)
    return len(ours) == len(theirs) and all(map(_same, ours, theirs))


def _same(one: str, other: str) -> bool:
    try:
        first, second = float(one), float(other)
    except ValueError:
        return one == other
    return math.isclose(first, second, rel_tol=_RELATIVE_TOLERANCE, abs_tol=_ABSOLUTE_TOLERANCE)


# Operators of ONNX, as far as fully connected networks use them: inputs in order, attributes by
# name. https://onnx.ai/onnx/operators/


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


def _identity(x: torch.Tensor) -> torch.Tensor:
    return x


def _leaky_relu(x: torch.Tensor, alpha: float = 0.01) -> torch.Tensor:
    return functional.leaky_relu(x, alpha)


def _selu(x: torch.Tensor, alpha: float = 1.67326319, gamma: float = 1.05070102) -> torch.Tensor:
    return gamma * functional.elu(x, alpha)


def _concat(*parts: torch.Tensor, axis: int) -> torch.Tensor:
    return torch.cat(parts, dim=axis)


_OPERATORS: Mapping[str, _Operator] = {
    "Add": torch.add,
    "Clip": _clip,
    "Concat": _concat,
    "Constant": _identity,
    "Div": torch.div,
    "Elu": functional.elu,
    "Erf": torch.erf,
    "Gemm": _gemm,
    "Identity": _identity,
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
