"""Check of a bundle: its programs in plain MuJoCo against the golden trace, stage by stage.

Each stage starts from the values of the trace, so that a mistake shows where it is made:

    sensors        state of the trace -> `Simulation.measure`
    term           measurements of the trace -> values before clip and scale
    history        the same -> clip, scale, history
    vector         the same -> network inputs
    action         the same -> answer of the network
    target         the same -> joint targets, as computed and as sent
    torque         state and targets of the trace -> controls and torques of the last physics step
    state          the same -> state after one control step
    next sensors   the same -> `Simulation.measure` after it
    free steps     two control steps of an episode without values of the trace
    contract       scene -> what `contract.json` lists of the joints, and no other stage compares;
                   contract -> `params/deploy.yaml` and the network beside it

No code of this package runs between a state and the next: `Simulation` of the bundle calls `mj_step`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjlab.deploy.causes import Verdict, likely_cause
from mjlab.deploy.evidence import Difference, Evidence, Programs, flat, one_step
from mjlab.deploy.fitness import fitness_warnings
from mjlab.deploy.unitree import file_numbers
from mjlab.utils.errors import UserError
from mjlab.utils.tables import Table

TOLERANCES = {
    "rates": 1e-6,
    "sensors": 1e-5,
    "term": 1e-5,
    "history": 1e-5,
    "vector": 1e-5,
    "action": 1e-5,
    "target": 1e-5,
    "torque": 1e-4,
    "state": 1e-4,
    "next sensors": 1e-4,
    "free steps": 1e-3,
    "contract": 1e-4,
}
"""Largest difference by stage, in causal order, as a fraction of the range of the values; for rates, of the period."""
_CHAINS = (
    ("rates",),
    ("sensors",),
    ("term", "history", "vector", "action", "target"),
    ("torque", "state", "next sensors"),
    ("contract",),
)
_JOINT_FIELDS = ("default_pos", "armature", "damping", "frictionloss")
_SMALLEST_RANGE = 1e-3
# Difference of a number in `deploy.yaml` that is none, and the value of a key that is not there.
_ROUNDED, _ABSENT = 1e-6, -1e12
_FREE_STEPS = 2
# The trace shows frames if it tilts and turns by this much (rad).
_TILT, _TURN = 0.2, math.pi / 2


@dataclass(frozen=True)
class Comparison:
    """Values of one name, of the trace and of the bundle's programs.

    Attributes:
        stage: Stage.
        name: Name of the values in the trace.
        expected: Values of the trace, (K, n). NaN: unknown.
        got: Values of the programs, (K, n).
        labels: Name of each component.
        bound: Largest difference that is none; None: that of the stage.
    """

    stage: str
    name: str
    expected: np.ndarray
    got: np.ndarray
    labels: list[str]
    bound: float | None = None

    @property
    def span(self) -> float:
        """Range of the values in the trace."""
        known = self.expected[np.isfinite(self.expected)]
        return max(_SMALLEST_RANGE, float(np.ptp(known)) if known.size else 0.0)

    @property
    def tolerance(self) -> float:
        """Largest difference that is none."""
        return TOLERANCES[self.stage] * self.span if self.bound is None else self.bound

    @property
    def num_rows(self) -> int:
        """Number of rows with a value to compare with."""
        return int(np.isfinite(self.expected).any(axis=1).sum())

    @property
    def errors(self) -> np.ndarray:
        """Differences, (K, n); infinite for values that are not finite or of another size."""
        if self.expected.shape != self.got.shape:
            return np.full(self.expected.shape, np.inf)
        known = np.isfinite(self.expected)
        difference = np.abs(self.got - np.where(known, self.expected, 0.0))
        return np.where(known, np.where(np.isfinite(difference), difference, np.inf), 0.0)

    @property
    def largest(self) -> float:
        """Largest difference."""
        return float(self.errors.max(initial=0.0))

    @property
    def is_equal(self) -> bool:
        """True if no difference is above the tolerance."""
        return self.largest <= self.tolerance

    @property
    def first(self) -> tuple[int, int]:
        """Row and component of the first difference; of several components, that of the largest."""
        errors = self.errors
        row = int(np.argmax((errors > self.tolerance).any(axis=1)))
        return row, int(np.argmax(errors[row]))


@dataclass(frozen=True)
class Finding:
    """First difference of a chain of stages, with its likely cause."""

    comparison: Comparison
    verdict: Verdict

    def __str__(self) -> str:
        one = self.comparison
        row, k = one.first
        lines = [f"{one.stage}, {one.name}: first difference in step {row}, {one.labels[k]}"]
        if one.expected.shape != one.got.shape:
            return f"{lines[0]}: size {one.got.shape[1]}, expected {one.expected.shape[1]}."
        lines[0] += f": expected {one.expected[row, k]:.6g}, got {one.got[row, k]:.6g}."
        if self.verdict.cause is not None:
            lines.append(f"Likely cause: {self.verdict.cause}.")
        else:
            lines.append(f"Cause: not decidable. {self.verdict.note}".rstrip())
        residuals = [f"{name} {left:.2g}" for name, left in self.verdict.residuals.items()]
        lines.append(
            f"Largest difference {one.largest:.3g}, tolerance {one.tolerance:.2g}; left after: "
            f"{', '.join(residuals) or 'nothing tried'}."
        )
        return "\n  ".join(lines)


@dataclass
class Report:
    """Result of a check.

    Attributes:
        comparisons: All comparisons, in causal order.
        findings: First differences; empty if the bundle passes.
        undecided: Mistakes that this trace cannot show, one sentence each.
        notes: Other sentences, such as the timing of a log.
        warnings: What a robot may not measure or follow, one sentence each.
    """

    comparisons: list[Comparison]
    findings: list[Finding] = field(default_factory=list)
    undecided: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def is_passed(self) -> bool:
        """True if values beside the period were compared, and there is no difference."""
        is_compared = any(one.num_rows for one in self.comparisons if one.stage != "rates")
        return is_compared and all(one.is_equal for one in self.comparisons)

    @property
    def causes(self) -> list[str]:
        """Named causes."""
        return [one.verdict.cause for one in self.findings if one.verdict.cause is not None]

    def table(self) -> Table:
        """Return the table of comparisons."""
        rows = [
            (
                one.stage,
                one.name,
                one.expected.shape[1],
                f"{one.num_rows} of {len(one.expected)}",
                float(f"{one.largest:.2g}"),
                float(f"{one.largest / one.span:.2g}"),
                _result(one),
            )
            for one in self.comparisons
        ]
        columns = ("stage", "values", "size", "steps", "difference", "of range", "result")
        return Table("stages", columns, rows)

    def __str__(self) -> str:
        parts = [self.table().text()]
        parts += [str(finding) for finding in self.findings]
        parts += self.notes
        if self.undecided:
            parts.append("Not decidable by this trace:\n  " + "\n  ".join(self.undecided))
        if self.warnings:
            parts.append("For a robot:\n  " + "\n  ".join(self.warnings))
        compared = [one for one in self.comparisons if one.num_rows]
        equal = sum(one.is_equal for one in compared)
        result = "PASSED" if self.is_passed else "FAILED"
        parts.append(f"{result}: {equal} of {len(compared)} values equal.")
        return "\n\n".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        return {
            "passed": self.is_passed,
            "stages": [_finite(record) for record in self.table().records()],
            "findings": [
                {
                    "stage": one.comparison.stage,
                    "values": one.comparison.name,
                    "step": one.comparison.first[0],
                    "component": one.comparison.labels[one.comparison.first[1]],
                    "cause": one.verdict.cause,
                    "left_after": _finite(one.verdict.residuals),
                    "note": one.verdict.note,
                }
                for one in self.findings
            ],
            "undecided": self.undecided,
            "notes": self.notes,
            "warnings": self.warnings,
        }


def _finite(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with None for infinite numbers, which JSON does not have."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in record.items()
    }


def _result(one: Comparison) -> str:
    if not one.num_rows:
        return "not compared"
    return "equal" if one.is_equal else f"differs from step {one.first[0]}"


def check_bundle(folder: Path) -> Report:
    """Return the report of a bundle.

    Raises:
        UserError: `folder` is not a bundle, or its programs raise.
    """
    evidence = Evidence(folder)
    with _named_failures(folder):
        programs = Programs.load(folder)
        values = replay(evidence, programs)
    comparisons = compare(evidence, values) + _unitree_files(evidence)
    report = Report(comparisons, undecided=undecided(evidence), warnings=fitness_warnings(evidence))
    if not report.is_passed:
        report.findings = find_causes(evidence, comparisons, replay(evidence, programs))
    return report


@contextlib.contextmanager
def _named_failures(folder: Path) -> Generator[None]:
    """Raise errors of the programs as those of the bundle."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{folder}: its programs raise {type(error).__name__}: {error}") from error


