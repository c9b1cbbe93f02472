"""Contacts that are quicker to solve, for `cpu` profiles.

On the Go1 that walks, the physics of a step takes half the time.
"""

from __future__ import annotations

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.tasks.easing import Undo

_ROBOT = "robot"
_SLIDING = 3


def simplify_contacts(env_cfg: ManagerBasedRlEnvCfg) -> Undo:
    """Make friction cones pyramidal, and take rolling and torsional friction from the robot.

    Edits the config in place. Returns what gives such a config, or a copy, the contacts back.
    """
    cone = env_cfg.sim.mujoco.cone
    collisions = env_cfg.scene.entities[_ROBOT].collisions
    condim = [collision.condim for collision in collisions]
    env_cfg.sim.mujoco.cone = "pyramidal"
    for collision in collisions:
        dims = collision.condim
        if isinstance(dims, dict):
            collision.condim = {name: min(dim, _SLIDING) for name, dim in dims.items()}
        elif dims is not None:
            collision.condim = min(dims, _SLIDING)

    def undo(simple: ManagerBasedRlEnvCfg) -> None:
        simple.sim.mujoco.cone = cone
        for collision, dims in zip(simple.scene.entities[_ROBOT].collisions, condim, strict=True):
            collision.condim = dims

    return undo
