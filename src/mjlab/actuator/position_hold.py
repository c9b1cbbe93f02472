"""Controls and activations after a reset: those that hold the current length, or of the keyframe."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.utils.indexing import EnvIds, read_columns, write_columns

_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT), _INTEGRATOR)
_POSITION_INPUT = int(mujoco.mjtCtrlInput.mjINPUT_POS)
# Kinds with a position input, and their default inputs.
_SERVOS = {
    int(mujoco.mjtGain.mjGAIN_PID): _POSITION_INPUT,
    int(mujoco.mjtGain.mjGAIN_DCMOTOR): 0,
}


class PositionHold:
    """Controls and activations u without force: g u + b0 + b1 l = 0 at the current length l.

    g is the gain, b0 and b1 are the bias of an actuator that pulls toward a position. Activations
    are those of all such actuators; controls, those without an actuator config. Controls that a
    keyframe sets are those of the keyframe instead.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        data: Any,
        actuator_ids: Sequence[int],
        unlisted: Collection[int],
        keyframe: np.ndarray | None,
        device: str,
    ) -> None:
        """Find the actuators among `actuator_ids`.

        Args:
            mj_model: Compiled model of the scene.
            data: Data fields of the simulation.
            actuator_ids: Actuators of the entity.
            unlisted: Those without a config.
            keyframe: Controls of all actuators, if the initial state is a keyframe's.
            device: Torch device.
        """
        m, found = mj_model, {"ctrl": [], "act": []}
        for i in actuator_ids:
            first = int(m.actuator_ctrladr[i])
            columns = range(first, first + int(m.actuator_ctrlnum[i]))
            from_keyframe = keyframe is not None and i in unlisted and keyframe[columns].any()
            if from_keyframe:
                output = int(m.actuator_outadr[i])
                found["ctrl"] += [(k, output, 0.0, float(keyframe[k])) for k in columns]
            gain, offset, slope = m.actuator_gainprm[i, 0], *m.actuator_biasprm[i, :2]
            kinds = m.actuator_gaintype[i], m.actuator_biastype[i]
            if kinds == (_FIXED, _AFFINE) and gain != 0.0 and slope != 0.0:
                held = int(m.actuator_outadr[i]), float(-slope / gain), float(-offset / gain)
            elif (m.actuator_ctrlspec[i] or _SERVOS.get(kinds[0], 0)) & _POSITION_INPUT:
                held = int(m.actuator_outadr[i]), float(kinds[0] in _SERVOS), 0.0
            else:
                continue
            if i in unlisted and not from_keyframe and m.actuator_dyntype[i] != _INTEGRATOR:
                found["ctrl"].append((first, *held))
            if kinds[0] == _FIXED and m.actuator_dyntype[i] in _FILTERS:
                last = int(m.actuator_actadr[i] + m.actuator_actnum[i] - 1)
                found["act"].append((last, *held))
        self._data = data
        self._held = {
            field: tuple(torch.tensor(values, device=device) for values in zip(*rows, strict=True))
            for field, rows in found.items()
            if rows
        }
        if self:
            # Engines compute a field after its first access.
            _ = data.actuator_length

    def __bool__(self) -> bool:
        return bool(self._held)

    def apply(self, env_ids: EnvIds = None) -> None:
        """Write the controls and activations that are 0. `actuator_length` must be current."""
        for field, (columns, outputs, slope, offset) in self._held.items():
            target = getattr(self._data, field)
            held = read_columns(self._data.actuator_length, outputs) * slope + offset
            value = read_columns(target, columns)
            value = torch.where(value == 0.0, held.to(value.dtype), value)
            write_columns(target, columns, value, env_ids)
