"""Stable-Baselines3 adapter for `ManagerBasedRlEnv`.

Needs Stable-Baselines3 (`pip install "mjlab[sb3]"`). `examples/sb3_swing_up.py` trains with it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from mjlab.rl.gymnasium_vector import gymnasium_env

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


class Sb3VecEnv(VecEnv):
    """Stable-Baselines3's `VecEnv` interface of a `ManagerBasedRlEnv`.

    When an episode ends, observations are those after the reset, and the environment's info has
    `terminal_observation`, `TimeLimit.truncated` (time-out without termination), and `episode` with
    its return `r`, length `l` and the time `t` (s) since construction, which Stable-Baselines3 logs.
    A `VecMonitor` is not needed.
    """

    def __init__(
        self,
        env: ManagerBasedRlEnv,
        group: str | None = "actor",
        clip_actions: float = 100.0,
    ) -> None:
        """Adapt `env`.

        Args:
            env: Environment, with `auto_reset`.
            group: Observation group used as the observation. None: all, for a `MultiInputPolicy`.
            clip_actions: Bound c: actions are clamped to [-c, c], also in the action space, because
                Stable-Baselines3 requires bounds. SAC and TD3 map their actions to this range: use
                about 1.

        Raises:
            ValueError: the group is unknown, `clip_actions` is not positive, or `auto_reset` is off.
        """
        if not env.unwrapped.cfg.auto_reset:
            raise ValueError(
                "auto_reset: expected True, got False; Stable-Baselines3 does not reset environments."
            )
        # First, because the base constructor reads attributes of the environment.
        self.env = env
        self._envs = gymnasium_env(env, group, clip_actions)
        self._seed: int | None = None
        self._actions: np.ndarray | None = None
        self._begin = time.monotonic()
        spaces = self._envs.single_observation_space, self._envs.single_action_space
        super().__init__(env.unwrapped.num_envs, *spaces)

    def reset(self) -> Any:
        """Start new episodes in all environments; return their observations."""
        observations, _ = self._envs.reset(seed=self._seed)
        self._seed = None
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observations

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next `reset`, shared by all environments; return it once for each."""
        self._seed = super().seed(seed)[0]
        return [self._seed] * self.num_envs

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step; return observations, rewards (N,), dones (N,), and one info dict per environment."""
        observations, rewards, terminated, truncated, infos = self._envs.step(self._actions)
        each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        dones = terminated | truncated
        for row in dones.nonzero()[0].tolist():
            ended = infos["final_info"]
            each[row] = {
                "terminal_observation": infos["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "episode": {
                    "r": float(ended["episode_return"][row]),
                    "l": int(ended["episode_length"][row]),
                    "t": round(time.monotonic() - self._begin, 6),
                },
            }
        return observations, rewards, dones, each

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, once for each of `indices`."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment, shared by all `indices`."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the environment once; return the result for each of `indices`."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return for each of `indices` if `wrapper_class` is among the wrappers of the environment.

        True for Stable-Baselines3's `Monitor`: infos already have its `episode`.
        """
        env, found = self.env, wrapper_class is Monitor
        while env is not env.unwrapped and not found:
            found, env = isinstance(env, wrapper_class), env.env
        return [found for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return one image of each environment; None for each without a render mode."""
        return self._envs.render() or [None] * self.num_envs

    def close(self) -> None:
        """Close the environment."""
        self._envs.close()
