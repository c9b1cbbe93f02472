"""Refusing a `symmetry_cfg` that would fail at the first update of a training run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from mjlab.rl.rsl import resolve_callable

_FUNCTION = "data_augmentation_func"
_ALLOWED = {_FUNCTION, "use_data_augmentation", "use_mirror_loss", "mirror_loss_coeff"}
_EXAMPLE = (
    'An example is {"data_augmentation_func": "mjlab.tasks.velocity.symmetry:mirror_left_right", '
    '"use_data_augmentation": True}; None is without.'
)


def check_symmetry(env: Any, observations: Any, cfg: Mapping[str, Any]) -> None:
    """Let the function of `symmetry_cfg` mirror the observations once.

    Args:
        env: The environments.
        observations: Their observations, a TensorDict of batch size (N,).
        cfg: A `RslRlOnPolicyRunnerCfg` as a dict.

    Raises:
        ValueError: a setting is missing or unknown, the function does not exist, or it does not
            return the given rows and as many or more mirrored ones.
    """
    symmetry = cfg["algorithm"].get("symmetry_cfg")
    if not symmetry:
        return
    if _FUNCTION not in symmetry or not set(symmetry) <= _ALLOWED:
        raise ValueError(
            f"symmetry_cfg has {', '.join(map(str, symmetry))}; it needs {_FUNCTION}, and may have "
            f"{', '.join(sorted(_ALLOWED - {_FUNCTION}))}. {_EXAMPLE}"
        )
    try:
        function = resolve_callable(symmetry[_FUNCTION])
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"symmetry_cfg names the function {symmetry[_FUNCTION]!r}, which cannot be imported: "
            f"{error}. {_EXAMPLE}"
        ) from error
    actions = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    mirrored, mirrored_actions = function(env=env, obs=observations, actions=actions)
    rows, action_rows = mirrored.batch_size[0], mirrored_actions.shape[0]
    if rows != action_rows or rows < 2 * env.num_envs or rows % env.num_envs:
        raise ValueError(
            f"The function {symmetry[_FUNCTION]!r} of symmetry_cfg returned {rows} observations and "
            f"{action_rows} actions for {env.num_envs} environments; it has to return the given ones "
            "and as many mirror images of all of them."
        )
