"""Simulation of a limb with given drives, for many sets of parameters at once."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from mjlab.identification.log import JointLog

KINDS = ("armature", "damping", "friction", "kp", "kd")
"""Parameters of a joint: rotor inertia, viscous and dry friction, gains. The delay is the limb's."""
_INPUTS = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED
_START = 10
"""Rows that the initial position is averaged over."""


@dataclass(frozen=True)
class Response:
    """Simulated signals at the rows of a log, for N sets of parameters, (N, T, J)."""

    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray


class Plant:
    """A limb and its logs.

    The torque of a motor is `clamp(kp (u - q) - kd q', -E, E)`, with the target `u` of `delay` ago and
    the effort limit E. Parameters x, (P,): `KINDS` of the first group of joints, of the second, ...,
    `phase`, `delay`. Drives report torques for the target in effect at some time within a row: `phase`
    is that time, from the mean over a row (s).

    Args:
        model: Limb as of `build_limb`, with servos in the order of the logs' joints.
        logs: Logs of the limb's joints, each from rest.
        groups: Group of each joint, (J,).
        effort_limit: Effort limits E (N m or N), (J,); infinite if unlimited.
        num_threads: Threads of the simulation.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        logs: Sequence[JointLog],
        groups: Sequence[int],
        effort_limit: np.ndarray,
        num_threads: int,
    ) -> None:
        self.logs = logs
        self.groups = np.asarray(groups)
        self.size = len(KINDS) * (int(self.groups.max()) + 1) + 2
        self._effort_limit = effort_limit
        self._model = model
        self._substeps = round(logs[0].period / model.opt.timestep)
        self._dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        self._qpos = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        model.actuator_forcelimited[:] = np.isfinite(effort_limit)
        limit = np.where(np.isfinite(effort_limit), effort_limit, 0.0)
        model.actuator_forcerange[:] = np.stack([-limit, limit], axis=1)
        self._data = [mujoco.MjData(model) for _ in range(max(1, num_threads))]
        self._rollout = rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)

    def of_joints(self, x: np.ndarray) -> np.ndarray:
        """Return the parameters of each joint, (J, 5)."""
        return x[:-2].reshape(-1, len(KINDS))[self.groups]

    def servo_gains(self, delay: float) -> tuple[np.ndarray, float]:
        """Return the gains kp and kd, (J, 2), that explain the logged torques, and the squared error."""
        gains, cost = [], 0.0
        for joint, limit in enumerate(self._effort_limit):
            rows, torques = [], []
            for log in self.logs:
                assert log.torque is not None
                times = np.arange(len(log.target)) * log.period
                error = held_targets(log, times - delay)[:, joint] - log.position[:, joint]
                free = np.abs(log.torque[:, joint]) < 0.95 * limit
                rows.append(np.stack([error, -_velocity(log)[:, joint]], axis=1)[free])
                torques.append(log.torque[free, joint])
            matrix, torque = np.concatenate(rows), np.concatenate(torques)
            own = np.linalg.lstsq(matrix, torque, rcond=None)[0]
            gains.append(np.maximum(own, 1e-3 * np.abs(own).max()))
            cost += float(((matrix @ own - torque) ** 2).sum())
        return np.stack(gains), cost

    def simulate(self, x: np.ndarray, added: Sequence[np.ndarray] | None = None) -> list[Response]:
        """Return the response to the targets of each log.

        Args:
            x: Parameters, (N, P).
            added: Torques at the joints (N m or N), from outside the model, at the rows of each log,
                (T, J).
        """
        models = [self._with(parameters) for parameters in x]
        added = [np.zeros_like(log.target) for log in self.logs] if added is None else added
        return [
            self._simulate(models, x, log, torque)
            for log, torque in zip(self.logs, added, strict=True)
        ]

    def _with(self, x: np.ndarray) -> mujoco.MjModel:
        model = copy.copy(self._model)
        armature, damping, friction, kp, kd = self.of_joints(x).T
        model.dof_armature[self._dofs] = armature
        model.dof_damping[self._dofs] = damping
        model.dof_frictionloss[self._dofs] = friction
        model.actuator_gainprm[:, 0] = kp
        model.actuator_biasprm[:, 1] = -kp
        model.actuator_biasprm[:, 2] = -kd
        mujoco.mj_setConst(model, self._data[0])
        return model

    def _simulate(
        self, models: list[mujoco.MjModel], x: np.ndarray, log: JointLog, added: np.ndarray
    ) -> Response:
        num_rows, num_joints = log.target.shape
        steps = (num_rows - 1) * self._substeps
        times = np.arange(steps + 1) * self._model.opt.timestep
        # (N, T) averages of each target over each timestep: smooth in the delay.
        control = np.stack([mean_targets(log, times - delay) for delay in x[:, -1]])
        applied = np.zeros((len(x), steps, self._model.nv))
        applied[:, :, self._dofs] = np.repeat(added[:-1], self._substeps, axis=0)
        initial = self._initial_state(log)
        state, _ = self._rollout.rollout(
            models,
            self._data,
            initial,
            np.concatenate([control, applied], axis=2),
            control_spec=int(_INPUTS),
        )
        state = np.concatenate([np.broadcast_to(initial, (len(x), 1, initial.size)), state], axis=1)
        state = state[:, :: self._substeps]
        first = 1  # the state begins with the time
        position = state[:, :, first + self._qpos]
        velocity = state[:, :, first + self._model.nq + self._dofs]
        gains = np.stack([self.of_joints(parameters) for parameters in x])
        kp, kd = gains[:, None, :, 3], gains[:, None, :, 4]
        # (N, T, J) averages over a row: smooth in phase and delay.
        edges = (np.arange(num_rows + 1) - 0.5) * log.period
        sent = np.stack([mean_targets(log, edges - phase - delay) for phase, delay in x[:, -2:]])
        torque = kp * (sent - position) - kd * velocity
        return Response(
            position, velocity, np.clip(torque, -self._effort_limit, self._effort_limit)
        )

    def _initial_state(self, log: JointLog) -> np.ndarray:
        data = self._data[0]
        mujoco.mj_resetData(self._model, data)
        data.qpos[self._qpos] = log.position[:_START].mean(axis=0)
        state = np.empty(mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(self._model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return state


def _velocity(log: JointLog) -> np.ndarray:
    return np.gradient(log.position, log.period, axis=0) if log.velocity is None else log.velocity


def held_targets(log: JointLog, times: np.ndarray) -> np.ndarray:
    """Return the targets in effect at some times after the first row (s), (T, J)."""
    rows = np.floor(times / log.period + 1e-9).astype(int)
    return log.target[np.clip(rows, 0, len(log.target) - 1)]


def mean_targets(log: JointLog, times: np.ndarray) -> np.ndarray:
    """Return the targets, held from row to row, averaged over each interval of times, (T - 1, J)."""
    # Integral of the targets at the rows; linear between them.
    total = np.concatenate([np.zeros((1, log.target.shape[1])), np.cumsum(log.target, axis=0)])
    place = times / log.period
    before = np.minimum(place, 0.0)[:, None] * log.target[0]
    rows = np.arange(len(total))
    integral = np.stack([np.interp(place, rows, column) for column in total.T], axis=1) + before
    return np.diff(integral, axis=0) / np.diff(place)[:, None]
