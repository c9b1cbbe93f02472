"""Torque of MuJoCo's DC motors against the equations of the motor, written here in numpy."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from mjlab.actuator import (
    BuiltinDcMotorActuatorCfg,
    DcMotorDatasheetParams,
    DcMotorInputMode,
)
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.sim import SimulationCfg
from mjlab.sim.simulation import Simulation

DATASHEET = DcMotorDatasheetParams(nominal_voltage=24.0, stall_torque=5.0, no_load_speed=30.0)
K, R = 24.0 / 30.0, 24.0 / 30.0 * 24.0 / 5.0  # K = V / w, R = K V / T.
POSITION, VELOCITY, VOLTAGE = (
    DcMotorInputMode.POSITION,
    DcMotorInputMode.VELOCITY,
    DcMotorInputMode.VOLTAGE,
)
STEP = 0.002

POS = np.array([0.3, -0.4, 0.0, 0.9])
VEL = np.array([0.7, -2.0, 25.0, -6.0])
TARGET = np.array([1.0, 0.2, -8.0, 12.0])

CASES: dict[str, dict[str, Any]] = {
    "voltage": {"mode": VOLTAGE},
    "voltage, limited": {"mode": VOLTAGE, "voltage_limit": 6.0},
    "voltage, slew": {"mode": VOLTAGE, "slew_rate": 500.0},
    "position": {"mode": POSITION, "stiffness": 2.0, "damping": 0.5, "voltage_limit": 1e6},
    "position, no damping": {"mode": POSITION, "stiffness": 2.0, "voltage_limit": 24.0},
    "position, limited": {"mode": POSITION, "stiffness": 12.0, "damping": 0.5, "voltage_limit": 9.0},
    "position, integral": {
        "mode": POSITION, "stiffness": 2.0, "damping": 0.5, "voltage_limit": 24.0,
        "integral_gain": 30.0, "integral_limit": 0.01,
    },
    "position, slew": {
        "mode": POSITION, "stiffness": 20.0, "voltage_limit": 24.0, "slew_rate": 100.0
    },
    "velocity": {"mode": VELOCITY, "stiffness": 5.0, "voltage_limit": 1e6},
    "velocity, limited": {"mode": VELOCITY, "stiffness": 5.0, "voltage_limit": 24.0},
    "velocity, damping": {
        "mode": VELOCITY, "stiffness": 5.0, "damping": 3.0, "voltage_limit": 24.0
    },
    "velocity, slew": {
        "mode": VELOCITY, "stiffness": 5.0, "voltage_limit": 24.0, "slew_rate": 100.0
    },
    "effort limit": {
        "mode": VELOCITY, "stiffness": 5.0, "voltage_limit": 24.0, "effort_limit": 2.0
    },
    "inductance": {
        "mode": VELOCITY, "stiffness": 5.0, "voltage_limit": 24.0, "inductance": 0.03
    },
    "thermal": {
        "mode": POSITION, "stiffness": 20.0, "damping": 0.5, "voltage_limit": 24.0,
        "thermal": (0.5, 0.02, 0.0, 0.004, 25.0, 20.0),
    },
    "cogging": {"mode": VOLTAGE, "cogging": (0.3, 6.0, 0.4), "effort_limit": 1.0},
    "position, gear": {
        "mode": POSITION, "stiffness": 2.0, "damping": 0.5, "voltage_limit": 24.0, "gear": 3.0
    },
    "velocity, gear": {"mode": VELOCITY, "stiffness": 5.0, "voltage_limit": 24.0, "gear": 3.0},
}  # fmt: skip


class Motor:
    """The equations of the motor, with what it remembers of earlier substeps."""

    def __init__(self, fields: dict[str, Any]) -> None:
        self.fields = fields
        self.integral = np.zeros(4)  # rad s
        self.command = np.zeros(4)
        self.current = np.zeros(4)  # A
        self.rise = np.zeros(4)  # temperature above ambient, K

    def torque(self, target: np.ndarray, pos: np.ndarray, vel: np.ndarray) -> np.ndarray:
        """Return the torque of the motor's shaft, and let STEP seconds pass.

        The target is one of the shaft; position and speed are those of the joint.
        """
        get = self.fields.get
        pos, vel = get("gear", 1.0) * pos, get("gear", 1.0) * vel
        u = target
        if rate := get("slew_rate"):
            u = self.command = np.clip(u, self.command - rate * STEP, self.command + rate * STEP)
        volts = u
        kp, limit = get("stiffness", 0.0), get("voltage_limit", np.inf)
        if self.fields["mode"] == POSITION:
            volts = kp * (u - pos) + get("integral_gain", 0.0) * self.integral
            volts = volts - get("damping", 0.0) * vel
        elif self.fields["mode"] == VELOCITY:
            volts = kp * (u - vel)
        volts = np.clip(volts, -limit, limit)
        bound = get("integral_limit", np.inf)
        self.integral = np.clip(self.integral + (u - pos) * STEP, -bound, bound)

        resistance = R
        if thermal := get("thermal"):
            to_air, capacity, _, coefficient, reference, ambient = thermal
            resistance = R * (1.0 + coefficient * (self.rise + ambient - reference))
        current = (volts - K * vel) / resistance
        if inductance := get("inductance"):
            # The exact solution over a substep of constant voltage and speed.
            decay = np.exp(-STEP * resistance / inductance)
            current = self.current = current + (self.current - current) * decay
        if thermal:
            heat = resistance * current**2 - self.rise / to_air
            self.rise = self.rise + heat / capacity * STEP
        torque = np.clip(K * current, -get("effort_limit", np.inf), get("effort_limit", np.inf))
        if cogging := get("cogging"):
            amplitude, poles, phase = cogging
            torque = torque + amplitude * np.sin(poles * pos + phase)
        return torque


@cache
def simulate(engine: str, steps: int = 3) -> dict[str, np.ndarray]:
    """Return torques of substeps from the same positions and speeds: one motor a case, four states.

    The motors are side by side in one model, (steps, 4) each.
    """
    bodies = "".join(
        f'<body><joint name="{k}" axis="0 1 0"/><geom size="0.05" mass="1" contype="0"/></body>'
        for k in range(len(CASES))
    )
    actuators = tuple(
        BuiltinDcMotorActuatorCfg(target_names_expr=(str(k),), motor_params=DATASHEET, **fields)
        for k, fields in enumerate(CASES.values())
    )
    entity, sim = build_motors(bodies, actuators, engine)
    torques = []
    for _ in range(steps):
        sim.data.qpos[:] = column(POS)
        sim.data.qvel[:] = column(VEL)
        for command in ("position", "velocity", "effort"):
            getattr(entity, f"set_joint_{command}_target")(column(TARGET).expand(-1, len(CASES)))
        entity.write_data_to_sim()
        sim.step()
        torques.append(sim.data.actuator_force.double().numpy().copy())
    return {case: np.stack(torques)[..., k] for k, case in enumerate(CASES)}


def build_motors(
    bodies: str, actuators: tuple[BuiltinDcMotorActuatorCfg, ...], engine: str
) -> tuple[Any, Simulation]:
    """Build four environments of one entity."""
    text = f"""<mujoco><option timestep="{STEP}" gravity="0 0 0"/>
    <worldbody><body name="base"><geom size="0.05"/>{bodies}</body></worldbody></mujoco>"""
    entity = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(text),
        articulation=EntityArticulationInfoCfg(actuators=actuators),
    ).build()
    model = entity.compile()
    model.opt.timestep, model.opt.gravity[:] = STEP, 0.0
    cfg = SimulationCfg(engine=engine)
    cfg.mujoco.timestep, cfg.mujoco.gravity = STEP, (0.0, 0.0, 0.0)
    sim = Simulation(4, cfg, model, device="cpu")
    entity.initialize(model, sim.model, sim.data, "cpu")
    _ = sim.data.actuator_force  # Read as zero until it has been bound once.
    return entity, sim


def column(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)[:, None]


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("case", CASES)
def test_torque_is_that_of_the_equations_of_the_motor(case: str, engine: str) -> None:
    motor = Motor(CASES[case])
    expected = [motor.torque(TARGET, POS, VEL) for _ in range(3)]
    np.testing.assert_allclose(simulate(engine)[case], expected, rtol=2e-5, atol=2e-5)


def test_velocity_mode_settles_where_the_torque_vanishes() -> None:
    cfg = BuiltinDcMotorActuatorCfg(
        target_names_expr=("hinge",), motor_params=DATASHEET, mode=VELOCITY, stiffness=5.0,
        voltage_limit=24.0,
    )  # fmt: skip
    body = '<body><joint name="hinge" axis="0 1 0"/><geom size="0.05" mass="1"/></body>'
    entity, sim = build_motors(body, (cfg,), "native")
    entity.set_joint_velocity_target(torch.full((4, 1), 3.0))
    for _ in range(50):
        entity.write_data_to_sim()
        sim.step()
    # kp (u - w) = K w.
    torch.testing.assert_close(sim.data.qvel, torch.full((4, 1), 3.0 * 5.0 / (5.0 + K)))
