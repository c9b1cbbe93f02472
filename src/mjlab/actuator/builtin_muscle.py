"""Muscles simulated by MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from mjlab.actuator.actuator import ActuatorCfg
from mjlab.actuator.direct import DirectActuator
from mjlab.utils.spec import create_muscle_actuator

if TYPE_CHECKING:
    import mujoco

    from mjlab.entity import Entity
    from mjlab.utils.mujoco import CommandField


@dataclass(kw_only=True)
class BuiltinMuscleActuatorCfg(ActuatorCfg):
    """MuJoCo muscle; the figures are those of MJCF's `<muscle>`, see `BuiltinMuscleActuator`."""

    length_range: tuple[float, float] = (0.0, 0.0)
    """Shortest and longest length of the actuator (m or rad); (0, 0) lets MuJoCo find them."""
    gear: float = 1.0
    """Scale of the force, and of the length, on the target."""
    timeconst: tuple[float, float] = (0.01, 0.04)
    """Time constants of activation and deactivation (s)."""
    tausmooth: float = 0.0
    """Width of the smooth change between the two time constants."""
    range: tuple[float, float] = (0.75, 1.05)
    """Operating range of lengths, in units of the optimal fibre length."""
    force: float = -1.0
    """Peak force at rest (N); negative takes `scale` over the actuator's acceleration."""
    scale: float = 200.0
    """Numerator of the peak force if `force` is negative."""
    lmin: float = 0.5
    """Lower end of the force-length curve."""
    lmax: float = 1.6
    """Upper end of the force-length curve."""
    vmax: float = 1.5
    """Shortening velocity at which the force is zero, in optimal lengths a second."""
    fpmax: float = 1.3
    """Passive force at `lmax`, relative to the peak force."""
    fvmax: float = 1.2
    """Active force at the fastest lengthening, relative to the peak force."""

    _accepts_site: ClassVar[bool] = False

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinMuscleActuator:
        """See `ActuatorCfg`."""
        return BuiltinMuscleActuator(self, entity, target_ids, target_names)


class BuiltinMuscleActuator(DirectActuator[BuiltinMuscleActuatorCfg]):
    """MuJoCo muscle. The effort target is its excitation, from 0 to 1."""

    shares_delay: ClassVar[bool] = True

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The effort target, as excitation."""
        return ("effort",)

    def _add_element(self, spec: mujoco.MjSpec, target_name: str) -> mujoco.MjsActuator:
        cfg = self.cfg
        return create_muscle_actuator(
            spec,
            target_name,
            length_range=cfg.length_range,
            gear=cfg.gear,
            timeconst=cfg.timeconst,
            tausmooth=cfg.tausmooth,
            range=cfg.range,
            force=cfg.force,
            scale=cfg.scale,
            lmin=cfg.lmin,
            lmax=cfg.lmax,
            vmax=cfg.vmax,
            fpmax=cfg.fpmax,
            fvmax=cfg.fvmax,
            transmission_type=self.transmission_type,
        )
