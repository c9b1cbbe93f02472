"""What a deployment has to know about an exported policy, written into the ONNX file.

Each key is one string property of the file; lists are comma-separated. The keys of mjlab 1.6 come
first, in its order and layout; numbers have full precision, and more keys follow:

| key | value |
| --- | --- |
| action_names, action_types, action_entities, action_dims | per action term |
| action_target_names, action_offset, action_clip | per component of the action vector |
| observation_group | the group that the policy reads; several make up `obs` in this order |
| image_groups | the groups of images, each an input of its own; left out where there are none |
| observation_dims | size of each of its terms, history included |
| observation_delay | lowest and highest lag of each term, in steps |
| initializers_sha256 | digest of the weights in the file, see `initializers_digest` |
| step_dt, physics_dt, decimation | control period (s), physics time step (s), their ratio |

A term's target is `action * action_scale + action_offset`, clipped to `action_clip`. Commands that a
deployment generates itself, such as the gait clock, export their parameters (`CommandTerm.export_metadata`):

| key | value |
| --- | --- |
| clock_command | name of the gait clock among the commands |
| clock_frequency, clock_fade_s | strides per second (Hz), and seconds in which the amplitude A goes from 0 to 1 |
| clock_standing_threshold | commanded motion `|c_xy| + |c_z|` below which A falls to 0; 0: it never does |
| clock_starts | phases c (strides) at which the clock starts; empty: any |

The policy observes (A sin(2 pi c), A cos(2 pi c)).
"""

from __future__ import annotations

import hashlib
import io
import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.utils.os import replacing

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
Metadata = dict[str, list | str | float]
DIGEST_KEY = "initializers_sha256"
logger = logging.getLogger(__name__)


def export_with_metadata(
    write: Callable[[str, str], None], metadata: Callable[[], Metadata], path: str
) -> bool:
    """Write a policy as ONNX with all that a deployment needs to know; return whether it was written.

    Failures are logged: a run is not lost because its policy has no ONNX form.

    Args:
        write: Called as `write(folder, filename)`.
        metadata: Returns the metadata.
        path: The file.
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
        logger.warning("The exported policy %s is without metadata: %s", path, error)
    return True


def list_to_csv_str(
    arr: Any, *, decimals: int | None = 3, delimiter: str = ",", sub_delimiter: str = ";"
) -> str:
    """Return the items of `arr`, joined by `delimiter`; nested lists by `sub_delimiter`.

    Numbers get `decimals` decimals, booleans counting as 1 and 0; None writes them in full, as
    short as reads back to the same number. Everything else is `str`.
    """
    return delimiter.join(
        list_to_csv_str(item, decimals=decimals, delimiter=sub_delimiter)
        if isinstance(item, (list, tuple))
        else _item_to_str(item, decimals)
        for item in _as_list(arr)
    )


def _item_to_str(item: Any, decimals: int | None) -> str:
    if not isinstance(item, (bool, int, float, np.bool_, np.number)):
        return str(item)
    if decimals is not None:
        return f"{item:.{decimals}f}"
    if isinstance(item, (bool, np.bool_)):
        return str(int(item))
    return str(item)


def _as_list(values: Any) -> list:
    return values.tolist() if hasattr(values, "tolist") else list(values)


def attach_metadata_to_onnx(onnx_path: str, metadata: Mapping[str, list | str | float]) -> None:
    """Write `metadata` into the ONNX file; keys that it has already are replaced.

    The file is replaced as a whole, so it is never seen half written.
    """
    import onnx

    model = onnx.load(onnx_path)
    kept = {entry.key: entry.value for entry in model.metadata_props}
    del model.metadata_props[:]
    for key, value in {**kept, **metadata_texts(metadata)}.items():
        model.metadata_props.add(key=key, value=value)
    write_atomically(Path(onnx_path), model.SerializeToString())


def initializers_digest(path: str | Path) -> str:
    """Return the SHA-256 (hexadecimal) over the initializers of an ONNX file: the policy's weights.

    Over each, in order of their names: name, NumPy type and shape, a line each, and the values.
    """
    import onnx

    digest = hashlib.sha256()
    initializers = onnx.load(str(path)).graph.initializer
    for tensor in sorted(initializers, key=lambda tensor: tensor.name):
        values = onnx.numpy_helper.to_array(tensor)
        digest.update(f"{tensor.name}\n{values.dtype}\n{values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def metadata_texts(metadata: Mapping[str, list | str | float]) -> dict[str, str]:
    """Return `metadata` as the strings that the ONNX file keeps."""
    return {
        key: list_to_csv_str(value, decimals=None)
        if isinstance(value, (list, tuple))
        else _item_to_str(value, None)
        for key, value in metadata.items()
    }


def write_atomically(path: Path, content: bytes) -> None:
    """Write `content` to `path` through a temporary file in the same folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(content)


