"""March in place: joint position targets that lift the feet by the gait clock.

A policy that has learned to stand finds no way to a step: to lift a foot a little costs balance, and
is paid only when it is lifted by much. So the legs march by themselves, and the policy, whose actions
are too small to stop them, learns to keep the robot upright and to move it meanwhile (Iscen et al.,
1910.02812, modulate trajectory generators likewise).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.envs.mdp.actions import JointPositionAction, JointPositionActionCfg
from mjlab.tasks.velocity.mdp.gait import require_gait_clock, swing_at
from mjlab.utils.lab_api.string import resolve_matching_names_values

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass(kw_only=True)
class MarchActionCfg(JointPositionActionCfg):
    """Joint position targets `q0 + m + scale * action`, where m marches in place."""

    swing: tuple[dict[str, float], ...]
    """Joint offsets in the middle of a swing (rad) by name pattern, one dict for each leg; others 0."""
    offsets: tuple[float, ...] = (0.0, 0.5)
    """Offset of each leg (strides), as in `feet_height_by_phase`."""
    command_name: str = "gait"
    """Gait clock."""

    def build(self, env: ManagerBasedRlEnv) -> MarchAction:
        """Return the term.

        Raises:
            ValueError: there is no such gait clock, legs and offsets differ in number, or a pattern
                matches no joint.
        """
        return MarchAction(self, env)


class MarchAction(JointPositionAction):
    """Commands joint positions (rad) around a march in place in time with the gait clock.

    Leg i adds `s_i swing_i`, where s_i is the clock's `swing`. `clip` bounds the sum.

    Attributes:
        march_change: (N, action_dim) change of the march in the last step (rad).
    """

    _transient = {"_clock", "_command_name", "_offsets", "_swing"}

    def __init__(self, cfg: MarchActionCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        if len(cfg.swing) != len(cfg.offsets):
            raise ValueError(
                f"swing: expected one dict for each of the {len(cfg.offsets)} offsets, got "
                f"{len(cfg.swing)}."
            )
        self._clock = require_gait_clock(env, cfg.command_name)
        self._command_name, self._offsets = cfg.command_name, cfg.offsets
        self._swing = torch.zeros(len(cfg.swing), self.action_dim, device=self.device)
        for leg, table in enumerate(cfg.swing):
            ids, _, values = resolve_matching_names_values(table, self.target_names)
            self._swing[leg, ids] = torch.tensor(values, dtype=torch.float32, device=self.device)
        self._march = torch.zeros_like(self._raw_actions)
        self.march_change = torch.zeros_like(self._march)

    def march_at(self, cycles: torch.Tensor) -> torch.Tensor:
        """Return the march (P, action_dim) (rad) at phases (P,), in strides, of a clock at full amplitude."""
        return swing_at(cycles, self._offsets) @ self._swing

    def process_actions(self, actions: torch.Tensor) -> None:
        """Scale `actions` (N, action_dim), add default pose and march, and clip."""
        march = self._clock.swing(self._offsets) @ self._swing
        self.march_change, self._march = march - self._march, march
        rest = self._offset
        self._offset = rest + march
        super().process_actions(actions)
        # The offset that policies are exported with is the same at every phase.
        self._offset = rest

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Zero the raw action and the march of environments (None means all)."""
        super().reset(env_ids)
        index = slice(None) if env_ids is None else env_ids
        self._march[index] = self.march_change[index] = 0.0

    def export_metadata(self) -> dict[str, list | str | float | torch.Tensor]:
        """Return the march and its clock, under the keys of `mjlab.rl.exporter_utils`."""
        return {
            "march_swing": self._swing,
            "march_offsets": list(self._offsets),
            "march_frequency": self._clock.cfg.frequency,
            "march_fade_s": self._clock.cfg.fade_s,
            "march_standing_threshold": self._clock.cfg.standing_threshold
            if self._clock.cfg.velocity_command_name is not None
            else 0.0,
            "march_starts": list(self._clock.cfg.starts or ()),
            "march_command": self._command_name,
        }
