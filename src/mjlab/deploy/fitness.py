"""Fitness for a robot: what the golden trace asks of sensors and motors."""

from __future__ import annotations

import numpy as np

from mjlab.deploy.evidence import Evidence, rotations

# Share of the steps at a limit that is worth a warning.
_OFTEN = 0.01


def fitness_warnings(evidence: Evidence) -> list[str]:
    """Return one sentence on each demand that a robot may not meet."""
    contract = evidence.contract
    warnings = [
        f"Robots do not measure {one['measurement']}, which {one['term']} needs ({one['why']})."
        for one in contract["unmeasured"]
    ]
    return warnings + _torques(evidence) + _speeds(evidence) + _targets(evidence) + _tilts(evidence)


def _torques(evidence: Evidence) -> list[str]:
    force = np.abs(evidence.torques)
    shares = {
        actuator["name"]: float((force[:, k] >= actuator["effort"] * (1 - 1e-6)).mean())
        for k, actuator in enumerate(evidence.contract["actuators"])
        if actuator["effort"]
    }
    return _worst(shares, "at the effort limit", "actuators")


def _speeds(evidence: Evidence) -> list[str]:
    speed = np.abs(evidence.values("joint_vel"))
    limits = np.array(evidence.contract["limits"]["joint_speed"])
    shares = (speed > limits).mean(axis=0)
    return _worst(
        dict(zip(evidence.joint_names, shares, strict=True)), "above limits.joint_speed", "joints"
    )


def _targets(evidence: Evidence) -> list[str]:
    target, limits = evidence.trace["target"].astype(float), evidence.contract["limits"]
    names = evidence.target_joints
    jumps = np.abs(target - evidence.previous(target))
    low, high = np.array(limits["target_low"]), np.array(limits["target_high"])
    shares = {
        "change by more than limits.target_step": jumps > np.array(limits["target_step"]),
        "beyond limits.target_low or target_high": (target < low) | (target > high),
    }
    texts = []
    for what, over in shares.items():
        found = dict(zip(names, over.mean(axis=0), strict=True))
        texts += _worst(found, what, "targets", least=0.0)
    return texts


def _tilts(evidence: Evidence) -> list[str]:
    """Return a sentence if the trace, or the reference motion, tilts the robot beyond the limit."""
    contract = evidence.contract
    limit, name = contract["limits"]["tilt"], contract["limits"]["tilt_from"]
    if limit is None or name is None:
        return []
    quats = {"golden trace": evidence.values(name)}
    (source,) = [one["source"] for one in contract["measurements"] if one["name"] == name]
    for command in contract["commands"]:
        if command["kind"] == "motion":
            bodies = np.load(evidence.folder / command["file"])["body_quat_w"]
            body = command["bodies"].index(source["body"].rpartition("/")[2])
            quats["reference motion"] = bodies[:, body]
    texts = []
    for what, turns in quats.items():
        tilt = float(np.arccos(np.clip(rotations(turns)[:, 2, 2], -1.0, 1.0)).max())
        if tilt > limit:
            texts.append(
                f"The {what} tilts the robot by {tilt:.3g} rad; beyond limits.tilt, {limit:.3g}, it is "
                "damped."
            )
    return texts


def _worst(shares: dict[str, float], what: str, kind: str, least: float = _OFTEN) -> list[str]:
    """Return a sentence on the names with a share above `least`."""
    over = {name: share for name, share in shares.items() if share > least}
    if not over:
        return []
    name = max(over, key=lambda one: over[one])
    return [
        f"{len(over)} of {len(shares)} {kind} {what}; most {name}, in {100 * over[name]:.1f} % of the "
        "steps."
    ]
