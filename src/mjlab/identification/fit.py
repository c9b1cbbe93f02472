"""Least-squares fit of a limb's drives to its logs, with intervals.

Residuals are simulated minus measured signals, each divided by the root mean square of its joint's
residuals, found by repeating the fit; and the first guess, as a weak prior of 100 %, for what the logs
do not tell. MuJoCo's `minimize.least_squares`, which `mujoco.sysid` also uses, finds the minimum.

Residuals are not white: the friction of gears is not that of the model. Intervals therefore add the
jackknife over windows of the log, one left out at a time, and the shift of the estimates by a friction
that is larger at rest than in motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from mujoco import minimize
from scipy import stats

from mjlab.identification.log import JointLog
from mjlab.identification.plant import KINDS, Plant

_PASSES = 8
"""Most fits, each with the weights that follow from the one before."""
_SAME_WEIGHTS = 0.05
"""Change of all weights, as a share, below which the fit is not repeated."""
SETTLE = 0.3
"""Time at the start that is left out of the residuals (s): the initial state is measured with noise."""
WINDOW = 1.0
"""Length of a window (s); errors of the friction are correlated for a fraction of it."""
LEAST_WINDOWS = 5
"""Windows that intervals need: fewer tell no spread of the estimates."""
_REST_FRICTION, _REST_SPEED = 0.4, 0.1
"""Friction of gears at rest above that in motion, as a share of it, and the speed (rad/s or m/s) below
which it acts: the larger of common values."""
_MAX_DELAY = 0.1
_MAX_FACTOR = 100.0
_DELAYS = np.arange(0.0, 0.041, 0.002)
"""Delays among which the fit starts at the best (s)."""
_ROUNDING = 0.01
"""Error of finite differences, relative to the columns of the Jacobian: directions in which it has less
slope are not known. Directions that logs of legs tell had 0.03 and more, others 0.004 and less."""
_STEP = 1e-3
"""Step of finite differences while fitting, relative to the scale of a parameter. The Jacobian of the
intervals takes ten times the step, on both sides, over the corners that dry friction makes."""


@dataclass(frozen=True)
class Fit:
    """Parameters of a limb, in the order of `Plant`."""

    x: np.ndarray
    """Estimates, (P,)."""
    covariance: np.ndarray
    """Covariance of the estimates, (P, P)."""
    quantile: float
    """Half-width of a 95 % interval in standard deviations."""
    shift: np.ndarray
    """Errors by what the model lacks: friction at rest, and time stamps of a row's precision, (P,)."""
    rms: dict[str, np.ndarray]
    """Root mean square of the residuals of each signal, (J,)."""

    @property
    def half_width(self) -> np.ndarray:
        """Half-widths of the 95 % intervals, (P,)."""
        return self.half_width_of(np.eye(len(self.x)))

    def half_width_of(self, weights: np.ndarray) -> np.ndarray:
        """Return the half-widths of the 95 % intervals of sums `weights @ x`, weights (S, P)."""
        variance = np.einsum("sp,pq,sq->s", weights, self.covariance, weights)
        return self.quantile * np.sqrt(variance) + np.abs(weights @ self.shift)


def fit_limb(plant: Plant, start: np.ndarray, scale: np.ndarray, max_iterations: int = 30) -> Fit:
    """Return the parameters with the least residuals.

    Args:
        plant: Limb and logs.
        start: First guess, (P,).
        scale: Typical size of each parameter, (P,).
        max_iterations: Most iterations of each pass.
    """
    logs = plant.logs
    signals = [
        name
        for name in ("position", "velocity", "torque")
        if all(getattr(log, name) is not None for log in logs)
    ]
    sigma = {
        name: 0.05 * np.concatenate([getattr(log, name) for log in logs]).std(axis=0)
        for name in signals
    }
    z = first_step(plant, start, scale, sigma) / scale
    bounds = [np.zeros(plant.size), np.full(plant.size, _MAX_FACTOR)]
    bounds[0][-2], bounds[1][-2:] = -logs[0].period / scale[-2], [logs[0].period, _MAX_DELAY]
    bounds[1][-2:] /= scale[-2:]
    for _ in range(_PASSES):
        residuals = weighted(plant, start, scale, sigma)
        z, _ = minimize.least_squares(
            z,
            residuals,
            bounds,
            eps=_STEP,
            mu_min=1.0,  # J'J is above 1e4: smaller regularizers only cost simulations
            mu_factor=3.0,
            xtol=3e-3,
            max_iter=max_iterations,
            verbose=minimize.Verbosity.SILENT,
        )
        z, last = z.ravel(), sigma
        sigma = _rms(plant, z * scale, signals)
        change = max(np.abs(sigma[name] / last[name] - 1.0).max() for name in signals)
        if change < _SAME_WEIGHTS:
            break
    residuals = weighted(plant, start, scale, sigma)
    windows = _windows(plant, len(signals))
    jacobian = _central_differences(residuals, z, bounds[0])
    jacobian[windows >= 0] = _without_rounding(jacobian[windows >= 0])
    covariance, freedom = jackknife(jacobian, residuals(z[:, None])[:, 0], windows)
    friction = weighted(plant, start, scale, sigma, _rest_friction(plant, z * scale))
    bend = (friction(z[:, None]) - residuals(z[:, None]))[:, 0]
    shift = np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ bend) * scale
    shift[-1] = abs(shift[-1]) + 0.5 * logs[0].period
    return Fit(
        z * scale,
        covariance * np.outer(scale, scale),
        float(stats.t.ppf(0.975, freedom)),
        shift,
        sigma,
    )


