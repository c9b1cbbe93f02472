"""Methods of command terms of releases 1.1 to 1.5, called with today's arguments.

These commands update all environments in every call, with `_update_command(self)` and
`compute(self, dt)`. After a partial reset, only some environments may advance, so the state of the
other environments is restored.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

import torch

from mjlab.utils.indexing import as_ids
from mjlab.utils.state import changes_undone

_PHYSICS = ("qpos", "qvel", "mocap_pos", "mocap_quat")


def update_command(method: Any, *args: Any, **kwargs: Any) -> Any:
    """Call `_update_command(self)`. With `env_ids`, only the state of `env_ids` changes."""
    env_ids, args, kwargs = _split_env_ids(args, kwargs)
    with _other_envs_kept(method.__self__, env_ids):
        return method(*args, **kwargs)


def compute(method: Any, dt: Any, *args: Any, **kwargs: Any) -> Any:
    """Call `compute(self, dt)` with scalar `dt`. With `env_ids`, only the state of `env_ids` changes.

    A per-environment `dt` is zero for environments at the start of an episode. The call's decrement
    of their `time_left` is undone.
    """
    term = method.__self__
    env_ids, args, kwargs = _split_env_ids(args, kwargs)
    if isinstance(dt, torch.Tensor):
        if dt.ndim > 0 and env_ids is None:
            step_dt = term._env.step_dt
            term.time_left += step_dt - dt
            dt = step_dt
        else:
            dt = dt.item()
    with _other_envs_kept(term, env_ids):
        return method(dt, *args, **kwargs)


def create_gui(
    method: Callable[..., Any],
    name: str,
    server: Any,
    get_env_idx: Any,
    on_change: Any = None,
    request_action: Any = None,
) -> Any:
    """Call `create_gui(self, name, server, get_env_idx)` with the further arguments it takes."""
    args = (name, server, get_env_idx)
    further = {"on_change": on_change, "request_action": request_action}
    parameters = inspect.signature(method).parameters
    kinds = [parameter.kind for parameter in parameters.values()]
    if inspect.Parameter.VAR_KEYWORD in kinds:
        return method(*args, **further)
    named = {key: value for key, value in further.items() if key in parameters}
    if named:
        return method(*args, **named)
    # Arguments with other names.
    positional = kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return method(*(*args, *further.values())[:positional])


def _split_env_ids(
    args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    """Separate `env_ids` from additional arguments of a legacy method."""
    if "env_ids" in kwargs:
        kwargs = dict(kwargs)
        return kwargs.pop("env_ids"), args, kwargs
    if args and (args[0] is None or isinstance(args[0], (torch.Tensor, slice, list))):
        return args[0], args[1:], kwargs
    return None, args, kwargs


@contextmanager
def _other_envs_kept(term: Any, env_ids: Any) -> Generator[None]:
    """Undo changes of the body to term and physics state outside `env_ids` (None: all).

    Tensors with one row per environment keep their new values in rows `env_ids`. Other state, such as
    step counters and running means, is restored completely, because a reset takes no simulation time.
    Generators are not restored, so that later samples differ.
    """
    env_ids = as_ids(env_ids, term.num_envs, term.device)
    if len(env_ids) == term.num_envs:
        yield
        return
    data = term._env.sim.data
    physics = {name: getattr(data, name).clone() for name in _PHYSICS}
    with changes_undone([term], env_ids, term.num_envs, generators=False):
        yield
    moved = False
    for name, old in physics.items():
        field = getattr(data, name)
        kept = old.index_copy(0, env_ids, field[env_ids])
        moved |= not torch.equal(kept, field)
        field.copy_(kept)
    if moved:
        # The body may have computed derived quantities from the discarded state. Forces of environments
        # outside `env_ids` stay those of the last substep.
        term._env.sim.forward(stage="vel")
        term._env.sim.forward(env_ids)
