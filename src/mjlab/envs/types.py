"""Types of what an environment returns."""

from __future__ import annotations

import torch

VecEnvObs = dict[str, torch.Tensor | dict[str, torch.Tensor]]
"""Observations by group; a group whose terms are not concatenated is a dict by term."""

VecEnvStepReturn = tuple[VecEnvObs, torch.Tensor, torch.Tensor, torch.Tensor, dict]
"""Observations, rewards, terminated, truncated, extras."""