def first_step(
    plant: Plant, start: np.ndarray, scale: np.ndarray, sigma: dict[str, np.ndarray]
) -> np.ndarray:
    """Return a better first guess: the delay, and with torques the gains, that fit without simulation.

    Torques of a servo are linear in its gains for a given delay. From a delay that is wrong by 10 ms,
    a fit of all parameters at once may end in a local minimum.
    """
    x = np.tile(start, (len(_DELAYS), 1))
    x[:, -1] = _DELAYS
    if "torque" not in sigma:
        costs = (weighted(plant, start, scale, sigma)((x / scale).T) ** 2).sum(axis=0)
        return x[np.argmin(costs)]
    costs = np.zeros(len(_DELAYS))
    for n, delay in enumerate(_DELAYS):
        gains, costs[n] = plant.servo_gains(delay)
        # Targets of a row are in effect for half a row on average.
        x[n, -1] = max(0.0, delay - 0.5 * plant.logs[0].period)
        for group in np.unique(plant.groups):
            first = len(KINDS) * group + KINDS.index("kp")
            x[n, first : first + 2] = gains[plant.groups == group].mean(axis=0)
    return x[np.argmin(costs)]


def jackknife(jacobian: np.ndarray, r: np.ndarray, windows: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the covariance of least squares from windows left out, and its degrees of freedom.

    Estimates without window g differ by `(J'J - Jg'Jg)^-1 Jg'rg`, to first order. The covariance for
    white residuals of unit variance, `(J'J)^-1`, is added: windows do not tell about directions in
    which only the prior, window -1, has a slope.

    Args:
        jacobian: J at the solution, (R, P).
        r: Residuals, (R,).
        windows: Window of each residual, (R,). -1 is never left out.
    """
    hessian = jacobian.T @ jacobian
    changes = []
    for window in range(windows.max() + 1):
        rows = windows == window
        rest = hessian - jacobian[rows].T @ jacobian[rows]
        changes.append(np.linalg.solve(rest, jacobian[rows].T @ r[rows]))
    changes = np.stack(changes)
    count = len(changes)
    changes -= changes.mean(axis=0)
    covariance = (count - 1) / count * changes.T @ changes
    return covariance + np.linalg.inv(hessian), count - 1


def weighted(
    plant: Plant,
    start: np.ndarray,
    scale: np.ndarray,
    sigma: dict[str, np.ndarray],
    added: Sequence[np.ndarray] | None = None,
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function of scaled parameters, (P, N), to weighted residuals, (R, N).

    Args:
        plant: Limb and logs.
        start: Mean of the prior, (P,).
        scale: Scale of the parameters, and standard deviation of the prior, (P,).
        sigma: Standard deviation of each signal, (J,).
        added: Torques from outside the model; see `Plant.simulate`.
    """

    def residuals(z: np.ndarray) -> np.ndarray:
        responses = plant.simulate(z.T * scale, added)
        parts = [z.T - start / scale]
        for log, response in zip(plant.logs, responses, strict=True):
            for name, deviation in sigma.items():
                error = (getattr(response, name) - getattr(log, name)) / deviation
                parts.append(error[:, _skipped(log) :].reshape(z.shape[1], -1))
        return np.concatenate(parts, axis=1).T

    return residuals


def _windows(plant: Plant, num_signals: int) -> np.ndarray:
    """Return the window of each residual; -1 for the prior."""
    parts, first = [np.full(plant.size, -1)], 0
    for log in plant.logs:
        rows = len(log.target) - _skipped(log)
        count = max(1, round(rows * log.period / WINDOW))
        window = first + np.arange(rows) * count // rows
        parts += [np.repeat(window, len(log.joints))] * num_signals
        first += count
    return np.concatenate(parts)


def _central_differences(
    function: Callable[[np.ndarray], np.ndarray], z: np.ndarray, lower: np.ndarray
) -> np.ndarray:
    """Return the Jacobian; below `lower`, differences are one-sided."""
    step = 10.0 * _STEP * np.eye(len(z))
    above, below = z[:, None] + step, np.maximum(z[:, None] - step, lower[:, None])
    values = function(np.concatenate([above, below], axis=1))
    return (values[:, : len(z)] - values[:, len(z) :]) / (above - below).diagonal()


def _without_rounding(jacobian: np.ndarray) -> np.ndarray:
    """Return a Jacobian without the slopes that its rounding may have made."""
    norms = np.linalg.norm(jacobian, axis=0)
    norms[norms == 0.0] = 1.0
    left, values, right = np.linalg.svd(jacobian / norms, full_matrices=False)
    values = np.sqrt(np.maximum(values**2 - _ROUNDING**2, 0.0))
    return (left * values) @ right * norms


def _rest_friction(plant: Plant, x: np.ndarray) -> list[np.ndarray]:
    """Return the torques of friction at rest above that in motion, along the simulated motion."""
    friction = _REST_FRICTION * plant.of_joints(x)[:, KINDS.index("friction")]
    speeds = (response.velocity[0] / _REST_SPEED for response in plant.simulate(x[None]))
    return [-friction * np.exp(-(v**2)) * np.tanh(10.0 * v) for v in speeds]


def _rms(plant: Plant, x: np.ndarray, signals: list[str]) -> dict[str, np.ndarray]:
    pairs = list(zip(plant.logs, plant.simulate(x[None]), strict=True))
    return {
        name: np.sqrt(
            np.concatenate(
                [
                    (getattr(response, name)[0] - getattr(log, name))[_skipped(log) :] ** 2
                    for log, response in pairs
                ]
            ).mean(axis=0)
        )
        for name in signals
    }


def _skipped(log: JointLog) -> int:
    return round(SETTLE / log.period)
