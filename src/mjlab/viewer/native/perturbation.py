"""Pushing bodies with the mouse."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.viewer.model_sync import to_numpy


class MousePush:
    """Turns the window's mouse force into `qfrc_applied` of one environment.

    Wrenches that tasks script stay in `xfrc_applied`, and generalised forces that a task wrote
    itself are added to, not replaced: they are put back when the push ends.
    """

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._env_idx: int | None = None
        self._base: np.ndarray | None = None
        self._written: np.ndarray | None = None

    @property
    def active(self) -> bool:
        """Whether a force of the mouse stands in an environment."""
        return self._env_idx is not None

    def apply(
        self, sim: Any, env_idx: int, data: mujoco.MjData, perturb: mujoco.MjvPerturb
    ) -> None:
        """Write the force of `perturb` for the next step; `data` holds the state it acts on."""
        if not perturb.active or perturb.select <= 0:
            self.release(sim)
            return
        force = self._generalised_force(data, perturb)
        self._take_base(sim, env_idx)
        assert self._base is not None
        self._write(sim, env_idx, self._base + force)

    def release(self, sim: Any) -> None:
        """Take the push back; what the environment itself applies stays."""
        if self._env_idx is None or self._base is None:
            return
        if self._is_ours(sim, self._env_idx):
            self._write(sim, self._env_idx, self._base)
        self._env_idx = self._base = self._written = None

    def _take_base(self, sim: Any, env_idx: int) -> None:
        if self._env_idx != env_idx:
            self.release(sim)
        # A reset or the task overwrote the row: what stands there now is the task's.
        if self._base is None or not self._is_ours(sim, env_idx):
            self._base = _row(sim, env_idx)
        self._env_idx = env_idx

    def _is_ours(self, sim: Any, env_idx: int) -> bool:
        return self._written is not None and np.array_equal(_row(sim, env_idx), self._written)

    def _write(self, sim: Any, env_idx: int, force: np.ndarray) -> None:
        rows = sim.data.qfrc_applied
        rows[env_idx] = torch.as_tensor(force, dtype=rows.dtype, device=rows.device)
        self._written = _row(sim, env_idx)

    def _generalised_force(self, data: mujoco.MjData, perturb: mujoco.MjvPerturb) -> np.ndarray:
        scripted = data.xfrc_applied.copy()
        data.xfrc_applied[:] = 0.0
        mujoco.mjv_applyPerturbForce(self._model, data, perturb)
        wrench = data.xfrc_applied[perturb.select].copy()
        data.xfrc_applied[:] = scripted
        force = np.zeros(self._model.nv)
        point = data.xipos[perturb.select].copy()
        mujoco.mj_applyFT(self._model, data, wrench[:3], wrench[3:], point, perturb.select, force)
        return force


def _row(sim: Any, env_idx: int) -> np.ndarray:
    return to_numpy(sim.data.qfrc_applied[env_idx]).copy()
