"""Final observations of episodes that end in a step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv


def final_observations(env: ManagerBasedRlEnv, moved: torch.Tensor | None) -> dict[str, Any]:
    """Return the entries of `extras` about k episodes that end, before their reset; {} if k is 0.

    Episodes that are truncated and not terminated; with `observes_failures` all that end, except
    those that diverged. `final_observations`, group to (k, ...), are the observations that `step`
    would have returned had the episodes continued, and `final_ids`, (k,), their environments in
    ascending order. Commands are an exception: they are those of the step, neither advanced nor
    resampled. Trajectories do not change, nor what resets and curricula read: derived quantities,
    rays, images, random numbers.

    Args:
        env: Environment, after the events of a step.
        moved: Environments moved by an event, (N,) bool. None: no environment.
    """
    if env.observes_failures:
        observed = env.reset_buf & ~env.diverged
    else:
        observed = env.reset_time_outs & ~env.reset_terminated
    ids = observed.nonzero().flatten()
    if len(ids) == 0:
        return {}
    with env.sim.looking_ahead(ids):
        if moved is not None and len(placed := ids[moved[ids]]) > 0:
            env.sim.forward(placed)
        env.sim.sense(ids)
        observations = env.observation_manager.preview()
    kept = {
        name: value[ids]
        if isinstance(value, torch.Tensor)
        else {term: part[ids] for term, part in value.items()}
        for name, value in observations.items()
    }
    return {"final_observations": kept, "final_ids": ids}
