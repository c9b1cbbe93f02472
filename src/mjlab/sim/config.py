"""Configuration of the physics: MuJoCo's options, the engine, and its guards."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from mjlab.compat import ALWAYS_ENABLED_FLAGS, accepts_older_fields
from mjlab.utils.nan_guard import NanGuardCfg

if TYPE_CHECKING:
    import mujoco

_FLAG_PREFIXES = {"disableflags": "mjDSBL_", "enableflags": "mjENBL_"}

# Options that differ from their config value only in being an enum of MuJoCo, by prefix.
_ENUM_OPTIONS = {
    "jacobian": ("mjtJacobian", "mjJAC_"),
    "cone": ("mjtCone", "mjCONE_"),
    "integrator": ("mjtIntegrator", "mjINT_"),
    "solver": ("mjtSolver", "mjSOL_"),
}

_PLAIN_OPTIONS = (
    "timestep",
    "impratio",
    "gravity",
    "iterations",
    "tolerance",
    "ls_iterations",
    "ls_tolerance",
    "ccd_iterations",
)


@accepts_older_fields
@dataclass
class MujocoCfg:
    """MuJoCo options, written onto the compiled model. Names and meanings are MuJoCo's."""

    timestep: float = 0.002
    """Physics time step, in seconds."""
    integrator: Literal["euler", "implicitfast"] = "implicitfast"
    """Numerical integrator."""
    impratio: float = 1.0
    """Ratio of frictional to normal constraint impedance, for elliptic cones."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Type of contact friction cone."""
    jacobian: Literal["auto", "dense", "sparse"] = "auto"
    """Type of constraint Jacobian."""
    solver: Literal["newton", "cg", "pgs"] = "newton"
    """Constraint solver."""
    iterations: int = 100
    """Maximum number of solver iterations."""
    tolerance: float = 1e-8
    """Solver tolerance for early termination."""
    ls_iterations: int = 50
    """Maximum number of line-search iterations."""
    ls_tolerance: float = 0.01
    """Line-search tolerance."""
    ccd_iterations: int = 50
    """Maximum number of convex-collision iterations."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Gravitational acceleration in the world frame, in m/s^2."""
    disableflags: tuple[str, ...] = ()
    """MuJoCo features to disable, by lower-case flag name, such as `contact`."""
    enableflags: tuple[str, ...] = ()
    """MuJoCo features to enable, by lower-case flag name, such as `energy`."""

    def apply(self, model: mujoco.MjModel) -> None:
        """Write these options onto `model`; flags are added to those already set.

        Raises:
            ValueError: an option or flag that MuJoCo does not know, with those it does.
        """
        import mujoco

        for name, (enum_name, prefix) in _ENUM_OPTIONS.items():
            value = _enum_value(mujoco, name, enum_name, prefix, getattr(self, name))
            setattr(model.opt, name, value)
        for name in _PLAIN_OPTIONS:
            value = getattr(self, name)
            if name == "gravity":
                model.opt.gravity[:] = value
            else:
                setattr(model.opt, name, value)
        model.opt.disableflags |= self._flags(mujoco, "disableflags")
        model.opt.enableflags |= self._flags(mujoco, "enableflags")

    def _flags(self, mujoco: Any, kind: str) -> int:
        enum_name = "mjtDisableBit" if kind == "disableflags" else "mjtEnableBit"
        bits = 0
        for flag in getattr(self, kind):
            if kind == "enableflags" and flag in ALWAYS_ENABLED_FLAGS:
                continue
            bits |= int(_enum_value(mujoco, kind, enum_name, _FLAG_PREFIXES[kind], flag))
        return bits


def _enum_value(mujoco: Any, option: str, enum_name: str, prefix: str, name: str) -> Any:
    """Return MuJoCo's enum member for a lower-case name, or raise listing the valid names."""
    members = {
        member[len(prefix) :].lower(): value
        for member, value in getattr(mujoco, enum_name).__members__.items()
        if member.startswith(prefix)
    }
    if name not in members:
        raise ValueError(
            f"MujocoCfg.{option}: {name!r} is not known to MuJoCo. Choose from: "
            f"{', '.join(sorted(members))}."
        )
    return members[name]


@dataclass(kw_only=True)
class SimulationCfg:
    """Which engine runs the physics, and how."""

    nconmax: int | None = None
    """Contacts per environment for which Warp allocates memory; None estimates. Native ignores it."""
    njmax: int | None = None
    """Constraint rows per environment for Warp; None estimates. Native ignores it."""
    contact_sensor_maxmatch: int = 64
    """Matches that Warp keeps for each contact sensor. Native has no limit."""
    broadphase: Literal["nxn", "sap_tile", "sap_segmented"] | None = None
    """Warp's broad-phase collision method; None keeps its default."""
    broadphase_filter: tuple[Literal["plane", "sphere", "aabb", "obb"], ...] | None = None
    """Warp's broad-phase filters; None keeps its default."""
    ls_parallel: bool | None = None
    """Ignored; accepted because earlier releases had it."""
    mujoco: MujocoCfg = field(default_factory=MujocoCfg)
    """MuJoCo options."""
    nan_guard: NanGuardCfg = field(default_factory=NanGuardCfg)
    """Recording of the states that lead to NaN."""
    engine: Literal["auto", "native", "warp"] = "auto"
    """`native` runs MuJoCo on CPU threads, `warp` runs MuJoCo Warp on an NVIDIA GPU (or, slowly, on
    the CPU). `auto` takes native on `cpu` and warp on `cuda`."""
    num_threads: int = 0
    """Physics threads of the native engine; 0 takes every core that this process may use (affinity
    mask, container quota, share among ranks). Results do not depend on it."""

    def apply_wp_opt(self, wp_opt: Any) -> None:
        """Write the Warp-only options onto `mujoco_warp`'s `Option`."""
        import warnings

        if self.ls_parallel is not None:
            warnings.warn(
                "SimulationCfg.ls_parallel has no effect any more; remove it.",
                DeprecationWarning,
                stacklevel=2,
            )
        wp_opt.contact_sensor_maxmatch = self.contact_sensor_maxmatch
        if self.broadphase is not None or self.broadphase_filter is not None:
            from mjlab.sim.warp.engine import set_broadphase

            set_broadphase(wp_opt, self.broadphase, self.broadphase_filter)
