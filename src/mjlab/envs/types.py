"""Types of observations and step results."""

from __future__ import annotations

import torch

VecEnvObs = dict[str, torch.Tensor | dict[str, torch.Tensor]]
"""Observations by group; groups whose terms are not concatenated are dicts by term."""

VecEnvStepReturn = tuple[VecEnvObs, torch.Tensor, torch.Tensor, torch.Tensor, dict]
"""Observations, rewards, terminated, truncated, extras."""