def get_base_metadata(
    env: ManagerBasedRlEnv, run_path: str, observation_groups: Sequence[str] | None = None
) -> Metadata:
    """Return what a deployment needs to run a policy of `env`, whatever the task has.

    Args:
        env: The environment; environment 0 stands for all.
        run_path: Name of the run, or "local".
        observation_groups: Groups that make up the policy's flat observation, in order; None takes
            "actor", or the first one.

    Joint keys are those of the entity that the actions drive: the one called "robot" if it is
    among them, else that of the first action term.
    """
    metadata: Metadata = {"run_path": run_path}
    entity = _controlled_entity(env)
    if entity is not None:
        metadata.update(_joint_metadata(env, entity))
    metadata["command_names"] = list(env.command_manager.active_terms)
    for name in env.command_manager.active_terms:
        if (term := env.command_manager.get_term(name)) is not None:
            metadata.update(term.export_metadata(name))
    metadata.update(_observation_metadata(env, observation_groups))
    metadata.update(_action_metadata(env))
    metadata["step_dt"] = _shortest(env.step_dt)
    metadata["physics_dt"] = _shortest(env.physics_dt)
    metadata["decimation"] = env.cfg.decimation
    return metadata


def _action_terms(env: ManagerBasedRlEnv) -> dict[str, Any]:
    return {name: env.action_manager.get_term(name) for name in env.action_manager.active_terms}


def _controlled_entity(env: ManagerBasedRlEnv) -> Entity | None:
    names = [term.cfg.entity_name for term in _action_terms(env).values()]
    if not names:
        return None
    return env.scene["robot" if "robot" in names else names[0]]


def _joint_metadata(env: ManagerBasedRlEnv, entity: Entity) -> Metadata:
    stiffness, damping = _gains_by_joint(env, entity)
    actuated = [name for name in entity.joint_names if name in stiffness]
    default = entity.data.default_joint_pos
    return {
        "joint_names": list(entity.joint_names),
        "joint_stiffness": [stiffness[name] for name in actuated],
        "joint_damping": [damping[name] for name in actuated],
        "default_joint_pos": _numbers(default[0]) if default is not None else [],
    }


