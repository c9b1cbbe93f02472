"""Contacts that take the solver half the time, for `cpu` profiles."""

from __future__ import annotations

from collections.abc import Callable

from mjlab.envs import ManagerBasedRlEnvCfg

_ROBOT = "robot"
_SLIDING = 3


def simplify_contacts(
    env_cfg: ManagerBasedRlEnvCfg,
) -> Callable[[ManagerBasedRlEnvCfg], None]:
    """Give contacts of the robot a pyramidal friction cone, and no rolling or torsional friction.

    Edits the config in place. Returns what gives such a config, or a copy, the contacts back.
    """
    cone = env_cfg.sim.mujoco.cone
    collisions = env_cfg.scene.entities[_ROBOT].collisions
    condim = [collision.condim for collision in collisions]
    env_cfg.sim.mujoco.cone = "pyramidal"
    for collision in collisions:
        if isinstance(collision.condim, dict):
            collision.condim = {name: min(dim, _SLIDING) for name, dim in collision.condim.items()}

    def undo(simple: ManagerBasedRlEnvCfg) -> None:
        simple.sim.mujoco.cone = cone
        for collision, dims in zip(simple.scene.entities[_ROBOT].collisions, condim, strict=True):
            collision.condim = dims

    return undo
