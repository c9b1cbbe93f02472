"""ONNX policies: export, deployment metadata, and inference with onnxruntime.

Inputs and outputs of a file have batch size 1, because deployment programs multiply their dimensions.
The graph itself computes any batch size; `OnnxPolicy` runs it for all environments at once. Recurrent
policies have one input and one output per hidden state, with rsl_rl's names: `h_in` and `h_out`, for
LSTMs also `c_in` and `c_out`, (layers, 1, hidden).

Each key of the metadata is one string property of the file; lists are comma-separated. The keys of
mjlab 1.6 come first, in its order and layout; numbers have full precision, and more keys follow:

| key | value |
| --- | --- |
| action_names, action_types, action_entities, action_dims | per action term |
| action_target_names, action_offset, action_clip | per component of the action vector |
| observation_group | observation groups of the policy, concatenated to `obs` in this order |
| image_groups | image groups, each a separate input; omitted without images |
| observation_dims | size of each of its terms, history included |
| observation_delay | minimum and maximum lag of each term, in steps |
| initializers_sha256 | digest of the weights in the file, see `initializers_digest` |
| graph_batch_size | "any": the graph computes more rows than its inputs declare |
| step_dt, physics_dt, decimation | control timestep (s), physics timestep (s), their ratio |
| actuator_delay | minimum and maximum lag of each actuator config of the entity, in physics steps |

The target of an action term is `action * action_scale + action_offset`, clipped to `action_clip`.
Commands generated on the robot, such as the gait clock, export their parameters
(`CommandTerm.export_metadata`):

| key | value |
| --- | --- |
| clock_command | command name of the gait clock |
| clock_frequency, clock_fade_s | stride frequency (Hz), and fade time (s) of the amplitude A from 0 to 1 |
| clock_standing_threshold | A fades to 0 for commanded motion `|c_xy| + |c_z|` below this; 0: never |
| clock_starts | initial phases c (strides) of the clock; empty: any |
| pose_command | command name of the pose command: position, quaternion (w, x, y, z), root frame |
| pose_frame | type and name of the frame that the command moves |
| pose_reference_quat | of the two signs of the command's quaternion, the one closer to this |

The policy observes (A sin(2 pi c), A cos(2 pi c)).
"""

from __future__ import annotations

import hashlib
import io
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.rl.checkpoint import CheckpointError
from mjlab.utils.logging import first_line
from mjlab.utils.os import write_atomically
from mjlab.utils.torch import torch_threads

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

Metadata = dict[str, list | str | float]
logger = logging.getLogger(__name__)

OPSET = 18
DIGEST_KEY = "initializers_sha256"
_BATCH_KEY, _ANY_BATCH = "graph_batch_size", "any"
_ACTIONS = "actions"
# Metadata that must agree between training and inference. Numbers are compared with a tolerance,
# because mjlab 1.6 writes three decimals.
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
# Names, not settings.
_UNCOMPARED = ("run_path", "observation_group")
# Missing in files of policies that do not observe a gait clock.
_CLOCK = ("clock_frequency", "clock_fade_s", "clock_standing_threshold", "clock_starts")
_RELATIVE_TOLERANCE = 0.01
_ABSOLUTE_TOLERANCE = 6e-4


# Export.