def _gains_by_joint(
    env: ManagerBasedRlEnv, entity: Entity
) -> tuple[dict[str, float], dict[str, float]]:
    """Return PD gains as configured (not as randomized) by joint; 0 for an actuator without."""
    stiffness: dict[str, float] = {}
    damping: dict[str, float] = {}
    model = env.sim.mj_model
    for actuator in entity.actuators:
        if str(getattr(actuator.transmission_type, "value", "joint")) != "joint":
            continue
        elements = actuator.global_element_ids.tolist()
        for k, name in enumerate(actuator.target_names):
            # Elements of one target follow each other; the first holds the gains.
            element = elements[k * len(elements) // len(actuator.target_names)]
            kp, kd = _mujoco_gains(model, element)
            # A PD law that is computed outside MuJoCo is not in the model, but in the config.
            stiffness[name] = float(getattr(actuator.cfg, "stiffness", kp))
            damping[name] = float(getattr(actuator.cfg, "damping", kd))
    return stiffness, damping


def _mujoco_gains(model: Any, element: int) -> tuple[float, float]:
    """Return kp and kd of the affine bias -kp l - kd l' of a position or velocity servo."""
    affine = 1  # mujoco.mjtBias.mjBIAS_AFFINE
    if int(model.actuator_biastype[element]) != affine:
        return 0.0, 0.0
    bias = model.actuator_biasprm[element]
    return float(0.0 - bias[1]), float(0.0 - bias[2])


def _observation_metadata(env: ManagerBasedRlEnv, groups: Sequence[str] | None) -> Metadata:
    manager = env.observation_manager
    if groups is None:
        groups = ["actor"] if "actor" in manager.active_terms else list(manager.active_terms)[:1]
    if not groups:
        return {}
    terms = [(group, name) for group in groups for name in manager.active_terms[group]]
    cfgs = [manager.get_term_cfg(group, name) for group, name in terms]
    dims = [dim for group in groups for dim in manager.group_obs_term_dim[group]]
    return {
        "observation_names": [name for _, name in terms],
        "observation_terms_scale": [_scale(cfg.scale) for cfg in cfgs],
        "observation_terms_flatten_history_dim": [cfg.flatten_history_dim for cfg in cfgs],
        "observation_terms_history_length": [cfg.history_length for cfg in cfgs],
        "observation_terms_clip": [
            list(cfg.clip) if cfg.clip is not None else [-np.inf, np.inf] for cfg in cfgs
        ],
        "observation_group": ",".join(groups),
        "observation_dims": [int(np.prod(dim)) for dim in dims],
        "observation_delay": [[cfg.delay_min_lag, cfg.delay_max_lag] for cfg in cfgs],
    }


def _scale(scale: Any) -> float | list[float]:
    if scale is None:
        return 1.0
    if isinstance(scale, torch.Tensor):
        return _numbers(scale) if scale.ndim > 0 else _shortest(scale.item())
    return list(scale) if isinstance(scale, (list, tuple)) else float(scale)


def _action_metadata(env: ManagerBasedRlEnv) -> Metadata:
    terms = _action_terms(env)
    scales = [getattr(term, "_scale", 1.0) for term in terms.values()]
    several = len({term.cfg.entity_name for term in terms.values()}) > 1
    components: dict[str, list] = {"names": [], "scale": [], "offset": [], "clip": []}
    for name, term in terms.items():
        prefix = f"{term.cfg.entity_name}/" if several else ""
        components["names"] += [prefix + target for target in _target_names(name, term)]
        components["scale"] += _per_component(term, "_scale", 1.0)
        components["offset"] += _per_component(term, "_offset", 0.0)
        components["clip"] += _clip_per_component(term)
    # One number where one number was configured, as mjlab 1.6 writes it.
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


def _target_names(name: str, term: Any) -> list[str]:
    """Return what each component drives; terms that drive no named thing number them."""
    names: list[str] = list(getattr(term, "_target_names", ()))
    if len(names) == term.action_dim:
        return names
    return [f"{name}_{k}" for k in range(term.action_dim)]


def _per_component(term: Any, attribute: str, default: float) -> list[float]:
    value = getattr(term, attribute, default)
    if isinstance(value, torch.Tensor):
        row = value[0] if value.ndim > 1 else value
        return _numbers(row.expand(term.action_dim))
    return [float(value)] * term.action_dim


def _clip_per_component(term: Any) -> list[list[float]]:
    clip = getattr(term, "_clip", None)
    if not isinstance(clip, torch.Tensor):
        return [[-np.inf, np.inf]] * term.action_dim
    return [_numbers(bounds) for bounds in clip[0]]


def _numbers(values: torch.Tensor) -> list[float]:
    return [_shortest(value) for value in values.flatten().tolist()]


def _shortest(value: float) -> float:
    """Return the number with the fewest digits that is `value` in float32: 0.1, not 0.100000001."""
    return float(str(np.float32(value)))


# MERGED mjlab.rl.exporter_utils: Export of a network to ONNX.

OPSET = 18


def export_to_onnx(model: Any, path: Path, verbose: bool = False) -> None:
    """Write `model`, what rsl_rl's `as_onnx` returns, to `path` with a batch size of 1.

    The exporter is the one that traces (`dynamo=False`): it needs neither the compiler nor
    onnxscript, whose imports alone take longer than the whole export, and it makes one file.
    """
    if getattr(model, "obs_dim_1d", None) == 0:
        model = _ImagesOnly(model)
    model.to("cpu")
    model.eval()
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
                dynamic_axes={},
                dynamo=False,
            )
        finally:
            exporter_log.setLevel(level)
    write_atomically(path, buffer.getvalue())


class _ImagesOnly(torch.nn.Module):
    """An image model without flat observations, and without the empty input for them."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model
        self.input_names = model.input_names[1:]
        self.output_names = model.output_names

    def get_dummy_inputs(self) -> tuple[torch.Tensor, ...]:
        """Return images of zeros."""
        return self.model.get_dummy_inputs()[1:]

    def forward(self, *images: torch.Tensor) -> torch.Tensor:
        """Return the action for one image of each group."""
        return self.model(images[0].new_zeros(1, 0), *images)
