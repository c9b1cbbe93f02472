"""A small environment with episodes, time-outs and random numbers of all generators."""

from __future__ import annotations

import random
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from mjlab.rl.config import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg


@dataclass
class FakeSceneCfg:
    num_envs: int = 8


@dataclass
class FakeEnvCfg:
    scene: FakeSceneCfg = field(default_factory=FakeSceneCfg)
    seed: int | None = 0
    episode_steps: int = 12
    is_finite_horizon: bool = False
    scale_rewards_by_dt: bool = True
    always_terminate: bool = False


class FakeEnv:
    """A point that actions push and noise shakes; the reward is 1 at the origin, less elsewhere."""

    def __init__(self, cfg: FakeEnvCfg, device: str = "cpu") -> None:
        self.cfg = cfg
        self.device = device
        self.num_envs = cfg.scene.num_envs
        self.render_mode = None
        self.step_dt = 0.5
        self.max_episode_length = cfg.episode_steps
        self.action_manager = SimpleNamespace(
            total_action_dim=2,
            active_terms=["force"],
            get_term=lambda _: SimpleNamespace(action_dim=2),
        )
        self.command_manager = self.termination_manager = SimpleNamespace(active_terms=[])
        self.scene = SimpleNamespace(terrain=None)
        self.curricula_in_use, self.curricula_held = dict, nullcontext
        self.common_step_counter = 0
        self.position = torch.zeros(self.num_envs, 2)
        self.drift = torch.zeros(self.num_envs, 2)
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        self.reset_terminated = torch.zeros(self.num_envs, dtype=torch.bool)
        self.closed = False
        self.seen_actions: torch.Tensor | None = None
        if cfg.seed is not None:
            self.seed(cfg.seed)

    @property
    def unwrapped(self) -> FakeEnv:
        return self

    @staticmethod
    def seed(seed: int = -1) -> int:
        torch.manual_seed(seed)
        np.random.seed(seed)
        random.seed(seed)
        return seed

    def reset(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        self._start_episodes(torch.ones(self.num_envs, dtype=torch.bool))
        return self.get_observations(), {}

    def get_observations(self) -> dict[str, torch.Tensor]:
        return {
            "actor": self.position.clone(),
            "critic": torch.cat((self.position, self.drift), dim=-1),
        }

    def step(self, action: torch.Tensor):
        self.seen_actions = action.clone()
        gust = random.gauss(0.0, 0.01) + float(np.random.normal(0.0, 0.01))
        self.position = self.position + 0.1 * action + self.drift + gust
        self.common_step_counter += 1
        self.episode_length_buf += 1
        reward = torch.exp(-self.position.square().sum(-1)) * self.step_dt
        terminated = self.position.abs().amax(-1) > 1.5
        if self.cfg.always_terminate:
            terminated = torch.ones_like(terminated)
        truncated = self.episode_length_buf >= self.max_episode_length
        log = {"Metrics/distance": self.position.norm(dim=-1).mean(), "plain": 2.0}
        self.reset_terminated = terminated
        self._start_episodes(terminated | truncated)
        return self.get_observations(), reward, terminated, truncated, {"log": log}

    def _start_episodes(self, mask: torch.Tensor) -> None:
        fresh = torch.randn(self.num_envs, 2)
        drift = 0.02 * torch.randn(self.num_envs, 2)
        self.position = torch.where(mask[:, None], fresh, self.position)
        self.drift = torch.where(mask[:, None], drift, self.drift)
        self.episode_length_buf[mask] = 0

    def state_dict(self) -> dict[str, Any]:
        return {
            "position": self.position.clone(),
            "drift": self.drift.clone(),
            "lengths": self.episode_length_buf.clone(),
            "steps": self.common_step_counter,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.position = state["position"].clone()
        self.drift = state["drift"].clone()
        self.episode_length_buf.copy_(state["lengths"])
        self.common_step_counter = state["steps"]

    def close(self) -> None:
        self.closed = True


def runner_cfg(**changes: Any) -> dict[str, Any]:
    """Return a config of small networks, as the dict that runners take."""
    actor = RslRlModelCfg(
        hidden_dims=(8,),
        obs_normalization=True,
        distribution_cfg={
            "class_name": "GaussianDistribution",
            "init_std": 1.0,
            "std_type": "scalar",
        },
    )
    cfg = RslRlOnPolicyRunnerCfg(
        num_steps_per_env=5,
        save_interval=2,
        actor=actor,
        critic=RslRlModelCfg(hidden_dims=(8,), obs_normalization=True),
        algorithm=RslRlPpoAlgorithmCfg(num_learning_epochs=2, num_mini_batches=2),
    )
    return {**asdict(cfg), **changes}
