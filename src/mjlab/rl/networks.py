"""Completion of network settings, and checks of values that rsl_rl accepts but cannot learn with."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.utils import resolve_callable

from mjlab.rl.learners import drop_unchanged_additions
from mjlab.rl.sac_models import SacActorModel
from mjlab.utils.string import counted

MODELS = ("actor", "critic", "student", "teacher")
_PACKAGES = ("mjlab", "rsl_rl")
_RECURRENT_KEYS = ("rnn_type", "rnn_hidden_dim", "rnn_num_layers")


def prepare_train_cfg(env: Any, cfg: dict[str, Any]) -> None:
    """Complete a runner's config for the observations of `env`, in place.

    Args:
        env: Environments, as rsl_rl's `VecEnv`.
        cfg: A `RslRlOnPolicyRunnerCfg` as a dict.

    Raises:
        ValueError: the policy has no distribution to explore with.
    """
    drop_unchanged_additions(cfg)
    check_distribution(cfg)
    observations = env.get_observations()
    for name in MODELS:
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
    if cfg["algorithm"].get("share_cnn_encoders"):
        # Required by rsl_rl, but without effect.
        cfg["critic"].setdefault("cnn_cfg", cfg["actor"].get("cnn_cfg"))
    if cfg["algorithm"].get("symmetry_cfg"):
        check_symmetry(env, observations, cfg)


def check_distribution(cfg: Mapping[str, Any]) -> None:
    """Raise `ValueError` if rsl_rl's or mjlab's algorithms would train a deterministic policy.

    Networks and algorithms of other packages may do without `distribution_cfg`.
    """
    for name in ("actor", "student"):
        policy = cfg.get(name)
        if not isinstance(policy, dict) or policy.get("distribution_cfg") is not None:
            continue
        kinds = [resolve_callable(part["class_name"]) for part in (policy, cfg["algorithm"])]
        if all(kind.__module__.partition(".")[0] in _PACKAGES for kind in kinds):
            example = "squashed_gaussian" if kinds[0] is SacActorModel else "gaussian_distribution"
            raise ValueError(
                f"agent.{name} distribution_cfg: expected a distribution to explore with, got None; use "
                f"RslRlModelCfg(distribution_cfg={example}()), with the function of mjlab.rl.config."
            )


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
            stacklevel=4,
        )


def check_symmetry(env: Any, observations: Any, cfg: Mapping[str, Any]) -> None:
    """Warn if the function of `symmetry_cfg` returns other rows than its input and mirrored copies.

    Args:
        env: Environments.
        observations: Observations, a TensorDict of batch size (N,).
        cfg: A `RslRlOnPolicyRunnerCfg` as a dict, with a `symmetry_cfg`.
    """
    name = cfg["algorithm"]["symmetry_cfg"]["data_augmentation_func"]
    actions = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    mirrored, mirrored_actions = resolve_callable(name)(env=env, obs=observations, actions=actions)
    rows, action_rows = mirrored.batch_size[0], len(mirrored_actions)
    if rows != action_rows or rows < 2 * env.num_envs or rows % env.num_envs:
        warnings.warn(
            f"symmetry_cfg data_augmentation_func {name!r}: expected the original and the mirrored rows of "
            f"{counted(env.num_envs, 'environment')}, got {rows} observations and {action_rows} actions.",
            UserWarning,
            stacklevel=4,
        )


def deduplicate_parameters(optimizer: torch.optim.Optimizer) -> None:
    """Remove duplicate parameters of `optimizer`, before its first step.

    rsl_rl passes the parameters of actor and critic, hence those of shared encoders twice; each
    step would apply their gradient twice.
    """
    for group in optimizer.param_groups:
        group["params"] = list(dict.fromkeys(group["params"]))
