"""Observation noise: independent samples, and models with state.

`NoiseCfg` samples independently and applies itself; a `NoiseModelCfg` builds a model with state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch

from mjlab.utils.errors import check_field, check_one_of
from mjlab.utils.state import stateful
from mjlab.utils.tables import format_value, settings_of
from mjlab.utils.torch import constant_tensor

NoiseParam = float | tuple[float, ...]
"""A scalar, or one value per entry of the last axis of the data."""

_OPERATIONS = {"add": "+", "scale": "*", "abs": "="}
"""Signs of operations in tables."""


@dataclass(kw_only=True)
class NoiseCfg(ABC):
    """Noise n on data x. Configs have no state: edited fields apply from the next call."""

    _symbol: ClassVar[str] = "noise"

    operation: Literal["add", "scale", "abs"] = "add"
    """Combination with the data: `add` (x + n), `scale` (x * n) or `abs` (n, independent of x)."""

    def __post_init__(self) -> None:
        check_one_of(f"{type(self).__name__}.operation", self.operation, _OPERATIONS)

    @abstractmethod
    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return the data with noise, as a new tensor of the same shape."""

    def __str__(self) -> str:
        """Return the noise as in the tables of `dr`: `+U(-0.1, 0.1)`."""
        parameters = {k: v for k, v in settings_of(self).items() if k != "operation"}
        values = ", ".join(format_value(value) for value in parameters.values())
        return f"{_OPERATIONS[self.operation]}{self._symbol}({values})"

    def _combine(self, data: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Combine data and noise in place in `noise`, a new tensor of the shape of `data`."""
        if self.operation == "add":
            return noise.add_(data)
        if self.operation == "scale":
            return noise.mul_(data)
        check_one_of(f"{type(self).__name__}.operation", self.operation, _OPERATIONS)
        return noise


@dataclass
class ConstantNoiseCfg(NoiseCfg):
    """Constant offset, factor or value."""

    _symbol = "const"

    bias: NoiseParam = 0.0
    """n, a scalar or one value per component."""

    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return the data with n = bias."""
        return self._combine(data, torch.zeros_like(data).add_(_param(self.bias, data)))


@dataclass
class UniformNoiseCfg(NoiseCfg):
    """Uniform noise, sampled per element."""

    _symbol = "U"

    n_min: NoiseParam = -1.0
    """Lower bound of n (inclusive), a scalar or one value per component."""
    n_max: NoiseParam = 1.0
    """Upper bound of n (exclusive), a scalar or one value per component."""

    def __post_init__(self) -> None:
        """Raise `ValueError` unless n_min < n_max, if both are floats."""
        super().__post_init__()
        both = isinstance(self.n_min, float) and isinstance(self.n_max, float)
        if both and self.n_min >= self.n_max:
            raise ValueError(
                f"UniformNoiseCfg: expected n_min < n_max, got n_min={self.n_min}, "
                f"n_max={self.n_max}."
            )

    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return the data with n uniform in [n_min, n_max)."""
        low, high = _param(self.n_min, data), _param(self.n_max, data)
        return self._combine(data, torch.rand_like(data).mul_(high - low).add_(low))


@dataclass
class GaussianNoiseCfg(NoiseCfg):
    """Gaussian noise, sampled per element."""

    _symbol = "N"

    mean: NoiseParam = 0.0
    """Mean of n, a scalar or one value per component."""
    std: NoiseParam = 1.0
    """Standard deviation of n, a scalar or one value per component."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for a float std <= 0."""
        super().__post_init__()
        is_wrong = isinstance(self.std, float) and self.std <= 0.0
        check_field(self, "std", not is_wrong, "a number > 0")

    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return the data with n = mean + std z, z standard normal."""
        noise = torch.randn_like(data).mul_(_param(self.std, data))
        return self._combine(data, noise.add_(_param(self.mean, data)))


@stateful
class NoiseModel:
    """Noise model that applies the noise of its config. Subclasses keep per-environment state."""

    def __init__(self, noise_model_cfg: NoiseModelCfg, num_envs: int, device: str) -> None:
        """Create the model. Raises `ValueError` if `noise_cfg` is None."""
        is_set = noise_model_cfg.noise_cfg is not None
        check_field(noise_model_cfg, "noise_cfg", is_set, "a NoiseCfg")
        self._noise_model_cfg = noise_model_cfg
        self._num_envs = num_envs
        self._device = device

    def __call__(self, data: torch.Tensor) -> torch.Tensor:
        """Return `data`, (num_envs, ...), with noise."""
        return self._noise_model_cfg.noise_cfg.apply(data)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Reset the state of `env_ids` (None: all)."""


@dataclass(kw_only=True)
class NoiseModelCfg:
    """Noise model configuration. Each observation term builds a separate model.

    Set the model class by a class keyword: `class MyCfg(NoiseModelCfg, class_type=My)`.
    """

    class_type: ClassVar[type[NoiseModel]] = NoiseModel
    """Model class, constructed as `class_type(cfg, num_envs, device)`."""

    noise_cfg: NoiseCfg
    """Noise of each call."""

    def __str__(self) -> str:
        """Return the noises of the model by field."""
        noises = {k: v for k, v in settings_of(self).items() if isinstance(v, NoiseCfg)}
        return f"{self.class_type.__name__}({', '.join(f'{k}={v}' for k, v in noises.items())})"

    def __init_subclass__(cls, class_type: type[NoiseModel] | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if class_type is not None:
            cls.class_type = class_type


class NoiseModelWithAdditiveBias(NoiseModel):
    """Noise plus a per-environment bias, resampled at reset."""

    _noise_model_cfg: NoiseModelWithAdditiveBiasCfg

    def __init__(
        self,
        noise_model_cfg: NoiseModelWithAdditiveBiasCfg,
        num_envs: int,
        device: str,
    ) -> None:
        """Create the model. Raises `ValueError` if `noise_cfg` or `bias_noise_cfg` is None."""
        super().__init__(noise_model_cfg, num_envs, device)
        is_set = noise_model_cfg.bias_noise_cfg is not None
        check_field(noise_model_cfg, "bias_noise_cfg", is_set, "a NoiseCfg")
        self._bias_noise_cfg: Any = noise_model_cfg.bias_noise_cfg
        # One bias per environment, expanded to one per component when the first data arrives.
        self._bias = torch.zeros(num_envs, 1, dtype=torch.float32, device=device)
        self._waits_for_components = noise_model_cfg.sample_bias_per_component

    def __call__(self, data: torch.Tensor) -> torch.Tensor:
        """Return `data`, (num_envs, ..., components), with noise and bias."""
        if self._waits_for_components:
            self._waits_for_components = False
            # If the first data arrives under `inference_mode`, later resets outside it must work.
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
        """Resample the bias of `env_ids` (None: all)."""
        if self._waits_for_components:
            return
        ids = slice(None) if env_ids is None else env_ids
        # Applied to zeros: adding to the previous bias would be a random walk over resets.
        self._bias[ids] = self._bias_noise_cfg.apply(torch.zeros_like(self._bias[ids]))


@dataclass(kw_only=True)
class NoiseModelWithAdditiveBiasCfg(NoiseModelCfg, class_type=NoiseModelWithAdditiveBias):
    """Noise at each call, plus a bias that is resampled at reset."""

    bias_noise_cfg: NoiseCfg | None = None
    """Bias distribution: this noise applied to zero. Required."""
    sample_bias_per_component: bool = True
    """Sample a separate bias per component. False: one bias for all components."""


def _param(value: Any, data: torch.Tensor) -> Any:
    """Return a parameter as a number, or as a tensor that broadcasts along the last axis."""
    if isinstance(value, (int, float)):
        return value
    if isinstance(value, torch.Tensor):
        return value.to(data)
    return constant_tensor(tuple(value), data.device, data.dtype)
