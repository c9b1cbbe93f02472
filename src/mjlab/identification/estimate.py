"""Estimates of a limb by joint: values, intervals, and what its logs cannot separate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mjlab.identification.fit import Fit
from mjlab.identification.plant import KINDS

UNITS = {
    "armature": "kg m^2",
    "damping": "N m s/rad",
    "friction": "N m",
    "kp": "N m/rad",
    "kd": "N m s/rad",
}
"""Units of the parameters of hinges."""
WIDE = 0.3
"""Half-width of a 95 % interval, relative to its value, above which a value is not known."""


@dataclass(frozen=True)
class Estimate:
    """A parameter with its 95 % interval, value +- half_width."""

    value: float
    half_width: float

    @property
    def share(self) -> float:
        """Half-width as a share of the value; infinite for 0."""
        return self.half_width / abs(self.value) if self.value else np.inf

    @property
    def is_known(self) -> bool:
        """True if the interval is narrow against the value."""
        return self.share <= WIDE

    def __str__(self) -> str:
        """Return value and half-width, to the second digit of the half-width."""
        digits = max(0, 1 - int(np.floor(np.log10(self.half_width))))
        return f"{self.value:.{digits}f} +- {self.half_width:.{digits}f}"


@dataclass(frozen=True)
class DriveEstimate:
    """Estimates of the joints of a group, which share their parameters."""

    joints: tuple[str, ...]
    parameters: dict[str, Estimate]
    """By kind, of `KINDS`."""
    remarks: tuple[str, ...]
    """Each a sentence about what the logs cannot separate."""


@dataclass(frozen=True)
class LimbEstimate:
    """Estimates of a limb."""

    drives: tuple[DriveEstimate, ...]
    delay: Estimate
    """Time from a row's measurement to the effect of its target (s)."""
    rms: dict[str, np.ndarray]
    """Root mean square of the residuals by signal, of each joint."""


def limb_estimate(fit: Fit, groups: Sequence[tuple[str, ...]]) -> LimbEstimate:
    """Return the estimates of a limb.

    Args:
        fit: Fit of its logs.
        groups: Joints of each group.
    """
    half_width, delay = fit.half_width, len(fit.x) - 1
    drives = []
    for number, joints in enumerate(groups):
        own = np.arange(number * len(KINDS), (number + 1) * len(KINDS))
        parameters = {
            kind: Estimate(float(fit.x[i]), float(half_width[i]))
            for kind, i in zip(KINDS, own, strict=True)
        }
        remarks = tuple(not_separated(fit, dict(zip(KINDS, own, strict=True)), parameters))
        drives.append(DriveEstimate(tuple(joints), parameters, remarks))
    return LimbEstimate(
        tuple(drives), Estimate(float(fit.x[delay]), float(half_width[delay])), fit.rms
    )


def not_separated(
    fit: Fit, index: dict[str, int], parameters: dict[str, Estimate]
) -> Iterator[str]:
    """Yield a sentence for each combination of parameters in which the estimates are not known.

    A sum or a quotient may be known although its parts are not: then the Jacobian has no slope where
    they change together.

    Args:
        fit: Fit.
        index: Index of a joint's parameters in those of the fit, by kind.
        parameters: Estimates of the same parameters.
    """
    unknown = [kind for kind in KINDS if not parameters[kind].is_known]
    terms = {kind: _unit(fit, index[kind]) for kind in unknown}
    if "damping" in unknown or "kd" in unknown:
        weights = _unit(fit, index["damping"]) + _unit(fit, index["kd"])
        total = Estimate(float(weights @ fit.x), float(fit.half_width_of(weights[None])[0]))
        if total.is_known or "kp" in unknown:
            terms = {kind: term for kind, term in terms.items() if kind not in ("damping", "kd")}
            yield f"damping and kd only as their sum{_shown(total)}: log torques to separate them"
            if not total.is_known:
                terms["the sum"] = weights
    if "kp" in unknown:
        kp = _unit(fit, index["kp"])
        ratios = [name for name, term in terms.items() if _ratio_share(fit, term, kp) <= WIDE]
        if len(ratios) > 1:
            yield (
                f"{', '.join(ratios)} only as ratios: a factor common to them is not known; log "
                "torques, or hang a known load"
            )
        terms = {name: term for name, term in terms.items() if name not in ratios}
    for kind in terms:
        if kind in parameters:
            most = parameters[kind].value + parameters[kind].half_width
            yield f"{kind}: the log does not show it; any value up to {most:.3g} fits"


def _unit(fit: Fit, index: int) -> np.ndarray:
    return np.eye(len(fit.x))[index]


def _shown(total: Estimate) -> str:
    return f", {total} {UNITS['kd']}" if total.is_known else ""


def _ratio_share(fit: Fit, weights: np.ndarray, others: np.ndarray) -> float:
    """Return the half-width of the quotient of two sums of parameters, as a share of it."""
    change = weights / (weights @ fit.x) - others / (others @ fit.x)
    return float(fit.half_width_of(change[None])[0])
