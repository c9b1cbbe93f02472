"""What several terms of the velocity task compute."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch

from mjlab.utils.lab_api.string import resolve_matching_names_values

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg


def velocity_command(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Return a velocity command (vx, vy, wz) in the frame of the root, (N, 3)."""
    # That it exists was checked when the term was built.
    manager: Any = env.command_manager
    return manager.get_command(command_name)


def command_speed(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Return `|c_xy| + |c_z|` of a velocity command, (N,): how much motion is asked for."""
    command = velocity_command(env, command_name)
    return torch.linalg.vector_norm(command[:, :2], dim=1).add_(command[:, 2].abs())


def if_commanded(
    cost: torch.Tensor, env: ManagerBasedRlEnv, command_name: str | None, threshold: float
) -> torch.Tensor:
    """Return `cost` (N,), and 0 where the command asks for no more motion than `threshold`.

    Without a command's name, `cost` is returned as it is.
    """
    if command_name is None:
        return cost
    return torch.where(command_speed(env, command_name) > threshold, cost, 0.0)


def log_metric(env: ManagerBasedRlEnv, name: str, value: torch.Tensor) -> None:
    """Log one number of this step under `Metrics/<name>`."""
    env.extras.setdefault("log", {})[f"Metrics/{name}"] = value


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return the mean of the finite values where `mask` is true, as one number; 0 if there are none."""
    # `isfinite` takes twice the operations.
    mask = mask & (values.abs() < torch.inf)
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def tilt_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the squared horizontal part of "up" in frames of orientation (N, 4): sin(tilt)^2, (N,).

    With x and y of a unit quaternion, that of the third row of its rotation matrix is
    `4 s (1 - s)`, where s = x^2 + y^2.
    """
    x, y = quat[:, 1], quat[:, 2]
    share = x * x + y * y
    return 4.0 * share * (1.0 - share)


def single_body(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> int | None:
    """Return the index of the selected body, or None for the root where none is selected.

    Raises:
        ValueError: several bodies are selected; the message names them.
    """
    ids: Any = asset_cfg.body_ids
    entity: Entity = env.scene[asset_cfg.name]
    if isinstance(ids, slice) and asset_cfg.body_names is None:
        return None
    chosen = list(range(entity.num_bodies))[ids] if isinstance(ids, slice) else list(ids)
    if len(chosen) != 1:
        names = [entity.body_names[i] for i in chosen]
        raise ValueError(
            f"asset_cfg selects the bodies {names} of entity {asset_cfg.name!r}; exactly one is "
            f"needed, or no body_names for the root {entity.body_names[0]!r}."
        )
    return int(chosen[0])


def values_of_joints(
    joints: list[str],
    name: str,
    table: dict[str, float],
    *,
    above: float = -math.inf,
    least: float = -math.inf,
) -> list[float]:
    """Return the value of each joint, of the parameter `name`, a table of patterns and values.

    Raises:
        ValueError: a joint matches no pattern or several, a pattern matches no joint, or a value is
            not `above` a bound or less than the `least`.
    """
    try:
        _, covered, values = resolve_matching_names_values(table, joints)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    missing = [joint for joint in joints if joint not in covered]
    if missing:
        raise ValueError(
            f"{name} has no entry for the joints {missing}. Its patterns {list(table)} must cover "
            "every selected joint."
        )
    wrong = {
        pattern: value for pattern, value in table.items() if not (value > above and value >= least)
    }
    if wrong:
        bound = f"above {above:g}" if above > least else f"of at least {least:g}"
        raise ValueError(f"{name}: expected numbers {bound}, got {wrong}.")
    return [float(value) for value in values]
