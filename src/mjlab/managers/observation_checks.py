"""Checks of noise, clip and scale of an observation term, made when it is built."""

from __future__ import annotations

from numbers import Real
from typing import Any

import torch

from mjlab.utils.noise import NoiseCfg, NoiseModelCfg


def check_noise(label: str, noise: Any) -> None:
    """Raise `ValueError` unless `noise` is None or the config of a noise or a noise model."""
    if noise is None or isinstance(noise, NoiseCfg | NoiseModelCfg):
        return
    raise ValueError(
        f"Observation term {label!r}: noise is {noise!r}, but must be a NoiseCfg "
        "(UniformNoiseCfg(n_min=-0.1, n_max=0.1), say), a NoiseModelCfg, or None."
    )


def check_clip(label: str, clip: Any) -> None:
    """Raise `ValueError` unless `clip` is None or two numbers, the second not the smaller."""
    if clip is None:
        return
    is_pair = (
        isinstance(clip, tuple | list)
        and len(clip) == 2
        and all(isinstance(bound, Real) for bound in clip)
    )
    # A bound that is NaN fails the comparison as well.
    if not is_pair or not clip[0] <= clip[1]:
        raise ValueError(
            f"Observation term {label!r}: clip is {clip!r}, but must be (lowest, highest), two "
            "numbers of which the second is not the smaller; None does not clip."
        )


def scale_tensor(label: str, scale: Any, raw_shape: torch.Size, device: str) -> torch.Tensor:
    """Return `scale` as a tensor that multiplies values of `raw_shape` (num_envs, ...).

    A tensor is returned as it is, anything else as float32 on `device`.

    Raises `ValueError` if it is no number or numbers, or does not fit `raw_shape`.
    """
    tensor = scale
    if not isinstance(scale, torch.Tensor):
        try:
            tensor = torch.tensor(scale, dtype=torch.float32, device=device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(
                f"Observation term {label!r}: scale is {scale!r}, but must be one number, one for "
                "each component, or None."
            ) from error
    if not _fits(tensor.shape, raw_shape):
        raise ValueError(
            f"Observation term {label!r}: scale has shape {tuple(tensor.shape)}, which does not "
            f"fit the term's value of shape {tuple(raw_shape)}. Give one number, or one for each "
            f"of the {raw_shape[-1]} components of the last axis."
        )
    return tensor


def _fits(shape: torch.Size, raw_shape: torch.Size) -> bool:
    try:
        # A larger result would mean that the scale stretches the observation.
        return torch.broadcast_shapes(shape, raw_shape) == raw_shape
    except RuntimeError:
        return False
