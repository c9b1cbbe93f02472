"""Causes of wrong values: sensors, terms, histories, vectors, actions and targets.

Each function returns the values that a mistake would give, (K, n); None where it does not apply.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjlab.deploy.evidence import Difference, Evidence, flat, rotations


def _known(d: Difference) -> tuple[np.ndarray, np.ndarray]:
    """Return expected and found values of the rows that are known; what is fitted, is fitted to them."""
    rows = np.isfinite(d.expected).all(axis=1)
    return d.expected[rows], d.got[rows]


# Rates.


def period(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return the period found: another one than that of the trace."""
    return d.got


# Any values.


def sign(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return values of the opposite sign."""
    return -d.expected


def nothing(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return zeros."""
    return np.zeros_like(d.expected)


def late(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return the values of the step before."""
    return evidence.previous(d.expected)


def early(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return the values of the next step."""
    return evidence.previous(d.expected, -1)


def degrees(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return degrees for radians."""
    return np.degrees(d.expected)


def one_scale(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the values times the factor that fits best."""
    e, g = _known(d)
    square = (e * e).sum()
    return None if square == 0.0 else (e * g).sum() / square * d.expected


def some_signs(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the values with opposite sign of some components."""
    e, g = _known(d)
    signs = np.where((e * g).sum(axis=0) < 0.0, -1.0, 1.0)
    return None if d.expected.shape[1] == 1 else signs * d.expected


def scales(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return the values times the factor of each component that fits best."""
    e, g = _known(d)
    return (e * g).sum(axis=0) / np.maximum((e * e).sum(axis=0), 1e-30) * d.expected


def offsets(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return the values plus a constant for each component."""
    e, g = _known(d)
    return d.expected + np.median(g - e, axis=0)


def order(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return components in another order, of the values or of the measurement they are computed from."""
    if d.expected.shape[1] < 2:
        return None
    explained, term = _reordered(d.expected, d.got), _term(d, evidence)
    if term is None or d.stage != "term" or term["kind"] != "reading":
        return explained
    read = evidence.evaluate({**term, "offset": None})
    if read is None:
        return explained
    offset = np.nanmedian(read - d.expected, axis=0)
    other = _reordered(read, d.got + offset) - offset
    return min((explained, other), key=lambda one: np.nanmax(np.abs(one - d.got)))


def _reordered(expected: np.ndarray, got: np.ndarray) -> np.ndarray:
    """Return the columns of `expected` in the order that resembles `got`."""
    distance = np.nansum((got[:, :, None] - expected[:, None, :]) ** 2, axis=0)  # (n, n)
    # Greedy, closest pair first; equal components keep their places.
    distance -= 1e-12 * np.eye(len(distance))
    source = np.full(len(distance), -1)
    for _ in range(len(distance)):
        i, j = np.unravel_index(np.argmin(distance), distance.shape)
        source[i] = j
        distance[i, :] = distance[:, j] = np.inf
    return expected[:, source]


def turned(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return vectors turned by the constant rotation that fits best."""
    if d.expected.shape[1] != 3:
        return None
    e, g = _known(d)
    u, _, v = np.linalg.svd(g.T @ e)
    rotation = u @ np.diag((1.0, 1.0, np.linalg.det(u @ v))) @ v
    return d.expected @ rotation.T


def bounded(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the values between one lowest and one highest value."""
    _, g = _known(d)
    low, high = g.min(), g.max()
    inside = (d.expected > low) & (d.expected < high)
    return d.expected.clip(low, high) if inside.mean() > 0.1 else None


def bounded_each(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the values between the lowest and highest value of each component."""
    _, g = _known(d)
    low, high = g.min(axis=0), g.max(axis=0)
    inside = (d.expected > low) & (d.expected < high)
    return d.expected.clip(low, high) if inside.mean() > 0.1 else None


# Frames and quaternions.


def quaternion_cycle(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return values of a quaternion (x, y, z, w) read as (w, x, y, z)."""
    return _quaternion(d, evidence, lambda q: q[:, [1, 2, 3, 0]])


def quaternion_cycle_back(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return values of a quaternion (w, x, y, z) read as (x, y, z, w)."""
    return _quaternion(d, evidence, lambda q: q[:, [3, 0, 1, 2]])


def conjugate(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return values of the inverse rotation: R for R', or the conjugate quaternion."""
    return _quaternion(d, evidence, lambda q: q * [1.0, -1.0, -1.0, -1.0])


def _quaternion(
    d: Difference, evidence: Evidence, change: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray | None:
    """Return a quaternion, or a term computed from one, with `change` of it."""
    term = _term(d, evidence)
    if term is None:
        return change(d.expected) if d.expected.shape[1] == 4 else None
    changes = [name for name in term["inputs"] if name.endswith(("quat", "quat_b"))]
    if not changes:
        return None
    return evidence.evaluate(term, lambda name, x: change(x) if name in changes else x)


def to_world(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return vectors in world axes, not in those of the body."""
    if d.expected.shape[1] != 3:
        return None
    return np.einsum("kij,kj->ki", evidence.root_rotation, d.expected)


def to_body(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return vectors turned into the axes of the body once too often."""
    if d.expected.shape[1] != 3:
        return None
    return np.einsum("kji,kj->ki", evidence.root_rotation, d.expected)


def other_link(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the IMU, or the velocity, of the link that fits best."""
    if not evidence.has_states:
        return None
    quats, velocities = evidence.bodies
    candidates: Iterable[np.ndarray] = ()
    if d.expected.shape[1] == 4:
        candidates = quats[:, 1:].swapaxes(0, 1)
    elif d.expected.shape[1] == 3:
        gravity = np.array([-rotations(q)[:, 2] for q in quats[:, 1:].swapaxes(0, 1)])
        parts = [velocities[:, 1:, :3].swapaxes(0, 1), velocities[:, 1:, 3:].swapaxes(0, 1)]
        candidates = np.concatenate([gravity, *parts])
    best, least = None, np.inf
    for candidate in candidates:
        is_same = np.abs(candidate - d.expected).max() <= d.tolerance
        left = np.abs(candidate - d.got).max()
        if not is_same and left < least:
            best, least = candidate, left
    return best


# Terms.


def _term(d: Difference, evidence: Evidence) -> dict[str, Any] | None:
    """Return the entry of the term that `d` is of."""
    kind, _, rest = d.name.partition("/")
    key = tuple(rest.split("/", 1))
    return evidence.terms.get(key) if kind in ("raw", "term") and len(key) == 2 else None


def default_kept(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return joint positions without the default pose subtracted."""
    term = _term(d, evidence)
    if term is None or term["kind"] != "reading":
        return None
    joints = term["inputs"] == ["joint_pos"]
    return evidence.evaluate({**term, "offset": None}) if joints else None


def processed_action(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the joint targets of the step before, not the network's last answer."""
    # Of the program itself: its answers to wrong last actions are other ones.
    targets = (evidence.found.get("target", evidence.trace["target"]), evidence.trace["target"])
    tried = [_of_last_action(d, evidence, values) for values in targets]
    known = [one for one in tried if one is not None]
    return min(known, key=lambda one: np.nanmax(np.abs(one - d.got)), default=None)


def scaled_action(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the last action after scale, without offset."""
    scale, _ = _scale_and_offset(evidence)
    action = evidence.trace["action"]
    return _of_last_action(d, evidence, action * scale if len(scale) == action.shape[1] else action)


def _of_last_action(d: Difference, evidence: Evidence, values: np.ndarray) -> np.ndarray | None:
    term = _term(d, evidence)
    if term is None or term["kind"] != "last_action" or values.shape[1] != d.expected.shape[1]:
        return None
    return evidence.previous(flat(values))


# History, clip and scale.


def _stacked(
    values: np.ndarray, evidence: Evidence, length: int, start: str = "first"
) -> np.ndarray:
    """Return the last `length` values of each row, oldest first, (K, length, D)."""
    rows = []
    for k, age in enumerate(evidence.age):
        past = [values[k - min(back, age)] for back in range(length - 1, -1, -1)]
        if start == "zeros":
            past = [p if length - 1 - i <= age else 0 * p for i, p in enumerate(past)]
        rows.append(past)
    return np.array(rows)


def _newest(d: Difference, evidence: Evidence) -> tuple[np.ndarray, int] | None:
    """Return the golden newest value of a term, after clip and scale, (K, D), and its history."""
    term = _term(d, evidence)
    if term is None or d.stage != "history":
        return None
    return d.expected[:, -term["size"] :], max(1, d.expected.shape[1] // term["size"])


def newest_first(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return histories with the newest value first."""
    found = _newest(d, evidence)
    if found is None or found[1] < 2:
        return None
    return flat(_stacked(found[0], evidence, found[1])[:, ::-1])


def by_component(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return histories by component, not by step."""
    found = _newest(d, evidence)
    if found is None or found[1] < 2 or found[0].shape[1] < 2:
        return None
    return flat(np.ascontiguousarray(_stacked(found[0], evidence, found[1]).swapaxes(1, 2)))


def from_zeros(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return histories that start with zeros."""
    found = _newest(d, evidence)
    if found is None or found[1] < 2:
        return None
    return flat(_stacked(found[0], evidence, found[1], "zeros"))


@dataclass(frozen=True)
class _Clip:
    """Value of a term before clip and scale, and what the trace says of both.

    Attributes:
        raw: Value before clip and scale, (K, D).
        scale: Scale, (D,).
        low: Lowest value after the clip, before scale; -inf if none was clipped.
        high: Highest one; inf if none was clipped.
        length: Length of the history.
    """

    raw: np.ndarray
    scale: np.ndarray
    low: float
    high: float
    length: int

    @property
    def is_clipped(self) -> bool:
        """True if the clip acts in the trace."""
        return bool(np.isfinite(self.low) or np.isfinite(self.high))


def _clip(d: Difference, evidence: Evidence) -> _Clip | None:
    """Return what the trace says of the clip and scale of a term."""
    found, raw = _newest(d, evidence), evidence.trace.get(d.name.replace("term/", "raw/", 1))
    if found is None or raw is None:
        return None
    newest, raw = found[0], flat(raw).astype(float)
    inside = (newest > np.nanmin(newest)) & (newest < np.nanmax(newest)) & (np.abs(raw) > 1e-6)
    ratio = np.where(inside, newest / np.where(inside, raw, 1.0), np.nan)
    if not inside.any(axis=0).all():
        return None
    scale = np.nanmedian(ratio, axis=0)
    value = newest / scale
    cut = np.abs(value - raw) > 1e-4 * max(1e-6, np.ptp(raw))
    low = value[cut & (raw < value)].max(initial=-np.inf)
    high = value[cut & (raw > value)].min(initial=np.inf)
    return _Clip(raw, scale, float(low), float(high), found[1])


def not_clipped(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return values without the clip."""
    clip = _clip(d, evidence)
    if clip is None or not clip.is_clipped:
        return None
    return flat(_stacked(clip.raw * clip.scale, evidence, clip.length))


def clipped_last(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return values clipped after scale, not before."""
    clip = _clip(d, evidence)
    if clip is None or not clip.is_clipped or np.allclose(clip.scale, 1.0):
        return None
    values = (clip.raw * clip.scale).clip(clip.low, clip.high)
    return flat(_stacked(values, evidence, clip.length))


def not_scaled(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return values without the scale."""
    clip = _clip(d, evidence)
    if clip is None or np.allclose(clip.scale, 1.0):
        return None
    return flat(_stacked(clip.raw.clip(clip.low, clip.high), evidence, clip.length))


# Vector.


def _terms_of(d: Difference, evidence: Evidence) -> dict[str, np.ndarray]:
    """Return the golden parts of an input, by term, in their order."""
    prefix = f"term/{d.name.removeprefix('input/')}/"
    return {k: flat(v) for k, v in evidence.trace.items() if k.startswith(prefix)}


def term_order(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return inputs with the terms in another order."""
    parts = _terms_of(d, evidence)
    if len(parts) < 2 or sum(p.shape[1] for p in parts.values()) != d.got.shape[1]:
        return None
    explained, place, left = [], 0, dict(parts)
    while left:
        fits = {
            name: np.nanmax(np.abs(d.got[:, place : place + part.shape[1]] - part))
            for name, part in left.items()
            if place + part.shape[1] <= d.got.shape[1]
        }
        if not fits:
            return None
        name = min(fits, key=lambda one: fits[one])
        explained.append(left.pop(name))
        place += explained[-1].shape[1]
    return np.concatenate(explained, axis=1)


def by_frame(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the history of whole observations: one step of all terms after another."""
    parts = _terms_of(d, evidence)
    input_name = d.name.removeprefix("input/")
    lengths, steps, single = set(), [], []
    for key, part in parts.items():
        term = evidence.terms.get((input_name, key.rsplit("/", 1)[1]))
        length = 0 if term is None else term["history"]["length"]
        if length > 1:
            lengths.add(length)
            steps.append(part.reshape(len(part), length, -1))
        else:
            single.append(part)
    if len(lengths) != 1 or len(steps) < 2:
        return None
    stacked = flat(np.ascontiguousarray(np.concatenate(steps, axis=2)))
    explained = np.concatenate([stacked, *single], axis=1)
    return explained if explained.shape == d.got.shape else None


# Action.


def other_network(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the answers of `policy.onnx` where it is not the network of the trace."""
    return None if _is_network(evidence) else evidence.answers()


def no_normalizer(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the answers without the normalizer."""
    if evidence.normalizer is None or not _is_network(evidence):
        return None
    mean, std = evidence.normalizer
    return evidence.answers(lambda x: (x * std + mean).astype(np.float32))


def normalized_twice(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the answers with the normalizer applied twice; the network already has it."""
    if evidence.normalizer is None or not _is_network(evidence):
        return None
    mean, std = evidence.normalizer
    return evidence.answers(lambda x: ((x - mean) / std).astype(np.float32))


def no_memory(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the answers of the recurrent network without its memory fed back."""
    return evidence.answers(memory="cleared") if _has_memory(evidence) else None


def memory_kept(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the answers of the recurrent network with its memory kept at the start of an episode."""
    return evidence.answers(memory="not reset") if _has_memory(evidence) else None


def _has_memory(evidence: Evidence) -> bool:
    kinds = [one["kind"] for one in evidence.contract["policy"]["inputs"]]
    return "memory" in kinds and _is_network(evidence)


def _is_network(evidence: Evidence) -> bool:
    """True if the network of the folder gives the actions of the trace."""
    if "is_network" not in evidence.memo:
        action = evidence.trace["action"]
        left = np.abs(evidence.answers() - action).max()
        evidence.memo["is_network"] = bool(left < 1e-4 * max(1e-3, float(np.ptp(action))))
    return evidence.memo["is_network"]


# Target.


def _scale_and_offset(evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """Return scale and offset of each target, read off the trace."""
    action, target = evidence.trace["action"].astype(float), evidence.trace["target"].astype(float)
    if action.shape != target.shape:
        return np.ones(target.shape[1]), np.zeros(target.shape[1])
    scale, offset = np.ones(action.shape[1]), np.zeros(action.shape[1])
    for j in range(action.shape[1]):
        # Clipped targets are the lowest or highest.
        inside = (target[:, j] > target[:, j].min()) & (target[:, j] < target[:, j].max())
        if inside.sum() > 1 and np.ptp(action[inside, j]) > 0.0:
            scale[j], offset[j] = np.polyfit(action[inside, j], target[inside, j], 1)
    return scale, offset


def target_scale(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return targets with one other action scale for all joints."""
    _, offset = _scale_and_offset(evidence)
    e, g = _known(d)
    square = ((e - offset) ** 2).sum()
    if square == 0.0:
        return None
    return offset + ((e - offset) * (g - offset)).sum() / square * (d.expected - offset)


def target_scales(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return targets with another action scale of some joints."""
    _, offset = _scale_and_offset(evidence)
    e, g = _known(d)
    square = np.maximum(((e - offset) ** 2).sum(axis=0), 1e-30)
    return offset + ((e - offset) * (g - offset)).sum(axis=0) / square * (d.expected - offset)


def no_offset(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return targets without the default pose added."""
    return d.expected - _scale_and_offset(evidence)[1]


def raw_action(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return the answer of the network as the target, without scale and offset."""
    action = evidence.trace["action"].astype(float)
    return action if action.shape == d.got.shape else None


def joint_range(d: Difference, evidence: Evidence) -> np.ndarray:
    """Return targets clipped to the range of the joints."""
    ranges = {one["name"]: one["range"] or (-np.inf, np.inf) for one in evidence.contract["joints"]}
    low, high = np.array([ranges.get(j, (-np.inf, np.inf)) for j in evidence.target_joints]).T
    return d.expected.clip(low, high)


def target_not_clipped(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Return targets without their clip."""
    action, free = evidence.trace["action"].astype(float), d.expected.copy()
    for entry in evidence.contract["actions"]:
        if "scale" in entry:
            raw = action[:, entry["start"] : entry["stop"]]
            part = slice(entry["target_start"], entry["target_stop"])
            free[:, part] = raw * entry["scale"] + entry["offset"]
    low, high = np.nanmin(d.expected, axis=0), np.nanmax(d.expected, axis=0)
    return free if np.nanmax(np.abs(free.clip(low, high) - d.expected)) <= d.tolerance else None
