"""Causes of wrong physics: torques, states, and the sensors read after them.

A program at fault: the original program with the mistake gives the values found. Model or contract at fault:
the original program with the correction gives the expected ones.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from mjlab.deploy.evidence import Difference, Evidence


def _is_program(d: Difference, evidence: Evidence) -> bool:
    """True if the original programs give the expected values with this contract and model."""
    if "physics" not in evidence.memo:
        evidence.memo["physics"] = evidence.physics()
    known = np.isfinite(d.expected)
    left = np.abs(evidence.memo["physics"][d.name] - d.expected)[known]
    return bool(left.max(initial=0.0) <= d.tolerance)


def _mistaken(
    d: Difference, evidence: Evidence, name: str, mistake: Callable[[Any], Any]
) -> np.ndarray | None:
    """Return the values of the original simulation with a mistake, a subclass of it."""
    if not _is_program(d, evidence):
        return None
    # Controls, torques and states differ together; computed once for all (3.4 to 1.7 s on a Go1).
    if name not in evidence.memo:
        simulation = mistake(evidence.originals.simulate.Simulation)
        evidence.memo[name] = evidence.physics(simulation=simulation)
    return evidence.memo[name].get(d.name)


def _corrected(
    d: Difference,
    evidence: Evidence,
    name: str,
    correct: Callable[[dict, mujoco.MjModel], bool],
) -> np.ndarray | None:
    """Return the values found, plus what is left to the expected ones after a correction."""
    if name not in evidence.memo:
        contract, model = copy.deepcopy(evidence.contract), copy.copy(evidence.model)
        is_other = correct(contract, model)
        evidence.memo[name] = evidence.physics(contract, model) if is_other else {}
    found = evidence.memo[name].get(d.name)
    return None if found is None else d.got + found - d.expected


def joint_order(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Write controls in the order of the joints, not of the scene's actuators."""

    def mistake(base: Any) -> Any:
        class JointOrder(base):
            def write_controls(self, targets: Any) -> None:
                super().write_controls(targets)
                places = [k for k, j in enumerate(self.joint_of) if j >= 0]
                ordered = sorted(places, key=lambda k: self.joint_of[k])
                self.data.ctrl[places] = self.data.ctrl[ordered]

        return JointOrder

    return _mistaken(d, evidence, "joint_order", mistake)