# Replay.


def replay(evidence: Evidence, programs: Programs) -> dict[tuple[str, str], np.ndarray]:
    """Return what the programs compute from the trace, by (stage, name), (K, n)."""
    found: dict[tuple[str, str], list] = {}

    def add(stage: str, name: str, value: Any) -> None:
        found.setdefault((stage, name), []).append(np.ravel(value).astype(float))

    contract = evidence.contract
    policy = programs.runtime.Policy.load(evidence.folder, limits=False)
    model = programs.simulate.load_model(evidence.folder)
    simulation = programs.simulate.Simulation(contract, model)
    for k in range(len(evidence.first)):
        if evidence.first[k]:
            policy.reset(motion=evidence.motion(k))
        simulation.set_state(**evidence.state(k))
        for name, value in _sensors(evidence, simulation).items():
            add("sensors", f"measurement/{name}", value)
        targets = policy.step(evidence.measured(k), evidence.command(k))
        add("rates", "time", [targets.period])
        for (place, term), value in policy.values.items():
            add("term", f"raw/{place}/{term}", value)
        for (place, term), entry in evidence.terms.items():
            axis = next(o["axis"] for o in contract["observations"] if o["input"] == place)
            slot = (0, *(slice(None),) * axis, slice(entry["start"], entry["stop"]))
            add("history", f"term/{place}/{term}", policy.inputs[place][slot])
        for place in {place for place, _ in evidence.terms}:
            add("vector", f"input/{place}", policy.inputs[place])
        add("action", "action", policy.action)
        add("target", "target", policy.target)
        add("target", "sent", _sent(evidence, targets))
        # Later rows do not inherit a wrong answer.
        policy.action[:] = evidence.trace["action"][k]
        if not evidence.has_physics:
            continue
        step = one_step(evidence, simulation, evidence.golden_targets(targets, k), k)
        for name, value in step.items():
            stage = "torque" if name in ("ctrl", "actuator_force", "motor_torque") else "state"
            add("next sensors" if name.startswith("next/") else stage, name, value)
    if evidence.has_physics:
        for stage, name, value in _free(evidence, policy, simulation):
            add(stage, name, value)
    for name, values in _listed(evidence).items():
        add("contract", name, values)
    return {key: np.array(rows) for key, rows in found.items()}


