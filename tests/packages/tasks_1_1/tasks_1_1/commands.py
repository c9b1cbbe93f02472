"""Goal positions, in two ways to write a command: by its parts, and by `compute`."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from mjlab.managers.command_manager import CommandTerm, CommandTermCfg


class GoalCommand(CommandTerm):
    """Goal that drifts, (N, 1)."""

    cfg: GoalCommandCfg

    def __init__(self, cfg: GoalCommandCfg, env):
        super().__init__(cfg, env)
        self.goal = torch.zeros(self.num_envs, 1, device=self.device)
        self.metrics["goal"] = torch.zeros(self.num_envs, device=self.device)

    @property
    def command(self) -> torch.Tensor:
        return self.goal

    def _update_metrics(self) -> None:
        self.metrics["goal"] += self.goal[:, 0].abs()

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        goal = torch.empty(len(env_ids), device=self.device)
        self.goal[env_ids, 0] = goal.uniform_(*self.cfg.goal_range)

    def _update_command(self) -> None:
        self.goal *= self.cfg.drift


@dataclass(kw_only=True)
class GoalCommandCfg(CommandTermCfg):
    goal_range: tuple[float, float]
    drift: float = 0.999

    def build(self, env) -> GoalCommand:
        return GoalCommand(self, env)


class ClockCommand(CommandTerm):
    """Sine and cosine of a phase that runs on with the time, (N, 2)."""

    cfg: ClockCommandCfg

    def __init__(self, cfg: ClockCommandCfg, env):
        super().__init__(cfg, env)
        self.phase = torch.zeros(self.num_envs, device=self.device)

    @property
    def command(self) -> torch.Tensor:
        return torch.stack([self.phase.sin(), self.phase.cos()], dim=-1)

    def compute(self, dt: float) -> None:
        super().compute(dt)
        self.phase += dt * self.cfg.rate

    def _update_metrics(self) -> None:
        pass

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        self.phase[env_ids] = 0.0

    def _update_command(self) -> None:
        pass


@dataclass(kw_only=True)
class ClockCommandCfg(CommandTermCfg):
    rate: float = 3.0

    def build(self, env) -> ClockCommand:
        return ClockCommand(self, env)
