"""What the Warp engine needs that does not touch Warp itself.

What MuJoCo Warp cannot do, found before a simulation is built, and facts about the host model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.sim.engine import EngineUnavailableError

if TYPE_CHECKING:
    import mujoco


class UnsupportedByWarpError(EngineUnavailableError, NotImplementedError):
    """The model or an option needs something that MuJoCo Warp does not have."""


def refuse_unsupported(model: mujoco.MjModel) -> None:
    """Raise if the model needs what MuJoCo Warp lacks, naming it and what to use instead.

    Raises:
        UnsupportedByWarpError: with everything that is unsupported, not only the first.
    """
    problems = _unsupported_options(model) + _unsupported_flags(model) + _unsupported_plugins(model)
    if problems:
        raise UnsupportedByWarpError(
            "The warp engine cannot simulate this model:\n"
            + "\n".join(f"  - {problem}" for problem in problems)
            + "\nOr use --engine native (SimulationCfg.engine='native'), which supports all of it."
        )


def _unsupported_options(model: mujoco.MjModel) -> list[str]:
    import mujoco

    problems = []
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        problems.append("the solver 'pgs'; use MujocoCfg.solver='newton' or 'cg'")
    return problems


def _unsupported_flags(model: mujoco.MjModel) -> list[str]:
    import mujoco

    disable, enable = mujoco.mjtDisableBit, mujoco.mjtEnableBit
    refused = (
        (model.opt.disableflags, disable.mjDSBL_AUTORESET, "disable", "autoreset"),
        (model.opt.disableflags, disable.mjDSBL_MIDPHASE, "disable", "midphase"),
        (model.opt.enableflags, enable.mjENBL_OVERRIDE, "enable", "override"),
        (model.opt.enableflags, enable.mjENBL_FWDINV, "enable", "fwdinv"),
        (model.opt.enableflags, enable.mjENBL_SLEEP, "enable", "sleep"),
    )
    return [
        f"the {kind} flag {name!r}; leave it out of MujocoCfg.{kind}flags and of the XML"
        + (" (Warp never resets an environment by itself)" if name == "autoreset" else "")
        for flags, bit, kind, name in refused
        if flags & bit
    ]


def _unsupported_plugins(model: mujoco.MjModel) -> list[str]:
    return [
        f"{kind} plugins; use MuJoCo's own elements"
        for kind in ("body", "actuator", "sensor")
        if (getattr(model, f"{kind}_plugin") != -1).any()
    ]


def raycast_problem(model: mujoco.MjModel) -> str | None:
    """Return why MuJoCo Warp cannot cast rays in a model, and what to do; None if it can."""
    if not model.nflex:
        return None
    return (
        "MuJoCo Warp cannot cast rays in a model with flexes. Leave out the ray sensors or the "
        "flexes, or use --engine native (SimulationCfg.engine='native')."
    )


def mocap_bodies(model: mujoco.MjModel) -> list[int]:
    """Return the bodies of the mocap poses, in their order."""
    bodies = [-1] * model.nmocap
    for body, mocap in enumerate(model.body_mocapid):
        if mocap >= 0:
            bodies[mocap] = body
    return bodies


def static_geoms(model: mujoco.MjModel) -> list[int]:
    """Return the geoms whose world pose MuJoCo Warp computes only once."""
    bodies = model.geom_bodyid
    welded = model.body_weldid[bodies] == 0
    carried = model.body_mocapid[model.body_rootid[bodies]] >= 0
    return (welded & ~carried).nonzero()[0].tolist()


def rotation_matrices(quat: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4), scalar first."""
    w, v = quat[..., 0, None, None], quat[..., 1:]
    outer = v[..., :, None] * v[..., None, :]
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(dim=-1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    # The identity R v = v + 2 w (u x v) + 2 u x (u x v), with [u]x [u]x = u u' - |u|^2 I.
    identity = torch.eye(3, device=quat.device)
    squared = (v * v).sum(dim=-1)[..., None, None]
    return identity + 2 * w * cross + 2 * (outer - squared * identity)
