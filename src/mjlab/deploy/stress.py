"""Stress: success of a deployed policy in plain MuJoCo, with one thing changed at a time.

An episode succeeds if the robot tilts by less than `limits.tilt` and stays above half of its initial height.
It starts in the initial pose, as after a hand-over, or at the start of a motion, and has commands drawn from
the ranges of training.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from mjlab.deploy.evidence import Evidence
from mjlab.deploy.noise import Noise, unknown_noises
from mjlab.utils.errors import UserError

_COMMAND_S, _PUSH_S = 2.0, 2.0
_LOWEST = 0.5


@dataclass(frozen=True)
class Setting:
    """Robot and floor of an episode; the defaults are those of the bundle."""

    latency: float = 0.0
    """Time from a measurement to the motors (s); simulated as the nearest number of physics steps."""
    noise: float = 0.0
    """Change of the terms by noise, as a multiple of training's. Noise of `unknown_noises` is left out."""
    joint_friction: float = 0.0
    """Friction added to each joint (N m)."""
    gains: float = 1.0
    """Factor on kp and kd."""
    mass: float = 1.0
    """Factor on masses and inertias of the robot."""
    floor_friction: float | None = None
    """Friction of all contacts. None: that of the scene."""
    payload: float = 0.0
    """Mass added to the root (kg)."""
    push: float = 0.0
    """Change of the velocity of the root every two seconds, in a random direction (m/s)."""


UNITS = {
    "latency": "s",
    "noise": "of training",
    "joint_friction": "N m",
    "gains": "of nominal",
    "mass": "of nominal",
    "floor_friction": "",
    "payload": "kg",
    "push": "m/s",
}
"""Unit of each field of `Setting`."""
LEVELS: Mapping[str, tuple[float, ...]] = {
    "latency": (0.0, 0.01, 0.02, 0.03, 0.04),
    "noise": (0.0, 0.5, 1.0, 2.0),
    "joint_friction": (0.0, 0.5, 1.0, 2.0),
    "gains": (0.8, 0.9, 1.0, 1.1, 1.2),
    "mass": (0.8, 0.9, 1.0, 1.1, 1.2),
    "floor_friction": (0.2, 0.4, 0.8, 1.2),
    "payload": (0.0, 1.0, 2.0, 5.0),
    "push": (0.0, 0.5, 1.0, 2.0),
}
"""Levels of each field that `stress` tries."""


@dataclass(frozen=True)
class Point:
    """Successes at one level."""

    level: float
    successes: int
    episodes: int

    @property
    def rate(self) -> float:
        """Share of successes."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the rate (Wilson)."""
        from mjlab.rl.evaluation import wilson_interval

        return wilson_interval(self.rate, self.episodes)


def stress(
    evidence: Evidence,
    episodes: int,
    seconds: float,
    levels: Mapping[str, tuple[float, ...]] = LEVELS,
    report: Callable[[str], None] = lambda text: None,
) -> dict[str, list[Point]]:
    """Return the successes at each level of each field of `Setting`.

    Levels of latency are rounded to physics steps, as they are simulated.

    Args:
        evidence: Evidence.
        episodes: Episodes at each level, with seeds from 0.
        seconds: Duration of an episode (s).
        levels: Levels by field.
        report: Called with a line about each level, and each noise that is left out.

    Raises:
        UserError: plain MuJoCo cannot supply the measurements, or the base is fixed.
    """
    _check_possible(evidence)
    for line in unknown_noises(evidence.contract):
        report(line)
    physics_dt = evidence.contract["rates"]["physics_dt"]
    curves: dict[str, list[Point]] = {}
    nominal: Point | None = None
    for name, values in levels.items():
        if name == "latency":
            steps = dict.fromkeys(_delay(level, physics_dt) for level in values)
            values = tuple(count * physics_dt for count in steps)
        for level in values:
            setting = replace(Setting(), **{name: level})
            if setting == Setting() and nominal is not None:
                point = replace(nominal, level=level)
            else:
                passed = [succeeds(evidence, setting, seed, seconds) for seed in range(episodes)]
                point = Point(level, sum(passed), episodes)
                nominal = point if setting == Setting() else nominal
            curves.setdefault(name, []).append(point)
            report(f"{name} {level:g} {UNITS[name]}: {point.successes} of {episodes}")
    return curves


def _check_possible(evidence: Evidence) -> None:
    traced = [
        one["name"] for one in evidence.contract["measurements"] if one["source"]["kind"] == "trace"
    ]
    if traced:
        raise UserError(
            "--stress: expected measurements that plain MuJoCo makes, got "
            f"{', '.join(traced)}; use a task that observes no scans or images."
        )
    if not evidence.contract["robot"]["is_floating"]:
        raise UserError(
            "--stress: expected a floating base, which may fall, got a fixed one; use `evaluate`."
        )
    if not evidence.has_physics:
        custom = [one["name"] for one in evidence.contract["actuators"] if one["law"] == "custom"]
        raise UserError(
            f"--stress: expected actuators whose laws `simulate.py` knows, got {', '.join(custom)}; "
            "use `evaluate`."
        )


