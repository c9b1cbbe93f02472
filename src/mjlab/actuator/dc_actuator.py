"""PD control with the torque-speed curve of a DC motor."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import torch

from mjlab.actuator.actuator import ActuatorCmd
from mjlab.actuator.pd_actuator import IdealPdActuator, IdealPdActuatorCfg, pd_torque

if TYPE_CHECKING:
    import mujoco

    from mjlab.entity.entity import Entity


@dataclass(kw_only=True)
class DcMotorActuatorCfg(IdealPdActuatorCfg):
    """PD control with a torque-speed curve, see `DcMotorActuator`."""

    saturation_effort: float
    """Stall torque S (N m or N)."""
    velocity_limit: float
    """No-load speed w (rad/s or m/s)."""

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> DcMotorActuator:
        """See `ActuatorCfg`."""
        return DcMotorActuator(self, entity, target_ids, target_names)


DcMotorCfgT = TypeVar("DcMotorCfgT", bound=DcMotorActuatorCfg)


class DcMotorActuator(IdealPdActuator[DcMotorCfgT], Generic[DcMotorCfgT]):
    """Force of `IdealPdActuator`, clamped by `dc_motor_clip` instead of by the effort limit only.

    `saturation_effort` and `velocity_limit_motor` are also tensors, (N, n).
    """

    param_names: ClassVar[tuple[str, ...]] = (
        *IdealPdActuator.param_names, "saturation_effort", "velocity_limit_motor",
    )  # fmt: skip

    saturation_effort: torch.Tensor
    velocity_limit_motor: torch.Tensor

    def __init__(
        self, cfg: DcMotorCfgT, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> None:
        """See `Actuator`. Warns of a curve below 0 or below the effort limit."""
        super().__init__(cfg, entity, target_ids, target_names)
        for name in ("saturation_effort", "velocity_limit"):
            value = getattr(cfg, name)
            if not value > 0.0:
                warnings.warn(
                    f"{type(cfg).__name__} for {cfg.target_names_expr} {name}: expected a number > 0, "
                    f"got {value}; the motor cannot follow its targets.",
                    UserWarning,
                    stacklevel=2,
                )
                return
        if math.isinf(cfg.effort_limit) or cfg.effort_limit > cfg.saturation_effort:
            warnings.warn(
                f"{type(cfg).__name__} for {cfg.target_names_expr}: effort_limit="
                f"{cfg.effort_limit} exceeds saturation_effort={cfg.saturation_effort}, so only "
                "the torque-speed curve limits the force. Set effort_limit to the motor's peak "
                "continuous effort.",
                UserWarning,
                stacklevel=2,
            )

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """See `IdealPdActuator`; also allocates the per-environment parameters of the curve."""
        super().initialize(mj_model, model, data, device)
        self.saturation_effort = torch.full_like(self.stiffness, self.cfg.saturation_effort)
        self.velocity_limit_motor = torch.full_like(self.stiffness, self.cfg.velocity_limit)

    @staticmethod
    def control_law(params: dict[str, torch.Tensor], cmd: ActuatorCmd) -> torch.Tensor:
        """Return the PD force, clamped to the torque-speed curve, (N, n)."""
        return dc_motor_clip(
            pd_torque(params["stiffness"], params["damping"], cmd),
            params["saturation_effort"],
            params["velocity_limit_motor"],
            params["force_limit"],
            cmd.vel,
        )


def dc_motor_clip(
    effort: torch.Tensor,
    saturation_effort: torch.Tensor,
    velocity_limit: torch.Tensor,
    force_limit: torch.Tensor,
    vel: torch.Tensor,
) -> torch.Tensor:
    """Return `effort` clamped to the torque-speed curve at speed `vel`; all tensors are (N, n).

    With S = saturation_effort, w = velocity_limit, F = force_limit and v = vel, the bounds are
    S (1 - v / w) above and S (-1 - v / w) below, both clamped to [-F, F]. For v > w the upper bound
    is negative: the motor brakes.
    """
    speed = vel / velocity_limit
    upper = torch.clamp(saturation_effort * (1.0 - speed), -force_limit, force_limit)
    lower = torch.clamp(saturation_effort * (-1.0 - speed), -force_limit, force_limit)
    return torch.clamp(effort, lower, upper)