def _listed(evidence: Evidence) -> dict[str, np.ndarray]:
    """Return what the contract lists of the joints: their order in the scene, and numbers."""
    joints = evidence.contract["joints"]
    order = [evidence.model.joint(joint["scene_name"]).id for joint in joints]
    numbers = {f"joints/{key}": np.array([j[key] for j in joints]) for key in _JOINT_FIELDS}
    return {"joints/order": np.array(order), **numbers}


def _in_scene(evidence: Evidence) -> dict[str, np.ndarray]:
    """Return the values of `_listed` in the scene, in the order of `joint_pos`; NaN without a keyframe."""
    model, measurements = evidence.model, evidence.contract["measurements"]
    (source,) = (one["source"] for one in measurements if one["name"] == "joint_pos")
    joints = [model.joint(name) for name in source["joints"]]
    dofs = [int(joint.dofadr[0]) for joint in joints]
    # The last keyframe is that of the initial state.
    pose = model.key_qpos[-1] if model.nkey else np.full(model.nq, np.nan)
    return {
        "joints/order": np.array([joint.id for joint in joints]),
        "joints/default_pos": pose[[int(joint.qposadr[0]) for joint in joints]],
        "joints/armature": model.dof_armature[dofs],
        "joints/damping": model.dof_damping.reshape(model.nv, -1)[dofs, 0],
        "joints/frictionloss": model.dof_frictionloss[dofs],
    }


def _sensors(evidence: Evidence, simulation: Any) -> dict[str, np.ndarray]:
    """Return the measurements that kinematics give; NaN for those that `measure` leaves out."""
    measured = simulation.measure()
    return {
        one["name"]: np.asarray(measured.get(one["name"], np.full(one["shape"], np.nan)))
        for one in evidence.contract["measurements"]
        if one["source"]["kind"] != "trace"
    }


