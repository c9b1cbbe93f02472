"""Playing an exported policy: the graph of the ONNX file, computed by torch.

So no ONNX runtime has to be installed, and one file plays in any number of environments, although
it is exported for one. It covers networks of fully connected layers, image encoders, LSTMs and GRUs.

Only what the actions follow from is computed. A file may have further outputs, and inputs that these
depend on: exported policies of motion tracking return the reference at an input `time_step`, which is
of use on a robot, and which an environment has itself.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.exporter_utils import (
    DIGEST_KEY,
    get_base_metadata,
    initializers_digest,
    metadata_texts,
)
from mjlab.rl.onnx_operators import (
    OPERATORS,
    ROW_WISE,
    Operator,
    attribute_value,
    identity,
    tensor_value,
)

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)

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
# Files without these are of policies that see no gait clock.
_CLOCK = ("clock_frequency", "clock_fade_s", "clock_standing_threshold", "clock_starts")
_ACTIONS = "actions"
_RELATIVE_TOLERANCE = 0.01
_ABSOLUTE_TOLERANCE = 6e-4


class OnnxPolicyError(CheckpointError):
    """Raised for a file that is no policy that can be played here; the text says why."""


@dataclass(frozen=True)
class _Step:
    """One node of the graph."""

    operator: Operator
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: dict[str, Any]

    def compute(self, values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the outputs by name, from the values of the graph."""
        inputs = [values[name] if name else None for name in self.inputs]
        results = self.operator(*inputs, **self.attributes)
        # An operator may have more results than the graph reads.
        return dict(zip(self.outputs, results if isinstance(results, tuple) else (results,)))  # noqa: B905