def succeeds(evidence: Evidence, setting: Setting, seed: int, seconds: float) -> bool:
    """Return True if the robot does not fall in an episode."""
    # One generator each: the level of one thing does not change what another draws.
    noise, commands, pushes = np.random.default_rng(seed).spawn(3)
    contract, model = _changed(evidence, setting)
    runtime = evidence.originals.runtime
    policy = runtime.Policy.load(evidence.folder, limits=False)
    policy.kp, policy.kd = setting.gains * policy.kp, setting.gains * policy.kd
    _add_noise(evidence, policy, setting.noise, noise)
    simulation = evidence.originals.simulate.Simulation(contract, model)
    if any(one["kind"] == "motion" for one in contract["commands"]):
        starts = np.flatnonzero(evidence.first)
        start = int(starts[seed % len(starts)])
        simulation.set_state(**evidence.state(start))
        policy.reset(evidence.motion(start), simulation.measure())
    rates, data = contract["rates"], simulation.data
    delay = _delay(setting.latency, rates["physics_dt"])
    root = model.body(contract["robot"]["root_body"]).id
    held, waiting, step = policy.commanded(policy.default.copy()), [], 0
    command: dict[str, np.ndarray] = {}
    for k in range(round(seconds / policy.period)):
        if k % round(_COMMAND_S / policy.period) == 0:
            command = _drawn(contract, commands)
        if setting.push and k % round(_PUSH_S / policy.period) == round(1.0 / policy.period):
            push(model, data, root, setting.push, pushes.uniform(-math.pi, math.pi))
        waiting.append((step + delay, policy.step(simulation.measure(), command)))
        for _ in range(rates["decimation"]):
            while waiting and waiting[0][0] <= step:
                held = waiting.pop(0)[1]
            simulation.write_controls(held)
            mujoco.mj_step(model, data)
            step += 1
        mujoco.mj_forward(model, data)
        if has_fallen(contract, data.xpos[root, 2], data.xmat[root].reshape(3, 3)[2, 2]):
            return False
    return True


def has_fallen(contract: Mapping[str, Any], height: Any, upright: Any) -> Any:
    """Return True where a robot is too low or too tilted.

    Args:
        contract: Contract.
        height: Height of the root (m), a number or an array.
        upright: Vertical component of the root's z axis.
    """
    is_tilted = upright < math.cos(contract["limits"]["tilt"])
    return is_tilted | (height < _LOWEST * contract["robot"]["initial_height"])


def push(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, speed: float, heading: float
) -> None:
    """Change the velocity of a floating body by `speed` (m/s), horizontally along `heading` (rad)."""
    start = int(model.body_dofadr[body])
    data.qvel[start : start + 2] += speed * np.array((math.cos(heading), math.sin(heading)))
    mujoco.mj_forward(model, data)


def _delay(latency: float, physics_dt: float) -> int:
    """Return a latency in physics steps."""
    return round(latency / physics_dt)


def _drawn(contract: Mapping[str, Any], random: np.random.Generator) -> dict[str, np.ndarray]:
    """Return given commands drawn from their ranges; zero without a range."""
    commands = {}
    for one in contract["commands"]:
        if one["kind"] == "given":
            ranges = [component["range"] or (0.0, 0.0) for component in one["components"]]
            low, high = np.array(ranges or [(0.0, 0.0)] * one["size"]).T
            commands[one["name"]] = random.uniform(low, high)
    return commands


def _add_noise(evidence: Evidence, policy: Any, level: float, random: np.random.Generator) -> None:
    """Add the noise of training to the values of the terms, times `level`."""

    def noisy(formula: Callable, noise: Noise) -> Callable:
        return lambda inputs, term: noise(formula(inputs, term))

    for key, formula in policy.formulas.items():
        policy.formulas[key] = noisy(formula, Noise(evidence.terms[key]["noise"], level, random))


def _changed(evidence: Evidence, setting: Setting) -> tuple[dict[str, Any], mujoco.MjModel]:
    """Return contract and model with a setting."""
    contract, model = copy.deepcopy(evidence.contract), copy.copy(evidence.model)
    root = model.body(contract["robot"]["root_body"]).id
    robot = np.flatnonzero(model.body_rootid == model.body_rootid[root])
    model.body_mass[robot] *= setting.mass
    model.body_inertia[robot] *= setting.mass
    model.body_mass[root] += setting.payload
    for joint in contract["joints"]:
        dof = int(model.joint(joint["scene_name"]).dofadr[0])
        model.dof_frictionloss[dof] += setting.joint_friction
    if setting.floor_friction is not None:
        model.geom_friction[:, 0] = setting.floor_friction
    for k, actuator in enumerate(contract["actuators"]):
        if actuator["law"] == "position":
            model.actuator_gainprm[k, 0] *= setting.gains
            model.actuator_biasprm[k, 1:3] *= setting.gains
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return contract, model