def _sent(evidence: Evidence, targets: Any) -> np.ndarray:
    """Return the motor commands in the order of the targets."""
    fields = {"joint_velocity": targets.velocity, "joint_effort": targets.effort}
    parts = [
        fields.get(action["kind"], targets.position)[
            [list(targets.names).index(name) for name in action["joints"]]
        ]
        for action in evidence.contract["actions"]
    ]
    return np.concatenate(parts)


def _starts(evidence: Evidence) -> list[int]:
    """Return the rows at which two free steps start."""
    rows = np.flatnonzero(evidence.first)
    return [
        int(k) for k in rows if (evidence.age[k : k + _FREE_STEPS + 1] > 0).sum() >= _FREE_STEPS
    ]


def _free(evidence: Evidence, policy: Any, simulation: Any) -> Iterator[tuple[str, str, Any]]:
    for start in _starts(evidence):
        policy.reset(motion=evidence.motion(start))
        simulation.set_state(**evidence.state(start))
        for k in range(start, start + _FREE_STEPS):
            measured = {**evidence.measured(k), **_sensors(evidence, simulation)}
            targets = policy.step(measured, evidence.command(k))
            for place, value in policy.inputs.items():
                if f"input/{place}" in evidence.trace:
                    yield "free steps", f"input/{place}", value
            yield "free steps", "action", policy.action
            simulation.apply(targets)
            yield "free steps", "after/qpos", simulation.data.qpos
            yield "free steps", "after/qvel", simulation.data.qvel


# Comparison.


def compare(evidence: Evidence, values: dict[tuple[str, str], np.ndarray]) -> list[Comparison]:
    """Return the comparisons of what the trace has, in causal order."""
    comparisons = []
    for stage in TOLERANCES:
        for (there, name), got in values.items():
            expected = _expected(evidence, stage, name) if there == stage else None
            if expected is not None and expected.shape[1]:
                labels = _labels(evidence, name, expected.shape[1])
                bound = TOLERANCES[stage] * float(expected[0, 0]) if stage == "rates" else None
                comparisons.append(Comparison(stage, name, expected, got, labels, bound))
    return comparisons


def _unitree_files(evidence: Evidence) -> list[Comparison]:
    """Return the comparisons of the files for Unitree's programs with the contract."""
    comparisons = []
    for name, parts in file_numbers(evidence.contract, evidence.folder).items():
        keys = list({**parts[0], **parts[1]})
        expected, got = (np.array([[part.get(key, _ABSENT) for key in keys]]) for part in parts)
        if keys:
            comparisons.append(Comparison("contract", name, expected, got, keys, _ROUNDED))
    return comparisons


def _expected(evidence: Evidence, stage: str, name: str) -> np.ndarray | None:
    """Return the values of the trace, (K, n); None if it has none."""
    trace = evidence.trace
    if stage == "rates":
        return np.full((len(trace["time"]), 1), np.median(np.diff(trace["time"])))
    if stage == "contract":
        return _in_scene(evidence)[name][None]
    if name == "sent":
        return flat(trace["target"]).astype(float)
    if stage == "next sensors":
        measured = trace[f"measurement/{name.removeprefix('next/')}"]
        return evidence.previous(flat(measured).astype(float), -1)
    if name == "motor_torque":
        return _motor_torques(evidence)
    if name not in trace:
        return None
    expected = flat(trace[name]).astype(float)
    if stage == "free steps":
        rows = [k for start in _starts(evidence) for k in range(start, start + _FREE_STEPS)]
        expected = expected[rows]
    return expected


def _motor_torques(evidence: Evidence) -> np.ndarray:
    """Return the torques of controls that a motor's kp and kd give; NaN for others, (K, nu)."""
    torques = evidence.torques.copy()
    joints = {one["scene_name"]: one for one in evidence.contract["joints"]}
    for k, actuator in enumerate(evidence.contract["actuators"]):
        is_motor = actuator["joint"] in joints and actuator["law"] in ("position", "pd")
        if not is_motor:
            torques[:, k] = np.nan
    return torques


