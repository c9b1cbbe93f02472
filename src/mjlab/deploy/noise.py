"""Observation noise of a contract, in numpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

_Noise = Mapping[str, Any]

_DISTRIBUTIONS: dict[str, Callable[[_Noise, np.random.Generator, tuple], np.ndarray]] = {
    "ConstantNoiseCfg": lambda noise, random, shape: np.full(shape, noise["bias"], float),
    "UniformNoiseCfg": lambda noise, random, shape: random.uniform(
        noise["n_min"], noise["n_max"], shape
    ),
    "GaussianNoiseCfg": lambda noise, random, shape: random.normal(
        noise["mean"], noise["std"], shape
    ),
}
_OPERATIONS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "add": lambda exact, n: exact + n,
    "scale": lambda exact, n: exact * n,
    "abs": lambda exact, n: n,
}
_MODELS = ("NoiseModelCfg", "NoiseModelWithAdditiveBiasCfg")


def unknown_noises(contract: Mapping[str, Any]) -> list[str]:
    """Return a line for each term whose noise is of a class of another package."""
    return [
        f"noise of {term['name']}: {term['noise'].get('type')} is of another package; left out."
        for observation in contract["observations"]
        for term in observation["terms"]
        if term["noise"] is not None and not _is_known(term["noise"])
    ]


class Noise:
    """Noise of a term during an episode. Noise of an unknown class is none.

    Args:
        noise: Entry of the contract; None: no noise.
        level: Factor on the difference that the noise makes; 1: that of training.
        random: Generator.
    """

    def __init__(self, noise: _Noise | None, level: float, random: np.random.Generator) -> None:
        is_used = noise is not None and level != 0.0 and _is_known(noise)
        self._noise, self._level, self._random = noise if is_used else None, level, random
        self._bias: np.ndarray | None = None

    def __call__(self, exact: np.ndarray) -> np.ndarray:
        """Return a value with noise."""
        if self._noise is None:
            return exact
        return exact + self._level * (self._noisy(np.asarray(exact, float), self._noise) - exact)

    def _noisy(self, exact: np.ndarray, noise: _Noise) -> np.ndarray:
        if noise["type"] not in _MODELS:
            return self._applied(exact, noise)
        noisy = self._applied(exact, noise["noise_cfg"])
        if noise["type"] == "NoiseModelCfg":
            return noisy
        if self._bias is None:
            size = exact.shape[-1:] if noise["sample_bias_per_component"] else (1,)
            self._bias = self._applied(np.zeros(size), noise["bias_noise_cfg"])
        return noisy + self._bias

    def _applied(self, exact: np.ndarray, noise: _Noise) -> np.ndarray:
        drawn = _DISTRIBUTIONS[noise["type"]](noise, self._random, exact.shape)
        return _OPERATIONS[noise["operation"]](exact, drawn)


def _is_known(noise: _Noise) -> bool:
    if noise.get("type") in _MODELS:
        parts = [noise[key] for key in ("noise_cfg", "bias_noise_cfg") if key in noise]
        return all(part.get("type") in _DISTRIBUTIONS for part in parts)
    return noise.get("type") in _DISTRIBUTIONS
