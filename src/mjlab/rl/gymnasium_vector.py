"""Gymnasium vector environment around `ManagerBasedRlEnv`, with NumPy arrays or torch tensors.

Needs Gymnasium (`pip install "mjlab[gymnasium]"`).
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, iterate

from mjlab.managers.action_manager import as_action
from mjlab.utils.errors import WrongStateError, check_one_of, check_positive
from mjlab.utils.torch import torch_threads, using_torch_threads

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.observation_manager import ObservationManager


def gymnasium_env(
    env: ManagerBasedRlEnv,
    group: str | None = None,
    clip_actions: float | None = None,
    tensors: bool = False,
) -> GymnasiumVectorEnv:
    """Return `env` as a Gymnasium vector environment; closing it closes `env`.

    Args:
        env: Environment.
        group: Observation group used as the observation. None: all groups, as a `Dict`.
        clip_actions: Bound c: actions are clamped to [-c, c], also in the action space. None:
            unbounded.
        tensors: Return torch tensors on the environment's device instead of NumPy arrays.

    Raises:
        ValueError: the group is unknown, or `clip_actions` is not positive.
    """
    return GymnasiumVectorEnv(env, group, clip_actions, tensors)


class GymnasiumVectorEnv(VectorEnv):
    """`ManagerBasedRlEnv` with Gymnasium's vector interface; see `gymnasium_env`.

    Environments are reset in the step that ends their episode (`AutoresetMode.SAME_STEP`). The
    `infos` of that step hold the final values, as in Gymnasium's vector environments:

    - `final_obs`: object array (N,) with the last observation of episodes that ended, else None.
      If the physics diverged, the observation before the step.
    - `final_info`: `episode_return` and `episode_length` (N,) of the episodes that ended.
    - `_final_obs`, `_final_info`, and within `final_info` `_episode_return` and `_episode_length`: (N,)
      bool, True if the episode ended.

    With `auto_reset=False` environments are not reset (`AutoresetMode.DISABLED`); reset those that
    ended by `reset(options={"reset_mask": mask})`.

    With `is_finite_horizon`, time-outs count as terminations.

    Rewards (N,) are float32. Arrays belong to the caller: later steps do not write to them.
    """

    def __init__(
        self,
        env: ManagerBasedRlEnv,
        group: str | None = None,
        clip_actions: float | None = None,
        tensors: bool = False,
    ) -> None:
        self.env = env
        core = env.unwrapped
        self.num_envs = core.num_envs
        self.device = torch.device(core.device)
        self.render_mode = env.render_mode
        self._resets = core.cfg.auto_reset
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": core.metadata["render_fps"],
            "autoreset_mode": AutoresetMode.SAME_STEP if self._resets else AutoresetMode.DISABLED,
        }
        # TorchRL reads this attribute of Gymnasium's vector environments.
        self.autoreset_mode = self.metadata["autoreset_mode"]
        self.single_observation_space = observation_space(core, group)
        self.single_action_space = action_space(core, clip_actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._group, self._limit, self._tensors = group, clip_actions, tensors
        self._returns = torch.zeros(self.num_envs, device=self.device)
        self._observations: dict[str, Any] = {}
        self._first_state: dict[str, Any] | None = None
        core.observes_ends = core.observes_failures = self._resets

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all environments, or those with `options["reset_mask"]` (N,) bool.

        A `seed` restores the state of the first `reset` with a seed, including curricula and other
        state that outlasts episodes, and seeds every random number generator of the process (Python,
        NumPy, torch). Randomizations made when the environment was built stay.

        Raises:
            ValueError: the mask has the wrong shape or type, or is combined with a seed.
        """
        super().reset(seed=seed)
        mask = torch.ones(self.num_envs, dtype=torch.bool)
        if options is not None and "reset_mask" in options:
            if seed is not None:
                raise ValueError("reset: expected a seed or a reset_mask, got both.")
            mask = torch.as_tensor(options["reset_mask"])
            # Integers would be interpreted as ids.
            if mask.shape != (self.num_envs,) or mask.dtype != torch.bool:
                raise ValueError(
                    f"reset_mask: expected ({self.num_envs},) bool, got {tuple(mask.shape)} "
                    f"{str(mask.dtype).removeprefix('torch.')}."
                )
        mask = mask.to(self.device)
        if seed is not None:
            core = self.env.unwrapped
            # Loading compares the shapes of observations and writes to them; the reset makes new
            # tensors, so that those of the caller are not changed.
            core.reset()
            if self._first_state is None:
                self._first_state = copy.deepcopy(core.state_dict())
            core.load_state_dict(self._first_state)
        self._observations, _ = self.env.reset(seed=seed, env_ids=mask)
        self._returns.masked_fill_(mask, 0.0)
        return self._shown(self._observations), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all environments by one step.

        Args:
            actions: (N, A), array or tensor.

        Returns:
            Observations, rewards (N,), terminations (N,) bool, truncations (N,) bool, infos.
        """
        actions = as_action(actions, self.env.unwrapped.device)
        before = self._observations
        if not before:
            raise WrongStateError(
                "step: expected an environment that was reset, got a new one; call reset."
            )
        lengths = self.env.unwrapped.episode_length_buf.clone()
        results = step_env(self.env, actions, self._limit)
        self._observations, rewards, terminated, truncated, extras = results
        self._returns += rewards
        infos: dict[str, Any] = {}
        ended = terminated | truncated
        if self._resets and ended.any():
            self._add_ends(infos, ended, lengths + 1, before, extras)
            self._returns.masked_fill_(ended, 0.0)
        rewards, terminated, truncated = map(self._arrays, (rewards, terminated, truncated))
        return self._shown(self._observations), rewards, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return one image of each environment; None without a render mode."""
        if self.render_mode != "rgb_array":
            return None
        render: Any = self.env.unwrapped.render
        return tuple(render(env_idx=index) for index in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment."""
        self.env.close()

    def _add_ends(
        self,
        infos: dict[str, Any],
        ended: torch.Tensor,
        lengths: torch.Tensor,
        before: dict[str, Any],
        extras: dict[str, Any],
    ) -> None:
        """Add final observations, returns and lengths of environments `ended` (N,) to `infos`."""
        final, space = np.full(self.num_envs, None, dtype=object), self.observation_space
        rows = ended.nonzero().flatten()
        ids = rows[:0]
        if "final_ids" in extras:
            ids = extras["final_ids"]
            shown = self._shown(extras["final_observations"])
            for row, one in zip(ids.tolist(), iterate(space, shown), strict=True):
                final[row] = one
        # Environments without a final observation diverged.
        diverged = rows[~torch.isin(rows, ids)]
        if len(diverged) > 0:
            shown = self._shown(before, diverged)
            for row, one in zip(diverged.tolist(), iterate(space, shown), strict=True):
                final[row] = one
        mask = self._arrays(ended)
        infos |= {
            "final_obs": final,
            "_final_obs": mask,
            "final_info": {
                "episode_return": self._arrays(torch.where(ended, self._returns, 0.0)),
                "_episode_return": mask,
                "episode_length": self._arrays(torch.where(ended, lengths, 0)),
                "_episode_length": mask,
            },
            "_final_info": mask,
        }

    def _shown(self, observations: dict[str, Any], rows: Any = slice(None)) -> Any:
        """Return the observations of the group, as arrays for the caller."""
        shown = observations if self._group is None else observations[self._group]
        return self._arrays(shown, rows)

    def _arrays(self, values: Any, rows: Any = slice(None)) -> Any:
        if isinstance(values, dict):
            return {name: self._arrays(value, rows) for name, value in values.items()}
        return values[rows] if self._tensors else values[rows].cpu().numpy()


def step_env(
    env: Any, actions: torch.Tensor, limit: float | None
) -> tuple[dict[str, Any], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Step a `ManagerBasedRlEnv` for a library that keeps the results, with few threads of torch.

    Args:
        env: Environment.
        actions: Actions, (N, A).
        limit: Bound c: actions are clamped to [-c, c]. None: unbounded.

    Returns:
        Results of `env.step`. With `is_finite_horizon`, time-outs are terminations instead of
        truncations.
    """
    if limit is not None:
        actions = actions.clamp(-limit, limit)
    core = env.unwrapped
    # As the runner: with torch's default of all cores, steps of Go1 and G1 take 1.08 and 1.10 times as
    # long, because threads wait for each other over small tensors.
    with using_torch_threads(torch_threads(0, core.num_envs)):
        observations, rewards, terminated, truncated, extras = env.step(actions)
    if core.cfg.is_finite_horizon:
        terminated, truncated = terminated | truncated, torch.zeros_like(truncated)
    return observations, rewards, terminated, truncated, extras


# Spaces.


def observation_space(env: ManagerBasedRlEnv, group: str | None = None) -> gymnasium.Space:
    """Return the space of one environment's observations: a `Dict` of all groups, or one group's.

    Bounds are the `clip` of terms, times their scale.

    Raises:
        ValueError: the group is unknown.
    """
    manager = env.observation_manager
    names = list(manager.active_terms)
    if group is None:
        return gymnasium.spaces.Dict({name: _group_space(manager, name) for name in names})
    check_one_of("group", group, names)
    return _group_space(manager, group)


def action_space(env: ManagerBasedRlEnv, limit: float | None = None) -> gymnasium.spaces.Box:
    """Return the space of one environment's actions (A,), within [-`limit`, `limit`]; None: unbounded.

    Raises:
        ValueError: `limit` is not positive.
    """
    if limit is not None:
        check_positive("clip_actions", limit)
    bound = np.inf if limit is None else limit
    shape = (env.action_manager.total_action_dim,)
    return gymnasium.spaces.Box(-bound, bound, shape, np.float32)


def _group_space(manager: ObservationManager, group: str) -> gymnasium.Space:
    shapes = manager.group_obs_term_dim[group]
    terms = manager.active_terms[group]
    bounds = [
        _term_bounds(manager, group, term, shape) for term, shape in zip(terms, shapes, strict=True)
    ]
    if not manager.group_obs_concatenate[group]:
        boxes = [gymnasium.spaces.Box(low, high, dtype=np.float32) for low, high in bounds]
        return gymnasium.spaces.Dict(dict(zip(terms, boxes, strict=True)))
    cfg = manager.cfg[group]
    assert cfg is not None
    axis = cfg.concatenate_dim
    lows, highs = zip(*bounds, strict=True)
    low, high = np.concatenate(lows, axis=axis), np.concatenate(highs, axis=axis)
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


def _term_bounds(
    manager: ObservationManager, group: str, term: str, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bound of each entry of a term."""
    cfg = manager.get_term_cfg(group, term)
    if cfg.clip is None:
        return np.full(shape, -np.inf, np.float32), np.full(shape, np.inf, np.float32)
    scale = torch.as_tensor(1.0 if cfg.scale is None else cfg.scale).cpu().float().numpy()
    if scale.ndim > 0 and shape[-1] != scale.shape[-1]:
        # A flat history repeats the components.
        scale = np.tile(scale, shape[-1] // scale.shape[-1])
    # An infinite bound times a scale of 0 is 0.
    ends = [
        np.broadcast_to(np.where(scale == 0.0, 0.0, np.float32(end) * scale), shape)
        for end in cfg.clip
    ]
    return np.minimum(*ends), np.maximum(*ends)