def _labels(evidence: Evidence, name: str, count: int) -> list[str]:
    """Return a name for each component."""
    key = name.rsplit("/", 1)[-1]
    contract = evidence.contract
    if name == "time":
        return ["period"]
    if name in ("after/qpos", "after/qvel"):
        return _joints_of(evidence.model, key)
    term = evidence.terms.get(tuple(name.split("/", 2)[1:]), {})
    inputs = term.get("inputs", [key])
    size = term.get("size", count)
    names: list[str] = []
    if inputs in (["joint_pos"], ["joint_vel"]) or name.startswith("joints/"):
        names = evidence.joint_names
        names = [names[k] for k in term["columns"]] if term.get("columns") else names
    elif key in ("target", "sent") or term.get("kind") == "last_action" or key == "action":
        names = evidence.target_joints
    elif key in ("ctrl", "actuator_force", "motor_torque"):
        names = [actuator["name"] for actuator in contract["actuators"]]
    elif inputs and inputs[0].startswith("command/"):
        commands = {f"command/{one['name']}": one for one in contract["commands"]}
        entry = commands.get(inputs[0], {})
        names = [one["name"] for one in entry.get("components") or []]
    elif key.endswith(("quat", "quat_b")):
        names = list("wxyz")
    elif size == 3:
        names = list("xyz")
    elif name.startswith("input/"):
        names = _places(evidence, key, count)
    if len(names) != size:
        names = [str(k) for k in range(size)]
    if count == size:
        return [f"component {label}" if label.isdigit() else label for label in names]
    length = count // size
    return [f"{label}, {length - 1 - age} steps ago" for age in range(length) for label in names]


def _joints_of(model: mujoco.MjModel, field: str) -> list[str]:
    """Return the joint of each element of `qpos` or `qvel`, with a number within free and ball joints."""
    starts, end = (model.jnt_qposadr, model.nq) if field == "qpos" else (model.jnt_dofadr, model.nv)
    sizes = np.diff(np.append(starts, end))
    return [
        name if size == 1 else f"{name}[{k}]"
        for name, size in zip((model.joint(j).name for j in range(model.njnt)), sizes, strict=True)
        for k in range(size)
    ]


def _places(evidence: Evidence, place: str, count: int) -> list[str]:
    """Return term and component of each element of a flat input."""
    names = [str(k) for k in range(count)]
    for (there, term), entry in evidence.terms.items():
        if there == place and entry["stop"] <= count:
            for k in range(entry["start"], entry["stop"]):
                names[k] = f"{term}[{k - entry['start']}]"
    return names


# Findings.


def find_causes(
    evidence: Evidence,
    comparisons: list[Comparison],
    again: dict[tuple[str, str], np.ndarray],
) -> list[Finding]:
    """Return the differences at the first stage of each chain, with their causes.

    Args:
        evidence: Evidence.
        comparisons: All comparisons.
        again: Values of a second run of the same programs; empty if there is none.
    """
    findings = []
    evidence.found = {one.name: one.got for one in comparisons if one.stage != "free steps"}
    for chain in _CHAINS:
        stages = [s for s in chain if any(c.stage == s and not c.is_equal for c in comparisons)]
        if stages and not (chain[0] == "torque" and stages[0] == "next sensors" and findings):
            wrong = [c for c in comparisons if c.stage == stages[0] and not c.is_equal]
            if stages[0] == "history":
                wrong = _as_vector(evidence, comparisons, wrong)
            findings += [Finding(one, _verdict(evidence, one, again)) for one in wrong]
    if not findings:
        wrong = [one for one in comparisons if not one.is_equal]
        findings = [Finding(one, Verdict(None, {}, "only free steps differ")) for one in wrong]
    return findings


def _as_vector(
    evidence: Evidence, comparisons: list[Comparison], wrong: list[Comparison]
) -> list[Comparison]:
    """Return the comparisons of network inputs whose order explains wrong histories, and the rest."""
    shown: list[Comparison] = []
    for one in comparisons:
        if one.stage == "vector" and not one.is_equal:
            difference = _difference(one)
            if difference is not None and likely_cause(difference, evidence).cause is not None:
                shown.append(one)
    ordered = {one.name.removeprefix("input/") for one in shown}
    return shown + [one for one in wrong if one.name.split("/")[1] not in ordered]


def _difference(one: Comparison) -> Difference | None:
    if one.expected.shape != one.got.shape:
        return None
    if not np.isfinite(one.got[np.isfinite(one.expected)]).all():
        return None
    return Difference(one.stage, one.name, one.expected, one.got, one.tolerance)