def one_step_late(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Apply targets one control step late."""

    def mistake(base: Any) -> Any:
        class Late(base):
            def apply(self, targets: Any) -> None:
                self.held = held = getattr(self, "sent", targets)
                self.sent = targets
                super().apply(held)

        return Late

    return _mistaken(d, evidence, "one_step_late", mistake)


def one_substep_late(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Apply targets one physics step late."""

    def mistake(base: Any) -> Any:
        class Late(base):
            def apply(self, targets: Any) -> None:
                held = getattr(self, "sent", targets)
                for k in range(self.contract["rates"]["decimation"]):
                    self.write_controls(held if k == 0 else targets)
                    mujoco.mj_step(self.model, self.data)
                mujoco.mj_forward(self.model, self.data)
                self.sent = targets

        return Late

    return _mistaken(d, evidence, "one_substep_late", mistake)


def stale_sensors(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Read sensors after `mj_step` without `mj_forward`: those of one physics step before."""

    def mistake(base: Any) -> Any:
        class Stale(base):
            def apply(self, targets: Any) -> None:
                for _ in range(self.contract["rates"]["decimation"]):
                    self.write_controls(targets)
                    mujoco.mj_step(self.model, self.data)

        return Stale

    return _mistaken(d, evidence, "stale_sensors", mistake)


def control_rate(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Run another number of physics steps in a control step."""

    def correct(contract: dict, model: mujoco.MjModel) -> bool:
        times = np.diff(evidence.trace["time"])
        steps = round(float(np.median(times)) / model.opt.timestep)
        is_other = steps != contract["rates"]["decimation"]
        contract["rates"]["decimation"] = steps
        return is_other

    if not _is_program(d, evidence):
        return _corrected(d, evidence, "control_rate", correct)
    usual = evidence.contract["rates"]["decimation"]
    found = [
        _mistaken(d, evidence, f"decimation {steps}", _with_decimation(steps))
        for steps in sorted({1, usual // 2, usual * 2} - {0, usual})
    ]
    known = [one for one in found if one is not None]
    return min(known, key=lambda one: np.abs(one - d.got).max(), default=None)


def _with_decimation(steps: int) -> Callable[[Any], Any]:
    def mistake(base: Any) -> Any:
        class Other(base):
            def apply(self, targets: Any) -> None:
                rates = {**self.contract["rates"], "decimation": steps}
                self.contract = {**self.contract, "rates": rates}
                super().apply(targets)

        return Other

    return mistake


def physics_rate(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Correct a time step of the scene other than `rates.physics_dt`."""

    def correct(contract: dict, model: mujoco.MjModel) -> bool:
        is_other = not np.isclose(model.opt.timestep, contract["rates"]["physics_dt"], rtol=1e-6)
        model.opt.timestep = contract["rates"]["physics_dt"]
        return is_other

    return _corrected(d, evidence, "physics_rate", correct)


def of_joints(
    field: str,
) -> Callable[[Difference, Evidence], np.ndarray | None]:
    """Return the cause that `field` of the scene's joints is not that of the contract."""

    def explain(d: Difference, evidence: Evidence) -> np.ndarray | None:
        def correct(contract: dict, model: mujoco.MjModel) -> bool:
            values = getattr(model, f"dof_{field}").reshape(model.nv, -1)
            before = values.copy()
            for joint in contract["joints"]:
                values[int(model.joint(joint["scene_name"]).dofadr[0]), 0] = joint[field]
            return not np.allclose(before, values, rtol=1e-9, atol=0.0)

        return _corrected(d, evidence, f"joint {field}", correct)

    return explain


def _gains(contract: dict, model: mujoco.MjModel) -> np.ndarray:
    """Return kp (twice) and kd of each control, as held and as listed, (2, nu, 3)."""
    joints = {joint["scene_name"]: joint for joint in contract["joints"]}
    rows = []
    for k, actuator in enumerate(contract["actuators"]):
        joint = joints.get(actuator["joint"])
        if joint is None:
            continue
        held = (actuator["kp"], actuator["kp"], actuator["kd"])
        if actuator["law"] == "position":
            # At the joint.
            square = model.actuator_gear[k, 0] ** 2
            gain, bias = square * model.actuator_gainprm[k], square * model.actuator_biasprm[k]
            held = (gain[0], -bias[1], -bias[2])
        rows.append((held, (joint["kp"], joint["kp"], joint["kd"])))
    return np.array(rows).swapaxes(0, 1)


def _correct_gains(is_order: bool, source: str) -> Callable[[dict, mujoco.MjModel], bool]:
    def correct(contract: dict, model: mujoco.MjModel) -> bool:
        held, listed = _gains(contract, model)
        same = np.allclose(np.sort(held, axis=0), np.sort(listed, axis=0), rtol=1e-5)
        if np.allclose(held, listed, rtol=1e-5) or same != is_order:
            return False
        joints = {joint["scene_name"]: joint for joint in contract["joints"]}
        driven = [a for a in enumerate(contract["actuators"]) if a[1]["joint"] in joints]
        for (k, actuator), (kp, _, kd) in zip(driven, held, strict=True):
            joint = joints[actuator["joint"]]
            if source == "scene":
                joint["kp"], joint["kd"] = kp, kd
                continue
            joint["kp"], joint["kd"] = actuator["kp"], actuator["kd"]
            if actuator["law"] == "position":
                square = model.actuator_gear[k, 0] ** 2
                model.actuator_gainprm[k, 0] = actuator["kp"] / square
                model.actuator_biasprm[k, 1:3] = -actuator["kp"] / square, -actuator["kd"] / square
        return True

    return correct


def _of_gains(is_order: bool) -> Callable[[Difference, Evidence], np.ndarray | None]:
    """Return the cause of wrong gains; those of the contract's actuators, or of the scene, are right."""

    def explain(d: Difference, evidence: Evidence) -> np.ndarray | None:
        found = [
            _corrected(d, evidence, f"gains {is_order} {source}", _correct_gains(is_order, source))
            for source in ("actuators", "scene")
        ]
        known = [one for one in found if one is not None]
        return min(known, key=lambda one: np.nanmax(np.abs(one - d.got)), default=None)

    return explain


gains = _of_gains(False)
"""Correct gains that are others."""
gains_order = _of_gains(True)
"""Correct gains in another order."""


def effort_limit(d: Difference, evidence: Evidence) -> np.ndarray | None:
    """Correct an effort limit that is missing, or another one."""

    def correct(contract: dict, model: mujoco.MjModel) -> bool:
        joints, changed = {j["scene_name"]: j for j in contract["joints"]}, False
        for k, actuator in enumerate(contract["actuators"]):
            joint, limit = joints.get(actuator["joint"]), actuator["effort"]
            if joint is None:
                continue
            limited, gear = bool(model.actuator_forcelimited[k]), model.actuator_gear[k, 0]
            held = float(model.actuator_forcerange[k, 1] * gear) if limited else None
            if actuator["law"] == "position" and not _same(held, limit):
                changed, model.actuator_forcelimited[k] = True, limit is not None
                bound = 0.0 if limit is None else limit / gear
                model.actuator_forcerange[k] = -bound, bound
            if not _same(joint["effort"], limit):
                changed, joint["effort"] = True, limit
        return changed

    return _corrected(d, evidence, "effort_limit", correct)


def _same(one: float | None, other: float | None) -> bool:
    return one == other if one is None or other is None else bool(np.isclose(one, other))
