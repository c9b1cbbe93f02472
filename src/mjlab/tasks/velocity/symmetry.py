"""Left-right symmetry augmentation of legged robots, with the terms of the velocity task.

Name `mirror_left_right` in `symmetry_cfg` of `RslRlPpoAlgorithmCfg`. How images are made, and further terms:
`mjlab.tasks.symmetry`. Partners of joints and feet that geometry does not find are named in a function of
the task's own:

    def mirror(env, obs=None, actions=None):
        return mirror_left_right(env, obs, actions, pairs={"port_knee": "starboard_knee"})
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import mujoco
import torch

from mjlab.envs import mdp as envs_mdp
from mjlab.sensor import ContactSensor
from mjlab.tasks import symmetry
from mjlab.tasks.symmetry import HINT, MirrorOfTerm, SymmetricRobot
from mjlab.tasks.symmetry import Coupling as Coupling
from mjlab.tasks.symmetry import Mirror as Mirror
from mjlab.tasks.symmetry import mirror_of_joints as mirror_of_joints
from mjlab.tasks.velocity import mdp
from mjlab.utils.mirror import DIRECTION

_PLANAR_VELOCITY = (1.0, -1.0, -1.0)
# Signs of (sin, cos) half a cycle later, the phase of the other side in walks and trots.
_HALF_A_CYCLE_LATER = (-1.0, -1.0)


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
        pairs: Names of joints and feet (geoms, bodies, sites) and of their partners on the other side, in
            either direction. Others are found by geometry; None: all are.
        terms: Mirrors of further observation functions, see `mjlab.tasks.symmetry`.

    Returns:
        Observations and actions with 2 N rows, the originals first.

    Raises:
        ValueError: the robot is not symmetric, or a term has no known mirror image.
    """
    return symmetry.mirror_left_right(env, obs, actions, pairs, {**TERMS, **(terms or {})})


def _of_command(robot: SymmetricRobot, params: dict[str, Any]) -> Mirror:
    term = robot.env.command_manager.get_term(params["command_name"])
    if isinstance(term, mdp.UniformVelocityCommand):
        return Mirror(range(3), _PLANAR_VELOCITY)
    if isinstance(term, mdp.GaitClockCommand):
        return Mirror(range(2), _HALF_A_CYCLE_LATER)
    raise ValueError(
        f"Command {params['command_name']!r}: mirror_left_right expected a UniformVelocityCommand or "
        f"GaitClockCommand, got {type(term).__name__}. {HINT}"
    )


def _of_feet(
    robot: SymmetricRobot, params: dict[str, Any], signs: tuple[float, ...] = (1.0,)
) -> Mirror:
    """Return the mirror of foot vectors with `signs`, of a contact or height sensor."""
    sensor, model = robot.env.scene[params["sensor_name"]], robot.model
    if isinstance(sensor, ContactSensor):
        found = [model.sensor(f"{sensor.cfg.name}_{name}") for name in sensor.primary_names]
        is_geom = found[0].objtype.item() == mujoco.mjtObj.mjOBJ_GEOM
        kind, ids = "geom" if is_geom else "body", [int(foot.objid.item()) for foot in found]
    else:
        kind = sensor.cfg.frame[0].type
        ids = [getattr(model, frame.type)(frame.prefixed_name()).id for frame in sensor.cfg.frame]
    size, feet = len(signs), robot.partners(f"Sensor {params['sensor_name']!r}", kind, ids)
    return Mirror([size * foot + i for foot in feet for i in range(size)], signs * len(feet))


TERMS: dict[Any, MirrorOfTerm] = {
    envs_mdp.generated_commands: _of_command,
    mdp.stepping_action: symmetry.of_actions,
    mdp.foot_height: _of_feet,
    mdp.foot_air_time: _of_feet,
    mdp.foot_contact: _of_feet,
    mdp.foot_contact_forces: partial(_of_feet, signs=DIRECTION),
}
"""Mirrors of the observation functions of these tasks."""
