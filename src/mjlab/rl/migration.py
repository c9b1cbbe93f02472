"""Older layouts of a checkpoint, brought to today's; and whether one fits the networks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from mjlab.rl.checkpoint import CheckpointError

_STD_NAMES = {
    "std": "distribution.std_param",
    "log_std": "distribution.log_std_param",
}


# The entries whose type is known, whoever wrote the file: a dict, or a number of iterations.
_DICT_ENTRIES = (
    "model_state_dict", "actor_state_dict", "critic_state_dict", "student_state_dict",
    "teacher_state_dict", "optimizer_state_dict", "rnd_state_dict", "rnd_optimizer_state_dict",
    "infos", "training_state",
)  # fmt: skip
# Entries of learning, beside the networks.
_LEARNING_ENTRIES = ("optimizer_state_dict", "rnd_optimizer_state_dict", "sac_state_dict")
_COUNT_ENTRIES = {"iter": -1, "iterations_finished": 0, "last_evaluated": 0}


def migrate(checkpoint: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Return `checkpoint`, read from `path`, in today's layout; the argument is not changed.

    Two older layouts are known: one state dict for actor and critic together
    (`model_state_dict`), and an actor whose standard deviation is called `std` or `log_std`.

    Raises:
        CheckpointError: an entry is not of the type that it must have.
    """
    _check_types(checkpoint, path)
    migrated = dict(checkpoint)
    if migrated.get("model_state_dict") is not None:
        migrated.update(_split_single_model(migrated.pop("model_state_dict")))
    if migrated.get("actor_state_dict") is not None:
        migrated["actor_state_dict"] = {
            _STD_NAMES.get(name, name): value
            for name, value in migrated["actor_state_dict"].items()
        }
    return migrated


def _check_types(checkpoint: Mapping[str, Any], path: str) -> None:
    for name in _DICT_ENTRIES:
        value = checkpoint.get(name)
        # None stands for an entry that is not there: rsl_rl writes `infos` so.
        if value is not None and not isinstance(value, dict):
            raise _malformed(path, name, "a dict", value)
        if value is not None and name.endswith("_state_dict"):
            for key in value:
                if not isinstance(key, str):
                    raise _malformed(path, f"a key of {name}", "a string", key)
    for name, least in _COUNT_ENTRIES.items():
        if name in checkpoint and not _is_count(checkpoint[name], least):
            raise _malformed(path, name, f"a whole number from {least} up", checkpoint[name])
    owes = checkpoint.get("owes_evaluation", False)
    if not isinstance(owes, bool):
        raise _malformed(path, "owes_evaluation", "a bool", owes)
    env_state = (checkpoint.get("infos") or {}).get("env_state")
    if env_state is None:
        return
    if not isinstance(env_state, dict):
        raise _malformed(path, "infos.env_state", "a dict", env_state)
    counter = env_state.get("common_step_counter", 0)
    if not _is_count(counter, 0):
        name = "infos.env_state.common_step_counter"
        raise _malformed(path, name, "a whole number from 0 up", counter)


