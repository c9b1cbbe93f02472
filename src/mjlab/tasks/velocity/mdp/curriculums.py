"""Curriculum terms of the velocity task: harder terrain and faster commands as training goes on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.term_checks import check_range, checked_when_built, require_command
from mjlab.tasks.velocity.mdp.rewards import velocity_command
from mjlab.tasks.velocity.mdp.velocity_command import RANGES, UniformVelocityCommand
from mjlab.utils.string import suggest

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
    """Command ranges from a number of environment steps on; those not given stay as they are."""

    step: int
    """First `common_step_counter` of the stage; required."""
    lin_vel_x: tuple[float, float] | None
    """Forward velocity, in m/s."""
    lin_vel_y: tuple[float, float] | None
    """Velocity to the left, in m/s."""
    ang_vel_z: tuple[float, float] | None
    """Yaw rate, in rad/s."""


def _check_levels(
    env: ManagerBasedRlEnv, command_name: str, use_elapsed_time: bool = False, **_: Any
) -> None:
    require_command(env, command_name)
    term = env.command_manager.get_term(command_name)
    if use_elapsed_time and not isinstance(term, UniformVelocityCommand):
        raise ValueError(
            f"use_elapsed_time needs a UniformVelocityCommand, which knows the time, and "
            f"{command_name!r} is a {type(term).__name__}. Set it to False."
        )


@checked_when_built(_check_levels)
def terrain_levels_vel(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    use_elapsed_time: bool = False,
) -> dict[str, torch.Tensor]:
    """Move environments to harder terrain where the robot walked far, and to easier where it did not.

    Up a level if the robot is further from its origin than half a cell; else down a level if it
    came less than half as far as its command asked for in a whole episode. Environments that have
    not made a step stay where they are, so that nothing moves at the first reset.

    Args:
        env: The environment.
        env_ids: Environments that are about to reset.
        command_name: The velocity command; its value now stands for that of the whole episode.
        asset_cfg: The robot.
        use_elapsed_time: Ask for the distance of the time that the robot had, not of a whole
            episode. Otherwise a robot is sent down when its episode was cut short, although it
            walked well: episodes also end early at the start of training, which spreads them.

    Returns, to be logged: mean and largest level, and the mean level of each kind of terrain where
    each has its own column.
    """
    terrain: Any = env.scene.terrain
    if terrain is None or terrain.terrain_origins is None:
        return {}
    asset: Entity = env.scene[asset_cfg.name]
    offset = asset.data.root_link_pos_w[env_ids, :2] - env.scene.env_origins[env_ids, :2]
    distance = torch.linalg.vector_norm(offset, dim=1)
    command = velocity_command(env, command_name)[env_ids]
    duration: torch.Tensor | float = env.max_episode_length_s
    if use_elapsed_time:
        term: Any = env.command_manager.get_term(command_name)
        duration = term.elapsed_s[env_ids]
    asked = torch.linalg.vector_norm(command[:, :2], dim=1) * duration * 0.5
    move_up = distance > terrain.cfg.terrain_generator.size[0] / 2.0
    move_down = (distance < asked) & ~move_up
    # At the first reset robots are wherever the model puts them.
    has_moved = env.episode_length_buf[env_ids] > (0 if env.common_step_counter > 0 else torch.inf)
    terrain.update_env_origins(env_ids, move_up & has_moved, move_down & has_moved)
    return _levels_to_log(terrain)


def _levels_to_log(terrain: Any) -> dict[str, torch.Tensor]:
    levels = terrain.terrain_levels.float()
    names = list(terrain.cfg.terrain_generator.sub_terrains)
    numbers = [levels.mean().view(1), levels.max().view(1)]
    has_own_columns = terrain.terrain_origins.shape[1] == len(names)
    if has_own_columns:
        # In one matrix, so that it comes from the device in one go.
        is_of = terrain.terrain_types == torch.arange(len(names), device=levels.device).unsqueeze(1)
        count = is_of.sum(dim=1)
        mean = torch.where(is_of, levels, 0.0).sum(dim=1) / count
        numbers.append(mean)
    mean, largest, *of_kinds = torch.cat(numbers).cpu()
    logged = {"mean": mean, "max": largest}
    # A kind without environments has no mean.
    pairs = zip(names, of_kinds, strict=True) if has_own_columns else ()
    return logged | {name: level for name, level in pairs if not level.isnan()}


def _check_stages(
    env: ManagerBasedRlEnv, command_name: str, velocity_stages: Sequence[Any], **_: Any
) -> None:
    require_command(env, command_name)
    for stage in velocity_stages:
        if "step" not in stage:
            raise ValueError(f"velocity_stages: the stage {dict(stage)} has no 'step'.")
        for key, bounds in stage.items():
            if key != "step" and key not in RANGES:
                raise ValueError(
                    f"velocity_stages: the stage of step {stage['step']} has {key!r}; "
                    f"{suggest(key, RANGES)}"
                )
            if key != "step" and bounds is not None:
                check_range(f"velocity_stages: {key} of the stage of step {stage['step']}", bounds)


@checked_when_built(_check_stages)
def commands_vel(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor,
    command_name: str,
    velocity_stages: list[VelocityStage],
) -> dict[str, torch.Tensor]:
    """Set the ranges of a velocity command to those of the stages that have begun.

    Stages are applied in order, so that later ones win; what none of them gives stays as it is.
    Commands already given stay too. The ranges are those of the term, not of the config that the
    environment was made from, and are saved with a checkpoint.

    Args:
        env: The environment.
        env_ids: Not used; curricula are called when environments reset.
        command_name: The velocity command.
        velocity_stages: Dicts with `step` and ranges, see `VelocityStage`.

    Returns, to be logged, the bounds in use.
    """
    ranges: Any = env.command_manager.get_term_cfg(command_name).ranges  # ty: ignore
    for stage in velocity_stages:
        if env.common_step_counter >= stage["step"]:
            for name in RANGES:
                bounds = stage.get(name)
                if bounds is not None:
                    setattr(ranges, name, tuple(bounds))
    bounds = [float(bound) for name in RANGES for bound in getattr(ranges, name)]
    names = [f"{name}_{end}" for name in RANGES for end in ("min", "max")]
    return dict(zip(names, torch.tensor(bounds, dtype=torch.float32).unbind(), strict=True))
