"""What several terms of the manipulation tasks look up and check."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from mjlab.envs.mdp._checks import nearest, require_command
from mjlab.envs.mdp._indexing import columns
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.tasks.manipulation.mdp.commands import LiftingCommand, MultiCubeLiftingCommand
from mjlab.tasks.manipulation.mdp.reach import check_reach

if TYPE_CHECKING:
    import torch

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.manipulation.mdp.goal_command import GoalCommand

C = TypeVar("C", bound="GoalCommand")

DEFAULT_ASSET_CFG = SceneEntityCfg("robot")
"""The entity whose site terms take for the hand unless they are told."""


def lifting_command(env: ManagerBasedRlEnv, name: str) -> LiftingCommand:
    """Return the command for one object; raises `TypeError` if it is of another kind."""
    return _command(env, name, LiftingCommand)


def multi_cube_command(env: ManagerBasedRlEnv, name: str) -> MultiCubeLiftingCommand:
    """Return the command for one object of several; raises `TypeError` if it is of another kind."""
    return _command(env, name, MultiCubeLiftingCommand)


def goal_command(env: ManagerBasedRlEnv, name: str) -> LiftingCommand | MultiCubeLiftingCommand:
    """Return a command with a goal; raises `TypeError` if it has none."""
    return _command(env, name, (LiftingCommand, MultiCubeLiftingCommand))


def _command(env: ManagerBasedRlEnv, name: str, kind: Any) -> Any:
    command = env.command_manager.get_term(name)
    if not isinstance(command, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or a ".join(cls.__name__ for cls in kinds)
        raise TypeError(
            f"The command {name!r} is a {type(command).__name__}; a {wanted} is needed."
        )
    return command


def site_pos(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the position of the one selected site in the world, (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.site_pos_w[:, columns(asset_cfg.site_ids, env.device)].squeeze(1)


def site_quat(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the orientation of the one selected site in the world, (N, 4)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.site_quat_w[:, columns(asset_cfg.site_ids, env.device)].squeeze(1)


# Checks, made when a manager is built.


def check_entity(env: ManagerBasedRlEnv, name: str, label: str) -> None:
    """Raise `ValueError` unless the scene has an entity of that name."""
    if name not in env.scene.entities:
        raise ValueError(
            f"{label} is {name!r}; the scene has no such entity. {nearest(name, env.scene.entities)}"
        )


def check_site(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> str:
    """Return the name of the one selected site; raises `ValueError` if it is not one."""
    check_entity(env, asset_cfg.name, "asset_cfg.name")
    names = env.scene.entities[asset_cfg.name].site_names
    ids = asset_cfg.site_ids
    selected = list(names[ids]) if isinstance(ids, slice) else [names[index] for index in ids]
    if len(selected) != 1:
        raise ValueError(
            f"asset_cfg selects {len(selected)} sites of entity {asset_cfg.name!r}; the term needs "
            "one, such as the site between the fingers. Give it as site_names; there are "
            f"{list(names)}."
        )
    return selected[0]


def check_single_with_hand(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG, **params: Any
) -> None:
    """Check a term about a hand, one object and its goal."""
    check_single(env, asset_cfg=asset_cfg, **params)


def check_multi_with_hand(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG, **params: Any
) -> None:
    """Check a term about a hand, one object of several and its goal."""
    check_multi(env, asset_cfg=asset_cfg, **params)


def check_single(
    env: ManagerBasedRlEnv,
    command_name: str,
    object_name: str,
    asset_cfg: SceneEntityCfg | None = None,
    **params: Any,
) -> None:
    """Check a term about one object and its goal, and whether the arm of `asset_cfg` reaches it."""
    require_command(env, command_name)
    command = lifting_command(env, command_name)
    check_entity(env, object_name, "object_name")
    check_stds(**params)
    if asset_cfg is not None:
        check_reach(env, command_name, command.cfg, asset_cfg.name, check_site(env, asset_cfg))


def check_multi(
    env: ManagerBasedRlEnv,
    command_name: str,
    asset_cfg: SceneEntityCfg | None = None,
    **params: Any,
) -> None:
    """Check a term about one object of several, likewise."""
    require_command(env, command_name)
    command = multi_cube_command(env, command_name)
    check_stds(**params)
    if asset_cfg is not None:
        check_reach(env, command_name, command.cfg, asset_cfg.name, check_site(env, asset_cfg))


def check_stds(**params: Any) -> None:
    """Raise `ValueError` unless all parameters called `std` or `..._std` are positive."""
    for name, value in params.items():
        if name.endswith("std") and not value > 0.0:
            raise ValueError(f"{name} is {value!r}; it is a distance in metres above 0.")
