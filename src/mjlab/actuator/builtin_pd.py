"""PD control of position and velocity targets by two of MuJoCo's own servos a target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco

from mjlab.actuator.actuator import ActuatorCfg, TransmissionType
from mjlab.actuator.direct import DirectActuator
from mjlab.utils.spec import create_position_actuator, create_velocity_actuator

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.utils.mujoco import CommandField


@dataclass(kw_only=True)
class BuiltinPdActuatorCfg(ActuatorCfg):
    """PD control inside MuJoCo, see `BuiltinPdActuator`."""

    stiffness: float
    """Gain kp on the position error (N m/rad or N/m)."""
    damping: float
    """Gain kd on the velocity error (N m s/rad or N s/m)."""
    effort_limit: float | None = None
    """Largest sum of forces of all actuators on a target (N m or N); None for no limit."""

    _accepts_site: ClassVar[bool] = False
    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> BuiltinPdActuator:
        """See `ActuatorCfg`."""
        return BuiltinPdActuator(self, entity, target_ids, target_names)


class BuiltinPdActuator(DirectActuator[BuiltinPdActuatorCfg]):
    """Two servos a target: force = clamp(kp (p* - l) + kd (v* - l'), -E, E).

    Controls, and `ctrl_ids`, are all position targets p*, then all velocity targets v*, in whatever
    order the elements were added. E is a limit of the joint or tendon, so it holds for the sum of
    all actuators there.
    """

    # Kept in step with _mjs_actuators, which has them in the order of adding.
    _transient = {"_position_elements", "_velocity_elements"}

    def __init__(
        self,
        cfg: BuiltinPdActuatorCfg,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """See `Actuator`."""
        super().__init__(cfg, entity, target_ids, target_names)
        self._position_elements: list[mujoco.MjsActuator] = []
        self._velocity_elements: list[mujoco.MjsActuator] = []

    @property
    def num_targets(self) -> int:
        """Number of joints or tendons, half the number of controls."""
        return len(self._target_ids_list)

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """The position targets, then the velocity targets."""
        return ("position", "velocity")

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add `<target>_pd_pos` for each target, then `<target>_pd_vel` for each."""
        for name in target_names:
            self._position_elements.append(self._add_position_servo(spec, name))
            self._override_target(spec, name)
        for name in target_names:
            element = create_velocity_actuator(
                spec,
                name,
                damping=self.cfg.damping,
                transmission_type=self.transmission_type,
                actuator_name=f"{name}_pd_vel",
            )
            self._velocity_elements.append(element)
        self._mjs_actuators += self._position_elements[-len(target_names) :]
        self._mjs_actuators += self._velocity_elements[-len(target_names) :]

    def _add_position_servo(self, spec: mujoco.MjSpec, name: str) -> mujoco.MjsActuator:
        element = create_position_actuator(
            spec,
            name,
            stiffness=self.cfg.stiffness,
            damping=0.0,
            transmission_type=self.transmission_type,
            actuator_name=f"{name}_pd_pos",
        )
        if self.cfg.effort_limit is not None:
            on_joint = self.transmission_type == TransmissionType.JOINT
            target: Any = spec.joint(name) if on_joint else spec.tendon(name)
            target.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
            target.actfrcrange[:] = (-self.cfg.effort_limit, self.cfg.effort_limit)
        return element

    def _ordered_elements(self) -> list[mujoco.MjsActuator]:
        return [*self._position_elements, *self._velocity_elements]