def export_with_metadata(
    write: Callable[[str, str], None], metadata: Callable[[], Metadata], path: str
) -> bool:
    """Write a policy as ONNX with deployment metadata; return True if the file was written.

    Failures are logged: a run must not fail because its policy cannot be exported.

    Args:
        write: Export function, called as `write(folder, filename)`.
        metadata: Function that returns the metadata.
        path: ONNX file.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        write(str(target.parent), target.name)
    except Exception as error:
        logger.warning("The policy was not exported to %s: %s", path, error)
        return False
    try:
        digest = {DIGEST_KEY: initializers_digest(path)}
        attach_metadata_to_onnx(path, {**metadata(), **digest})
    except Exception as error:
        logger.warning("The exported policy %s has no metadata: %s", path, error)
    return True


def export_to_onnx(
    model: Any, path: Path, verbose: bool = False, clip_actions: float | None = None
) -> None:
    """Write `model`, the result of rsl_rl's `as_onnx`, to `path`, with batch size 1.

    The graph clips actions to [-clip_actions, clip_actions], as the environment does in training, because
    programs on robots do not.

    The graph computes any batch size, because the export with a dynamic batch dimension keeps reshapes
    from fixing it; `OnnxPolicy` reads such a file for any number of environments. The tracing exporter
    (`dynamo=False`) writes a single file and needs neither the compiler nor onnxscript, whose imports
    alone take longer than the whole export.
    """
    if getattr(model, "obs_dim_1d", None) == 0:
        model = _ImagesOnly(model)
    if clip_actions is not None:
        model = _Clipped(model, clip_actions)
    model.to("cpu")
    model.eval()
    memories = _memories(model.input_names, model.output_names)
    second = {*memories, *memories.values()}
    buffer: Any = io.BytesIO()
    exporter_log = logging.getLogger("torch.onnx")
    level = exporter_log.level
    with warnings.catch_warnings():
        if not verbose:
            warnings.simplefilter("ignore")
            exporter_log.setLevel(logging.ERROR)
        try:
            torch.onnx.export(
                model,
                model.get_dummy_inputs(),
                buffer,
                export_params=True,
                opset_version=OPSET,
                verbose=verbose,
                input_names=model.input_names,
                output_names=model.output_names,
                dynamic_axes={
                    name: {1 if name in second else 0: "batch"}
                    for name in (*model.input_names, *model.output_names)
                },
                dynamo=False,
            )
        finally:
            exporter_log.setLevel(level)
    import onnx

    exported = onnx.load_from_string(buffer.getvalue())
    _declare_batch_size(exported.graph, 1)
    exported.metadata_props.add(key=_BATCH_KEY, value=_ANY_BATCH)
    write_atomically(path, exported.SerializeToString())


def action_limit(path: str | os.PathLike[str]) -> float:
    """Return the bound c of the actions of a graph that clips them to [-c, c]; inf without one.

    Files of earlier versions have none.
    """
    import onnx

    graph = onnx.load(path).graph
    values = {tensor.name: tensor for tensor in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            values[node.output[0]] = node.attribute[0].t
        if node.op_type == "Clip" and _ACTIONS in node.output:
            low, high = (float(onnx.numpy_helper.to_array(values[name])) for name in node.input[1:])
            return max(-low, high)
    return math.inf


class _Clipped(torch.nn.Module):
    """Model whose first output, the actions, is clipped."""

    def __init__(self, model: Any, limit: float) -> None:
        super().__init__()
        self.model, self.limit = model, limit
        self.input_names, self.output_names = model.input_names, model.output_names

    def get_dummy_inputs(self) -> tuple[torch.Tensor, ...]:
        """Return those of the model."""
        return self.model.get_dummy_inputs()

    def forward(self, *inputs: torch.Tensor) -> Any:
        """Return the outputs of the model."""
        outputs = self.model(*inputs)
        if isinstance(outputs, torch.Tensor):
            return outputs.clamp(-self.limit, self.limit)
        actions, *others = outputs
        return actions.clamp(-self.limit, self.limit), *others


class _ImagesOnly(torch.nn.Module):
    """Image model without the empty input for flat observations."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model
        self.input_names = model.input_names[1:]
        self.output_names = model.output_names

    def get_dummy_inputs(self) -> tuple[torch.Tensor, ...]:
        """Return images of zeros."""
        return self.model.get_dummy_inputs()[1:]

    def forward(self, *images: torch.Tensor) -> torch.Tensor:
        """Return the actions for the images of each group."""
        return self.model(images[0].new_zeros(images[0].shape[0], 0), *images)


