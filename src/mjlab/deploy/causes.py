"""Causes of a difference: each explains a wrong value by one mistake, or does not.

A cause is a function of the expected values, those found and the evidence. It returns the values that
the mistake would give, NaN where it says nothing, or None where it does not apply. `likely_cause` names one only if
it brings the residual within tolerance, and if all others with as little freedom leave ten times more. Those
with more fitted numbers do not count: they explain all that simpler ones explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjlab.deploy import physics_causes as physics
from mjlab.deploy import value_causes as values
from mjlab.deploy.evidence import Difference, Evidence

CLEARER = 10.0
"""Factor by which the residual of a cause must be below all others."""
# Share of the rows that an explanation must cover.
_COVERED = 0.5

Explain = Callable[[Difference, Evidence], np.ndarray | None]


@dataclass(frozen=True)
class Cause:
    """Mistake that may explain a difference.

    Attributes:
        name: Mistake in words.
        stages: Stages at which it can appear first.
        freedom: 0 without fitted numbers; 1 with one number or choice; 2 with one a component. A cause with
            less freedom is preferred, because those with more include it.
        explain: Function that returns the values the mistake would give.
    """

    name: str
    stages: tuple[str, ...]
    freedom: int
    explain: Explain


@dataclass(frozen=True)
class Verdict:
    """Answer to the question for the cause.

    Attributes:
        cause: Name of the cause; None if not decidable.
        residuals: Residual of the best candidates, by name, smallest first.
        note: Sentence on what was seen.
    """

    cause: str | None
    residuals: dict[str, float]
    note: str = ""


_VALUES = ("sensors", "term")
_PHYSICS = ("torque", "state", "next sensors")
_ARRAYS = (*_VALUES, "history", "action", "target")

CAUSES: tuple[Cause, ...] = (
    Cause("other control rate", ("rates",), 0, values.period),
    Cause("opposite sign", _ARRAYS, 0, values.sign),
    Cause("always zero: missing", _ARRAYS, 0, values.nothing),
    Cause("one control step late", _ARRAYS, 0, values.late),
    Cause("one control step early", _ARRAYS, 0, values.early),
    Cause("degrees for radians", _ARRAYS, 0, values.degrees),
    Cause("quaternion (x, y, z, w) read as (w, x, y, z)", _VALUES, 0, values.quaternion_cycle),
    Cause("quaternion (w, x, y, z) read as (x, y, z, w)", _VALUES, 0, values.quaternion_cycle_back),
    Cause("inverse rotation", _VALUES, 0, values.conjugate),
    Cause("world axes, not those of the body", _VALUES, 0, values.to_world),
    Cause("turned into the body's axes twice", _VALUES, 0, values.to_body),
    Cause("default pose not subtracted", ("term",), 0, values.default_kept),
    Cause("joint targets instead of the raw last action", ("term",), 0, values.processed_action),
    Cause("last action after scale", ("term",), 0, values.scaled_action),
    Cause("history newest first", ("history",), 0, values.newest_first),
    Cause("history by component, not by step", ("history",), 0, values.by_component),
    Cause("history starts with zeros", ("history",), 0, values.from_zeros),
    Cause("clip left out", ("history",), 0, values.not_clipped),
    Cause("clip after scale", ("history",), 0, values.clipped_last),
    Cause("scale left out", ("history",), 0, values.not_scaled),
    Cause("history of whole observations", ("vector",), 0, values.by_frame),
    Cause("terms in another order", ("vector",), 1, values.term_order),
    Cause("policy.onnx is not the network of the trace", ("action",), 0, values.other_network),
    Cause("normalizer left out", ("action",), 0, values.no_normalizer),
    Cause("normalizer applied twice", ("action",), 0, values.normalized_twice),
    Cause("memory not fed back", ("action",), 0, values.no_memory),
    Cause("memory not cleared at the start", ("action",), 0, values.memory_kept),
    Cause("default pose not added", ("target",), 0, values.no_offset),
    Cause("no scale and offset", ("target",), 0, values.raw_action),
    Cause("targets clipped to the joint ranges", ("target",), 0, values.joint_range),
    Cause("target clip left out", ("target",), 0, values.target_not_clipped),
    Cause("other action scale", ("target",), 1, values.target_scale),
    Cause("other action scale of some joints", ("target",), 2, values.target_scales),
    Cause("controls in joint order", _PHYSICS, 0, physics.joint_order),
    Cause("targets one control step late", _PHYSICS, 0, physics.one_step_late),
    Cause("targets one physics step late", _PHYSICS, 0, physics.one_substep_late),
    Cause("sensors read without mj_forward", _PHYSICS, 0, physics.stale_sensors),
    Cause("other control rate", _PHYSICS, 0, physics.control_rate),
    Cause("other physics time step", _PHYSICS, 0, physics.physics_rate),
    Cause("other armature", _PHYSICS, 0, physics.of_joints("armature")),
    Cause("other joint damping", _PHYSICS, 0, physics.of_joints("damping")),
    Cause("other joint friction", _PHYSICS, 0, physics.of_joints("frictionloss")),
    Cause("gains in another order", _PHYSICS, 0, physics.gains_order),
    Cause("other gains", _PHYSICS, 0, physics.gains),
    Cause("other effort limit", _PHYSICS, 0, physics.effort_limit),
    Cause("another scale", (*_VALUES, "history", "action"), 1, values.one_scale),
    Cause("opposite sign of some components", _ARRAYS, 1, values.some_signs),
    Cause("components in another order", (*_ARRAYS, "torque"), 1, values.order),
    Cause("clipped", _ARRAYS, 1, values.bounded),
    Cause("IMU, or velocity, of another link", _VALUES, 1, values.other_link),
    Cause("another scale of some components", (*_VALUES, "history", "action"), 2, values.scales),
    Cause("constant offsets", _ARRAYS, 2, values.offsets),
    Cause("components clipped", _ARRAYS, 2, values.bounded_each),
    Cause("constant rotation between frames", _VALUES, 2, values.turned),
)
"""All causes."""


def likely_cause(difference: Difference, evidence: Evidence) -> Verdict:
    """Return the cause that explains a difference clearly better than all others."""
    found: list[tuple[int, float, str]] = []
    for cause in CAUSES:
        if difference.stage in cause.stages:
            explained = cause.explain(difference, evidence)
            if explained is not None:
                found.append((cause.freedom, _residual(explained, difference), cause.name))
    found.sort(key=lambda one: one[1])
    residuals = {name: residual for _, residual, name in found[:4]}
    total = float(np.nanmax(np.abs(difference.got - difference.expected)))
    fitting = [one for one in found if one[1] <= difference.tolerance]
    if not fitting:
        return Verdict(None, residuals)
    freedom, residual, name = min(fitting)
    rivals = [one[1] for one in found if one[0] <= freedom and one[2] != name]
    if min([total, *rivals]) <= max(CLEARER * residual, difference.tolerance):
        equal = [one[2] for one in fitting if one[0] <= freedom]
        return Verdict(None, residuals, f"explained equally by: {'; '.join(equal)}")
    return Verdict(name, residuals)


def _residual(explained: np.ndarray, difference: Difference) -> float:
    """Return the largest difference left; infinite if too few rows are explained."""
    known = np.isfinite(explained).all(axis=1)
    if known.mean() < _COVERED:
        return np.inf
    left = np.abs(explained - difference.got)[known]
    changed = np.abs(difference.got - difference.expected) > difference.tolerance
    # A cause that says nothing about the rows that differ explains nothing.
    return float(left.max()) if changed[known].any() else np.inf
