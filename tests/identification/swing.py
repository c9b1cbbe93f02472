"""A hinge with a link, driven by chirps: logs of known drives."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from mjlab.identification.limb import build_limb, hang
from mjlab.identification.log import JointLog
from mjlab.identification.plant import Plant

PERIOD, SECONDS = 0.004, 8.0
TRUE = np.array([0.01, 0.2, 0.4, 30.0, 1.0, 0.001, 0.0085])
"""Armature, damping, friction, kp, kd, phase, delay."""
NOISE = {"position": 5e-4, "velocity": 0.05, "torque": 0.1}


def link_spec(mass: float = 1.0, joints: int = 1) -> mujoco.MjSpec:
    """Return a chain of links of 0.2 m, each on a hinge."""
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for number in range(joints):
        body = body.add_body(name=f"link{number}", pos=(0, 0, -0.2 * (number > 0)))
        body.add_joint(name=f"hinge{number}", axis=(0, 1, 0))
        body.add_geom(size=(0.03, 0, 0), pos=(0, 0, -0.2), mass=mass)
    return spec


def chirp(seconds: float = SECONDS) -> np.ndarray:
    """Return targets (rad): half a second still, then 0.3 to 8 Hz, (T, 1)."""
    time = np.clip(np.arange(round(seconds / PERIOD)) * PERIOD - 0.5, 0.0, None)
    growth = np.log(8.0 / 0.3) / (seconds - 0.5)
    phase = 2 * np.pi * 0.3 * (np.exp(growth * time) - 1.0) / growth
    return 0.4 * np.sin(phase)[:, None]


def plant_of(spec: mujoco.MjSpec, target: np.ndarray, effort_limit: float = np.inf) -> Plant:
    """Return the plant of the first hinge, with a log of its targets only."""
    log = JointLog(PERIOD, ("hinge0",), target, np.zeros_like(target), None, None)
    return Plant(
        build_limb(hang(spec), log.joints, PERIOD), [log], [0], np.array([effort_limit]), 1
    )


def make_log(spec: mujoco.MjSpec, with_torque: bool, seed: int = 0) -> JointLog:
    """Return a noisy log of a hinge with the drive `TRUE`."""
    plant = plant_of(spec, chirp())
    response, rng = plant.simulate(TRUE[None])[0], np.random.default_rng(seed)
    noisy = {
        name: getattr(response, name)[0] + rng.normal(0.0, deviation, plant.logs[0].target.shape)
        for name, deviation in NOISE.items()
    }
    if not with_torque:
        noisy.pop("torque")
    return dataclasses.replace(plant.logs[0], **noisy)
