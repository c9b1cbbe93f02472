"""Binary action: one component that opens or closes a gripper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.actuator.actuator import constant_within_step
from mjlab.compat import suggests_fields
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.managers.manager_base import label_errors
from mjlab.utils.indexing import as_columns
from mjlab.utils.lab_api.string import resolve_matching_names_values

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@suggests_fields
@dataclass(kw_only=True)
class BinaryJointPositionActionCfg(ActionTermCfg):
    """Joint positions of an open or a closed gripper. `clip` has no effect."""

    actuator_names: tuple[str, ...] | list[str]
    """Patterns of the actuated joints, matched in full."""

    open_command_expr: dict[str, float]
    """Positions if open: joint name pattern to position (rad or m). Must cover every joint."""

    close_command_expr: dict[str, float]
    """Positions if closed, as `open_command_expr`."""

    def build(self, env: ManagerBasedRlEnv) -> BinaryJointPositionAction:
        return BinaryJointPositionAction(self, env)


class BinaryJointPositionAction(ActionTerm):
    """Commands the open positions for actions >= 0 and the closed ones for actions < 0.

    The only component is shared by all joints. Open after a reset.

    Raises `ValueError` if a pattern matches nothing, or a joint has no position.
    """

    cfg: BinaryJointPositionActionCfg

    # Derived from the config; not checkpointed.
    _transient = {"_entity", "_columns", "_open", "_closed"}

    def __init__(self, cfg: BinaryJointPositionActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        ids, self.target_names = self._entity.find_joints_by_actuator_names(cfg.actuator_names)
        self._columns = as_columns(ids, self.device)
        self._open = self._positions("open_command_expr", cfg.open_command_expr)
        self._closed = self._positions("close_command_expr", cfg.close_command_expr)
        self._raw_actions = torch.zeros(self.num_envs, 1, dtype=torch.float32, device=self.device)
        self._processed_actions = self._open.repeat(self.num_envs, 1)

    @property
    def action_dim(self) -> int:
        """1."""
        return 1

    @property
    def raw_action(self) -> torch.Tensor:
        """Last unprocessed action, (N, 1). Zero after a reset."""
        return self._raw_actions

    def process_actions(self, actions: torch.Tensor) -> None:
        """Choose the positions of `actions`, (N, 1)."""
        self._raw_actions.copy_(actions)
        torch.where(self._raw_actions < 0.0, self._closed, self._open, out=self._processed_actions)

    @constant_within_step
    def apply_actions(self) -> None:
        """Write joint position targets."""
        bias = self._entity.data.encoder_bias[:, self._columns]
        self._entity.set_joint_position_target(
            self._processed_actions - bias, joint_ids=self._columns
        )

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Open the gripper and zero the raw action of `env_ids` (None: all)."""
        index = slice(None) if env_ids is None else env_ids
        self._raw_actions[index] = 0.0
        self._processed_actions[index] = self._open

    def _positions(self, name: str, table: dict[str, float]) -> torch.Tensor:
        owner = f"{type(self.cfg).__name__}.{name}"
        with label_errors(owner):
            _, covered, values = resolve_matching_names_values(table, self.target_names)
        missing = [joint for joint in self.target_names if joint not in covered]
        if missing:
            raise ValueError(f"{owner}: expected a position of every joint, got none of {missing}.")
        return torch.tensor(values, dtype=torch.float32, device=self.device)
