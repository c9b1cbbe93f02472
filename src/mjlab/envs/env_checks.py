"""Checks of what an environment is given: config and device, actions, environments to reset."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.envs.mdp.terminations import time_out
from mjlab.managers.real_values import check_real

if TYPE_CHECKING:
    from mjlab.envs.env_cfg import ManagerBasedRlEnvCfg


def check_env_cfg(cfg: ManagerBasedRlEnvCfg) -> None:
    """Refuse values that could only fail later.

    Raises:
        ValueError: naming the field, what was given and what is allowed.
    """
    if not _is_count(cfg.scene.num_envs):
        raise ValueError(
            f"scene.num_envs is {cfg.scene.num_envs!r}; the number of environments has to be a "
            "whole number, at least 1 (--num-envs 4096, say)."
        )
    if not _is_count(cfg.decimation):
        raise ValueError(
            f"decimation is {cfg.decimation!r}; it has to be a whole number of physics substeps, "
            "at least 1."
        )
    timestep = cfg.sim.mujoco.timestep
    if not (isinstance(timestep, Real) and timestep > 0):
        raise ValueError(f"sim.mujoco.timestep is {timestep!r}; it has to be positive (seconds).")
    for name, entity in cfg.scene.entities.items():
        if entity is None:
            raise ValueError(
                f"scene.entities[{name!r}] is None; an entity cannot be switched off like a term. "
                f"Give an EntityCfg, or remove it: del cfg.scene.entities[{name!r}]."
            )
    _check_episode_length(cfg)


def check_device(device: Any) -> None:
    """Refuse a device on which no tensor could be made.

    Raises:
        ValueError: no name of a CPU or CUDA device, or a CUDA device that is not there.
    """
    allowed = "Use 'cpu', 'cuda', or 'cuda:<index>'."
    try:
        parsed = torch.device(device) if isinstance(device, str) else None
    except RuntimeError:
        parsed = None
    if parsed is None or parsed.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {device!r}, which is not a device name. {allowed}")
    if parsed.type != "cuda":
        return
    if not torch.cuda.is_available():
        raise ValueError(
            f"device is {device!r}, but PyTorch finds no CUDA here. Use 'cpu', or install an "
            "NVIDIA driver and a PyTorch with CUDA."
        )
    count = torch.cuda.device_count()
    if (parsed.index or 0) >= count:
        raise ValueError(
            f"device is {device!r}, but the indices of the GPUs here are 0 to {count - 1}."
        )


def as_action(action: Any, device: str) -> torch.Tensor:
    """Return an action as a tensor on `device`; arrays and lists of numbers become float32.

    Raises:
        ValueError: it is neither a tensor nor an array of numbers.
        TypeError: it is a tensor of complex numbers, or without data.
    """
    if isinstance(action, torch.Tensor):
        check_real("The action", action)
        return action.to(device)
    try:
        # Copied, because torch warns about arrays that it may not write to.
        return torch.as_tensor(np.array(action), dtype=torch.float32, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"The action is a {type(action).__name__} that does not convert to a tensor ({error}). "
            "Give a float tensor, array or list of shape (environments, components)."
        ) from error


def as_reset_ids(env_ids: Any, num_envs: int, device: str) -> torch.Tensor:
    """Return the environments to reset as a 1-D int64 tensor on `device`.

    Args:
        env_ids: None for all, a slice, a bool mask (num_envs,), or indices in any integer type.
        num_envs: Number of environments.
        device: Device of the result.

    Raises:
        ValueError: a mask of another length, indices that are no integers or out of range.
    """
    if env_ids is None or isinstance(env_ids, slice):
        return torch.arange(num_envs, device=device)[env_ids or slice(None)]
    expected = (
        f"env_ids must be integers from 0 to {num_envs - 1}, a bool mask of length {num_envs}, a "
        "slice, or None for all environments"
    )
    try:
        ids = torch.as_tensor(env_ids, device=device).flatten()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{expected}; got {env_ids!r}.") from error
    if ids.dtype == torch.bool:
        if len(ids) != num_envs:
            raise ValueError(f"{expected}; got a mask of length {len(ids)}.")
        return ids.nonzero().flatten()
    # An empty list becomes a float tensor.
    if ids.numel() == 0:
        return ids.long()
    if ids.is_floating_point() or ids.is_complex():
        raise ValueError(f"{expected}; got numbers of type {ids.dtype}.")
    ids = ids.long()
    wrong = ids[(ids < 0) | (ids >= num_envs)]
    if len(wrong) > 0:
        raise ValueError(f"{expected}; got {wrong[:10].tolist()}{' ...' * (len(wrong) > 10)}.")
    return ids


def _is_count(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and value >= 1


def _check_episode_length(cfg: ManagerBasedRlEnvCfg) -> None:
    length = cfg.episode_length_s
    if not (isinstance(length, Real) and math.isfinite(length) and length >= 0):
        raise ValueError(
            f"episode_length_s is {length!r}; it has to be a finite number of seconds and cannot "
            "be negative."
        )
    if length == 0:
        names = [
            name
            for name, term in cfg.terminations.items()
            if term is not None and term.func is time_out
        ]
        if names:
            raise ValueError(
                f"episode_length_s is 0, so the termination {names[0]!r} would fire at every step. "
                "Set episode_length_s to the length of an episode in seconds, or remove the term."
            )