def _memories(inputs: Iterable[str], outputs: Iterable[str]) -> dict[str, str]:
    """Return the hidden state inputs, each with the output that feeds it in the next step."""
    pairs = {name: f"{name.removesuffix('_in')}_out" for name in inputs if name.endswith("_in")}
    known = set(outputs)
    return {before: after for before, after in pairs.items() if after in known}


def _declare_batch_size(graph: Any, size: int | None) -> None:
    """Set the batch size of inputs and outputs of `graph`, in place. None: dynamic."""
    memories = _memories([item.name for item in graph.input], [item.name for item in graph.output])
    second = {*memories, *memories.values()}
    for value in (*graph.input, *graph.output):
        dim = value.type.tensor_type.shape.dim[1 if value.name in second else 0]
        dim.Clear()
        if size is not None:
            dim.dim_value = size


# Metadata.


def get_base_metadata(
    env: ManagerBasedRlEnv, run_path: str, observation_groups: Sequence[str] | None = None
) -> Metadata:
    """Return the metadata that a deployment needs to run a policy of `env`.

    Args:
        env: Environment; values are those of environment 0.
        run_path: Name of the run, or "local".
        observation_groups: Groups of the policy's flat observation, in order; None: "actor", or the
            first group.

    Joint keys are those of the entity that the actions drive: the entity "robot" if it is
    actuated, else that of the first action term.
    """
    metadata: Metadata = {"run_path": run_path}
    actions = env.action_manager
    terms: dict[str, Any] = {name: actions.get_term(name) for name in actions.active_terms}
    entities = [term.cfg.entity_name for term in terms.values()]
    if entities:
        entity = env.scene["robot" if "robot" in entities else entities[0]]
        metadata.update(_joint_metadata(env, entity))
    metadata["command_names"] = list(env.command_manager.active_terms)
    for name in env.command_manager.active_terms:
        if (term := env.command_manager.get_term(name)) is not None:
            metadata.update(term.export_metadata(name))
    metadata.update(_observation_metadata(env, observation_groups))
    metadata.update(_action_metadata(terms))
    metadata["step_dt"] = shortest(env.step_dt)
    metadata["physics_dt"] = shortest(env.physics_dt)
    metadata["decimation"] = env.cfg.decimation
    if entities:
        cfgs = [actuator.cfg for actuator in entity.actuators]
        metadata["actuator_delay"] = [[cfg.delay_min_lag, cfg.delay_max_lag] for cfg in cfgs]
    return metadata


def joint_gains(entity: Entity, model: Any) -> dict[str, tuple[float, float]]:
    """Return the PD gains kp and kd of each actuated joint, as configured (not as randomized).

    Args:
        entity: Entity with the joints.
        model: Compiled `MjModel` of the scene.
    """
    gains: dict[str, tuple[float, float]] = {}
    affine = 1  # mujoco.mjtBias.mjBIAS_AFFINE
    for name, actuator, element in joint_actuators(entity):
        # The bias of a position or velocity servo is -kp l - kd l'.
        has_gains = int(model.actuator_biastype[element]) == affine
        bias = model.actuator_biasprm[element] if has_gains else np.zeros(3)
        # The gains of a PD law computed outside MuJoCo are in the config, not in the model.
        kp = getattr(actuator.cfg, "stiffness", 0.0 - bias[1])
        kd = getattr(actuator.cfg, "damping", 0.0 - bias[2])
        gains[name] = float(kp), float(kd)
    return gains


