"""Curriculum terms of the velocity task: terrain levels and command ranges."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, TypedDict, cast

import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.tasks.velocity.mdp.rewards import velocity_command
from mjlab.tasks.velocity.mdp.velocity_command import (
    RANGES,
    UniformVelocityCommand,
    UniformVelocityCommandCfg,
)

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "VelocityStage",
    "commands_vel",
    "terrain_levels_vel",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")

__getattr__ = older_names(__name__)


class VelocityStage(TypedDict, total=False):
    """Command ranges that take effect at an environment step. Omitted ranges are unchanged."""

    step: int
    """First `common_step_counter` of the stage; required."""
    lin_vel_x: tuple[float, float] | None
    """Forward velocity (m/s)."""
    lin_vel_y: tuple[float, float] | None
    """Velocity to the left (m/s)."""
    ang_vel_z: tuple[float, float] | None
    """Yaw rate (rad/s)."""


def terrain_levels_vel(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    use_elapsed_time: bool = False,
    first_step: int = 0,
) -> dict[str, torch.Tensor]:
    """Raise the terrain level of robots that walked far, and lower it for robots that did not.

    Up one level if the distance from the origin exceeds half a cell. Otherwise down one level if the
    distance is less than half of commanded speed times episode length. Environments without a step
    keep their level, so the first reset changes nothing.

    Args:
        env: The environment.
        env_ids: Environments about to reset.
        command_name: Velocity command; its current value represents the whole episode.
        asset_cfg: The robot.
        use_elapsed_time: Use the time since the reset instead of the full episode length. Otherwise
            robots whose episodes were truncated early are sent down although they walked well.
            Training truncates first episodes early, because it randomizes their initial lengths.
        first_step: `common_step_counter` before which all keep their level, because robots that do not
            walk yet would all be sent to the lowest.

    Returns, for logging: mean and maximum level, and the mean level per sub-terrain if each
    sub-terrain has one column.
    """
    terrain = env.scene.terrain
    if terrain is None or terrain.terrain_origins is None or terrain.terrain_generator is None:
        return {}
    generator = terrain.terrain_generator.cfg
    asset: Entity = env.scene[asset_cfg.name]
    offset = asset.data.root_link_pos_w[env_ids, :2] - env.scene.env_origins[env_ids, :2]
    distance = torch.linalg.vector_norm(offset, dim=1)
    command = velocity_command(env, command_name)[env_ids]
    duration: torch.Tensor | float = env.max_episode_length_s
    if use_elapsed_time:
        term = cast("UniformVelocityCommand", env.command_manager.get_term(command_name))
        duration = term.elapsed_s[env_ids]
    required = torch.linalg.vector_norm(command[:, :2], dim=1) * duration * 0.5
    move_up = distance > generator.size[0] / 2.0
    move_down = (distance < required) & ~move_up
    # Before the first reset, robots are at their model pose.
    has_moved = env.episode_length_buf[env_ids] > (0 if env.common_step_counter > 0 else torch.inf)
    has_moved &= env.common_step_counter >= first_step
    terrain.update_env_origins(env_ids, move_up & has_moved, move_down & has_moved)
    return _levels_to_log(terrain)


def _levels_to_log(terrain: Any) -> dict[str, torch.Tensor]:
    levels = terrain.terrain_levels.float()
    names = list(terrain.cfg.terrain_generator.sub_terrains)
    numbers = [levels.mean().view(1), levels.max().view(1)]
    has_own_columns = terrain.terrain_origins.shape[1] == len(names)
    if has_own_columns:
        # One matrix, so that one transfer from the device suffices.
        is_of = terrain.terrain_types == torch.arange(len(names), device=levels.device).unsqueeze(1)
        count = is_of.sum(dim=1)
        mean = torch.where(is_of, levels, 0.0).sum(dim=1) / count
        numbers.append(mean)
    mean, largest, *level_means = torch.cat(numbers).cpu()
    logged = {"mean": mean, "max": largest}
    # Sub-terrains without environments have no mean.
    pairs = zip(names, level_means, strict=True) if has_own_columns else ()
    return logged | {name: level for name, level in pairs if not level.isnan()}


def commands_vel(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor,
    command_name: str,
    velocity_stages: list[VelocityStage],
) -> dict[str, torch.Tensor]:
    """Set the ranges of a velocity command to those of the stages that have begun.

    Stages are applied in order; later stages override earlier ones, and omitted ranges are unchanged.
    Current commands are unchanged. The ranges belong to the term, not to the environment config, and
    are checkpointed.

    Args:
        env: The environment.
        env_ids: Unused.
        command_name: Velocity command.
        velocity_stages: Dicts with `step` and ranges, see `VelocityStage`.

    Returns, for logging, the bounds in use.
    """
    cfg = cast("UniformVelocityCommandCfg", env.command_manager.get_term_cfg(command_name))
    for stage in velocity_stages:
        if env.common_step_counter >= stage["step"]:
            if unknown := stage.keys() - {"step", *RANGES}:
                warnings.warn(
                    f"velocity_stages: expected ranges {RANGES}, got {sorted(unknown)}, ignored.",
                    UserWarning,
                    stacklevel=2,
                )
            for name in RANGES:
                bounds = stage.get(name)
                if bounds is not None:
                    setattr(cfg.ranges, name, tuple(bounds))
    bounds = [float(bound) for name in RANGES for bound in getattr(cfg.ranges, name)]
    names = [f"{name}_{end}" for name in RANGES for end in ("min", "max")]
    return dict(zip(names, torch.tensor(bounds, dtype=torch.float32).unbind(), strict=True))
