"""rsl_rl adapter for `ManagerBasedRlEnv`."""

from __future__ import annotations

import dataclasses
import warnings
from typing import TYPE_CHECKING, Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from mjlab.utils.spaces import batch_space

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnvCfg
    from mjlab.utils.spaces import Space


class RslRlVecEnvWrapper(VecEnv):
    """rsl_rl's `VecEnv` interface of a `ManagerBasedRlEnv` (possibly wrapped).

    Observations are a TensorDict of groups with batch size [num_envs]; `terminated` and `truncated`
    are combined to `dones`. Time-outs without termination are marked in `extras["time_outs"]`, for
    bootstrapping by the algorithm, unless the task has a finite horizon.
    """

    def __init__(self, env: ManagerBasedRlEnv, clip_actions: float | None = None):
        """Wrap `env` and reset it once.

        Args:
            env: Environment.
            clip_actions: Bound c: actions are clamped to [-c, c] before `env`. None: unbounded.

        """
        if clip_actions is not None and not clip_actions > 0.0:
            warnings.warn(
                f"agent.clip_actions: expected a number > 0, got {clip_actions}.",
                UserWarning,
                stacklevel=2,
            )
        self.env = env
        self.clip_actions = clip_actions
        self.num_envs = self.unwrapped.num_envs
        self.device = torch.device(self.unwrapped.device)
        self.max_episode_length = self.unwrapped.max_episode_length
        self.num_actions = self.unwrapped.action_manager.total_action_dim
        if clip_actions is not None:
            unwrapped, limits = self.unwrapped, {"low": -clip_actions, "high": clip_actions}
            space = dataclasses.replace(unwrapped.single_action_space, **limits)
            unwrapped.single_action_space = space
            unwrapped.action_space = batch_space(space, self.num_envs)
        self.env.reset()

    def __str__(self) -> str:
        return f"<{type(self).__name__}{self.env!r}>"

    __repr__ = __str__

    @classmethod
    def class_name(cls) -> str:
        """Name of this class."""
        return cls.__name__

    @property
    def cfg(self) -> ManagerBasedRlEnvCfg:  # ty: ignore[incompatible-property-override]
        """Config of the environment."""
        return self.unwrapped.cfg

    @property
    def render_mode(self) -> str | None:
        """Render mode of the environment."""
        return self.env.render_mode

    @property
    def observation_space(self) -> Space:
        """Space of all environments' observations."""
        return self.env.observation_space

    @property
    def action_space(self) -> Space:
        """Space of all environments' actions."""
        return self.env.action_space

    @property
    def unwrapped(self) -> ManagerBasedRlEnv:
        """Environment without wrappers."""
        return self.env.unwrapped

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Number of steps since the last reset, (num_envs,), int64.

        Assignment copies into the environment's tensor, so that references to it stay valid.
        """
        return self.unwrapped.episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.unwrapped.episode_length_buf.copy_(value)

    def observe_ends(self, enabled: bool = True) -> None:
        """Enable final observations of episodes that time out.

        In steps with k time-outs, `step` returns `extras["final_observations"]`, a TensorDict of batch
        size [k], and `extras["final_ids"]` (k,). Without effect if time-outs are not bootstrapped
        (`is_finite_horizon`) or the environment cannot observe them.
        """
        env = self.unwrapped
        if hasattr(env, "observes_ends"):
            env.observes_ends = enabled and not self.cfg.is_finite_horizon

    def seed(self, seed: int = -1) -> int:
        """Seed every random number generator; -1 draws a seed. Returns the seed used."""
        return self.unwrapped.seed(seed)

    def reset(self) -> tuple[TensorDict, dict]:
        """Start new episodes in all environments."""
        observations, extras = self.env.reset()
        return TensorDict(observations, batch_size=[self.num_envs]), extras

    def get_observations(self) -> TensorDict:
        """Return the observations of the last step or reset."""
        return TensorDict(self.unwrapped.get_observations(), batch_size=[self.num_envs])

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Step all environments.

        Args:
            actions: Actions, (num_envs, num_actions).

        Returns:
            Observations; rewards (num_envs,); dones (num_envs,) int64; extras.
        """
        if self.clip_actions is not None:
            actions = torch.clamp(actions, -self.clip_actions, self.clip_actions)
        observations, rewards, terminated, truncated, extras = self.env.step(actions)
        dones = (terminated | truncated).to(dtype=torch.long)
        if not self.cfg.is_finite_horizon:
            # A terminal state has no future to bootstrap from, even if the episode timed out in the
            # same step.
            extras["time_outs"] = truncated & ~terminated
        if "final_observations" in extras:
            extras["final_observations"] = TensorDict(
                extras["final_observations"], batch_size=[len(extras["final_ids"])]
            )
        return TensorDict(observations, batch_size=[self.num_envs]), rewards, dones, extras

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
