"""Short forms of term configs, for the base configs of the task families."""

from __future__ import annotations

from mjlab.managers import ObservationTermCfg
from mjlab.utils.noise import UniformNoiseCfg


def observation(
    func: object, noise: float | None = None, scale: float | None = None, **params: object
) -> ObservationTermCfg:
    """Return an observation term with parameters, and uniform noise of half-width `noise`."""
    uniform = None if noise is None else UniformNoiseCfg(n_min=-noise, n_max=noise)
    return ObservationTermCfg(func=func, params=params, noise=uniform, scale=scale)
