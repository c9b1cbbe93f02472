"""What commands about goals refuse when they are built."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.envs.mdp._checks import check_range

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.manipulation.mdp.goal_command import GoalCommandCfg

_DIFFICULTIES = ("fixed", "dynamic")


def check_goal_cfg(cfg: GoalCommandCfg) -> None:
    """Raise `ValueError` for a difficulty, a threshold or a range that make no sense."""
    if cfg.difficulty not in _DIFFICULTIES:
        raise ValueError(f"difficulty is {cfg.difficulty!r}; it has to be one of {_DIFFICULTIES}.")
    if not cfg.success_threshold > 0.0:
        raise ValueError(
            f"success_threshold is {cfg.success_threshold!r}; it is a distance in metres, and no "
            "object is closer to its goal than 0."
        )
    for axis in ("x", "y", "z"):
        check_range(f"target_position_range.{axis}", getattr(cfg.target_position_range, axis))


def check_pose_range(within: Any) -> None:
    """Raise `ValueError` for a range of poses that makes no sense."""
    for name in ("x", "y", "z", "yaw"):
        check_range(f"object_pose_range.{name}", getattr(within, name))


def require_object(env: ManagerBasedRlEnv, name: str, label: str, is_moved: bool) -> Entity:
    """Return an entity of the scene; raises `ValueError` if there is none, or it cannot move."""
    entities = env.scene.entities
    if name not in entities:
        raise ValueError(f"{label} is {name!r}, but the scene's entities are {list(entities)}.")
    entity: Entity = entities[name]
    if is_moved and entity.is_fixed_base:
        raise ValueError(
            f"{label} is {name!r}, which has a fixed base, so that it cannot be lifted. Give its "
            "root body a free joint."
        )
    return entity