def _is_count(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _malformed(path: str, name: str, allowed: str, value: Any) -> CheckpointError:
    shown = repr(value)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    return CheckpointError(
        f"The checkpoint {path!r} is malformed: {name} must be {allowed} and is {shown} "
        f"({type(value).__name__}). Use another checkpoint; nothing was changed."
    )


def _split_single_model(model: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    prefixes = {
        "actor.": ("actor_state_dict", "mlp."),
        "actor_obs_normalizer.": ("actor_state_dict", "obs_normalizer."),
        "critic.": ("critic_state_dict", "mlp."),
        "critic_obs_normalizer.": ("critic_state_dict", "obs_normalizer."),
    }
    split: dict[str, dict[str, torch.Tensor]] = {"actor_state_dict": {}, "critic_state_dict": {}}
    for name, value in model.items():
        if name in _STD_NAMES:
            split["actor_state_dict"][name] = value
        for prefix, (part, today) in prefixes.items():
            if name.startswith(prefix):
                split[part][today + name.removeprefix(prefix)] = value
    return split


def check_fits(
    model: torch.nn.Module, saved: Mapping[str, Any] | None, *, name: str, path: str
) -> None:
    """Check that the state dict `saved` fits `model`.

    Raises:
        CheckpointError: parameters are missing, unknown, of another shape, or NaN or infinite; all are
            listed.
    """
    if saved is None:
        raise CheckpointError(
            f"The checkpoint {path!r} holds no {name} weights; use one that the same learner wrote."
        )
    own = model.state_dict()
    expected = {key: tuple(value.shape) for key, value in own.items()}
    found = {key: tuple(value.shape) for key, value in saved.items() if hasattr(value, "shape")}
    if expected == found:
        # What a network is built with, such as a mask of minus infinity, may be in its checkpoint.
        broken = [key for key in own if not _is_finite(saved[key]) and _is_finite(own[key])]
        if broken:
            raise CheckpointError(
                f"The checkpoint {path!r} holds {name} weights that are NaN or infinite: "
                f"{', '.join(broken)}. Use an earlier one; nothing was changed."
            )
        return
    lines = [
        f"  {key}: expected {expected.get(key, 'nothing')}, found {found.get(key, 'nothing')}"
        for key in sorted(expected.keys() | found.keys())
        if expected.get(key) != found.get(key)
    ]
    raise CheckpointError(
        f"The checkpoint {path!r} is of another network: its {name} does not fit this task's "
        f"{name} config.\n" + "\n".join(lines) + "\nUse a checkpoint of this task, or make "
        f"the network (--agent.{name}.) and the observations what they were when it was trained."
    )


def _is_finite(value: torch.Tensor) -> bool:
    return bool(torch.isfinite(value).all())


def check_optimizer_fits(
    optimizer: torch.optim.Optimizer, saved: Mapping[str, Any] | None, *, path: str
) -> None:
    """Check that the state `saved` is of as many parameters of the same shapes.

    torch itself compares numbers of parameters only, and would fail at the next update.

    Raises:
        CheckpointError: it is not.
    """
    try:
        fits = saved is not None and _optimizer_fits(optimizer, saved)
    except (KeyError, TypeError, AttributeError):
        fits = False
    if not fits:
        raise CheckpointError(
            f"The checkpoint {path!r} holds no optimizer state for these networks. To use its "
            "policy only, load it with load_cfg={'actor': True}; nothing was changed."
        )


def check_finite(checkpoint: Mapping[str, Any], path: str) -> None:
    """Check the states of optimizers and of SAC.

    Raises:
        CheckpointError: tensors are NaN, or learning rates not finite.
    """
    broken = not_finite({name: checkpoint.get(name) for name in _LEARNING_ENTRIES})
    if broken:
        raise CheckpointError(
            f"The checkpoint {path!r} holds values that are NaN or infinite: {', '.join(broken)}. "
            "Use an earlier one; nothing was changed."
        )


def not_finite(value: Any, name: str = "") -> list[str]:
    """Return the names of tensors within `value` that hold NaN, and of learning rates not finite."""
    if isinstance(value, torch.Tensor):
        return [name] if bool(value.isnan().any()) else []
    if isinstance(value, float):
        return [name] if name.endswith(".lr") and not math.isfinite(value) else []
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    else:
        return []
    prefix = f"{name}." if name else ""
    return [found for key, item in items for found in not_finite(item, f"{prefix}{key}")]


def _optimizer_fits(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> bool:
    groups = saved["param_groups"]
    if len(groups) != len(optimizer.param_groups):
        return False
    for group, own in zip(groups, optimizer.param_groups, strict=True):
        if len(group["params"]) != len(own["params"]) or not isinstance(group["lr"], float):
            return False
        # Switches of torch's optimizers; another release may have others.
        switches = [name for name, value in own.items() if isinstance(value, bool)]
        if not all(isinstance(group.get(name, False), bool) for name in switches):
            return False
        for number, parameter in zip(group["params"], own["params"], strict=True):
            state = saved["state"].get(number)
            if state is not None and not state:
                # torch would begin with new moments, without a word.
                return False
            for value in (state or {}).values():
                is_moment = isinstance(value, torch.Tensor) and value.dim() > 0
                if is_moment and value.shape != parameter.shape:
                    return False
    return True
