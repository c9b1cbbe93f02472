"""How far an arm reaches, and whether goals lie beyond that."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.tasks.manipulation.mdp.goal_command import FIXED_GOAL

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.manipulation.mdp.goal_command import GoalCommandCfg


def reach(model: mujoco.MjModel, site: str) -> tuple[np.ndarray, float] | None:
    """Return the place from which a site reaches, (3,), and how far it gets at most, in metres.

    The place is the joint nearest to the base, where the model puts it. No configuration of the
    joints gets the site further from there than the sum of the distances from joint to joint; what
    joints slide comes on top. Limits of joints may well keep it closer.

    None: the arm can go anywhere, since its base floats, or a joint slides without limit.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    point, length, is_jointed = data.site(site).xpos.copy(), 0.0, False
    body = int(model.site_bodyid[model.site(site).id])
    while body > 0:
        first = int(model.body_jntadr[body])
        for joint in reversed(range(first, first + int(model.body_jntnum[body]))):
            kind = model.jnt_type[joint]
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                return None
            if kind == mujoco.mjtJoint.mjJNT_SLIDE:
                if not model.jnt_limited[joint]:
                    return None
                # A range is of the joint's position, which is not 0 where the model puts it.
                start = model.qpos0[model.jnt_qposadr[joint]]
                length += float(np.abs(model.jnt_range[joint] - start).max())
                continue
            anchor = data.xanchor[joint].copy()
            # What lies between the site and the last joint is turned as a whole; so is all else.
            length += float(np.linalg.norm(point - anchor))
            point, is_jointed = anchor, True
        body = int(model.body_parentid[body])
    return (point, length) if is_jointed or length > 0.0 else (point, 0.0)


def check_reach(
    env: ManagerBasedRlEnv, command_name: str, cfg: GoalCommandCfg, entity_name: str, site: str
) -> None:
    """Raise `ValueError` if goals or objects of a command are certainly out of an arm's reach.

    An object is at its goal within `success_threshold` of it, which is added to the reach.
    """
    found = reach(env.sim.mj_model, f"{entity_name}/{site}")
    if found is None:
        return
    center, longest = found
    starts = getattr(cfg, "object_pose_range", None)
    for label, points in (
        ("goals", _goals(cfg)),
        ("objects", [] if starts is None else _corners(starts)),
    ):
        if not points:
            continue
        farthest = max(points, key=lambda point: math.dist(point, center))
        distance = math.dist(farthest, center)
        if distance > longest + cfg.success_threshold:
            remedy = _remedy(cfg, label)
            raise ValueError(
                f"The command {command_name!r} puts {label} as far away as {farthest} (metres from "
                f"the environment's origin). That is {distance:.2f} m from the first joint of entity "
                f"{entity_name!r}, whose site {site!r} gets {longest:.2f} m from it at most. "
                f"{remedy}"
            )


def _remedy(cfg: GoalCommandCfg, label: str) -> str:
    if label == "goals" and cfg.difficulty == "fixed":
        return "Put the arm nearer, or choose the difficulty 'dynamic', whose goals have a range."
    field = "target_position_range" if label == "goals" else "object_pose_range"
    return f"Narrow {field} to what the arm can reach."


def _goals(cfg: GoalCommandCfg) -> list[tuple[float, ...]]:
    return [FIXED_GOAL] if cfg.difficulty == "fixed" else _corners(cfg.target_position_range)


def _corners(within: Any) -> list[tuple[float, ...]]:
    return list(itertools.product(within.x, within.y, within.z))