def joint_actuators(entity: Entity) -> Iterator[tuple[str, Any, int]]:
    """Yield each actuated joint, its actuator, and the first element of the model that drives it.

    Elements of one joint follow each other; the first holds gains and gear.
    """
    for actuator in entity.actuators:
        if str(getattr(actuator.transmission_type, "value", "joint")) != "joint":
            continue
        elements = actuator.global_element_ids.tolist()
        for k, name in enumerate(actuator.target_names):
            yield name, actuator, elements[k * len(elements) // len(actuator.target_names)]


def _joint_metadata(env: ManagerBasedRlEnv, entity: Entity) -> Metadata:
    """Return names, PD gains as configured (not as randomized) and default positions of joints."""
    gains = joint_gains(entity, env.sim.mj_model)
    actuated = [name for name in entity.joint_names if name in gains]
    default = entity.data.default_joint_pos
    return {
        "joint_names": list(entity.joint_names),
        "joint_stiffness": [gains[name][0] for name in actuated],
        "joint_damping": [gains[name][1] for name in actuated],
        "default_joint_pos": shortest(default[0]) if default is not None else [],
    }


def _observation_metadata(env: ManagerBasedRlEnv, groups: Sequence[str] | None) -> Metadata:
    manager = env.observation_manager
    if groups is None:
        groups = ["actor"] if "actor" in manager.active_terms else list(manager.active_terms)[:1]
    if not groups:
        return {}
    terms = [(group, name) for group in groups for name in manager.active_terms[group]]
    cfgs = [manager.get_term_cfg(group, name) for group, name in terms]
    dims = [dim for group in groups for dim in manager.group_obs_term_dim[group]]
    scales = [torch.as_tensor(1.0 if cfg.scale is None else cfg.scale) for cfg in cfgs]
    return {
        "observation_names": [name for _, name in terms],
        "observation_terms_scale": [
            shortest(scale.flatten() if scale.ndim > 0 else scale) for scale in scales
        ],
        "observation_terms_flatten_history_dim": [cfg.flatten_history_dim for cfg in cfgs],
        "observation_terms_history_length": [cfg.history_length for cfg in cfgs],
        "observation_terms_clip": [
            list(cfg.clip) if cfg.clip is not None else [-np.inf, np.inf] for cfg in cfgs
        ],
        "observation_group": ",".join(groups),
        "observation_dims": [int(np.prod(dim)) for dim in dims],
        "observation_delay": [[cfg.delay_min_lag, cfg.delay_max_lag] for cfg in cfgs],
    }


def _action_metadata(terms: Mapping[str, Any]) -> Metadata:
    scales = [getattr(term, "_scale", 1.0) for term in terms.values()]
    several = len({term.cfg.entity_name for term in terms.values()}) > 1
    components: dict[str, list] = {"names": [], "scale": [], "offset": [], "clip": []}
    for name, term in terms.items():
        prefix = f"{term.cfg.entity_name}/" if several else ""
        targets: list[str] = list(getattr(term, "_target_names", ()))
        if len(targets) != term.action_dim:
            # The term drives no named elements.
            targets = [f"{name}_{k}" for k in range(term.action_dim)]
        clip = getattr(term, "_clip", None)
        components["names"] += [prefix + target for target in targets]
        components["scale"] += _per_component(term, "_scale", 1.0)
        components["offset"] += _per_component(term, "_offset", 0.0)
        components["clip"] += (
            shortest(clip[0])
            if isinstance(clip, torch.Tensor)
            else [[-np.inf, np.inf]] * term.action_dim
        )
    # A scalar for a scalar config value, as mjlab 1.6 writes it.
    single = len(scales) == 1 and isinstance(scales[0], (int, float))
    return {
        "action_scale": float(scales[0]) if single else components["scale"],
        "action_names": list(terms),
        "action_types": [type(term).__name__ for term in terms.values()],
        "action_entities": [term.cfg.entity_name for term in terms.values()],
        "action_dims": [term.action_dim for term in terms.values()],
        "action_target_names": components["names"],
        "action_offset": components["offset"],
        "action_clip": components["clip"],
    }


def _per_component(term: Any, attribute: str, default: float) -> list[float]:
    value = getattr(term, attribute, default)
    if isinstance(value, torch.Tensor):
        row = value[0] if value.ndim > 1 else value
        return shortest(row.expand(term.action_dim))
    return [float(value)] * term.action_dim


def shortest(value: Any) -> Any:
    """Return the shortest decimals that equal `value`, a number or a tensor, in float32.

    0.1 instead of 0.100000001.
    """
    if isinstance(value, torch.Tensor):
        value = value.tolist()
    return [*map(shortest, value)] if isinstance(value, list) else float(str(np.float32(value)))


def attach_metadata_to_onnx(onnx_path: str, metadata: Mapping[str, list | str | float]) -> None:
    """Write `metadata` into the ONNX file; existing keys are replaced.

    The write is atomic.
    """
    import onnx

    model = onnx.load(onnx_path)
    kept = {entry.key: entry.value for entry in model.metadata_props}
    del model.metadata_props[:]
    for key, value in {**kept, **metadata_texts(metadata)}.items():
        model.metadata_props.add(key=key, value=value)
    write_atomically(Path(onnx_path), model.SerializeToString())


def metadata_texts(metadata: Mapping[str, list | str | float]) -> dict[str, str]:
    """Return `metadata` as strings, in the format of the ONNX file."""
    return {
        key: list_to_csv_str(value if isinstance(value, (list, tuple)) else [value], decimals=None)
        for key, value in metadata.items()
    }


def list_to_csv_str(
    arr: Any, *, decimals: int | None = 3, delimiter: str = ",", sub_delimiter: str = ";"
) -> str:
    """Return the items of `arr`, joined by `delimiter`; nested lists by `sub_delimiter`.

    Numbers have `decimals` decimals, booleans as 1 and 0; None: the shortest decimal that reads back
    as the same number. Other items are converted by `str`.
    """
    texts = []
    for item in arr.tolist() if hasattr(arr, "tolist") else arr:
        if isinstance(item, (list, tuple)):
            item = list_to_csv_str(item, decimals=decimals, delimiter=sub_delimiter)
        elif isinstance(item, (bool, int, float, np.bool_, np.number)) and decimals is not None:
            item = f"{item:.{decimals}f}"
        elif isinstance(item, (bool, np.bool_)):
            item = int(item)
        texts.append(str(item))
    return delimiter.join(texts)


def initializers_digest(model: str | Path | Any) -> str:
    """Return the SHA-256 (hexadecimal) of the initializers of an ONNX file: the policy's weights.

    Hashed for each, ordered by name: name, NumPy type and shape, one line each, and the values.

    Args:
        model: ONNX file, or the result of `onnx.load`.
    """
    import onnx

    if isinstance(model, str | Path):
        model = onnx.load(str(model))
    digest = hashlib.sha256()
    for tensor in sorted(model.graph.initializer, key=lambda tensor: tensor.name):
        values = onnx.numpy_helper.to_array(tensor)
        digest.update(f"{tensor.name}\n{values.dtype}\n{values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


# Inference.


class OnnxPolicyError(CheckpointError):
    """ONNX file that is not a policy, or not one for this environment; the message has the reason."""


def load_onnx_policy(
    path: Path, env: Any, device: str, trained: ManagerBasedRlEnvCfg | None = None
) -> OnnxPolicy:
    """Load the policy in `path` and check that it fits the wrapped environment `env`.

    Args:
        path: ONNX file.
        env: Wrapped environment.
        device: Torch device of the policy.
        trained: Training config of the task, whose physics a profile may ease. None: that of `env`.

    Raises:
        OnnxPolicyError: the policy cannot be run, or not in this environment.
    """
    try:
        policy = OnnxPolicy(path, device, env.unwrapped.num_envs)
        policy.check_fits(env.unwrapped, trained)
        if not policy.metadata.keys() & set(_INTERFACE):
            logger.warning(
                "The policy %s has no metadata of observations and actions: their order and scale are "
                "taken from this environment.", path
            )  # fmt: skip
        # One call, so that a damaged graph raises here.
        shapes = env.unwrapped.observation_manager.group_obs_dim
        policy({name: torch.zeros(2, *shapes[name], device=device) for name in policy.groups})
        policy.reset()
    except OnnxPolicyError:
        raise
    except Exception as error:
        raise OnnxPolicyError(
            f"Policy {path} cannot be run: {first_line(error, 400)}. The file is damaged, not a policy of "
            "this environment, or not supported by onnxruntime; play the checkpoint "
            "(model_<iteration>.pt) instead."
        ) from error
    return policy


class OnnxPolicy:
    """ONNX policy for any number of environments, run on the CPU.

    Calls with observations return actions (N, num_actions). Recurrent policies keep their hidden
    state until `reset`. Files of other programs with a fixed batch size of 1, also those of releases
    1.x, are run once per environment.

    Further outputs of a file, and their inputs, are ignored: exported policies of motion tracking
    return the reference at an input `time_step`, for use on a robot; an environment has its own
    reference.

    Attributes:
        metadata: Metadata of the file; see `mjlab.rl.exporter_utils`.
        num_observations: Size of the flat observation of one environment; 0 for images only.
        num_actions: Size of the action of one environment.
        image_shapes: Shape (channels, height, width) of each image group.
        groups: Observation groups of the policy.
    """

    def __init__(self, path: str | Path, device: str = "cpu", num_envs: int = 1) -> None:
        """Read the file.

        Args:
            path: ONNX file.
            device: Torch device of the actions. They are computed on the CPU.
            num_envs: Usual number of environments per call; sets the number of threads.

        Raises:
            OnnxPolicyError: the file is missing, is not an ONNX file, or has several outputs, none
                named `actions`; or the actions depend on inputs other than a flat observation,
                images and a hidden state.
        """
        import onnxruntime

        self.path = Path(path)
        self.device = device
        model = _read_model(self.path)
        self.metadata: dict[str, str] = {item.key: item.value for item in model.metadata_props}
        if self.metadata.get(_BATCH_KEY) == _ANY_BATCH:
            _declare_batch_size(model.graph, None)
        outputs = {item.name: _dims(item) for item in model.graph.output}
        if _ACTIONS not in outputs and len(outputs) != 1:
            raise OnnxPolicyError(
                f"Policy {self.path}: expected an output {_ACTIONS!r}, got outputs {list(outputs)}; play "
                "the checkpoint (model_<iteration>.pt) instead."
            )
        actions = _ACTIONS if _ACTIONS in outputs else next(iter(outputs))
        self.num_actions = outputs[actions][-1]
        self._memories = _memories((item.name for item in model.graph.input), outputs)
        self._outputs = [actions, *self._memories.values()]
        _keep_only(model.graph, self._outputs)
        self._read_inputs(model.graph)
        # Groups of the flat observation, in order; None if the file does not name its groups.
        self._named_groups: list[str] | None = None
        if self._state is None:
            self._named_groups = []
        elif "observation_group" in self.metadata:
            self._named_groups = self.metadata["observation_group"].split(",")
        self._flat_groups = ["actor"] if self._named_groups is None else self._named_groups
        self.groups = [*self.image_shapes, *self._flat_groups]
        self._memory: dict[str, np.ndarray] = {}
        options = onnxruntime.SessionOptions()
        weights = sum(math.prod(tensor.dims) for tensor in model.graph.initializer)
        options.intra_op_num_threads = torch_threads(weights, 1 if self._is_for_one else num_envs)
        # Spinning threads would take cores from the physics.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # Fatal errors only: errors are raised as exceptions.
        options.log_severity_level = 4
        graph = model.SerializeToString()
        # Also within branches and functions.
        self._may_be_endless = b"Loop" in graph
        self._session = onnxruntime.InferenceSession(
            graph, options, providers=["CPUExecutionProvider"]
        )

    def __call__(self, observations: Any) -> torch.Tensor:
        """Return actions (N, num_actions).

        Args:
            observations: Observation groups of the environment, a superset of `groups`; or, for a
                policy without images, a tensor (N, num_observations).
        """
        shown = {name: observations[name] for name in self.image_shapes}
        if self._state is not None:
            shown[self._state] = (
                observations
                if isinstance(observations, torch.Tensor)
                else torch.cat([observations[name] for name in self._flat_groups], dim=-1)
            )
        inputs = {
            name: value.detach().to("cpu", torch.float32).numpy() for name, value in shown.items()
        }
        count = len(next(iter(inputs.values())))
        if not self._memory:
            self._memory = {
                name: np.zeros((layers, count, *rest), np.float32)
                for name, (layers, _, *rest) in self._memory_shapes.items()
            }
        results = []
        for row in range(count) if self._is_for_one else (None,):
            rows = slice(None) if row is None else slice(row, row + 1)
            feed = {name: value[rows] for name, value in inputs.items()}
            feed |= {name: value[:, rows] for name, value in self._memory.items()}
            results.append(self._run(feed))
        actions, *memories = (
            np.concatenate(parts, axis=0 if k == 0 else 1)
            for k, parts in enumerate(zip(*results, strict=True))
        )
        self._memory = dict(zip(self._memories, memories, strict=True))
        return torch.from_numpy(actions).to(self.device)

    def _run(self, feed: dict[str, np.ndarray]) -> Any:
        """Run the graph once. An endless loop ends when the main thread is interrupted."""
        if not self._may_be_endless:
            return self._session.run(self._outputs, feed)
        import onnxruntime

        options = onnxruntime.RunOptions()
        # Python handles signals in the main thread only, and only between calls.
        with ThreadPoolExecutor(1) as worker:
            try:
                call = worker.submit(self._session.run, self._outputs, feed, options)
                # On Windows, Ctrl-C does not end a wait.
                while not wait([call], timeout=0.1).done:
                    pass
            except BaseException:
                options.terminate = True
                raise
            return call.result()

    def reset(self, dones: torch.Tensor | None = None) -> None:
        """Clear the hidden state of environments with nonzero `dones` (N,). None: all."""
        if dones is None:
            self._memory.clear()
            return
        ended = (dones != 0).cpu().numpy()
        for value in self._memory.values():
            value[:, ended] = 0.0

    def check_fits(
        self, env: ManagerBasedRlEnv, trained: ManagerBasedRlEnvCfg | None = None
    ) -> None:
        """Check that observations and actions of `env` are those of the training.

        Other differences from what the file records are one warning: physics, delays, gains, ...
        Timesteps of the physics may also be those of `trained`, the training config of the task.

        Raises:
            OnnxPolicyError: observations or actions differ; the message lists all differences.
        """
        others: list[str] = []
        shapes: dict[str, Any] = env.observation_manager.group_obs_dim
        differences = [
            f"observations {name!r}: the policy has {shape or 'a flat group'}, the environment "
            f"{shapes.get(name, 'no such group')}"
            for name, shape in (dict.fromkeys(self._named_groups or ()) | self.image_shapes).items()
            if name not in shapes or shape not in (None, tuple(shapes[name]))
        ]
        if not differences:
            expected = metadata_texts(get_base_metadata(env, "", self._named_groups))
            eased = {}
            if trained is not None:
                eased = {
                    "physics_dt": trained.sim.mujoco.timestep,
                    "decimation": trained.decimation,
                }
            known = {*expected, *_INTERFACE}.intersection(self.metadata).difference(_UNCOMPARED)
            for key in sorted({*known, *_CLOCK}):
                value, now = self.metadata.get(key, ""), expected.get(key, "")
                if not _alike(value, now) and not _alike(value, str(eased.get(key, now))):
                    kind = differences if key in (*_INTERFACE, *_CLOCK) else others
                    kind.append(
                        f"{key}: the policy has {value or 'none'}, the environment {now or 'none'}"
                    )
        sizes = env.action_manager.total_action_dim
        if sizes != self.num_actions:
            differences.append(f"actions: the policy has {self.num_actions}, not {sizes}")
        if differences:
            raise OnnxPolicyError(
                f"Policy {self.path} was trained in a different environment. "
                + "; ".join(differences)
                + "."
            )
        if others:
            logger.warning(
                "Policy %s was trained with other settings. %s.", self.path, "; ".join(others)
            )

    def _read_inputs(self, graph: Any) -> None:
        inputs = {item.name: _dims(item) for item in graph.input}
        self._memory_shapes = {name: inputs.pop(name) for name in self._memories}
        flat = [name for name, dims in inputs.items() if len(dims) == 2]
        self._state = flat[0] if flat else None
        self.num_observations = inputs[flat[0]][-1] if flat else 0
        self.image_shapes = {
            name: tuple(dims[1:]) for name, dims in inputs.items() if len(dims) == 4
        }
        batches = [size for dims in inputs.values() for size in dims[:1]]
        batches += [size for dims in self._memory_shapes.values() for size in dims[1:2]]
        is_known = len(flat) <= 1 and len(flat) + len(self.image_shapes) == len(inputs) > 0
        if not is_known or max(batches) > 1:
            raise OnnxPolicyError(
                f"Policy {self.path}: expected at most one flat input, any number of images and a hidden "
                "state (`h_in` with an output `h_out`), with batch size 1 or dynamic, got inputs "
                f"{list(inputs)} of sizes {list(inputs.values())}; play the checkpoint "
                "(model_<iteration>.pt) instead."
            )
        # The size of a dynamic dimension reads 0.
        self._is_for_one = max(batches) == 1


def _read_model(path: Path) -> Any:
    import onnx

    try:
        model = onnx.load(str(path))
        if not model.graph.node:
            raise ValueError("it has no graph.")
    except Exception as error:
        raise OnnxPolicyError(
            f"Policy {path} is not an ONNX file that can be read: {first_line(error, 400)}"
        ) from error
    # A warning only, because users optimize graphs.
    written = {item.key: item.value for item in model.metadata_props}.get(DIGEST_KEY)
    if written is not None and written != initializers_digest(model):
        logger.warning(
            "The weights in %s are not those exported (%s differs): the file was edited or damaged.",
            path, DIGEST_KEY,
        )  # fmt: skip
    return model


def _keep_only(graph: Any, outputs: Sequence[str]) -> None:
    """Remove from `graph`, in place, all nodes, weights and inputs that `outputs` do not depend on."""
    needed = set(outputs)
    # Nodes of a graph are in order of computation.
    for index in reversed(range(len(graph.node))):
        node = graph.node[index]
        if needed.intersection(node.output):
            needed.update(node.input)
        else:
            del graph.node[index]
    # Earlier versions of the format also list weights as inputs.
    weights = {tensor.name for tensor in graph.initializer}
    for values, kept in ((graph.initializer, needed), (graph.input, needed - weights)):
        for index in reversed(range(len(values))):
            if values[index].name not in kept:
                del values[index]
    for index in reversed(range(len(graph.output))):
        if graph.output[index].name not in outputs:
            del graph.output[index]


def _dims(value: Any) -> list[int]:
    return [int(dim.dim_value) for dim in value.type.tensor_type.shape.dim]


def _alike(one: str, other: str) -> bool:
    """Return True if two properties agree: words exactly, numbers within a tolerance."""
    if one == other:
        return True
    ours, theirs = one.replace(";", ",").split(","), other.replace(";", ",").split(",")
    if len(ours) == 1 and len(theirs) > 1:
        # A scalar applies to all components.
        ours *= len(theirs)
    try:
        return len(ours) == len(theirs) and all(
            math.isclose(a, b, rel_tol=_RELATIVE_TOLERANCE, abs_tol=_ABSOLUTE_TOLERANCE)
            for a, b in zip(map(float, ours), map(float, theirs), strict=True)
        )
    except ValueError:
        return ours == theirs