def _verdict(
    evidence: Evidence, one: Comparison, again: dict[tuple[str, str], np.ndarray]
) -> Verdict:
    if one.stage == "contract":
        return Verdict(None, {}, "contract.json and another file of the bundle differ")
    difference = _difference(one)
    if difference is None:
        return Verdict(None, {}, "values of another size, or not finite")
    repeated = again.get((one.stage, one.name), one.got)
    if np.abs(repeated - one.got).max() > one.tolerance:
        residual = one.got - one.expected
        note = f"mean {np.nanmean(residual):.2g}, largest {np.nanmax(np.abs(residual)):.2g}"
        return Verdict("random numbers: noise left on", {}, note)
    return likely_cause(difference, evidence)


# Limits of the trace.


def undecided(evidence: Evidence) -> list[str]:
    """Return the mistakes that this trace cannot show."""
    trace, contract = evidence.trace, evidence.contract
    notes = []
    force = np.abs(evidence.torques).max(axis=0)
    for k, actuator in enumerate(contract["actuators"]):
        limit = actuator["effort"]
        if limit is not None and force[k] < limit * (1 - 1e-6):
            notes.append((force[k] / limit, actuator["name"], force[k], limit))
    texts = []
    if notes:
        _, name, largest, limit = max(notes)
        texts.append(
            f"effort limits of {len(notes)} of {len(contract['actuators'])} actuators: never reached; "
            f"nearest {name} with {largest:.3g} of {limit:.3g}."
        )
    for (place, name), term in evidence.terms.items():
        raw = trace.get(f"raw/{place}/{name}")
        if term["clip"] not in (None, [None, None]) and raw is not None:
            low = -math.inf if term["clip"][0] is None else term["clip"][0]
            high = math.inf if term["clip"][1] is None else term["clip"][1]
            if raw.min() >= low and raw.max() <= high:
                texts.append(
                    f"clip of {name}: values from {raw.min():.3g} to {raw.max():.3g} of {low:.3g} to "
                    f"{high:.3g}."
                )
    for command in contract["commands"]:
        values = flat(trace[f"command/{command['name']}"])
        if command["kind"] == "given" and (np.ptp(values, axis=0) == 0.0).any():
            texts.append(
                f"sign and scale of the command {command['name']}: a component is constant."
            )
    ranges = [(j["name"], *j["range"]) for j in contract["joints"] if j["range"] is not None]
    index = {name: k for k, name in enumerate(evidence.target_joints)}
    known = [
        (trace["target"][:, index[name]], low, high) for name, low, high in ranges if name in index
    ]
    if known and all(x.min() >= low and x.max() <= high for x, low, high in known):
        texts.append("targets clipped to the joint ranges: no target is beyond them.")
    texts += _delays(contract)
    if not evidence.has_physics:
        texts.append(
            "torque, state and later: an actuator has a law that `simulate.py` does not know."
        )
    texts += _attitude(evidence)
    return texts


def _delays(contract: Mapping[str, Any]) -> list[str]:
    """Return a sentence on each kind of delay that training had, and the trace does not."""
    actuators = [tuple(one["delay"]) for one in contract["actuators"] if any(one["delay"])]
    terms = [
        term["name"]
        for one in contract["observations"]
        for term in one["terms"]
        if any(term["delay"])
    ]
    texts = []
    if actuators:
        low, high = min(one[0] for one in actuators), max(one[1] for one in actuators)
        texts.append(
            f"delays of {len(actuators)} of {len(contract['actuators'])} actuators, {low} to {high} "
            "physics steps in training: the trace and the programs have none, as a robot has its own."
        )
    if terms:
        texts.append(
            f"delays of {', '.join(terms)}: training had them; the trace and the programs do not."
        )
    return texts


def _attitude(evidence: Evidence) -> list[str]:
    """Return what small tilts and turns cannot show."""
    if not evidence.contract["robot"]["is_floating"]:
        return []
    rotation = evidence.root_rotation
    tilt = float(np.arccos(np.clip(rotation[:, 2, 2], -1, 1)).max())
    turn = float(np.ptp(np.unwrap(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))))
    texts = []
    if tilt < _TILT:
        texts.append(f"frames, by tilt: at most {tilt:.2g} rad.")
    if turn < _TURN:
        texts.append(f"frames, by yaw: it changes by {turn:.2g} rad.")
    return texts
