"""What the Warp engine needs that does not touch Warp itself.

What MuJoCo Warp cannot do, found before a simulation is built; facts about the host model; and the
watch over its fixed capacities.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import torch

from mjlab.sim.engine import EngineUnavailableError

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

# Dispatches of `step` between two looks at the overflow flags.
_CHECK_PERIOD = 64

OVERFLOW_MESSAGES: dict[str, str] = {
    "NEFC": "more constraint rows than njmax={njmax}; the excess was dropped. Raise "
    "SimulationCfg.njmax",
    "NJMAX_NNZ": "the sparse constraint Jacobian outgrew njmax={njmax}; the excess was dropped. "
    "Raise SimulationCfg.njmax",
    "BROADPHASE": "more candidate collisions than nconmax={nconmax} per environment allows; the "
    "excess was dropped. Raise SimulationCfg.nconmax",
    "NARROWPHASE": "more contacts than nconmax={nconmax} per environment allows; the excess was "
    "dropped. Raise SimulationCfg.nconmax",
    "CCD": "more convex collisions than nconmax={nconmax} per environment allows; the excess was "
    "dropped. Raise SimulationCfg.nconmax",
    "HFIELD": "one geom touched more height-field cells than can be kept. Use a coarser height "
    "field or smaller geoms",
    "CONTACT_MATCH": "a contact sensor matched more contacts than it keeps. Raise "
    "SimulationCfg.contact_sensor_maxmatch",
    "NVMAX": "more active degrees of freedom than were allocated",
    "EPA_HORIZON": "a deep penetration was resolved approximately. Reduce the time step or simplify "
    "the collision geometry",
    "TACTILE": "a tactile sensor met more geoms than it keeps",
}
"""By name of a `mujoco_warp.OverflowType`: what happened and what to change. Reaching an iteration
limit of the solver is left out, because native MuJoCo does not report it either."""


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
    if model.opt.noslip_iterations > 0:
        problems.append(
            f"the noslip solver (noslip_iterations={model.opt.noslip_iterations}); set it to 0 and "
            "raise MujocoCfg.impratio with cone='elliptic' instead"
        )
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


class OverflowWatch:
    """Logs, once a kind, that some environment exceeded a capacity, without waiting for the GPU.

    Every so many steps the flags of all environments are gathered and copied to the host in the
    background; they are read when they have arrived.
    """

    def __init__(
        self, flags: torch.Tensor, bits: dict[str, int], capacities: dict[str, int]
    ) -> None:
        """Watch `flags` (N,), whose bits are named by `bits`; `capacities` go into the messages."""
        self._flags = flags
        self._capacities = capacities
        self._kinds = [name for name in OVERFLOW_MESSAGES if name in bits]
        self._reported: set[str] = set()
        self._bits = torch.tensor([bits[name] for name in self._kinds], dtype=torch.int32)
        self._arrived = torch.zeros(len(self._bits), dtype=torch.int32)
        self._event: Any = None
        if flags.is_cuda:
            self._bits = self._bits.to(flags.device)
            self._arrived = self._arrived.pin_memory()
        self._steps = 0

    def tick(self) -> None:
        """Count a dispatch of `step`; look at the flags after the first and then now and then."""
        self._steps += 1
        if self._steps % _CHECK_PERIOD == 1:
            self.check(wait=False)

    def check(self, wait: bool) -> None:
        """Log what has exceeded its capacity; without `wait`, what is known by now."""
        if not self._flags.is_cuda:
            self._arrived = self._gather()
            self._report()
            return
        if self._event is None or wait:
            self._arrived.copy_(self._gather(), non_blocking=True)
            self._event = torch.cuda.current_stream(self._flags.device).record_event()
            if wait:
                self._event.synchronize()
        if self._event.query():
            self._event = None
            self._report()

    def _gather(self) -> torch.Tensor:
        return (self._flags[:, None] & self._bits).amax(dim=0)

    def _report(self) -> None:
        for name, found in zip(self._kinds, self._arrived.tolist(), strict=True):
            if found and name not in self._reported:
                self._reported.add(name)
                message = OVERFLOW_MESSAGES[name].format(**self._capacities)
                logger.warning("MuJoCo Warp overflow in some environment: %s.", message)
