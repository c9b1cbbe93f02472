"""Older layouts of a checkpoint, brought to today's; and whether one fits the networks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from mjlab.rl.checkpoint import CheckpointError

_STD_NAMES = {
    "std": "distribution.std_param",
    "log_std": "distribution.log_std_param",
}


def migrate(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return `checkpoint` in today's layout; the argument is not changed.

    Two older layouts are known: one state dict for actor and critic together
    (`model_state_dict`), and an actor whose standard deviation is called `std` or `log_std`.
    """
    migrated = dict(checkpoint)
    if "model_state_dict" in migrated:
        migrated.update(_split_single_model(migrated.pop("model_state_dict")))
    if "actor_state_dict" in migrated:
        migrated["actor_state_dict"] = {
            _STD_NAMES.get(name, name): value
            for name, value in migrated["actor_state_dict"].items()
        }
    return migrated


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
        CheckpointError: parameters are missing, unknown, or of another shape; all are listed.
    """
    if saved is None:
        raise CheckpointError(
            f"The checkpoint {path!r} holds no {name} weights; it is not one of an actor-critic "
            "run."
        )
    expected = {key: tuple(value.shape) for key, value in model.state_dict().items()}
    found = {key: tuple(value.shape) for key, value in saved.items() if hasattr(value, "shape")}
    if expected == found:
        return
    lines = [
        f"  {key}: expected {expected.get(key, 'nothing')}, found {found.get(key, 'nothing')}"
        for key in sorted(expected.keys() | found.keys())
        if expected.get(key) != found.get(key)
    ]
    raise CheckpointError(
        f"The checkpoint {path!r} is of another network: its {name} does not fit this task's "
        f"{name} config.\n" + "\n".join(lines) + "\nUse a checkpoint of this task, or set "
        f"--agent.{name}.hidden-dims and the observations as they were when it was trained."
    )
