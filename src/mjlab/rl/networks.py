"""Checks of networks against observations, completion of their settings, shared image encoders.

rsl_rl also fails on most of the errors checked here, but later and without naming the setting.
Unknown groups, and encoders without images, are errors of rsl_rl.
"""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Generator, Mapping
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import CNNModel, MLPModel
from rsl_rl.modules import CNN
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict
from torch import nn

from mjlab.rl.learners import drop_unchanged_additions
from mjlab.rl.sac_models import SacActorModel, TwinCriticModel
from mjlab.rl.spatial_softmax import SPATIAL_SOFTMAX_KEYS, cnn_cfg_by_group
from mjlab.utils.errors import check_positive
from mjlab.utils.logging import first_line
from mjlab.utils.memory import check_memory
from mjlab.utils.string import counted

_MODELS = ("actor", "critic", "student", "teacher")
_PACKAGES = ("mjlab", "rsl_rl")
# Rows of the replay that is measured; final observations then take one more row.
_REPLAY_ROWS = 32
_SAC_MODELS = {"actor": SacActorModel, "critic": TwinCriticModel}
_RECURRENT_KEYS = ("rnn_type", "rnn_hidden_dim", "rnn_num_layers")
_CNN_EXAMPLE = (
    "class_name='CNNModel' or 'mjlab.rl.spatial_softmax:SpatialSoftmaxCNNModel', with "
    "cnn_cfg={'output_channels': [16, 32], 'kernel_size': [5, 3], 'stride': [2, 2], "
    "'padding': 'zeros'}"
)
_SYMMETRY_FUNCTION = "data_augmentation_func"
_SYMMETRY_KEYS = {
    _SYMMETRY_FUNCTION, "use_data_augmentation", "use_mirror_loss", "mirror_loss_coeff"
}  # fmt: skip
_SYMMETRY_EXAMPLE = (
    'Example: {"data_augmentation_func": "mjlab.tasks.velocity.symmetry:mirror_left_right", '
    '"use_data_augmentation": True}; None disables it.'
)


def prepare_train_cfg(env: Any, cfg: dict[str, Any]) -> None:
    """Check a runner's config against the observations of `env`, and complete it in place.

    Args:
        env: Environments, as rsl_rl's `VecEnv`.
        cfg: A `RslRlOnPolicyRunnerCfg` as a dict.

    Raises:
        ValueError: see `check_networks` and `check_symmetry`.
    """
    drop_unchanged_additions(cfg)
    observations = env.get_observations()
    for name in _MODELS:
        if not isinstance(model := cfg.get(name), dict):
            continue
        # rsl_rl's constructors accept these keys only if they are used.
        unused = [key for key in ("cnn_cfg", "distribution_cfg") if model.get(key, ...) is None]
        unused += _RECURRENT_KEYS if model.get("rnn_type", ...) is None else ()
        for key in unused:
            model.pop(key, None)
        # Images are never normalized; without other observations, rsl_rl fails.
        groups = (cfg.get("obs_groups") or {}).get(name, ())
        known = [observations[group] for group in groups if group in observations]
        if known and all(value.ndim == 4 for value in known):
            model["obs_normalization"] = False
    check_networks(observations, cfg)
    if cfg["algorithm"].get("share_cnn_encoders"):
        # Required by rsl_rl, but without effect.
        cfg["critic"].setdefault("cnn_cfg", cfg["actor"].get("cnn_cfg"))
    check_symmetry(env, observations, cfg)


def check_networks(observations: TensorDict, cfg: Mapping[str, Any]) -> None:
    """Check that networks can process their observations.

    Args:
        observations: Observations of the environment.
        cfg: Runner config as a dict.

    Raises:
        ValueError: a network does not fit; the message names the setting and a remedy.
    """
    student = cfg.get("student")
    if isinstance(student, dict) and student.get("distribution_cfg") is None:
        raise ValueError(
            "agent.student distribution_cfg: expected a distribution, got None; use "
            "gaussian_distribution(0.1), with the standard deviation of the actions in training."
        )
    check_actor_distribution(cfg)
    shared = bool(cfg["algorithm"].get("share_cnn_encoders"))
    images = {
        model: _check_model(observations, cfg, model)
        for model in _MODELS
        if isinstance(cfg.get(model), dict)
    }
    actor, critic = images.get("actor", []), images.get("critic", [])
    if shared and (not actor or set(actor) != set(critic)):
        raise ValueError(
            "algorithm.share_cnn_encoders: expected actor and critic with image encoders for the same "
            f"groups, got {actor or 'none'} for the actor and {critic or 'none'} for the critic; use "
            "the same image groups in obs_groups and a CNN class for both, or share_cnn_encoders=False."
        )


