"""What evaluations of the manipulation tasks measure: whether, and how well, objects are placed."""

from __future__ import annotations

from typing import Any

import torch

_COMMAND = "lift_height"


def placed_at_goal(env: Any) -> torch.Tensor:
    """Return whether the object was at its goal, or, where time ran out on one too new, at the last.

    (num_envs,) bool. That is asked at the end of an episode. A goal is too new that came so shortly
    before that nobody could have reached it; see `GoalCommand.goal_is_met`. Where it is not time that
    ended the episode, the goal that there was then counts, however new.
    """
    term = _term(env)
    is_last_step = env.episode_length_buf >= env.max_episode_length - 1
    return torch.where(is_last_step, term.goal_is_met(), term.compute_success())


def position_error(env: Any) -> torch.Tensor:
    """Return the distance from the object to its goal, (num_envs,), in metres."""
    return _term(env).metrics["position_error"]


def at_goal(env: Any) -> torch.Tensor:
    """Return 1 where the object is at its goal, else 0, (num_envs,)."""
    return _term(env).metrics["at_goal"]


def _term(env: Any) -> Any:
    return env.command_manager.get_term(_COMMAND)


PLACEMENT = {"position_error": position_error, "at_goal": at_goal}
"""Metrics by the name under which evaluations report them; of `at_goal`, the mean over an episode
is the share of the time that the object was at its goal."""
