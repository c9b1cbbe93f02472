"""Left-right symmetry augmentation of arms that lift an object, with the state as observations.

Name `mirror_left_right` in `symmetry_cfg` of `RslRlPpoAlgorithmCfg`. How images are made, and further terms:
`mjlab.tasks.symmetry`. The orientation of the object is not observed, and need not be symmetric.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from mjlab.tasks import symmetry
from mjlab.tasks.manipulation import mdp
from mjlab.tasks.symmetry import HINT, Mirror, MirrorOfTerm, SymmetricRobot, of_direction


def mirror_left_right(
    env: Any,
    obs: Any = None,
    actions: torch.Tensor | None = None,
    pairs: Mapping[str, str] | None = None,
    terms: Mapping[Any, MirrorOfTerm] | None = None,
) -> tuple[Any, torch.Tensor | None]:
    """Append mirror images to observations and actions.

    Args:
        env: Environment, wrapped or not.
        obs: TensorDict of observation groups, each (N, D), or None.
        actions: Actions (N, A), or None.
        pairs: Names of joints and of their partners; others are found by geometry.
        terms: Mirrors of further observation functions, see `mjlab.tasks.symmetry`.

    Returns:
        Observations and actions with 2 N rows, the originals first.

    Raises:
        ValueError: the arm is not symmetric, or a term has no known mirror image.
    """
    return symmetry.mirror_left_right(env, obs, actions, pairs, {**TERMS, **(terms or {})})


def _of_hand(robot: SymmetricRobot, params: dict[str, Any]) -> Mirror:
    """Return the mirror of a vector from the site of the hand, which lies on the mirror plane."""
    asset_cfg = params["asset_cfg"]
    hand = robot.env.scene[asset_cfg.name]
    (site,), (name,) = hand.find_sites(asset_cfg.site_names)
    if not robot.is_on_plane("site", int(hand.indexing.site_ids[site])):
        raise ValueError(
            f"Site {name!r}: mirror_left_right expected a hand on the mirror plane of the robot. {HINT}"
        )
    return of_direction(robot, params)


TERMS: dict[Any, MirrorOfTerm] = {
    mdp.ee_to_object_distance: _of_hand,
    mdp.object_to_goal_distance: of_direction,
}
"""Mirrors of the observation functions of these tasks."""