def check_actor_distribution(cfg: Mapping[str, Any]) -> None:
    """Raise `ValueError` if rsl_rl's or mjlab's algorithms would train a deterministic actor.

    Networks and algorithms of other packages may do without `distribution_cfg`.
    """
    actor = cfg.get("actor")
    if not isinstance(actor, dict) or actor.get("distribution_cfg") is not None:
        return
    model, algorithm = (resolve_callable(part["class_name"]) for part in (actor, cfg["algorithm"]))
    if all(part.__module__.partition(".")[0] in _PACKAGES for part in (model, algorithm)):
        example = "squashed_gaussian()" if model is SacActorModel else "gaussian_distribution()"
        raise ValueError(
            "agent.actor distribution_cfg: expected a distribution to explore with, got None; use "
            f"RslRlModelCfg(distribution_cfg={example}), with the function of mjlab.rl.config."
        )


def check_sizes(env: Any, cfg: Mapping[str, Any], device: str) -> None:
    """Check networks, rollouts and replay against the memory of `device`; see `check_memory`.

    Measured by building the algorithm without allocating memory. Classes of other packages are not
    checked, because they may not support it.

    Raises:
        ValueError: they do not fit.
    """
    parts = [cfg[name] for name in ("algorithm", *_MODELS) if isinstance(cfg.get(name), dict)]
    kinds = [resolve_callable(part["class_name"]) for part in parts]
    if not all(kind.__module__.partition(".")[0] in _PACKAGES for kind in kinds):
        return
    one: dict[str, Any] = {
        **copy.deepcopy(dict(cfg)),
        "multi_gpu": None,
        "torch_compile_mode": None,
    }
    name, steps, rows = "agent num_steps_per_env", cfg["num_steps_per_env"], 1
    one["num_steps_per_env"] = 1
    if "replay_steps" in cfg["algorithm"]:
        name, steps, rows = "SAC replay_steps", cfg["algorithm"]["replay_steps"], _REPLAY_ROWS
        one["algorithm"]["replay_steps"] = rows - 1
    algorithm: Any = kinds[0]
    try:
        # The algorithm that is built for use warns.
        with torch.device("meta"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = algorithm.construct_algorithm(env.get_observations(), env, one, "meta")
    except Exception as error:
        # Parts of other packages may need values, which the meta device lacks.
        if "overflow" not in str(error).lower():
            return
        raise ValueError(
            f"agent networks: expected sizes below 2**63, got {first_line(error)}; use smaller "
            "hidden_dims."
        ) from error
    for field, module in vars(made).items():
        if isinstance(module, nn.Module) and not field.startswith("_"):
            weights = sum(parameter.numel() for parameter in module.parameters())
            check_memory(f"agent.{field} weights", weights, 4, device, "smaller hidden_dims")
    stored = list(vars(made.storage).values())
    stored += [
        part for parts in stored if isinstance(parts, (dict, TensorDict)) for part in parts.values()
    ]
    size = sum(value.nbytes for value in stored if torch.is_tensor(value))
    check_memory(name, steps, size // rows, device, "fewer steps or environments")


def check_mini_batches(num_envs: int, cfg: Mapping[str, Any]) -> None:
    """Warn if PPO's mini-batches outnumber samples: the loss is NaN, or no update is made."""
    algorithm = cfg["algorithm"]
    # Algorithms of other packages may divide their data differently.
    if resolve_callable(algorithm["class_name"]) is not PPO:
        return
    # rsl_rl does not split the steps of an environment for recurrent networks.
    kinds = [resolve_callable(cfg[model]["class_name"]) for model in ("actor", "critic")]
    is_recurrent = any(getattr(kind, "is_recurrent", False) for kind in kinds)
    steps = cfg["num_steps_per_env"]
    most = num_envs if is_recurrent else num_envs * steps
    parts = algorithm.get("num_mini_batches", 1)
    if parts > most:
        of = counted(num_envs, "environment") + ("" if is_recurrent else f" times {steps} steps")
        why = ", which recurrent networks learn from as a whole" if is_recurrent else ""
        warnings.warn(
            f"agent.algorithm num_mini_batches: expected at most {most} ({of}{why}), got {parts}; use "
            "fewer mini-batches, or more environments.",
            UserWarning,
            stacklevel=3,
        )


def check_symmetry(env: Any, observations: Any, cfg: Mapping[str, Any]) -> None:
    """Check the function of `symmetry_cfg` by mirroring the observations once.

    Args:
        env: Environments.
        observations: Observations, a TensorDict of batch size (N,).
        cfg: A `RslRlOnPolicyRunnerCfg` as a dict.

    Raises:
        ValueError: a setting is missing or unknown, the function does not exist, or it does not
            return its input rows and mirrored copies of them.
    """
    symmetry = cfg["algorithm"].get("symmetry_cfg")
    if not symmetry:
        return
    if _SYMMETRY_FUNCTION not in symmetry or not set(symmetry) <= _SYMMETRY_KEYS:
        raise ValueError(
            f"symmetry_cfg: expected {_SYMMETRY_FUNCTION} and optionally "
            f"{', '.join(sorted(_SYMMETRY_KEYS - {_SYMMETRY_FUNCTION}))}, got "
            f"{', '.join(map(str, symmetry))}. {_SYMMETRY_EXAMPLE}"
        )
    try:
        function = resolve_callable(symmetry[_SYMMETRY_FUNCTION])
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"symmetry_cfg {_SYMMETRY_FUNCTION}: {symmetry[_SYMMETRY_FUNCTION]!r} cannot be imported: "
            f"{error}. {_SYMMETRY_EXAMPLE}"
        ) from error
    actions = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    mirrored, mirrored_actions = function(env=env, obs=observations, actions=actions)
    rows, action_rows = mirrored.batch_size[0], mirrored_actions.shape[0]
    if rows == action_rows == env.num_envs:
        warnings.warn(
            f"symmetry_cfg {_SYMMETRY_FUNCTION} {symmetry[_SYMMETRY_FUNCTION]!r} returns no mirrored rows.",
            UserWarning,
            stacklevel=4,
        )
    elif rows != action_rows or rows < env.num_envs or rows % env.num_envs:
        raise ValueError(
            f"symmetry_cfg {_SYMMETRY_FUNCTION} {symmetry[_SYMMETRY_FUNCTION]!r}: expected the original "
            f"and the mirrored rows of {counted(env.num_envs, 'environment')}, got {rows} observations and "
            f"{action_rows} actions."
        )


@contextlib.contextmanager
def shared_parameters_allowed() -> Generator[None]:
    """Allow rsl_rl to pass parameters of shared encoders to its optimizer twice.

    Call `deduplicate_parameters` afterwards.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*duplicate parameters")
        yield


def deduplicate_parameters(optimizer: torch.optim.Optimizer) -> None:
    """Remove duplicate parameters of `optimizer`, before its first step.

    rsl_rl passes the parameters of actor and critic, hence those of shared encoders twice; each
    step would apply their gradient twice.
    """
    for group in optimizer.param_groups:
        group["params"] = list(dict.fromkeys(group["params"]))


def _check_model(observations: TensorDict, cfg: Mapping[str, Any], model: str) -> list[str]:
    """Check one network; return the image groups that it encodes."""
    settings, algorithm = cfg[model], cfg["algorithm"]
    name, is_sac = settings["class_name"], "replay_steps" in algorithm
    kind = resolve_callable(name)
    base = _SAC_MODELS[model] if is_sac else object
    if isinstance(kind, type) and not issubclass(kind, base):
        raise ValueError(
            f"agent.{model} class_name: expected {base.__module__}:{base.__name__} or a subclass for "
            f"the learner 'sac', got {name!r}; omit it, or use --learner ppo."
        )
    images = []
    for group in (cfg.get("obs_groups") or {}).get(model, (model,)):
        value = observations.get(group, None)
        if value is not None and not (torch.is_tensor(value) and value.is_floating_point()):
            got = value.dtype if torch.is_tensor(value) else f"a dict of {sorted(value.keys())}"
            raise ValueError(
                f"Observation group {group!r}: expected a tensor of floating-point numbers, got {got}; "
                "use concatenate_terms=True, or convert the values in the observation term."
            )
        if value is not None and value.ndim == 4:
            images.append(group)
    if isinstance(kind, type) and issubclass(kind, CNNModel):
        if model != "critic" or not algorithm.get("share_cnn_encoders"):
            shapes = {group: tuple(observations[group].shape[1:]) for group in images}
            _check_encoders(model, kind, settings.get("cnn_cfg"), shapes)
        return images
    # Models of other packages may accept images.
    if images and getattr(kind, "_get_obs_dim", None) is MLPModel._get_obs_dim:
        encoder = "--learner ppo" if is_sac else f"an image encoder ({_CNN_EXAMPLE})"
        raise ValueError(
            f"agent.{model} class_name {name!r}: expected flat observations, got the observation group "
            f"{images[0]!r}, which holds images of shape {tuple(observations[images[0]].shape[1:])}; "
            f"use {encoder}, or remove {images[0]!r} from obs_groups[{model!r}]."
        )
    return []


def _check_encoders(model: str, kind: type, cnn_cfg: Any, shapes: dict[str, Any]) -> None:
    """Check each encoder of `model` by building it once, without allocating memory."""
    name, groups = f"agent.{model} cnn_cfg", list(shapes)
    if not cnn_cfg or not isinstance(cnn_cfg, dict):
        raise ValueError(
            f"{name}: expected a dict for the images {groups}, got {cnn_cfg!r}. {_CNN_EXAMPLE}"
        )
    for group, settings in cnn_cfg_by_group(cnn_cfg, groups, name).items():
        temperature = settings.get("spatial_softmax_temperature", 1.0)
        check_positive(f"{name} spatial_softmax_temperature", temperature)
        if kind is not CNNModel:
            settings = {k: v for k, v in settings.items() if k not in SPATIAL_SOFTMAX_KEYS}
        try:
            # The meta device neither computes nor draws random numbers.
            with torch.device("meta"):
                channels, height, width = shapes[group]
                CNN((height, width), channels, **settings)(torch.empty(1, *shapes[group]))
        except (RuntimeError, TypeError, ValueError, IndexError, KeyError) as error:
            raise ValueError(
                f"{name}: expected settings of an encoder for the images {group!r} of shape {shapes[group]}, "
                f"large enough for all layers, got {settings}: {first_line(error)}."
            ) from error
