"""Logs of a robot, and answers of a program in another language, against the contract of a bundle.

Both are tables (CSV) with the columns of `golden.csv`:

    time                                   s, monotonic
    first                                  1 where an episode begins; without it, the log begins anywhere
    motion                                 motion of the episode; without it, that of the golden trace where
                                           there is a column step, else 0
    measurement.<name>.<k or joint>        raw measurements; also `quaternion.<w, x, y, z>`,
                                           `gyroscope.<x, y, z>`, `position.<joint>`, `velocity.<joint>`
    command.<name>.<k>                     commands
    obs.<k>, action.<k>, target.<joint>    what the program computed, as far as it is known

`golden.csv` is such a log.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mjlab.deploy.check import TOLERANCES, Comparison, Report, compare, find_causes
from mjlab.deploy.evidence import Evidence
from mjlab.deploy.usual_terms import imu_field
from mjlab.utils.csv_table import CsvTable
from mjlab.utils.errors import UserError

_ANSWERS = {"obs": "input/obs", "action": "action", "target": "target"}
_STAGES = {"input/obs": "vector", "action": "action", "target": "target"}
TOLERANCE = TOLERANCES["vector"]
"""Largest difference that is none, as a fraction of the range of the values."""
# Gaps above this multiple of the period are counted as missed steps.
_MISSED = 1.5
# Relative difference of another control rate.
_OTHER_PERIOD = 0.02
# Longest lag searched for (steps).
_LONGEST_LAG = 10
_ENOUGH = 20

# Answers.


@dataclass(frozen=True)
class Answers:
    """Answers of a program, as far as a table says them.

    Attributes:
        values: Values, (K, n).
        known: Cells that are not empty, (K, n). One may hold NaN.
    """

    values: np.ndarray
    known: np.ndarray

    def part(self, start: int, stop: int) -> Answers:
        """Return some of the columns."""
        return Answers(self.values[:, start:stop], self.known[:, start:stop])

    def row(self, k: int) -> np.ndarray | None:
        """Return row `k` in float32; None if a cell is empty."""
        return self.values[k].astype(np.float32) if self.known[k].all() else None


def check_answers(folder: Path, path: Path, tolerance: float = TOLERANCE) -> Report:
    """Return the report of a program's answers to `golden.csv`, with its `step` if rows are missing.

    Raises:
        UserError: the table has no answers, rows beyond the trace, or only some rows and no column `step`.
    """
    evidence, table = Evidence(folder), CsvTable(path)
    count = len(evidence.first)
    length = len(next(iter(table.columns.values())))
    if "step" not in table.columns and length != count:
        raise UserError(f"{path}: expected a column step, or all {count} rows, got {length} rows.")
    rows = table.columns.get("step", np.arange(count)).astype(int)
    if rows.min() < 0 or rows.max() >= count:
        raise UserError(f"{path} step: expected 0 to {count - 1}, got up to {rows.max()}.")
    values = {}
    for name, answers in _answers(evidence, table).items():
        shape = (count, answers.values.shape[1])
        values[name] = Answers(np.zeros(shape), np.zeros(shape, bool))
        values[name].values[rows], values[name].known[rows] = answers.values, answers.known
    return _report(evidence, values, [], [], tolerance)


def _answers(evidence: Evidence, table: CsvTable) -> dict[str, Answers]:
    """Return the answers in a table, by name in the trace.

    Raises:
        UserError: the table has none.
    """
    sizes = {one["input"]: one["shape"] for one in evidence.contract["observations"]}
    numbers = {
        "obs": sizes["obs"][-1] if len(sizes.get("obs", ())) == 1 else 0,
        "action": evidence.contract["policy"]["size"],
    }
    labels = {name: [str(k) for k in range(size)] for name, size in numbers.items()}
    labels["target"] = evidence.target_joints
    found = {}
    for name in _ANSWERS:
        values = table.group(name, labels[name])
        if values is not None:
            empty = np.stack([table.empty[f"{name}.{label}"] for label in labels[name]], axis=1)
            found[_ANSWERS[name]] = Answers(values, ~empty)
    if not found:
        raise UserError(
            f"{table.path}: expected columns obs.<k>, action.<k> or target.<joint>, got none."
        )
    return found


def _report(
    evidence: Evidence,
    answers: Mapping[str, Answers],
    timing: list[Comparison],
    undecided: list[str],
    tolerance: float,
) -> Report:
    """Return the report on answers; those that a table leaves empty are not compared."""
    found = {(_STAGES[name], name): value for name, value in answers.items()}
    if "input/obs" in answers:
        for (place, term), entry in evidence.terms.items():
            if place == "obs":
                part = answers["input/obs"].part(entry["start"], entry["stop"])
                found["history", f"term/obs/{term}"] = part
    compared = compare(evidence, {key: value.values for key, value in found.items()})
    known = {name: value.known for (_, name), value in found.items()}
    comparisons = timing + [_where_known(one, known[one.name], tolerance) for one in compared]
    report = Report(comparisons, undecided=undecided)
    if not report.is_passed:
        report.findings = find_causes(evidence, comparisons, {})
    return report


def _where_known(one: Comparison, known: np.ndarray, tolerance: float) -> Comparison:
    """Leave out what the table does not say."""
    if one.got.shape != one.expected.shape:
        return one
    known = known & np.isfinite(one.expected)
    one = replace(
        one, expected=np.where(known, one.expected, np.nan), got=np.where(known, one.got, 0.0)
    )
    return replace(one, bound=tolerance * one.span)


# Logs.


def check_log(folder: Path, path: Path, tolerance: float = TOLERANCE) -> Report:
    """Return the report of a log: terms, vector, action and target recomputed from its raw columns.

    Raises:
        UserError: the log lacks time, answers, or all that they are computed from.
    """
    bundle, table = Evidence(folder), CsvTable(path)
    if "time" not in table.columns:
        raise UserError(f"{path}: expected a column time (s).")
    raw, missing = _raw(bundle, table)
    answers = _answers(bundle, table)
    gaps = _gaps(raw)
    raw = {name: _held(values, gaps) for name, values in raw.items()}
    trace = _recomputed(bundle, table, raw, answers)
    evidence = Evidence(folder, trace)
    period, sentences = _timing(bundle, table.columns["time"], trace["first"])
    sentences += _lags(bundle, raw, answers)
    answers, unknown = _comparable(evidence, gaps, "first" in table.columns, answers)
    sentences += unknown
    notes = [
        f"{name}: not in the log; what is computed from it is not compared." for name in missing
    ]
    absent = [name for name in _ANSWERS if _ANSWERS[name] not in answers]
    notes += [f"{name}: not in the log." for name in absent]
    notes.append(
        "sensors, torque, state and what is read when: raw columns are taken as they are, and a log has "
        "no true state."
    )
    report = replace(_report(evidence, answers, period, notes, tolerance), notes=sentences)
    if not any(one.num_rows for one in report.comparisons if one.stage != "rates"):
        raise UserError(f"{path}: expected measurements to compute answers from, got none.")
    return report


def _raw(evidence: Evidence, table: CsvTable) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return measurements and commands of a log by name in the trace, and the missing ones."""
    found, missing = {}, []
    for entry in evidence.contract["measurements"]:
        name = entry["name"]
        joints = evidence.joint_names if name in ("joint_pos", "joint_vel") else None
        labels = joints or [str(k) for k in range(entry["size"])]
        values = table.group(f"measurement.{name}", labels)
        if values is None:
            values = table.group(*_plain_name(evidence.contract, entry, labels))
        if values is None:
            missing.append(f"measurement {name}")
            values = np.full((len(table.columns["time"]), entry["size"]), np.nan)
        found[f"measurement/{name}"] = values.reshape(-1, *entry["shape"])
    for entry in evidence.contract["commands"]:
        name = entry["name"]
        values = table.group(f"command.{name}", [str(k) for k in range(entry["size"])])
        if values is None and entry["kind"] == "given":
            missing.append(f"command {name}")
            values = np.full((len(table.columns["time"]), entry["size"]), np.nan)
        if values is not None:
            found[f"command/{name}"] = values
    return found, missing