class OnnxPolicy(torch.nn.Module):
    """A policy that was exported to ONNX, for any number of environments.

    Called with observations, it returns actions (N, num_actions). One with a memory remembers what it
    was called with before, until `reset`.

    Attributes:
        metadata: What the file says about itself; see `mjlab.rl.exporter_utils`.
        num_observations: Size of the flat observation of one environment; 0 if it sees images only.
        num_actions: Size of the action of one environment.
        image_shapes: For each group of images that it sees, (channels, height, width).
    """

    def __init__(self, path: str | Path, device: str = "cpu") -> None:
        """Read the file.

        Args:
            path: The ONNX file.
            device: Torch device to compute on.

        Raises:
            OnnxPolicyError: the file is missing, no ONNX file, has no output that is called
                `actions` nor only one; or the actions depend on other inputs than a flat
                observation, images and a memory, or on an operator that is not known here.
        """
        super().__init__()
        self.path = Path(path)
        model = _load(self.path)
        self.metadata: dict[str, str] = {item.key: item.value for item in model.metadata_props}
        self._compare_digests()
        self._constants = torch.nn.ParameterDict()
        self._names: dict[str, str] = {}
        # Sizes and axes, which stay on the CPU, where they are looked at.
        self._integers: dict[str, torch.Tensor] = {}
        output = self._find_output(model.graph)
        # Inputs of what is remembered, with the outputs that they are next. Named as rsl_rl does.
        outputs = {item.name for item in model.graph.output}
        inputs = {item.name: _dims(item) for item in model.graph.input}
        pairs = (
            (name, f"{name.removesuffix('_in')}_out") for name in inputs if name.endswith("_in")
        )
        self._memories = {before: after for before, after in pairs if after in outputs}
        self._memory_shapes = {name: tuple(inputs[name]) for name in self._memories}
        self._remembered: dict[str, torch.Tensor] = {}
        nodes, needed = _leading_to({output.name, *self._memories.values()}, model.graph.node)
        for initializer in model.graph.initializer:
            if initializer.name in needed:
                self._add_constant(initializer.name, tensor_value(initializer))
        self._state, self.num_observations, self.image_shapes = self._read_inputs(
            model.graph, needed
        )
        self._output = output.name
        self.num_actions = _dims(output)[-1]
        self._steps = [self._read(node) for node in nodes]
        kinds = {node.op_type for node in nodes}
        self._is_row_wise = not self.image_shapes and not self._memories and kinds <= set(ROW_WISE)
        if not self._is_row_wise:
            self._compute_sizes()
        self.requires_grad_(False)
        self.to(device)

    def forward(self, observations: Any) -> torch.Tensor:
        """Return actions (N, num_actions).

        Args:
            observations: The environment's groups of observations, of which those that the policy
                was trained with are taken; or, for a policy without images, a tensor
                (N, num_observations).
        """
        inputs = {name: observations[name] for name in self.image_shapes}
        if self._state is not None:
            inputs[self._state] = self._flat(observations)
        if self._is_row_wise:
            return self._run(inputs)[self._output]
        # The graph is that of one environment, and so it stays: torch adds the batch around it.
        alone = {name: value.unsqueeze(1) for name, value in inputs.items()}
        results = torch.vmap(self._run)(alone | self._memory(alone))
        for before, after in self._memories.items():
            self._remembered[before] = results[after]
        return results[self._output].squeeze(1)

    def reset(self, dones: torch.Tensor | None = None) -> None:
        """Forget what was seen in environments where `dones` (N,) is not 0; None: in all."""
        if dones is None:
            self._remembered.clear()
            return
        for name, value in self._remembered.items():
            ended = (dones != 0).view(-1, *(1 for _ in value.shape[1:]))
            self._remembered[name] = torch.where(ended, 0.0, value)

    def _compare_digests(self) -> None:
        # Not refused, because people optimize graphs.
        written = self.metadata.get(DIGEST_KEY)
        if written is not None and written != initializers_digest(self.path):
            logger.warning(
                "The weights in %s are not those that were exported (%s differs): the file was edited "
                "or damaged.", self.path, DIGEST_KEY,
            )  # fmt: skip

    def _memory(self, inputs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return what is remembered in each environment, (N, *shape) by name; zeros at first."""
        if not self._memories or self._remembered:
            return self._remembered
        like = next(iter(inputs.values()))
        return {
            name: like.new_zeros(len(like), *shape) for name, shape in self._memory_shapes.items()
        }

    def check_fits(self, env: ManagerBasedRlEnv) -> None:
        """Refuse an environment with other observations or actions than those of the training.

        Raises:
            OnnxPolicyError: something differs; the text names all of it.
        """
        differences = self._group_differences(env)
        if not differences:
            wanted = metadata_texts(get_base_metadata(env, "", self._named_groups()))
            own = {key: self.metadata[key] for key in _INTERFACE if key in self.metadata}
            own |= {key: self.metadata.get(key, "") for key in _CLOCK}
            differences = [
                f"{key}: the policy has {value or 'none'}, the environment {wanted.get(key) or 'none'}"
                for key, value in own.items()
                if not _alike(value, wanted.get(key, ""))
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

    def _group_differences(self, env: ManagerBasedRlEnv) -> list[str]:
        """Return, one text each, the groups of observations that the environment has not."""
        groups = self._named_groups() or []
        if not groups and not self.image_shapes:
            return []
        shapes: dict[str, Any] = env.observation_manager.group_obs_dim
        differences = [
            f"observations {name!r}: the environment has no such group"
            for name in groups
            if name not in shapes
        ]
        for name, shape in self.image_shapes.items():
            found = tuple(shapes[name]) if name in shapes else "no such group"
            if found != shape:
                differences.append(
                    f"images {name!r}: the policy has {shape}, the environment {found}"
                )
        return differences

    def _named_groups(self) -> list[str] | None:
        """Return the groups that make up the flat observation, in order, if the file says so."""
        if self._state is None:
            return []
        names = self.metadata.get("observation_group")
        return None if names is None else names.split(",")

    @property
    def groups(self) -> list[str]:
        """The groups of observations that the policy reads."""
        return [*self.image_shapes, *self._flat_groups()]

    def _flat_groups(self) -> list[str]:
        return [] if self._state is None else self._named_groups() or ["actor"]

    def _flat(self, observations: Any) -> torch.Tensor:
        if isinstance(observations, torch.Tensor):
            return observations
        return torch.cat([observations[name] for name in self._flat_groups()], dim=-1)

    def _run(self, inputs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the actions, and what is to be remembered, by name."""
        values = {**inputs, **self._integers}
        for name, key in self._names.items():
            values[name] = self._constants[key]
        for step in self._steps:
            values |= step.compute(values)
        return {name: values[name] for name in (self._output, *self._memories.values())}

    def _compute_sizes(self) -> None:
        """Compute the whole numbers in the graph, which depend on shapes and not on values."""
        values: dict[str, torch.Tensor] = dict(self._integers)
        for name, key in self._names.items():
            values[name] = self._constants[key]
        for name, shape in self.image_shapes.items():
            values[name] = torch.zeros(1, *shape)
        for name, shape in self._memory_shapes.items():
            values[name] = torch.zeros(shape)
        if self._state is not None:
            values[self._state] = torch.zeros(1, self.num_observations)
        remaining = []
        for step in self._steps:
            results = step.compute(values)
            values |= results
            if any(value.is_floating_point() for value in results.values()):
                remaining.append(step)
            else:
                self._integers |= results
        self._steps = remaining

    def _find_output(self, graph: Any) -> Any:
        outputs = {item.name: item for item in graph.output}
        if _ACTIONS not in outputs and len(outputs) != 1:
            raise OnnxPolicyError(
                f"The policy {self.path} has the outputs {list(outputs)}, of which none is called "
                f"{_ACTIONS!r}. Play the checkpoint (model_<iteration>.pt) instead."
            )
        return outputs.get(_ACTIONS, graph.output[0])

    def _read_inputs(
        self, graph: Any, needed: set[str]
    ) -> tuple[str | None, int, dict[str, tuple[int, ...]]]:
        """Return the name and size of the flat input, and the shapes of images by name.

        Of the inputs, only those among `needed` are looked at.
        """
        asked = needed - {*self._names, *self._integers, *self._memories}
        dims = {item.name: _dims(item) for item in graph.input if item.name in asked}
        flat = [name for name, size in dims.items() if len(size) == 2]
        images = {name: tuple(size[1:]) for name, size in dims.items() if len(size) == 4}
        understood = len(flat) <= 1 and len(flat) + len(images) == len(dims) > 0
        if not understood:
            raise OnnxPolicyError(
                f"The actions of the policy {self.path} depend on the inputs {list(dims)} of sizes "
                f"{list(dims.values())}; one flat input, any number of images and a memory (`h_in` "
                "with an output `h_out`) can be played here. Play the checkpoint (model_<iteration>.pt) instead."
            )
        state = flat[0] if flat else None
        return state, 0 if state is None else dims[state][-1], images

    def _add_constant(self, name: str, tensor: torch.Tensor) -> None:
        if not tensor.is_floating_point():
            self._integers[name] = tensor
            return
        # Names of an ONNX graph hold dots and slashes, which torch forbids.
        self._names[name] = key = f"c{len(self._names)}"
        self._constants[key] = torch.nn.Parameter(tensor, requires_grad=False)

    def _read(self, node: Any) -> _Step:
        attributes = {item.name: attribute_value(item) for item in node.attribute}
        if node.op_type == "Constant":
            self._add_constant(node.output[0], attributes["value"])
            return _Step(identity, (node.output[0],), (node.output[0],), {})
        if node.op_type not in OPERATORS:
            raise OnnxPolicyError(
                f"The policy {self.path} uses the operator {node.op_type}, which is not known "
                f"here; known are {sorted(OPERATORS)}. Play the checkpoint "
                "(model_<iteration>.pt) instead."
            )
        return _Step(OPERATORS[node.op_type], tuple(node.input), tuple(node.output), attributes)


def load_onnx_policy(path: Path, env: Any, device: str) -> OnnxPolicy:
    """Return the policy in `path`, which fits the wrapped environment `env`.

    Raises:
        OnnxPolicyError: it cannot be played, or not in this environment.
    """
    try:
        policy = OnnxPolicy(path, device)
        policy.check_fits(env.unwrapped)
        # Once, so that a damaged graph is told before anything is shown or measured.
        shapes = env.unwrapped.observation_manager.group_obs_dim
        policy({name: torch.zeros(2, *shapes[name], device=device) for name in policy.groups})
        policy.reset()
    except OnnxPolicyError:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        raise OnnxPolicyError(
            f"The policy {path} cannot be computed: {reason or type(error).__name__}. The file is "
            "damaged, or not a policy of this environment."
        ) from error
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


def _leading_to(outputs: set[str], nodes: Sequence[Any]) -> tuple[list[Any], set[str]]:
    """Return the nodes from which `outputs` follow, in order, and the names of all that they read."""
    needed, kept = set(outputs), []
    # The nodes of a graph are in the order in which they are computed.
    for node in reversed(nodes):
        if needed.intersection(node.output):
            needed.update(name for name in node.input if name)
            kept.append(node)
    return kept[::-1], needed


def _dims(value: Any) -> list[int]:
    return [int(dim.dim_value) for dim in value.type.tensor_type.shape.dim]


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
