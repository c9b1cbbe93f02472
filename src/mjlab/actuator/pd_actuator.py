"""PD control in torch, with per-environment gains and limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import mujoco
import torch

from mjlab.actuator.actuator import Actuator, ActuatorCfg, ActuatorCmd
from mjlab.compat import suggests_fields
from mjlab.sim.simulation import SharedField
from mjlab.utils.indexing import EnvIds, as_ids
from mjlab.utils.spec import create_motor_actuator
from mjlab.utils.string import counted

if TYPE_CHECKING:
    from mjlab.entity.entity import Entity


@suggests_fields
@dataclass(kw_only=True)
class IdealPdActuatorCfg(ActuatorCfg):
    """PD control, see `IdealPdActuator`."""

    stiffness: float
    """Gain kp on the position error (N m/rad or N/m)."""
    damping: float
    """Gain kd on the velocity error (N m s/rad or N s/m)."""
    effort_limit: float = float("inf")
    """Maximum force E (N m or N)."""

    _positive: ClassVar[tuple[str, ...]] = ("effort_limit",)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> IdealPdActuator:
        """See `ActuatorCfg`."""
        return IdealPdActuator(self, entity, target_ids, target_names)


IdealPdCfgT = TypeVar("IdealPdCfgT", bound=IdealPdActuatorCfg)


class IdealPdActuator(Actuator[IdealPdCfgT], Generic[IdealPdCfgT]):
    """Force = clamp(kp (p* - l) + kd (v* - l') + f*, -E, E), applied by one motor per target.

    Gains and limit are the tensors `stiffness`, `damping` and `force_limit`, (N, n). They may be
    changed in place; `default_stiffness`, `default_damping` and `default_force_limit` keep the
    configured values.

    Subclasses with a different force law override `control_law`, add the names of their parameters
    to `param_names`, and create them in `initialize` as tensors, (N, n).
    """

    _transient = {"default_stiffness", "default_damping", "default_force_limit", "_model"}

    param_names: ClassVar[tuple[str, ...]] = ("stiffness", "damping", "force_limit")

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

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add one motor per target.

        Force and control ranges hold the configured limit but are not enforced: `force_limit`
        applies instead, and may be raised per environment.
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
        """See `Actuator`; also allocates per-environment gains and limits."""
        super().initialize(mj_model, model, data, device)
        self._model = model
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
        """Return the forces of the control law, (N, n)."""
        return self.control_law({name: getattr(self, name) for name in self.param_names}, cmd)

    @staticmethod
    def control_law(params: dict[str, torch.Tensor], cmd: ActuatorCmd) -> torch.Tensor:
        """Return the PD force, clamped to the limit, (N, n)."""
        limit = params["force_limit"]
        return torch.clamp(pd_torque(params["stiffness"], params["damping"], cmd), -limit, limit)

    def set_gains(
        self,
        env_ids: EnvIds,
        kp: torch.Tensor | None = None,
        kd: torch.Tensor | None = None,
    ) -> None:
        """Set stiffness and damping of environments. None: unchanged.

        Args:
            env_ids: k environments; None for all.
            kp: Stiffness, (k,) for all targets alike, or (k, n).
            kd: Damping, (k,) for all targets alike, or (k, n).

        Raises:
            ValueError: a tensor has a wrong shape.
        """
        for parameter, value, name in ((self.stiffness, kp, "kp"), (self.damping, kd, "kd")):
            if value is not None:
                rows = as_ids(env_ids, len(parameter), parameter.device)
                parameter[rows] = _per_target(value, (len(rows), parameter.shape[1]), name)

    def set_effort_limit(self, env_ids: EnvIds, effort_limit: torch.Tensor) -> None:
        """Set the force limit of environments, (k,) or (k, n). May exceed the configured limit.

        If `actuator_forcerange` and `actuator_ctrlrange` are per-environment fields
        (`Simulation.expand_model_fields`), they are updated for information; they are not enforced.

        Raises:
            ValueError: a tensor has a wrong shape.
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
            # A shared row cannot hold the limit of a single environment.
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


def _per_target(value: torch.Tensor, shape: tuple[int, int], name: str) -> torch.Tensor:
    """Broadcast `value` to `shape` (number of environments, number of targets)."""
    value = torch.as_tensor(value, dtype=torch.float32)
    try:
        return (value.unsqueeze(-1) if value.ndim == 1 else value).expand(shape)
    except RuntimeError:
        raise ValueError(
            f"{name}: expected shape ({shape[0]},) or {shape} for {counted(shape[0], 'environment')} "
            f"and {counted(shape[1], 'target')}, got {tuple(value.shape)}."
        ) from None
