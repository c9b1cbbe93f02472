"""skrl adapter for `ManagerBasedRlEnv`.

Needs skrl (`pip install "mjlab[skrl]"`). `examples/skrl_swing_up.py` trains with it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import torch
from skrl.envs.wrappers.torch import Wrapper

from mjlab.rl.gymnasium_vector import action_space, observation_space, step_env

if TYPE_CHECKING:
    from skrl.agents.torch import Agent

    from mjlab.envs import ManagerBasedRlEnv


class SkrlEnv(Wrapper):
    """skrl's `Wrapper` interface of a `ManagerBasedRlEnv`, with tensors on the environment's device.

    Environments are reset in the step that ends their episode. The infos of that step have the
    final observations, for agents made by `with_final_observations`.
    """

    def __init__(
        self,
        env: ManagerBasedRlEnv,
        group: str = "actor",
        state_group: str | None = None,
        clip_actions: float | None = None,
    ) -> None:
        """Adapt `env`.

        Args:
            env: Environment, with `auto_reset`.
            group: Observation group of the policy.
            state_group: Observation group of the critic (skrl's state). None: no state.
            clip_actions: Bound c: actions are clamped to [-c, c], also in the action space. None:
                unbounded.

        Raises:
            ValueError: a group is unknown, `clip_actions` is not positive, or `auto_reset` is off.
        """
        super().__init__(env)
        core = env.unwrapped
        if not core.cfg.auto_reset:
            raise ValueError(
                "auto_reset: expected True, got False; skrl's trainers do not reset environments."
            )
        self._group, self._state_group, self._limit = group, state_group, clip_actions
        self._observation_space = observation_space(core, group)
        self._state_space = observation_space(core, state_group) if state_group else None
        self._action_space = action_space(core, clip_actions)
        self._observations: dict[str, Any] | None = None
        core.observes_ends = core.observes_failures = True

    @property
    def observation_space(self) -> gymnasium.Space:
        """Space of one environment's observations."""
        return self._observation_space

    @property
    def state_space(self) -> gymnasium.Space | None:
        """Space of one environment's critic observations; None without a state."""
        return self._state_space

    @property
    def action_space(self) -> gymnasium.Space:
        """Space of one environment's actions."""
        return self._action_space

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Reset all environments at the first call, and return the last observations afterwards."""
        if self._observations is None:
            self._observations, _ = self._env.reset()
        return self._observations[self._group], {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, Any]:
        """Step all environments.

        Args:
            actions: Actions, (N, A).

        Returns:
            Observations; rewards, terminated and truncated (N, 1); infos.
        """
        results = step_env(self._env, actions, self._limit)
        self._observations, rewards, terminated, truncated, extras = results
        # skrl bootstraps all truncated episodes, even those that terminated in the same step.
        truncated = truncated & ~terminated
        infos: dict[str, Any] = {"log": dict(extras["log"]), "num_envs": len(rewards)}
        if "final_ids" in extras:
            final = extras["final_observations"]
            infos["final_ids"] = extras["final_ids"]
            infos["final_observations"] = final[self._group]
            infos["final_states"] = final[self._state_group] if self._state_group else None
        rewards, terminated, truncated = (
            value.view(-1, 1) for value in (rewards, terminated, truncated)
        )
        return self._observations[self._group], rewards, terminated, truncated, infos

    def state(self) -> torch.Tensor | None:
        """Return the critic observations, (N, ...); None without a state."""
        if self._state_group is None or self._observations is None:
            return None
        return self._observations[self._state_group]

    def render(self, *args: Any, **kwargs: Any) -> Any:
        """Return one image of all environments, or None without a render mode."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


def with_final_observations(agent: type[Agent]) -> type[Agent]:
    """Return a subclass of `agent` that records the final observations of episodes.

    skrl's trainers pass on the results of `step`, with the first observation of the next episode after
    an end. With `time_limit_bootstrap`, an agent would bootstrap from its value. The agent must have
    all environments; several agents with scopes raise ValueError.
    """

    class WithFinalObservations(agent):
        def record_transition(
            self, *, next_observations: Any, next_states: Any, infos: Any, **rest: Any
        ) -> None:
            if len(next_observations) != infos["num_envs"]:
                raise ValueError(
                    f"with_final_observations: expected one agent for all {infos['num_envs']} "
                    f"environments, got {len(next_observations)} of them; do not use scopes."
                )
            if "final_ids" in infos:
                ids, states = infos["final_ids"], infos["final_states"]
                next_observations = next_observations.index_copy(
                    0, ids, infos["final_observations"]
                )
                if next_states is not None and states is not None:
                    next_states = next_states.index_copy(0, ids, states)
            super().record_transition(
                next_observations=next_observations, next_states=next_states, infos=infos, **rest
            )

    WithFinalObservations.__name__ = agent.__name__
    return WithFinalObservations
