"""Noise models: noise that keeps state between calls."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.utils.noise import noise_cfg


@stateful
class NoiseModel:
    """Applies the noise of its config; subclasses keep state for each environment."""

    def __init__(
        self, noise_model_cfg: noise_cfg.NoiseModelCfg, num_envs: int, device: str
    ) -> None:
        """Make the model. Raises `ValueError` if the config has no noise."""
        if noise_model_cfg.noise_cfg is None:
            raise ValueError(f"{type(noise_model_cfg).__name__}.noise_cfg is None; set a NoiseCfg.")
        self._noise_model_cfg = noise_model_cfg
        self._num_envs = num_envs
        self._device = device

    def __call__(self, data: torch.Tensor) -> torch.Tensor:
        """Return `data`, (num_envs, ...), with noise."""
        return self._noise_model_cfg.noise_cfg.apply(data)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Start the given environments (None: all) anew."""


class NoiseModelWithAdditiveBias(NoiseModel):
    """Noise plus a bias, drawn for each environment when it is reset."""

    _noise_model_cfg: noise_cfg.NoiseModelWithAdditiveBiasCfg

    def __init__(
        self,
        noise_model_cfg: noise_cfg.NoiseModelWithAdditiveBiasCfg,
        num_envs: int,
        device: str,
    ) -> None:
        """Make the model. Raises `ValueError` if the noise or the bias is missing."""
        super().__init__(noise_model_cfg, num_envs, device)
        if noise_model_cfg.bias_noise_cfg is None:
            raise ValueError(
                f"{type(noise_model_cfg).__name__}.bias_noise_cfg is None; set a NoiseCfg."
            )
        self._bias_noise_cfg = noise_model_cfg.bias_noise_cfg
        # One bias an environment; one a component once the first data shows how many there are.
        self._bias = torch.zeros(num_envs, 1, dtype=torch.float32, device=device)
        self._waits_for_components = noise_model_cfg.sample_bias_per_component

    def __call__(self, data: torch.Tensor) -> torch.Tensor:
        """Return `data`, (num_envs, ..., components), with noise and bias."""
        if self._waits_for_components:
            self._waits_for_components = False
            # Data that comes first under `inference_mode` must not forbid later resets without it.
            with torch.inference_mode(False):
                self._bias = torch.zeros(
                    self._num_envs, data.shape[-1], dtype=self._bias.dtype, device=self._device
                )
            self.reset()
        bias = self._bias
        if data.dim() > 2:
            bias = bias.view(self._num_envs, *(1,) * (data.dim() - 2), bias.shape[-1])
        return super().__call__(data) + bias

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Draw a new bias for the given environments (None: all)."""
        if self._waits_for_components:
            return
        ids = slice(None) if env_ids is None else env_ids
        # Applied to zeros: a bias drawn on top of the old one would wander from reset to reset.
        self._bias[ids] = self._bias_noise_cfg.apply(torch.zeros_like(self._bias[ids]))
