"""What exact resume needs beyond the networks: environments, generators, clocks.

Everything is plain data, so that a checkpoint loads with `weights_only=True`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.rsl import TensorDict
from mjlab.utils.random import rng_state, set_rng_state

if TYPE_CHECKING:
    from mjlab.rl.rsl import VecEnv
    from mjlab.rl.run_logger import RunLogger

VERSION = 1


def capture(
    env: VecEnv, algorithm: Any, run_logger: RunLogger, observations: TensorDict
) -> dict[str, Any]:
    """Return the state between two iterations, `observations` being the ones to act on next."""
    unwrapped: Any = getattr(env, "unwrapped", env)
    state: dict[str, Any] = {
        "version": VERSION,
        "num_envs": env.num_envs,
        "rng": rng_state(),
        "observations": {key: value.clone() for key, value in _flat(observations).items()},
        "logger": run_logger.state_dict(),
        "hidden_states": [_hidden_state(model) for model in _models(algorithm)],
        "rnd": _rnd_state(getattr(algorithm, "rnd", None)),
    }
    if hasattr(unwrapped, "state_dict"):
        state["env"] = unwrapped.state_dict()
    return state


def restore(
    state: dict[str, Any], env: VecEnv, algorithm: Any, run_logger: RunLogger
) -> TensorDict:
    """Restore what `capture` returned, and return the observations to act on next.

    Raises:
        ValueError: the state is of other environments; nothing was changed then.
        CheckpointError: the state is malformed.
    """
    try:
        return _restore(state, env, algorithm, run_logger)
    except torch.OutOfMemoryError:
        raise
    except (KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        raise CheckpointError(
            f"The checkpoint's training_state is malformed ({type(error).__name__}: {error}). Use an "
            "earlier checkpoint, or load only its networks with load_cfg={'actor': True, 'critic': True}."
        ) from error


def _restore(
    state: dict[str, Any], env: VecEnv, algorithm: Any, run_logger: RunLogger
) -> TensorDict:
    if state.get("version") != VERSION:
        raise ValueError(f"It was saved in format {state.get('version')}, not {VERSION}.")
    if state["num_envs"] != env.num_envs:
        raise ValueError(
            f"It is of {state['num_envs']} environments and this run has {env.num_envs}; give "
            f"--num-envs {state['num_envs']}."
        )
    observations = _unflat(state["observations"], env.num_envs)
    expected = env.get_observations()
    if _shapes(observations) != _shapes(expected):
        raise ValueError(
            f"Its observations are {_shapes(observations)}, and this run's {_shapes(expected)}."
        )
    unwrapped: Any = getattr(env, "unwrapped", env)
    if "env" in state and hasattr(unwrapped, "load_state_dict"):
        # Tensors that the rollout made can only be written to in this mode.
        with torch.inference_mode():
            unwrapped.load_state_dict(_to(state["env"], env.device))
    device = run_logger.device
    run_logger.load_state_dict(state["logger"])
    for model, hidden in zip(_models(algorithm), state["hidden_states"], strict=True):
        if hidden is not None:
            model.reset(hidden_state=_as_tuples(_to(hidden, device)))
    if hasattr(algorithm, "last_hidden_states"):
        # Of rsl_rl's distillation, which begins an update with those before the iteration.
        algorithm.last_hidden_states = (algorithm.student.get_hidden_state(), None)
    _restore_rnd(getattr(algorithm, "rnd", None), state["rnd"], device)
    observations = observations.to(device)
    # Last, because restoring may have drawn random numbers.
    set_rng_state(state["rng"])
    return observations


def _models(algorithm: Any) -> list[Any]:
    names = ("actor", "critic", "student", "teacher")
    return [getattr(algorithm, name) for name in names if hasattr(algorithm, name)]


def _hidden_state(model: Any) -> Any:
    hidden = model.get_hidden_state()
    return list(hidden) if isinstance(hidden, tuple) else hidden


def _as_tuples(hidden: Any) -> Any:
    return tuple(hidden) if isinstance(hidden, list) else hidden


def _rnd_state(rnd: Any) -> dict[str, Any] | None:
    if rnd is None:
        return None
    average = getattr(getattr(rnd, "reward_normalizer", None), "disc_avg", None)
    return {
        "update_counter": rnd.update_counter,
        "discounted_average": None if average is None else average.avg,
    }


def _restore_rnd(rnd: Any, state: dict[str, Any] | None, device: Any) -> None:
    if rnd is None or state is None:
        return
    rnd.update_counter = state["update_counter"]
    average = getattr(getattr(rnd, "reward_normalizer", None), "disc_avg", None)
    if average is not None:
        average.avg = _to(state["discounted_average"], device)


def _flat(observations: TensorDict) -> dict[str, torch.Tensor]:
    """Return the tensors by name; names of nested ones are joined by a newline."""
    return {
        "\n".join(key) if isinstance(key, tuple) else key: observations.get(key)
        for key in observations.keys(include_nested=True, leaves_only=True)
    }


def _shapes(observations: TensorDict) -> dict[str, tuple[int, ...]]:
    return {key: tuple(value.shape) for key, value in _flat(observations).items()}


def _unflat(tensors: dict[str, torch.Tensor], num_envs: int) -> TensorDict:
    observations = TensorDict({}, batch_size=[num_envs])
    for key, value in tensors.items():
        observations.set(tuple(key.split("\n")), value)
    return observations


def _to(value: Any, device: Any) -> Any:
    """Move all tensors within dicts and lists to `device`."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {key: _to(item, device) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_to(item, device) for item in value)
    return value