def _plain_name(
    contract: Mapping[str, Any], entry: Mapping[str, Any], labels: list[str]
) -> tuple[str, list[str]]:
    """Return the shorter name of a measurement, and the labels of its columns."""
    field = imu_field(contract, entry)
    if field is not None:
        return field, list("xyz" if field == "gyroscope" else "wxyz")
    name = entry["name"]
    return {"joint_pos": "position", "joint_vel": "velocity"}.get(name, name), labels


def _gaps(raw: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the rows that lack a value of a measurement or command that the log has, (K,)."""
    known = [np.isfinite(values.reshape(len(values), -1)).all(axis=1) for values in raw.values()]
    there = [rows for rows in known if rows.any()]
    count = len(next(iter(raw.values())))
    return ~np.all(there, axis=0) if there else np.zeros(count, bool)


def _held(values: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """Return `values` with those of gaps replaced by the last before, or the first of all."""
    kept = np.flatnonzero(~gaps)
    if not kept.size:
        return values
    rows = np.searchsorted(kept, np.arange(len(values)), side="right") - 1
    return values[kept[np.maximum(rows, 0)]]


def _comparable(
    evidence: Evidence, gaps: np.ndarray, has_starts: bool, answers: Mapping[str, Answers]
) -> tuple[dict[str, Answers], list[str]]:
    """Return the answers that a log decides about, and a sentence on what else it has.

    Left out are gaps, and histories that hold one; without a column `first`, histories before they are full,
    and what counts from the start of an episode: clocks, motions and memory.
    """
    sentences, contract = [], evidence.contract
    longest = max(1, *(term["history"]["length"] for term in evidence.terms.values()))
    hidden = np.convolve(gaps, np.ones(longest))[: len(gaps)] > 0
    if gaps.any():
        sentences.append(
            f"gaps: {gaps.sum()} rows lack a measurement or command; {hidden.sum()} rows are not compared, "
            "as their histories hold them."
        )
    counted = [f"command/{one['name']}" for one in contract["commands"] if one["kind"] != "given"]
    if not has_starts:
        hidden[:longest] = True
        sentences.append(
            "no column first: the log may begin within an episode. Rows are compared from "
            f"{longest} on, when histories are full."
        )
    known = {name: value.known & ~hidden[:, None] for name, value in answers.items()}
    memory = [one for one in contract["policy"]["inputs"] if one["kind"] == "memory"]
    if not has_starts and counted:
        for (place, name), term in evidence.terms.items():
            if place == "obs" and any(one.startswith(tuple(counted)) for one in term["inputs"]):
                sentences.append(
                    f"{name}: not compared, as it counts from the start of an episode."
                )
                if "input/obs" in known:
                    known["input/obs"][:, term["start"] : term["stop"]] = False
    if not has_starts and "action" in known and (memory or counted and "input/obs" not in answers):
        sentences.append("action: not compared, as it depends on the start of the episode.")
        known["action"][:] = False
    return {name: replace(value, known=known[name]) for name, value in answers.items()}, sentences


def _recomputed(
    evidence: Evidence,
    table: CsvTable,
    raw: Mapping[str, np.ndarray],
    answers: Mapping[str, Answers],
) -> dict[str, np.ndarray]:
    """Return the trace that the original runtime gives for the raw columns of a log.

    Each stage starts from the log where it has the stage before: the last action from its actions, the action
    from its observations, the target from its actions.
    """
    policy = evidence.policy()
    count = len(table.columns["time"])
    first = table.columns.get("first", np.arange(count) == 0).astype(bool)
    motions = _motions(evidence, table)
    rows: dict[str, list] = {}

    def add(name: str, value: Any) -> None:
        rows.setdefault(name, []).append(np.array(value))

    given = [one["name"] for one in evidence.contract["commands"] if one["kind"] == "given"]
    names = [one["name"] for one in evidence.contract["measurements"]]
    for k in range(count):
        if first[k]:
            policy.reset(motion=int(motions[k]))
        measured: dict[str, Any] = {name: raw[f"measurement/{name}"][k] for name in names}
        measured["time"] = float(table.columns["time"][k])
        policy.step(measured, {name: raw[f"command/{name}"][k] for name in given})
        for (place, term), value in policy.values.items():
            add(f"raw/{place}/{term}", np.ravel(value))
        for place, value in policy.inputs.items():
            add(f"input/{place}", value[0])
        for (place, term), entry in evidence.terms.items():
            if place == "obs":
                add(f"term/obs/{term}", policy.inputs[place][0, entry["start"] : entry["stop"]])
        x = answers["input/obs"].row(k) if "input/obs" in answers else None
        if x is not None and len(policy.inputs) == 1:
            policy.action = policy.infer({"obs": x[None]})
        add("action", policy.action.copy())
        logged = answers["action"].row(k) if "action" in answers else None
        if logged is not None:
            policy.action = logged
        policy.targets(measured["joint_pos"])
        add("target", policy.target.copy())
    trace = {name: np.array(values) for name, values in rows.items()}
    return {**trace, **raw, "first": first, "motion": motions, "time": table.columns["time"]}


def _motions(evidence: Evidence, table: CsvTable) -> np.ndarray:
    """Return the motion of each row, (K,); of rows that start an episode where the table has none.

    Raises:
        UserError: the contract has no such motion.
    """
    count = len(table.columns["time"])
    if "motion" not in table.columns:
        steps = table.columns.get("step", np.full(count, -1))
        return np.array([evidence.motion(int(step)) for step in steps])
    motions = table.columns["motion"]
    sizes = [len(one["motions"]) for one in evidence.contract["commands"] if "motions" in one]
    if not np.isin(motions, np.arange(max(sizes, default=1))).all():
        raise UserError(
            f"{table.path} motion: expected 0 to {max(sizes, default=1) - 1}, got {motions.max():g}."
        )
    return motions.astype(int)


def _timing(
    evidence: Evidence, time: np.ndarray, first: np.ndarray
) -> tuple[list[Comparison], list[str]]:
    """Return the comparison of the period of a log, and a sentence on its steadiness."""
    gaps = np.diff(time)[~first[1:].astype(bool)]
    if not len(gaps):
        return [], []
    period, wanted = float(np.median(gaps)), evidence.contract["rates"]["step_dt"]
    missed = int((gaps > _MISSED * wanted).sum())
    text = (
        f"period: median {1e3 * period:.2f} ms, contract {1e3 * wanted:.2f} ms; jitter (standard deviation) "
        f"{1e3 * gaps.std():.2f} ms, longest {1e3 * gaps.max():.2f} ms; {missed} gaps above "
        f"{_MISSED} periods."
    )
    expected, got = np.full((len(time), 1), wanted), np.full((len(time), 1), period)
    bound = _OTHER_PERIOD * wanted
    return [Comparison("rates", "time", expected, got, ["period"], bound)], [text]


def _lags(
    evidence: Evidence, raw: Mapping[str, np.ndarray], answers: Mapping[str, Answers]
) -> list[str]:
    """Return a sentence on the lag of joint positions behind their targets, and that of the trace."""
    if "target" not in answers:
        return []
    joints, dt = evidence.joint_names, evidence.contract["rates"]["step_dt"]
    index = [joints.index(name) for name in evidence.target_joints if name in joints]
    texts = []
    for target, position in (
        (answers["target"].values, raw["measurement/joint_pos"]),
        (evidence.trace["target"], evidence.trace["measurement/joint_pos"]),
    ):
        lag = _lag(target, position[:, index]) if target.shape[1] == len(index) else None
        texts.append("unknown" if lag is None else f"{1e3 * lag * dt:.0f} ms")
    return [f"lag of joint positions behind targets: {texts[0]}; in the golden trace {texts[1]}."]


def _lag(target: np.ndarray, position: np.ndarray) -> float | None:
    """Return the lag with the largest correlation of the changes, in steps, between samples too."""
    a, b = np.diff(target, axis=0), np.diff(position, axis=0)
    if len(a) < _ENOUGH + _LONGEST_LAG or not np.isfinite(a).all() or not np.isfinite(b).all():
        return None
    products = [
        float((a[: len(a) - lag] * b[lag:]).sum(axis=0).mean()) for lag in range(_LONGEST_LAG + 1)
    ]
    peak = int(np.argmax(products))
    if peak in (0, _LONGEST_LAG):
        return float(peak)
    # Peak of the parabola through three samples.
    before, here, after = products[peak - 1 : peak + 2]
    curvature = before - 2 * here + after
    return peak + 0.5 * (before - after) / curvature if curvature < 0 else float(peak)
