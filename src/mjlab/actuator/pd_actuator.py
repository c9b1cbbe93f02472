"""PD control computed in torch, with gains and limits of their own for every environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import mujoco
import torch

from mjlab.actuator.actuator import Actuator, ActuatorCfg, ActuatorCmd
from mjlab.sim.simulation import SharedField
from mjlab.utils.indexing import EnvIds, as_ids
from mjlab.utils.spec import create_motor_actuator

if TYPE_CHECKING:
    from mjlab.entity.entity import Entity


@dataclass(kw_only=True)
class IdealPdActuatorCfg(ActuatorCfg):
    """PD control, see `IdealPdActuator`."""

    stiffness: float
    """Gain kp on the position error (N m/rad or N/m)."""
    damping: float
    """Gain kd on the velocity error (N m s/rad or N s/m)."""
    effort_limit: float = float("inf")
    """Largest force E (N m or N)."""

    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> IdealPdActuator:
        """See `ActuatorCfg`."""
        return IdealPdActuator(self, entity, target_ids, target_names)


IdealPdCfgT = TypeVar("IdealPdCfgT", bound=IdealPdActuatorCfg)


class IdealPdActuator(Actuator[IdealPdCfgT], Generic[IdealPdCfgT]):
    """Force = clamp(kp (p* - l) + kd (v* - l') + f*, -E, E), one force motor a target.

    Gains and limit are the tensors `stiffness`, `damping` and `force_limit`, (N, n), which may be
    changed in place; `default_stiffness` and so on keep the configured values.

    A subclass that only has another force law overrides `control_law`, adds the names of its
    parameters, tensors (N, n), to `param_names`, and makes them in `initialize`. Like actuators are
    then computed together.
    """

    _transient = {"default_stiffness", "default_damping", "default_force_limit", "_model", "_fused"}

    param_names: ClassVar[tuple[str, ...]] = ("stiffness", "damping", "force_limit")
    """Attributes that `control_law` reads."""

    stiffness: torch.Tensor
    damping: torch.Tensor
    force_limit: torch.Tensor
    default_stiffness: torch.Tensor
    default_damping: torch.Tensor
    default_force_limit: torch.Tensor

    def __init__(
        self, cfg: IdealPdCfgT, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> None:
        """See `Actuator`."""
        super().__init__(cfg, entity, target_ids, target_names)
        self._model: Any = None
        self._fused = False

    def __setattr__(self, name: str, value: Any) -> None:
        # Actuators computed together hold their parameters in one tensor. An assignment that put
        # another tensor in place of this actuator's part would silently have no effect.
        if name in self.param_names and self.__dict__.get("_fused"):
            self.__dict__[name].copy_(value)
        else:
            super().__setattr__(name, value)

    def share_parameters(self, parts: dict[str, torch.Tensor]) -> None:
        """Take parts of larger tensors, which hold the same values, as parameters from now on."""
        self.__dict__.update(parts)
        self._fused = True

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add one motor for each target.

        Its force and control ranges tell the configured limit but are not enforced: the limit in
        force is `force_limit`, which may be raised, in each environment by itself.
        """
        cfg = self.cfg
        for name in target_names:
            element = create_motor_actuator(
                spec,
                name,
                effort_limit=cfg.effort_limit,
                armature=cfg.armature,
                frictionloss=cfg.frictionloss,
                viscous_damping=cfg.viscous_damping,
                transmission_type=self.transmission_type,
            )
            element.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
            element.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
            self._mjs_actuators.append(element)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """See `Actuator`; also makes gains and limits for every environment."""
        super().initialize(mj_model, model, data, device)
        self._model, self._fused = model, False
        shape = (data.nworld, len(self._target_ids_list))
        for name, value in (
            ("stiffness", self.cfg.stiffness),
            ("damping", self.cfg.damping),
            ("force_limit", self.cfg.effort_limit),
        ):
            for attribute in (name, f"default_{name}"):
                full = torch.full(shape, float(value), dtype=torch.float32, device=device)
                setattr(self, attribute, full)

    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return the forces, (N, n), by the class's control law."""
        return self.control_law({name: getattr(self, name) for name in self.param_names}, cmd)

    @staticmethod
    def control_law(params: dict[str, torch.Tensor], cmd: ActuatorCmd) -> torch.Tensor:
        """Return the PD force clamped to the limit, (N, n)."""
        limit = params["force_limit"]
        return torch.clamp(pd_torque(params["stiffness"], params["damping"], cmd), -limit, limit)

    def set_gains(
        self,
        env_ids: EnvIds,
        kp: torch.Tensor | None = None,
        kd: torch.Tensor | None = None,
    ) -> None:
        """Set stiffness and damping of environments; None leaves one alone.

        Args:
            env_ids: k environments; None for all.
            kp: (k,), the same for all targets, or (k, n).
            kd: Likewise.

        Raises:
            ValueError: a tensor of another shape.
        """
        for parameter, value, what in ((self.stiffness, kp, "kp"), (self.damping, kd, "kd")):
            if value is not None:
                rows = as_ids(env_ids, len(parameter), parameter.device)
                parameter[rows] = _per_target(value, (len(rows), parameter.shape[1]), what)

    def set_effort_limit(self, env_ids: EnvIds, effort_limit: torch.Tensor) -> None:
        """Set the force limit of environments, (k,) or (k, n); it may exceed the configured one.

        Where the model's `actuator_forcerange` and `actuator_ctrlrange` are kept per environment
        (`Simulation.expand_model_fields`), these, which only inform, follow.

        Raises:
            ValueError: a tensor of another shape.
        """
        rows = as_ids(env_ids, len(self.force_limit), self.force_limit.device)
        shape = (len(rows), self.force_limit.shape[1])
        limit = _per_target(effort_limit, shape, "effort_limit")
        self.force_limit[rows] = limit
        for field, columns in (
            ("actuator_forcerange", self.global_element_ids),
            ("actuator_ctrlrange", self.global_ctrl_ids),
        ):
            values = getattr(self._model, field)
            # One row that stands for all environments cannot hold a limit of one of them.
            if not isinstance(values, SharedField):
                ranges = torch.stack((-limit, limit), dim=-1).to(values.dtype)
                values[rows[:, None], columns] = ranges


def pd_torque(stiffness: torch.Tensor, damping: torch.Tensor, cmd: ActuatorCmd) -> torch.Tensor:
    """Return kp (p* - l) + kd (v* - l') + f*, (N, n)."""
    return (
        stiffness * (cmd.position_target - cmd.pos)
        + damping * (cmd.velocity_target - cmd.vel)
        + cmd.effort_target
    )


def _per_target(value: torch.Tensor, shape: tuple[int, int], what: str) -> torch.Tensor:
    """Return `value` as a tensor of this shape (number of environments, targets)."""
    value = torch.as_tensor(value, dtype=torch.float32)
    if value.shape == shape or value.ndim == 0:
        return value.expand(shape)
    if value.shape == shape[:1]:
        return value.unsqueeze(-1).expand(shape)
    raise ValueError(
        f"{what} has shape {tuple(value.shape)}; for {shape[0]} environments and {shape[1]} "
        f"targets it must be ({shape[0]},) or {shape}."
    )
