"""Physics configuration: MuJoCo options, engine, NaN guard."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mjlab.compat import ALWAYS_ENABLED_FLAGS, accepts_older_fields
from mjlab.utils.errors import check_positive
from mjlab.utils.nan_guard import NanGuardCfg
from mjlab.utils.ranges import Positive, Range, Weight

if TYPE_CHECKING:
    import mujoco

# Integers of MuJoCo have 32 bits.
Int32 = Annotated[int, Range(0, 2**31 - 1)]


@accepts_older_fields
@dataclass
class MujocoCfg:
    """MuJoCo options, with MuJoCo's names and meanings. Applied to the compiled model."""

    timestep: float = 0.002
    """Physics timestep (s)."""
    integrator: Literal["euler", "implicitfast"] = "implicitfast"
    """Numerical integrator."""
    impratio: Positive = 1.0
    """Ratio of frictional to normal constraint impedance, for elliptic cones."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Type of contact friction cone."""
    jacobian: Literal["auto", "dense", "sparse"] = "auto"
    """Type of constraint Jacobian."""
    solver: Literal["newton", "cg", "pgs"] = "newton"
    """Constraint solver."""
    iterations: Int32 = 100
    """Maximum number of solver iterations."""
    tolerance: Weight = 1e-8
    """Solver tolerance for early termination."""
    ls_iterations: Int32 = 50
    """Maximum number of line-search iterations."""
    ls_tolerance: Weight = 0.01
    """Line-search tolerance."""
    ccd_iterations: Int32 = 50
    """Maximum number of convex-collision iterations."""
    gravity: Annotated[tuple[float, float, float], Range(ends="()")] = (0.0, 0.0, -9.81)
    """Gravitational acceleration in the world frame (m/s^2)."""
    disableflags: tuple[str, ...] = ()
    """MuJoCo features to disable, by lower-case flag name, such as `contact`. Flags that the XML of
    an entity sets are added."""
    enableflags: tuple[str, ...] = ()
    """MuJoCo features to enable, by lower-case flag name, such as `energy`. Flags that the XML of
    an entity sets are added."""

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the options to `model`. Flags are added to those already set.

        Raises:
            ValueError: unknown option or flag (the message lists the valid ones), or a timestep that
                is not positive.
        """
        from mjlab.utils.mujoco import OPTION_ENUMS, enum_bits, enum_value

        check_positive("MujocoCfg.timestep", self.timestep)
        for option in fields(MujocoCfg):
            name, value = option.name, getattr(self, option.name)
            if name == "enableflags":
                value = tuple(flag for flag in value if flag not in ALWAYS_ENABLED_FLAGS)
            if name.endswith("flags"):
                bits = enum_bits(f"MujocoCfg.{name}", value, *OPTION_ENUMS[name])
                value = getattr(model.opt, name) | bits
            elif name in OPTION_ENUMS:
                value = enum_value(f"MujocoCfg.{name}", value, *OPTION_ENUMS[name])
            setattr(model.opt, name, value)


@dataclass(kw_only=True)
class SimulationCfg:
    """Physics engine and its settings."""

    nconmax: Int32 | None = None
    """Maximum number of contacts per environment on Warp; None: estimated. Ignored by native."""
    njmax: Int32 | None = None
    """Maximum number of constraint rows per environment on Warp; None: estimated. Native ignores it."""
    contact_sensor_maxmatch: Int32 = 64
    """Maximum number of matches per contact sensor on Warp. Unlimited on native."""
    broadphase: Literal["nxn", "sap_tile", "sap_segmented"] | None = None
    """Broad-phase collision method of Warp; None: Warp's default."""
    broadphase_filter: tuple[Literal["plane", "sphere", "aabb", "obb"], ...] | None = None
    """Broad-phase filters of Warp; None: Warp's default."""
    ls_parallel: bool | None = None
    """Ignored. Accepted for compatibility with earlier releases."""
    mujoco: MujocoCfg = field(default_factory=MujocoCfg)
    """MuJoCo options."""
    nan_guard: NanGuardCfg = field(default_factory=NanGuardCfg)
    """NaN guard: recording of the states that precede a NaN."""
    engine: Literal["auto", "native", "warp"] = "auto"
    """Physics engine: `native` (MuJoCo on CPU threads) or `warp` (MuJoCo Warp on an NVIDIA GPU, or
    slowly on the CPU). `auto`: native on `cpu`, warp on `cuda`."""
    num_threads: int = 0
    """Number of physics threads of the native engine. 0: all cores available to this process
    (affinity mask, container quota, share among ranks). Results do not depend on it."""

    def apply_wp_opt(self, wp_opt: Any) -> None:
        """Write the Warp-only options to `mujoco_warp`'s `Option`."""
        import warnings

        from mjlab.utils.mujoco import enum_bits, enum_value

        if self.ls_parallel is not None:
            warnings.warn(
                "SimulationCfg.ls_parallel no longer has an effect; remove it.",
                DeprecationWarning,
                stacklevel=2,
            )
        wp_opt.contact_sensor_maxmatch = self.contact_sensor_maxmatch
        for name, read in (("broadphase", enum_value), ("broadphase_filter", enum_bits)):
            value, enum = getattr(self, name), type(getattr(wp_opt, name))
            if value is not None:
                setattr(wp_opt, name, enum(read(f"SimulationCfg.{name}", value, enum)))
