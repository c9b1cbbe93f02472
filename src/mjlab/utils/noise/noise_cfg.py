"""Noise on observations: independent draws, and models that keep state between calls.

Independent draws are configs that apply themselves; a `NoiseModelCfg` has one model built from it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch

from mjlab.utils.errors import check_one_of
from mjlab.utils.state import stateful
from mjlab.utils.torch import constant_tensor

NoiseParam = float | tuple[float, ...]
"""One value, or one for each entry of the last axis of the data."""

_OPERATIONS = ("add", "scale", "abs")


@dataclass(kw_only=True)
class NoiseCfg(ABC):
    """Noise n on data x. Configs hold no state: an edited field counts from the next call on."""

    operation: Literal["add", "scale", "abs"] = "add"
    """add: x + n; scale: x * n; abs: n, whatever x is."""

    def __post_init__(self) -> None:
        self._check_operation()

    @abstractmethod
    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return a new tensor of the shape of `data`: the data with noise."""

    def _combine(self, data: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Combine into `noise`, a new tensor of the shape of `data`, which is given away."""
        if self.operation == "add":
            return noise.add_(data)
        if self.operation == "scale":
            return noise.mul_(data)
        self._check_operation()
        return noise

    def _check_operation(self) -> None:
        check_one_of(f"{type(self).__name__}.operation", self.operation, _OPERATIONS)


@dataclass
class ConstantNoiseCfg(NoiseCfg):
    """The same offset (or factor, or value) always."""

    bias: NoiseParam = 0.0
    """n, one value or one for each component."""

    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return the data with n = bias."""
        return self._combine(data, torch.zeros_like(data).add_(_param(self.bias, data)))


@dataclass
class UniformNoiseCfg(NoiseCfg):
    """Uniform noise, drawn for each element."""

    n_min: NoiseParam = -1.0
    """Smallest n, one value or one for each component."""
    n_max: NoiseParam = 1.0
    """Bound of n from above, which n does not reach."""

    def __post_init__(self) -> None:
        """Raise `ValueError` unless n_min < n_max (components of tuples may be equal)."""
        super().__post_init__()
        if not _in_order(self.n_min, self.n_max):
            raise ValueError(
                f"UniformNoiseCfg has n_min={self.n_min} and n_max={self.n_max}; "
                "n_min must be less than n_max."
            )

    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return the data with n uniform in [n_min, n_max)."""
        low, high = _param(self.n_min, data), _param(self.n_max, data)
        return self._combine(data, torch.rand_like(data).mul_(high - low).add_(low))


@dataclass
class GaussianNoiseCfg(NoiseCfg):
    """Normally distributed noise, drawn for each element."""

    mean: NoiseParam = 0.0
    """Mean of n, one value or one for each component."""
    std: NoiseParam = 1.0
    """Standard deviation of n, one value or one for each component."""

    def __post_init__(self) -> None:
        """Raise `ValueError` unless std is positive (components of tuples may be 0)."""
        super().__post_init__()
        if not _in_order(0.0, self.std):
            raise ValueError(f"GaussianNoiseCfg.std is {self.std}; it must be positive.")

    def apply(self, data: torch.Tensor) -> torch.Tensor:
        """Return the data with n = mean + std z, z standard normal."""
        noise = torch.randn_like(data).mul_(_param(self.std, data))
        return self._combine(data, noise.add_(_param(self.mean, data)))


@stateful
class NoiseModel:
    """Applies the noise of its config; subclasses keep state for each environment."""

    def __init__(self, noise_model_cfg: NoiseModelCfg, num_envs: int, device: str) -> None:
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


@dataclass(kw_only=True)
class NoiseModelCfg:
    """Config of a noise model, of which one is made for each observation term.

    The class it builds is given as a class keyword: `class MyCfg(NoiseModelCfg, class_type=My)`.
    """

    class_type: ClassVar[type[NoiseModel]] = NoiseModel
    """The model, made as `class_type(cfg, num_envs, device)`."""

    noise_cfg: NoiseCfg
    """Noise applied at each call."""

    def __init_subclass__(cls, class_type: type[NoiseModel] | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if class_type is not None:
            cls.class_type = class_type


class NoiseModelWithAdditiveBias(NoiseModel):
    """Noise plus a bias, drawn for each environment when it is reset."""

    _noise_model_cfg: NoiseModelWithAdditiveBiasCfg

    def __init__(
        self,
        noise_model_cfg: NoiseModelWithAdditiveBiasCfg,
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


@dataclass(kw_only=True)
class NoiseModelWithAdditiveBiasCfg(NoiseModelCfg, class_type=NoiseModelWithAdditiveBias):
    """Noise at each call, plus a bias that is drawn at reset and kept until the next."""

    bias_noise_cfg: NoiseCfg | None = None
    """The bias: this noise applied to zero. Required."""
    sample_bias_per_component: bool = True
    """Each component has a bias of its own; False: one for all components of an environment."""


def _param(value: Any, data: torch.Tensor) -> Any:
    """Return a parameter as a number, or as a tensor that broadcasts on the last axis."""
    if isinstance(value, (int, float)):
        return value
    if isinstance(value, torch.Tensor):
        return value.to(data)
    return constant_tensor(tuple(value), data.device, data.dtype)


def _in_order(low: Any, high: Any) -> bool:
    if isinstance(low, (int, float)) and isinstance(high, (int, float)):
        return low < high
    return bool((torch.as_tensor(low) <= torch.as_tensor(high)).all())
