"""Actuators defined in the XML of an entity."""

from __future__ import annotations

import warnings
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco

from mjlab.actuator.actuator import ActuatorCfg, DirectActuator, TransmissionType
from mjlab.compat import older_names
from mjlab.utils.errors import WrongStateError, check_one_of
from mjlab.utils.mujoco import CommandField, control_inputs, detect_command_field

if TYPE_CHECKING:
    from mjlab.entity.entity import Entity


@dataclass(kw_only=True)
class XmlActuatorCfg(ActuatorCfg):
    """XML actuator configuration, see `XmlActuator`."""

    command_field: CommandField | None = None
    """Target that the control reads: position, velocity or effort. None: detect from each
    actuator; required for actuators with several controls."""

    def validate(self) -> None:
        """See `ActuatorCfg`."""
        super().validate()
        fields = (None, "position", "velocity", "effort")
        check_one_of(self._label("command_field"), self.command_field, fields)

    def build(self, entity: Entity, target_ids: list[int], target_names: list[str]) -> XmlActuator:
        """See `ActuatorCfg`."""
        return XmlActuator(self, entity, target_ids, target_names)


class XmlActuator(DirectActuator[XmlActuatorCfg]):
    """First XML actuator on each target, driven by the commands that its kind reads.

    `<pid>` and `<dcmotor>` may read several: position, velocity, and an effort or voltage. Targets
    without an actuator are skipped. The config's armature, frictionloss and damping are written to
    the remaining targets.
    """

    _transient = {"_command_fields"}

    def __init__(
        self,
        cfg: XmlActuatorCfg,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """See `Actuator`."""
        super().__init__(cfg, entity, target_ids, target_names)
        field = cfg.command_field
        self._command_fields: tuple[CommandField, ...] = () if field is None else (field,)

    @property
    def command_field(self) -> CommandField:
        """First of `command_fields`; for most kinds, the only one."""
        return self.command_fields[0]

    @property
    def command_fields(self) -> tuple[CommandField, ...]:
        """Commands that each element reads: "position", "velocity", "effort".

        Raises `RuntimeError` before `edit_spec`, unless the config sets `command_field`.
        """
        if not self._command_fields:
            raise WrongStateError(
                f"XmlActuator for {self._target_names}: command_fields are not available before the "
                "entity is built."
            )
        return self._command_fields

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Find the elements for `target_names`. Must be called once, with all targets.

        Raises:
            ValueError: no target has an actuator, the actuators are of several kinds, or
                `command_field` contradicts the detected kind.
        """
        found: dict[str, mujoco.MjsActuator] = {}
        for element in spec.actuators:
            if element.trntype in XML_TRANSMISSIONS[self.transmission_type]:
                found.setdefault(element.target, element)
        kept = [k for k, name in enumerate(target_names) if name in found]
        if not kept:
            existing = [
                f"{element.name or '(unnamed)'} on "
                f"{element.trntype.name.removeprefix('mjTRN_').lower()} {element.target!r}"
                for element in spec.actuators
            ]
            raise ValueError(
                f"XmlActuatorCfg for {self.cfg.target_names_expr}: expected XML actuators on the "
                f"{self.transmission_type.value}s {target_names}, got none. Available: "
                f"{existing or 'no actuators'}. Add an actuator to the XML, or use a config that "
                "adds actuators, such as BuiltinPositionActuatorCfg."
            )
        self._mjs_actuators = [found[target_names[k]] for k in kept]
        self._command_fields = self._agreed_fields()
        unknown = [field for field in self._command_fields if field != "effort"]
        if self.transmission_type == TransmissionType.SITE and unknown:
            warnings.warn(
                f"The XML actuators on the sites {target_names} read {' and '.join(unknown)}, "
                "but sites have only effort targets, so their control stays 0.",
                UserWarning,
                stacklevel=2,
            )
        self._target_ids_list = [self._target_ids_list[k] for k in kept]
        self._target_names = [self._target_names[k] for k in kept]
        for k in kept:
            self._override_target(spec, target_names[k])

    def _agreed_fields(self) -> tuple[CommandField, ...]:
        """Return the commands that all elements read; raise if elements or `command_field` disagree."""
        stated = self.cfg.command_field
        detected: dict[tuple[CommandField, ...], list[str]] = defaultdict(list)
        for element in self._mjs_actuators:
            detected[self._fields_of(element)].append(element.name or element.target)
        breakdown = "; ".join(f"{', '.join(fields)}: {names}" for fields, names in detected.items())
        if len(detected) > 1:
            raise ValueError(
                f"XmlActuatorCfg for {self.cfg.target_names_expr}: expected actuators of one kind, "
                f"got {breakdown}; use one config per kind."
            )
        if stated is not None and (stated,) not in detected:
            raise ValueError(
                f"XmlActuatorCfg for {self.cfg.target_names_expr}: command_field={stated!r} "
                f"contradicts the XML ({breakdown}); omit command_field to follow the XML."
            )
        return next(iter(detected))

    def _fields_of(self, element: mujoco.MjsActuator) -> tuple[CommandField, ...]:
        """Return the commands that one element reads."""
        inputs = control_inputs(element)
        if inputs == (None,):
            # Not every kind can be detected; `command_field` overrides detection.
            return (self.cfg.command_field or detect_command_field(element),)
        known = tuple(field for field in inputs if field is not None)
        if not inputs or len(set(known)) < len(inputs):
            kinds = ", ".join(field or "orientation" for field in inputs) or "none"
            raise ValueError(
                f"XmlActuatorCfg for {self.cfg.target_names_expr}: expected at most one position, "
                f"velocity and effort input, got {kinds} on {element.name or element.target!r}; "
                "use other patterns, and write its controls with Entity.write_ctrl_to_sim."
            )
        return known


XML_TRANSMISSIONS = {
    TransmissionType.JOINT: (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT),
    TransmissionType.TENDON: (mujoco.mjtTrn.mjTRN_TENDON,),
    TransmissionType.SITE: (mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK),
}

__getattr__ = older_names(__name__)
